"""Exudyn: bodies and joints by its functions `Create...`, the loop as one of the joints."""

import exudyn
import numpy as np
from exudyn.utilities import RigidBodyInertia

container = exudyn.SystemContainer()
mbs = container.AddSystem()
ground = mbs.CreateGround()
rows = [  # mass, inertia, centre of mass in the world
    (2.0, 0.02, [0.1, 0, -0.15]),
    (4.0, 0.2, [0.55, 0, -0.4]),
    (3.0, 0.07, [0.85, 0, -0.25]),
]
crank, coupler, rocker = (
    mbs.CreateRigidBody(
        referencePosition=centre, inertia=RigidBodyInertia(mass, inertia * np.eye(3)),
        gravity=[0, 0, -9.81],
    )
    for mass, inertia, centre in rows
)  # fmt: skip
for bodies, point in (
    ([ground, crank], [0, 0, 0]),
    ([crank, coupler], [0.2, 0, -0.3]),
    ([ground, rocker], [0.8, 0, 0]),
):
    mbs.CreateRevoluteJoint(
        itemNumbers=bodies, position=point, axis=[0, 1, 0], useGlobalFrame=True
    )
# in the plane of the others: their other equations are redundant
mbs.CreateGenericJoint(
    itemNumbers=[coupler, rocker], position=[0.9, 0, -0.5], constrainedAxes=[1, 0, 1, 0, 0, 0],
    useGlobalFrame=True,
)  # fmt: skip
mbs.Assemble()
settings = exudyn.SimulationSettings()
settings.timeIntegration.endTime = 1
settings.timeIntegration.numberOfSteps = 1000
settings.timeIntegration.verboseMode = 0
settings.solution.file.write = False
settings.linearSolver.solverType = exudyn.LinearSolverType.EigenSparse
mbs.SolveDynamic(settings)
print(*mbs.GetObjectOutputBody(rocker, exudyn.OutputVariableType.Position, [0.05, 0, -0.25]))
