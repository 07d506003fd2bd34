"""The section of a machine file on what an identification estimates, `identification`."""

import math
from typing import Any

from crane.common.errors import InputError
from crane.description.estimation import Estimation, Known, Numbers
from crane.description.findings import recoverable
from crane.formats.machine_file.section import Section, as_float, as_truth
from crane.machine import Machine

_TERMS = "on, off, a number or a list of numbers"


def read_estimation(top: Section) -> Estimation:
    """Terms, prior and settings; that their names exist is for the identification to see."""
    section = top.section("identification", "'identification'")
    if section is None:
        return Estimation()
    section.only("terms", "prior", "bandwidth", "slow")
    terms: dict[str, Numbers | None] = {}
    inner = section.section("terms", "'terms'")
    for name in inner or ():
        assert inner is not None
        with recoverable():
            terms[name] = _numbers(inner, name)
    known: dict[str, Known] = {}
    inner = section.section("prior", "'prior'")
    for name in inner or ():
        assert inner is not None
        with recoverable():
            known[name] = _known(inner, name)
    inner = section.section("slow", "'slow'")
    slow = {name: inner.number(name, minimum=0.0) for name in inner or () if inner is not None}
    bandwidth = None
    if "bandwidth" in section:
        bandwidth = section.number("bandwidth", minimum=0.0)
        if bandwidth == 0:
            raise section.fail("bandwidth", "'bandwidth' is 0, give one in Hz")
    return Estimation(terms, known, bandwidth, slow)


def estimation_data(machine: Machine) -> dict[str, Any]:
    """The section as it is written."""
    given = machine.estimation
    terms = {name: _written(numbers) for name, numbers in given.terms.items()}
    prior = {name: str(known) for name, known in given.prior.items()}
    data = {"terms": terms, "prior": prior, "bandwidth": given.bandwidth, "slow": dict(given.slow)}
    return {key: value for key, value in data.items() if value}


def _numbers(section: Section, name: str) -> Numbers | None:
    """() of `on`, None of `off`."""
    value = section.raw(name)
    if (wanted := as_truth(value)) is not None:
        return () if wanted else None
    if isinstance(value, str) and not math.isfinite(as_float(value)):
        what = f"'{name}' of {section.title} is '{value}'"
        raise section.fail(name, f"{what}, give {_TERMS}")
    return section.numbers(name) if isinstance(value, list) else (section.number(name),)


def _known(section: Section, name: str) -> Known:
    try:
        return Known.read(section.raw(name))
    except InputError as error:
        raise section.fail(name, f"'{name}' of 'prior': {error}") from None


def _written(numbers: Numbers | None) -> bool | float | list[float]:
    if not numbers:
        return numbers is not None
    return numbers[0] if len(numbers) == 1 else list(numbers)
