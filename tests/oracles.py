"""Independent results: closed forms on paper, and Pinocchio's constraint solver.

Closed forms of positions are written so that a complex step differentiates them: with
x + ih they give f(x) + ih f'(x) to rounding.
"""

import numpy as np
import pinocchio as pin

COMPLEX_STEP = 1e-30
GRAVITY = 9.81


# --- plane geometry that a complex step can pass through -------------------------------------


def angle(x, y):
    """atan2(y, x), its derivative (x dy - y dx) / r^2 in the imaginary part."""
    if np.isrealobj(x) and np.isrealobj(y):
        return np.arctan2(y, x)
    real = np.arctan2(np.real(y), np.real(x))
    turn = np.real(x) * np.imag(y) - np.real(y) * np.imag(x)
    return real + 1j * turn / (np.real(x) ** 2 + np.real(y) ** 2)


def at_angle(turn, length=1.0):
    return np.array([length * np.cos(turn), length * np.sin(turn)])


def turned(turn, point):
    c, s = np.cos(turn), np.sin(turn)
    return np.array([c * point[0] - s * point[1], s * point[0] + c * point[1]])


def circles(one, r1, two, r2, side):
    """Where two circles meet, on the left (+1) or right (-1) of the way from one to two."""
    way = two - one
    d2 = way[0] ** 2 + way[1] ** 2
    along = (d2 + r1**2 - r2**2) / (2 * d2)
    across = np.sqrt(r1**2 / d2 - along**2)
    return one + along * way + side * across * np.array([-way[1], way[0]])


# --- the mini forwarder ----------------------------------------------------------------------

PASSIVE = ("q2", "q3", "q4", "q6", "q7", "q9", "q10", "q11")
ALPHA10 = 0.0181
B, C = np.array([[-0.017], [0.017]]), np.array([[0.015], [0.087]])
D_IN_2, E_IN_2, F_IN_2 = (np.array(p) for p in ((0.042, 0.030), (0.050, 0.0), (0.072, 0.0)))
AP1 = AP2 = 0.0825
KM, STEM = 0.19, 2 * (0.0825 - (0.04 - 0.81 * 0.036) / 0.19)  # length of the rod


def mini_forwarder_points(x1, x2):
    """Pins (2, N) and absolute angles (N,) of all bodies, by circles that meet.

    Frames and lengths: facts of the machine, in the coordinates (x, z) at q1 = 0, for strokes
    (N,). Branch: D behind C, J above the boom, K above link 7.
    """
    at = {"B": B, "C": C}
    at["D"] = circles(B, AP1 + x1, C, np.hypot(*D_IN_2), 1)
    link2 = angle(*(at["D"] - C)) - np.arctan2(D_IN_2[1], D_IN_2[0])
    at["E"], at["F"] = C + turned(link2, E_IN_2), C + turned(link2, F_IN_2)
    at["G"] = circles(at["E"], AP2 + x2, C, 0.095, 1)
    boom = angle(*(at["G"] - C))
    at["H"], at["elbow"] = C + at_angle(boom, 0.195), C + at_angle(boom - ALPHA10, 0.22)
    at["J"] = circles(at["F"], 0.205, at["H"], 0.045, 1)
    at["K"] = circles(at["J"], 0.0431, at["elbow"], 0.0305, 1)
    turn = {"2": link2, "3": boom}
    for body, (start, end) in {"A1": "BD", "A2": "EG", "4": "FJ", "5": "HJ", "6": "JK"}.items():
        turn[body] = angle(*(at[end] - at[start]))
    turn["7"] = angle(*(at["K"] - at["elbow"])) - np.deg2rad(100.0)
    at["tip"] = at["elbow"] + at_angle(turn["7"], 0.222)
    return at, turn


