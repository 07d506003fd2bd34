"""Motors that turn with several joints, as parts of a machine file."""

from typing import Any
from xml.sax.saxutils import escape

from crane.common.atomic_output import portable_file_name
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.mechanics.model_term import ForceDirection

_URDF_TEMPLATE = """<?xml version="1.0"?>
<!-- The rotor of the motor that turns with {words}: its angle is theirs on the joints' side. -->
<robot name="{name}">
  <link name="{name}_stator"/>
  <joint name="{name}" type="continuous">
    <parent link="{name}_stator"/>
    <child link="{name}_rotor"/>
    <axis xyz="0 0 1"/>
  </joint>
  <link name="{name}_rotor">
    <inertial>
      <mass value="1e-6"/>
      <inertia ixx="1e-12" ixy="0" ixz="0" iyy="1e-12" iyz="0" izz="1e-12"/>
    </inertial>
  </link>
</robot>
"""


def joint_combinations(model: IdentificationModel) -> list[ForceDirection]:
    """The directions of a model that several active joints make, each once."""
    found = {
        direction.name: direction
        for term in model.terms
        if (direction := getattr(term, "direction", None)) is not None and direction.factors
    }
    return list(found.values())


def motor_chain(
    direction: ForceDirection, parent: str
) -> tuple[dict[str, Any], dict[str, Any], str]:
    """A rotor that a coupling turns: its chain, the coupling, and its URDF.

    Its joint has the direction's name, and is where rotor inertia and friction are. Its link has a
    mass of a milligram, as a body wants one.
    """
    name = direction.name
    assert direction.factors is not None
    chain = {"name": name, "urdf": f"motor_{portable_file_name(name)}.urdf", "parent": parent}
    coupling_factors = {name: 1.0} | {
        joint: -factor for joint, factor in direction.factors.items()
    }
    text = _URDF_TEMPLATE.format(name=escape(name), words=escape(" and ".join(direction.factors)))
    return chain, {"name": name, "joints": coupling_factors}, text
