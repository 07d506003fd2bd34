"""Springs, gas springs and ropes between two frames of an assembled machine."""

from collections.abc import Iterable, Iterator

import numpy as np
import pinocchio as pin

from crane.closure import Closure, frame_id
from crane.common.errors import DescriptionError
from crane.description import AnyForceElement, MachineSpec
from crane.description.findings import report_error
from crane.description.specification import element_name

_COINCIDENT_TOLERANCE = 1e-9  # [m] distance that is rounding: it has no direction


def check_frame_elements(spec: MachineSpec, closure: Closure) -> None:
    """Refuse elements whose frames make one body, or that have no direction at home.

    Raises:
        DescriptionError: With file and line of the section.
    """
    for section in ("forces", "gas_springs", "ropes"):
        for problem in frame_element_problems(closure, getattr(spec, section)):
            place = spec.source_locations.get(section, spec.path.name)
            report_error(DescriptionError(f"{place}: {problem}"), harmless=True)


def frame_element_problems(closure: Closure, items: Iterable[AnyForceElement]) -> Iterator[str]:
    """What is wrong with elements between frames that are there, in words.

    Where frames meet, their distance has no direction. Along a motion an element exerts nothing
    there; at home it is refused, unless it exerts nothing by its law either: a slack rope, a
    spring of no length.

    Args:
        closure: Of the machine.
        items: Its elements, of joints, too.
    """
    model, data = closure.model, None
    for item in items:
        if item.between is None:
            continue
        if data is None:
            data = model.createData()
            coordinates = closure.equations.coordinates
            pin.framesForwardKinematics(model, data, coordinates.configuration(closure.home))
        one, two = (frame_id(model, link) for link in item.between)
        if model.frames[one].parentJoint == model.frames[two].parentJoint:
            yield f"the {element_name(item)} is within one body, choose frames of two"
            continue
        vector = data.oMf[two].translation - data.oMf[one].translation
        if item.requires_direction and np.linalg.norm(vector) < _COINCIDENT_TOLERANCE:
            yield (
                f"the {element_name(item)} has no direction, its frames meet at home: choose "
                "others or another home"
            )