def mini_forwarder(x1, x2):
    """Passive joints {name: (N,)} and the tip (2, N) for strokes (N,)."""
    at, turn = mini_forwarder_points(x1, x2)
    joints = {
        "q2": turn["3"],
        "q3": turn["3"] - ALPHA10 - turn["7"],  # clockwise, as q6 and q7
        "q4": turn["A1"],
        "q6": turn["2"] - np.pi / 4 - turn["4"],  # from D to F
        "q7": turn["4"] - turn["6"],
        "q9": turn["2"],
        "q10": turn["A2"] - turn["2"],
        "q11": turn["5"] - turn["3"],
    }
    return joints, at["tip"]


def by_stroke(function, x1, x2):
    """Derivatives of function(x1, x2) by both strokes, exact to rounding, (2, ...)."""
    h = 1j * COMPLEX_STEP
    values = (function(x1 + h, x2), function(x1, x2 + h))
    return np.array([np.imag(value) / COMPLEX_STEP for value in values])


def mini_forwarder_gamma(x1, x2):
    """Rows of gamma (N, 2) by [X1, X2] for all passive joints {name: (N, 2)}."""

    def joints(x1, x2):
        found, _ = mini_forwarder(x1, x2)
        return np.array([found[name] for name in PASSIVE])

    slopes = by_stroke(joints, x1, x2)
    return {name: slopes[:, i].T for i, name in enumerate(PASSIVE)}


def mini_forwarder_bodies(x1, x2):
    """Mass, COM (2, N), absolute angle and inertia about the COM of what moves in the plane."""
    at, turn = mini_forwarder_points(x1, x2)
    table = {  # pin, mass, COM, inertia zz
        "2": ("C", 0.1833, (0.0364, 0.0104), 0.0817e-3),
        "3": ("C", 0.2180, (0.1100, 0.0109), 0.419e-3),
        "4": ("F", 0.2010, (0.1025, 0.0), 0.814e-3),
        "5": ("H", 0.0280, (0.0225, 0.0), 0.0032e-3),
        "6": ("J", 0.0530, (0.0200, 0.0080), 0.0070e-3),
        "7": ("elbow", 0.2180, (0.1061, 0.00025), 0.640e-3),
    }
    bodies = [
        (mass, at[pin_] + turned(turn[body], com), turn[body], inertia)
        for body, (pin_, mass, com, inertia) in table.items()
    ]
    for body, eye in (("A1", "BD"), ("A2", "EG")):
        for mass, pin_, along, length in (
            ((1 - KM) * 0.034, eye[0], 0.036, 0.072),
            (KM * 0.034, eye[1], -STEM / 2, STEM),
        ):
            com = at[pin_] + at_angle(turn[body], along)
            bodies.append((mass, com, turn[body], mass * length**2 / 12))
    return bodies


def mini_forwarder_inertia(x1, x2):
    """M_A (N, 3, 3) for q_A = [q1, X1, X2], from bodies that are slender along x."""
    out = np.zeros((len(x1), 3, 3))
    out[:, 0, 0] = 0.0782e-3  # link 1
    here = mini_forwarder_bodies(x1, x2)
    h = 1j * COMPLEX_STEP
    moved = mini_forwarder_bodies(x1 + h, x2), mini_forwarder_bodies(x1, x2 + h)
    for (mass, com, turn, inertia), one, two in zip(here, *moved, strict=True):
        out[:, 0, 0] += mass * com[0].real ** 2 + inertia * np.cos(turn.real) ** 2
        speeds = [np.imag(body[1]) / COMPLEX_STEP for body in (one, two)]
        turns = [np.imag(body[2]) / COMPLEX_STEP for body in (one, two)]
        for i in range(2):
            for j in range(2):
                out[:, 1 + i, 1 + j] += mass * (speeds[i] * speeds[j]).sum(axis=0)
                out[:, 1 + i, 1 + j] += inertia * turns[i] * turns[j]
    return out


def mini_forwarder_potential(x1, x2):
    """V (N,) [J] of all bodies."""
    weight = sum(mass * com[1] for mass, com, _, _ in mini_forwarder_bodies(x1, x2))
    return GRAVITY * (0.3181 * 0.0032 + weight)


