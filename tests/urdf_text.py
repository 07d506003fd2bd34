"""Bodies, joints, frames and loops of a URDF as text."""


def _numbers(values):
    return values if isinstance(values, str) else " ".join(repr(float(x)) for x in values)


def body(name, mass, com=(0, 0, 0), moments=(1, 1, 1)):
    xx, yy, zz = (float(x) for x in moments)
    return (
        f'<link name="{name}"><inertial><origin xyz="{_numbers(com)}"/><mass value="{mass}"/>'
        f'<inertia ixx="{xx!r}" iyy="{yy!r}" izz="{zz!r}" ixy="0" ixz="0" iyz="0"/></inertial>'
        "</link>\n"
    )


def joint(
    name, parent, child, at=(0, 0, 0), kind="continuous", axis=(0, 0, 1), limits=(), turn=(0, 0, 0)
):
    """Limits are lower, upper, and perhaps effort and velocity."""
    values = zip(("lower", "upper", "effort", "velocity"), (*limits, 1, 1), strict=False)
    limit = " ".join(f'{key}="{value}"' for key, value in values)
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="{_numbers(at)}" rpy="{_numbers(turn)}"/>'
        f'<parent link="{parent}"/><child link="{child}"/><axis xyz="{_numbers(axis)}"/>'
        f"{f'<limit {limit}/>' if limits else ''}</joint>\n"
    )


def frame(name, on, at):
    """A link without mass on another."""
    return f'<link name="{name}"/>' + joint(f"{name}_fixed", on, name, at, "fixed")


def loop(name, one, two, axis=(0, 0, 1)):
    return (
        f'<loop name="{name}" type="revolute"><predecessor link="{one}"/>'
        f'<successor link="{two}"/><axis xyz="{_numbers(axis)}"/></loop>\n'
    )


def write(folder, name, root, *parts):
    """Write a robot of parts on a link without mass; its path."""
    path = folder / f"{name}.urdf"
    path.write_text(f'<robot name="{name}"><link name="{root}"/>\n{"".join(parts)}</robot>\n')
    return path


def sliding_block(folder, mass=2.0, axis=(1, 0, 0), end=100):
    """Write a block that slides along x, the name of its joint; its path."""
    slide = joint("x", "base", "block", kind="prismatic", axis=axis, limits=(-end, end))
    return write(folder, "block", "base", body("block", mass), slide)
