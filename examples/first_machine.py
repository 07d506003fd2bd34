"""How do I describe my first machine, a planar slider-crank?"""

from pathlib import Path

import numpy as np

import crane

R, L = 0.05, 0.2  # crank and connecting rod [m]

# z is up: a link along x rises with positive angles about the axis 0 -1 0
Path("crank.urdf").write_text(f"""<robot name="crank">
  <link name="block"/>
  <joint name="crank" type="continuous">
    <parent link="block"/><child link="crankshaft"/><axis xyz="0 -1 0"/>
  </joint>
  <link name="crankshaft"><inertial><mass value="5"/>
    <inertia ixx="0.01" iyy="0.02" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="crank_pin" type="continuous"><origin xyz="{R} 0 0"/>
    <parent link="crankshaft"/><child link="rod"/><axis xyz="0 -1 0"/>
  </joint>
  <link name="rod"><inertial><origin xyz="{L / 2} 0 0"/><mass value="0.6"/>
    <inertia ixx="0" iyy="0.002" izz="0.002" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="eye" type="fixed"><origin xyz="{L} 0 0"/>
    <parent link="rod"/><child link="rod_eye"/></joint>
  <link name="rod_eye"/>
</robot>""")
Path("piston.urdf").write_text("""<robot name="piston">
  <link name="bore"/>
  <joint name="stroke" type="prismatic">
    <parent link="bore"/><child link="piston"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="1" effort="0" velocity="0"/>
  </joint>
  <link name="piston"><inertial><mass value="0.4"/>
    <inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
</robot>""")
Path("engine.yaml").write_text(f"""name: engine
chains:
  - {{name: crank, urdf: crank.urdf}}
  - {{name: piston, urdf: piston.urdf, parent: block}}
loops:
  - {{name: wrist, type: revolute, predecessor: rod_eye, successor: piston, axis: [0, 1, 0]}}
active: [crank]
home: {{crank: 0, crank_pin: 0, stroke: {R + L}}}
""")

machine = crane.load("engine.yaml")
angle = np.linspace(0.0, 2 * np.pi, 361)[:, None]  # of the crank [rad]
q = machine.closure.solve(angle)
stroke = q[:, machine.column("stroke")]
rate = machine.closure.gamma(q)[:, machine.column("stroke"), 0]  # d stroke / d crank [m/rad]
most = np.abs(rate).max()
print(f"the piston travels {1e3 * np.ptp(stroke):.1f} mm")
print(f"at 3000 rpm it is {most * 3000 * 2 * np.pi / 60:.2f} m/s fast at most")

known = R * np.cos(angle[:, 0]) + np.sqrt(L**2 - (R * np.sin(angle[:, 0])) ** 2)
assert np.abs(stroke - known).max() < 1e-13