def mini_forwarder_force(q_a, v_a, a_a):
    """Inverse dynamics (3,) of one sample by Lagrange: d/dt (M v) - grad(v' M v) / 2 + V'."""

    def inertia(q):
        return mini_forwarder_inertia(q[1:2], q[2:3])[0]

    def moved(i):
        return lambda t: inertia(q_a + t * np.eye(3)[i])

    # a stroke bends the geometry over centimetres: truncation (step / 1 cm)^6 is below rounding
    slopes = [np.zeros((3, 3)), *(derivative(moved(i), 2e-5) for i in (1, 2))]
    rate = sum(slope * v for slope, v in zip(slopes, v_a, strict=True))
    gradient = np.array([v_a @ slope @ v_a for slope in slopes])
    weight = [0.0, *by_stroke(mini_forwarder_potential, q_a[1:2], q_a[2:3]).ravel()]
    return inertia(q_a) @ a_a + rate @ v_a - gradient / 2 + weight


# --- the slider-crank of data/slider_crank.yaml ----------------------------------------------


class SliderCrank:
    """Eccentric slider-crank in the vertical x-z plane, in closed form.

    Crank r from the origin at the angle theta above x, rod l at the absolute angle psi, slider
    at (s, e). T and V written out; M and its derivative give Lagrange's equation
    tau = M theta'' + M' theta'^2 / 2 + V'.
    """

    r, rod, e = 0.2, 0.3, 0.3
    crank_mass, crank_com, crank_iyy = 0.8, np.array([0.07, 0.01]), 0.004
    rod_mass, rod_com, rod_iyy = 0.5, np.array([0.16, -0.02]), 0.006
    slider_mass = 1.3

    def sine_cosine(self, theta):
        """Of the rod's angle psi; the rod points forward."""
        sine = (self.e - self.r * np.sin(theta)) / self.rod
        return sine, np.sqrt(1 - sine**2)

    def position(self, theta):
        """psi and s."""
        sine, cosine = self.sine_cosine(theta)
        return np.arcsin(sine), self.r * np.cos(theta) + self.rod * cosine

    def rates(self, theta):
        """dpsi/dtheta and ds/dtheta."""
        sine, cosine = self.sine_cosine(theta)
        turn = -self.r * np.cos(theta) / (self.rod * cosine)
        return turn, -self.r * np.sin(theta) - self.rod * sine * turn

    def second(self, theta):
        """d2psi/dtheta2 and d2s/dtheta2."""
        turn, slide = self.rates(theta + 1j * COMPLEX_STEP)
        return turn.imag / COMPLEX_STEP, slide.imag / COMPLEX_STEP

    def inertia(self, theta):
        """M(theta) [kg m2]."""
        turn, slide = self.rates(theta)
        sine, cosine = self.sine_cosine(theta)
        crank = self.crank_iyy + self.crank_mass * (self.crank_com**2).sum()
        x, z = self.rod_com
        com_x = -self.r * np.sin(theta) + turn * (-sine * x - cosine * z)
        com_z = self.r * np.cos(theta) + turn * (cosine * x - sine * z)
        rod = self.rod_iyy * turn**2 + self.rod_mass * (com_x**2 + com_z**2)
        return crank + rod + self.slider_mass * slide**2

    def potential(self, theta):
        """V(theta) [J]."""
        sine, cosine = self.sine_cosine(theta)
        x, z = self.crank_com
        crank = self.crank_mass * (np.sin(theta) * x + np.cos(theta) * z)
        x, z = self.rod_com
        rod = self.rod_mass * (self.r * np.sin(theta) + sine * x + cosine * z)
        return GRAVITY * (crank + rod + self.slider_mass * self.e)

    def torque(self, theta, rate, acceleration):
        """Inverse dynamics [N m]."""
        inertia = self.inertia(theta + 1j * COMPLEX_STEP)
        weight = self.potential(theta + 1j * COMPLEX_STEP).imag / COMPLEX_STEP
        return inertia.real * acceleration + inertia.imag / COMPLEX_STEP * rate**2 / 2 + weight


