"""Motion in time: Runge-Kutta, Radau and Rosenbrock methods in machine code, and scipy's.

Each integrates in one chart (`charts`); `ChartSwitchingIntegrator` goes from one to the next.
"""