# --- the five-bar of data/five_bar.urdf ------------------------------------------------------


def five_bar_tips(a, b):
    """Tips (2,) of both cranks."""
    return at_angle(a + 1.4, 0.3), np.array([0.4, 0.0]) + at_angle(b + 1.9, 0.3)


def five_bar(a, b):
    """Passive angles c and d; the rods meet on the left of the way from tip a to tip b."""
    tip_a, tip_b = five_bar_tips(a, b)
    meeting = circles(tip_a, 0.25, tip_b, 0.25, 1)
    return angle(*(meeting - tip_a)) - a - 1.0, angle(*(meeting - tip_b)) - b - 2.2


# --- the Stewart platform of data/stewart.urdf -----------------------------------------------

BASE_POINTS = np.array(
    [
        [0.49, 0.10, 0.0],
        [-0.16, 0.47, 0.01],
        [-0.33, 0.38, 0.0],
        [-0.33, -0.37, -0.01],
        [-0.16, -0.48, 0.0],
        [0.50, -0.09, 0.0],
    ]
)
PLATFORM_POINTS = np.array(  # at rest, in the world
    [
        [0.19, 0.23, 0.60],
        [0.10, 0.28, 0.61],
        [-0.29, 0.05, 0.60],
        [-0.30, -0.06, 0.60],
        [0.11, -0.28, 0.59],
        [0.19, -0.22, 0.60],
    ]
)
REST_LENGTHS = np.linalg.norm(PLATFORM_POINTS - BASE_POINTS, axis=1)


def stewart_legs(rotation, position):
    """Legs (6, 3) from base to platform of a pose; the platform's frame is at its first point."""
    arms = PLATFORM_POINTS - PLATFORM_POINTS[0]
    return position + arms @ rotation.T - BASE_POINTS


def stewart_strokes(rotation, position):
    """Inverse kinematics: the strokes (6,) that put the platform at a pose."""
    return np.linalg.norm(stewart_legs(rotation, position), axis=1) - REST_LENGTHS


def stewart_rates(rotation, position):
    """(6, 6): stroke rates = this @ [v; w] of the platform's frame, along the world's axes."""
    legs = stewart_legs(rotation, position)
    along = legs / np.linalg.norm(legs, axis=1)[:, None]
    arms = (PLATFORM_POINTS - PLATFORM_POINTS[0]) @ rotation.T
    return np.hstack([along, np.cross(arms, along)])


# --- an arm of seven joints whose hand closes a loop with the base ---------------------------

LOCKED = {"fixed": 6, "revolute": 5, "prismatic": 5, "cylindrical": 4, "spherical": 3, "planar": 3}


def looped_arm(folder, kind, axis):
    """Write arm.yaml and arm.urdf: seven joints in general position, closed at zero by one loop.

    The first 7 - LOCKED[kind] joints are active, joint 4 slides. Returns the machine file.
    """
    random = np.random.default_rng(24)
    hand = pin.SE3.Identity()
    lines = ['<robot name="arm">', '  <link name="body0"/>']

    def hook(name, link, place):
        xyz = " ".join(repr(float(x)) for x in place.translation)
        rpy = " ".join(repr(float(x)) for x in pin.rpy.matrixToRpy(place.rotation))
        lines.append(
            f'  <link name="{name}"/><joint name="{name}_fixed" type="fixed">'
            f'<origin xyz="{xyz}" rpy="{rpy}"/><parent link="{link}"/><child link="{name}"/>'
            "</joint>"
        )

    for i in range(1, 8):
        xyz, rpy = random.uniform(-0.5, 0.5, 3), random.uniform(-1.5, 1.5, 3)
        hand = hand * pin.SE3(pin.rpy.rpyToMatrix(rpy), xyz)
        x, y, z = (repr(float(value)) for value in xyz)
        a, b, c = (repr(float(value)) for value in rpy)
        style = "prismatic" if i == 4 else "revolute"
        lines.append(
            f'  <joint name="j{i}" type="{style}"><origin xyz="{x} {y} {z}" rpy="{a} {b} {c}"/>'
            f'<parent link="body{i - 1}"/><child link="body{i}"/><axis xyz="0 0 1"/>'
            '<limit lower="-1" upper="1" effort="9" velocity="9"/></joint>'
            f'<link name="body{i}"><inertial><mass value="1"/><inertia ixx="0.01" ixy="0" ixz="0"'
            ' iyy="0.01" iyz="0" izz="0.01"/></inertial></link>'
        )
    grip = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.8, 1.1), np.array([0.1, -0.2, 0.15]))
    hook("grip", "body7", grip)
    hook("anchor", "body0", hand * grip)
    (folder / "arm.urdf").write_text("\n".join([*lines, "</robot>"]))
    active = ", ".join(f"j{i}" for i in range(1, 8 - LOCKED[kind]))
    path = folder / "arm.yaml"
    path.write_text(
        f"name: arm\nchains: [{{name: arm, urdf: arm.urdf}}]\nactive: [{active}]\nloops:\n"
        f"  - {{name: clasp, type: {kind}, predecessor: anchor, successor: grip, axis: {axis}}}\n"
    )
    return path


# --- Pinocchio's constraint dynamics ---------------------------------------------------------


def constraint_dynamics(machine, q, v, tau, mu=1e-4, iterations=100):
    """Accelerations (nv,) of the tree under joint forces tau (nv,), with multipliers.

    Loops become points that coincide: one for a spherical loop, two on the axis of a revolute
    one. In a plane machine most of these rows say the same; mu keeps them solvable.
    """
    model = machine.model
    constraints = pin.StdVec_RigidConstraintModel()
    for loop in machine.closure.equations.loops:
        one, two = (
            model.frames[machine.frame(name)] for name in (loop.predecessor, loop.successor)
        )
        reach = {"spherical": (0.0,), "revolute": (0.0, 0.2)}[loop.type]
        for along in reach:
            offset = pin.SE3(np.eye(3), along * np.array(loop.axis))
            constraints.append(
                pin.RigidConstraintModel(
                    pin.ContactType.CONTACT_3D,
                    model,
                    one.parentJoint,
                    one.placement * offset,
                    two.parentJoint,
                    two.placement * offset,
                    pin.ReferenceFrame.LOCAL,
                )
            )
    memory = pin.StdVec_RigidConstraintData()
    for constraint in constraints:
        memory.append(constraint.createData())
    data = model.createData()
    pin.initConstraintDynamics(model, data, constraints, memory)
    settings = pin.ProximalSettings(1e-12, mu, iterations)
    at = machine.coordinates.configuration(q)
    return pin.constraintDynamics(model, data, at, v, tau, constraints, memory, settings).copy()


# --- differences -----------------------------------------------------------------------------


def derivative(function, step):
    """d/dt function(t) at 0 by central differences of eighth order."""
    weights = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}
    return (
        sum(weight * (function(k * step) - function(-k * step)) for k, weight in weights.items())
        / step
    )


# --- random spatial mechanisms ---------------------------------------------------------------

REACH = 0.1  # [rad], half of it [m]: limits of every joint of a random mechanism


def random_mechanism(folder, seed, kind):
    """Write a mechanism of random joints with one loop of a kind, closed at zero; its path.

    Two branches of joints grow from random bodies and meet in the loop. Which joints are active
    is drawn too, so a draw may be one that cannot be driven.
    """
    random = np.random.default_rng(seed)
    rows = LOCKED[kind]
    count = rows + int(random.integers(1, 3 if rows == 6 else 4))
    split = int(random.integers(1, count))  # joints of the first branch
    foot = int(random.integers(0, split))  # body that carries the second branch
    active = random.permutation(count)[: count - rows] + 1
    places = [pin.SE3.Identity()]  # of the bodies in the world, at zero
    lines = [f'<robot name="random{seed}">', '  <link name="body0"/>']

    def numbers(values):
        return " ".join(repr(float(value)) for value in values)

    def origin(place):
        return (
            f'<origin xyz="{numbers(place.translation)}" '
            f'rpy="{numbers(pin.rpy.matrixToRpy(place.rotation))}"/>'
        )

    def anywhere(size):
        turn = pin.rpy.rpyToMatrix(*random.uniform(-1.5, 1.5, 3))
        return pin.SE3(turn, random.uniform(-size, size, 3))

    for i in range(1, count + 1):
        parent = foot if i == split + 1 else i - 1
        step = pin.SE3.Identity() if random.random() < 0.15 else anywhere(0.4)
        places.append(places[parent] * step)
        axis = random.normal(size=3)
        if random.random() < 0.4:  # along a direction of the frame, either way
            axis = random.choice([-1.0, 1.0]) * np.eye(3)[random.integers(3)]
        slides = random.random() < 0.3
        reach = REACH / 2 if slides else REACH
        mass, extent = random.uniform(0.2, 3.0), random.uniform(0.02, 0.2, 3) ** 2
        turn = pin.rpy.rpyToMatrix(*random.uniform(-3, 3, 3))
        inertia = turn @ np.diag(mass * (extent.sum() - extent)) @ turn.T
        moments = dict(zip(("ixx", "ixy", "ixz"), inertia[0], strict=True))
        moments |= {"iyy": inertia[1, 1], "iyz": inertia[1, 2], "izz": inertia[2, 2]}
        tensor = " ".join(f'{key}="{float(value)!r}"' for key, value in moments.items())
        lines.append(
            f'  <joint name="j{i}" type="{"prismatic" if slides else "revolute"}" '
            f'independent="{str(i in active).lower()}">{origin(step)}'
            f'<parent link="body{parent}"/><child link="body{i}"/>'
            f'<axis xyz="{numbers(axis / np.linalg.norm(axis))}"/>'
            f'<limit lower="{-reach}" upper="{reach}" effort="9" velocity="9"/></joint>\n'
            f'  <link name="body{i}"><inertial><origin xyz="'
            f'{numbers(random.uniform(-0.2, 0.2, 3))}"/><mass value="{float(mass)!r}"/>'
            f"<inertia {tensor}/></inertial></link>"
        )
    clasp = places[count] * anywhere(0.3)
    axis = random.normal(size=3)
    axis /= np.linalg.norm(axis)
    # from the end of one branch to the end of the other
    ends = [(body, places[body].inverse() * clasp) for body in (split, count)]
    path = folder / f"random{seed}.urdf"
    if kind == "cylindrical":  # which URDF+ does not have
        for end, (body, place) in zip(("one", "two"), ends, strict=True):
            lines.append(
                f'  <link name="{end}"/><joint name="at_{end}" type="fixed">{origin(place)}'
                f'<parent link="body{body}"/><child link="{end}"/></joint>'
            )
        whole = folder / f"random{seed}.yaml"
        whole.write_text(
            f"name: random{seed}\nchains: [{{name: all, urdf: {path.name}}}]\n"
            f"active: [{', '.join(f'j{i}' for i in sorted(active))}]\nloops:\n"
            "  - {name: clasp, type: cylindrical, predecessor: one, successor: two, "
            f"axis: [{', '.join(repr(float(x)) for x in axis)}]}}\n"
        )
        lines = [line.replace('independent="true"', "") for line in lines]
        lines = [line.replace('independent="false"', "") for line in lines]
    else:
        one, two = (
            f'<{end} link="body{body}">{origin(place)}</{end}>'
            for end, (body, place) in zip(("predecessor", "successor"), ends, strict=True)
        )
        lines.append(
            f'  <loop name="clasp" type="{kind}">{one}{two}<axis xyz="{numbers(axis)}"/></loop>'
        )
        whole = path
    path.write_text("\n".join([*lines, "</robot>", ""]))
    return whole
