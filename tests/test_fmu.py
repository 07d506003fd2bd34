"""Machines as FMUs, judged by FMPy, and controllers as FMUs of other programs."""

import ctypes
import os
import shutil
import subprocess
import sys
import zipfile
from functools import partial

import numpy as np
import pytest
import singular_linkages
from command_line import typed
from warned import quiet, told

import crane
from crane.common.errors import InputError, SimulationError
from crane.control import FmuController, SampledCommand, ValveSignals, interpolate_references
from crane.export import fmu_libraries, write_fmu
from crane.export.fmu_variables import base_unit
from crane.machine.payload import Payload

fmpy = pytest.importorskip("fmpy", reason="FMPy is not here")
validate_fmu = pytest.importorskip("fmpy.validation").validate_fmu
COMPILER = shutil.which("gcc") or shutil.which("clang")
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O1", "-shared")
STEP = 0.01
DELAYS = {"valve.X_lift.delay": 0.0437, "valve.X_ext.delay": 0.02}
needs_compiler = pytest.mark.skipif(not COMPILER, reason="no C compiler is here")


@pytest.fixture(scope="module")
def fmus(tmp_path_factory):
    """FMUs of a machine with forces and of one with valves, by this computer's compiler."""
    folder = tmp_path_factory.mktemp("fmus")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fmu_libraries, "find_spec", lambda name: None)
        patch.setenv("CC", COMPILER)
        patch.setattr(fmu_libraries, "_FLAGS", STRICT)
        forwarder = crane.load("mini_forwarder")
        law = crane.control.make_controller("pi", forwarder)
        for name, machine, fmi, controller in (
            ("mini_forwarder", forwarder, 2, None),
            ("patu655", "patu655", 3, None),
            ("controlled", forwarder, 2, law),
            ("delayed", crane.load("patu655", DELAYS), 3, None),
            ("slider", singular_linkages.slider_crank(folder, "s", 0.3, 0.6), 3, None),
        ):
            path = folder / f"{name}.fmu"
            _, lines = told(write_fmu, machine, path, fmi, controller=controller)
            warned = any("the FMU has co-simulation, and no model exchange" in x for x in lines)
            assert warned == (name == "delayed")
    return folder


class Instance:
    """An instance of an FMU of FMI 2 or 3, by the names of its variables."""

    def __init__(self, path, log=None, co_simulation=True, time=0.0, **start):
        self.description = d = fmpy.read_model_description(str(path))
        self.folder = fmpy.extract(str(path))
        kind = "Slave" if co_simulation else "Model"
        self.is_fmi3 = d.fmiVersion == "3.0"
        module = fmpy.fmi3 if self.is_fmi3 else fmpy.fmi2
        self.fmu = getattr(module, f"FMU{d.fmiVersion[0]}{kind}")(
            guid=d.guid,
            unzipDirectory=self.folder,
            modelIdentifier=d.coSimulation.modelIdentifier,
        )
        self.log = [] if log is None else log
        self.fmu.instantiate(**self._logger())
        self.references = {x.name: x.valueReference for x in d.modelVariables}
        self.states = [x.variable.derivative.name for x in d.derivatives]
        self.set(**start)
        if not self.is_fmi3:
            self.fmu.setupExperiment(startTime=time)
        self.fmu.enterInitializationMode(**({"startTime": time} if self.is_fmi3 else {}))
        self.fmu.exitInitializationMode()
        self.time = time

    def _logger(self):
        if self.is_fmi3:
            return {
                "logMessage": lambda environment, status, category, text: self.log.append(text)
            }
        logger = fmpy.fmi2.fmi2CallbackLoggerTYPE(lambda *values: self.log.append(values[4]))
        self._callbacks = fmpy.fmi2.fmi2CallbackFunctions()
        self._callbacks.logger = logger
        return {"callbacks": self._callbacks}

    def set(self, **values):
        references = [self.references[name.replace("__", ".")] for name in values]
        method = self.fmu.setFloat64 if self.is_fmi3 else self.fmu.setReal
        method(references, [*map(float, values.values())])

    def get(self, *names):
        method = self.fmu.getFloat64 if self.is_fmi3 else self.fmu.getReal
        return np.array(method([self.references[x] for x in names]))

    def step(self, length=STEP):
        self.fmu.doStep(self.time, length)
        self.time += length

    def rates(self, states):
        array = ctypes.c_double * len(states)
        found = array()
        self.fmu.setContinuousStates(array(*states), len(states))
        derivatives = "getContinuousStateDerivatives" if self.is_fmi3 else "getDerivatives"
        getattr(self.fmu, derivatives)(found, len(states))
        return np.array(found)


def coordinates(machine):
    return [f"{x}.{'stroke' if machine.unit(x) == 'm' else 'angle'}" for x in machine.active]


def signals(machine, times):
    """Signals that open and reverse all valves, one after another."""
    spools = machine.hydraulics.spools
    return {
        name: spool.neutral
        + 0.25 * (spool.full - spool.neutral) * np.sin(3 * times + i) * (times > 0.1)
        for i, (name, spool) in enumerate(spools.items())
    }


def held_signals(machine, times):
    """`signals` at the samples, and the motion where each is held until the next one."""
    moved = signals(machine, times)
    table = np.column_stack([*moved.values()])
    command = SampledCommand(lambda t, *motion: table[round(t / STEP)], machine, STEP)
    return moved, quiet(crane.simulate, machine, command, duration=times[-1], step=STEP)


def largest_difference(machine, instances, moved, expected):
    """Of the active coordinates of instances that run side by side, over the samples."""
    table, worst = np.column_stack([*moved.values()]), 0.0
    for row, q_a in zip(table, expected.q[1:], strict=False):
        for instance in instances:
            instance.set(**dict(zip((f"{x}__signal" for x in moved), row, strict=True)))
            instance.step()
            found = instance.get(*coordinates(machine))
            worst = max(worst, np.abs(found - q_a).max())
    return worst


class Constant(crane.control.ControlLaw):
    """Constant forces."""

    def __init__(self, machine, forces):
        super().__init__(machine)
        self.settings = np.array(forces)

    def law(self, inputs):
        return list(inputs.settings), ()


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("name", ["mini_forwarder", "patu655"])
def test_files_are_valid(fmus, name):
    path = fmus / f"{name}.fmu"
    assert validate_fmu(str(path)) == []
    found = fmpy.read_model_description(str(path))
    assert found.modelExchange and found.coSimulation
    assert {x.name for x in found.modelVariables} >= {"tip.position_x", "payload.mass", "kinetic"}
    outputs = {x.variable.name: x.dependencies for x in found.outputs}
    stroke = "X1.stroke" if name == "mini_forwarder" else "X_lift.stroke"
    assert [x.name for x in outputs[stroke]] == [stroke]  # of itself alone: no algebraic loop
    units = {x.name: x.unit for x in found.modelVariables}
    if name == "patu655":  # a motor and a cylinder
        wanted = {"slew.area_a": "m3/rad", "slew.stroke": "rad", "X_lift.area_a": "m2"}
        wanted |= {"X_lift.stroke_": "m", "X_lift.per_stroke": None, "common_hose": None}
        assert {x: units[x] for x in wanted} == wanted
    sources = os.path.join(fmpy.extract(str(path)), "sources")
    for compiler in filter(shutil.which, ("gcc", "clang")):
        command = [compiler, *STRICT[:-2], "-fsyntax-only", "fmu.c"]
        subprocess.run(command, cwd=sources, check=True, timeout=60)
    members = zipfile.ZipFile(path).namelist()
    assert {"sources/fmu.c", "documentation/index.html", "modelDescription.xml"} <= {*members}


@needs_compiler
@pytest.mark.slow
def test_co_simulation_of_eight_instances_is_that_of_simulate(fmus):
    machine, times = crane.load("patu655"), STEP * np.arange(101)
    moved, expected = held_signals(machine, times)
    instances = [Instance(fmus / "patu655.fmu") for _ in range(8)]
    assert largest_difference(machine, instances, moved, expected) < 1e-12  # [m], [rad]
    found = np.array([x.get(*coordinates(machine)) for x in instances])
    assert np.array_equal(found, np.tile(found[0], (8, 1)))


@needs_compiler
@pytest.mark.slow
def test_dead_times_are_those_of_simulate(fmus):
    """Of signals that are held: at any start time, and as parameters of another FMU."""
    path, machine = fmus / "delayed.fmu", crane.load("patu655", DELAYS)
    assert validate_fmu(str(path)) == []
    moved, expected = held_signals(machine, STEP * np.arange(101))
    instances = [Instance(path, time=0.25), Instance(path)]
    assert largest_difference(machine, instances, moved, expected) < 1e-12
    moved, expected = held_signals(crane.load("patu655"), STEP * np.arange(51))
    changed = Instance(path, X_lift__delay=0.0, X_ext__delay=0.0)
    assert largest_difference(machine, [changed], moved, expected) < 1e-12


@needs_compiler
@pytest.mark.slow
def test_model_exchange_is_refused_where_valves_have_dead_times(fmus):
    assert fmpy.read_model_description(str(fmus / "delayed.fmu")).modelExchange is None
    log, failure = [], fmpy.fmi1.FMICallException
    with pytest.raises(Exception, match="nstantiate"):
        Instance(fmus / "delayed.fmu", log, co_simulation=False)
    assert log == [b"valves have dead times, which model exchange has not: take co-simulation"]
    with pytest.raises(failure):
        Instance(fmus / "delayed.fmu", log, X_lift__delay=-1.0)
    assert b"X_lift.delay is -1, give it at least 0" in log[-1]
    instance = Instance(fmus / "delayed.fmu", log)
    with pytest.raises(failure):
        for _ in range(100):
            instance.step(1e-4)
    assert b"the dead time of a valve takes more calls than are kept" in log[-1]


@needs_compiler
@pytest.mark.slow
def test_a_dead_centre_ends_a_step_with_a_message(fmus):
    """A slider that its drive pushes out; it is then where it was before the step."""
    path, log, failure = fmus / "slider.fmu", [], fmpy.fmi1.FMICallException
    instance = Instance(path, log, s__force=40.0)
    with pytest.raises(failure):
        for _ in range(500):
            before = instance.get("s.stroke", "s.rate")
            instance.step(1e-3)
    assert b"a dead centre: the active joints do not determine the motion" in log[-1]
    assert np.array_equal(instance.get("s.stroke", "s.rate"), before)
    assert 0.85 < before[0] < 0.9
    instance = Instance(path, log, co_simulation=False, s__force=40.0)
    states = instance.get(*instance.states)
    log.clear()
    with pytest.raises(failure):
        for _ in range(200):
            instance.rates(states)
            instance.fmu.completedIntegratorStep()
            states[0] += 1e-3
    assert b"a dead centre: the active joints do not determine the motion" in log[-1]
    assert 0.89 < states[0] < 0.9


@needs_compiler
@pytest.mark.slow
def test_references_with_slopes_are_those_of_a_trajectory(fmus):
    """PI through a task, whose references are linear between samples, with other gains."""
    machine = crane.load("mini_forwarder")
    reference = crane.task_trajectory(machine, "lift")
    gains = machine.control | {"X1": crane.description.PIGains(2e4, 1e4)}
    law, times = crane.PI(machine, reference, gains), STEP * np.arange(201)
    rows, start = law.references(times), reference.position(0.0)
    sampled = interpolate_references(law, times, rows)
    expected = quiet(
        crane.simulate, machine, sampled, initial=start, duration=times[-1], step=STEP
    )
    names = [f"{x}.reference" for x in machine.active]
    given = dict(zip(coordinates(machine), start, strict=True))
    given |= dict(zip(names, rows[0], strict=True)) | {"X1.kp": 2e4, "X1.ki": 1e4}
    instances = [
        Instance(fmus / "controlled.fmu", **{x.replace(".", "__"): y for x, y in given.items()})
        for _ in range(2)
    ]
    worst = 0.0
    for i, q_a in enumerate(expected.q[1:]):
        for instance in instances:
            references = [instance.references[x] for x in names]
            instance.fmu.setReal(references, [*rows[i]])
            slopes = (rows[i + 1] - rows[i]) / STEP
            instance.fmu.setRealInputDerivatives(references, [1] * len(names), [*slopes])
            instance.step()
            found = instance.get(*coordinates(machine))
            worst = max(worst, np.abs(found - q_a).max())
    assert worst < 1e-12
    assert np.ptp(expected.q, axis=0).max() > 1e-3
    assert "X1.error_integral" in instance.states
    log = []
    instance = Instance(fmus / "controlled.fmu", log)
    force, reference = instance.references["X1.force"], instance.references["X1.reference"]
    for where, order, slope in ((force, 1, 0.0), (reference, 2, 0.0), (reference, 1, np.nan)):
        with pytest.raises(fmpy.fmi1.FMICallException):
            instance.fmu.setRealInputDerivatives([where], [order], [slope])
        assert log.pop() == b"give finite first derivatives, of inputs"


@needs_compiler
@pytest.mark.slow
def test_forces_in_co_simulation_are_those_of_simulate(fmus, tmp_path):
    machine = crane.load("mini_forwarder")
    forces = 1.02 * crane.Dynamics(machine).gravity(machine.home[machine.closure.active])
    expected = quiet(crane.simulate, machine, Constant(machine, forces), duration=0.5, step=STEP)
    instance = Instance(fmus / "mini_forwarder.fmu")
    names = [f"{x}.force" for x in machine.active]
    for q_a in expected.q[1:]:
        instance.fmu.setReal([instance.references[x] for x in names], [*forces])
        instance.step()
        assert np.abs(instance.get(*coordinates(machine)) - q_a).max() < 1e-12


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("name", ["mini_forwarder", "patu655", "controlled"])
def test_model_exchange_by_cvode_is_that_of_simulate(fmus, name):
    machine = crane.load(name.replace("controlled", "mini_forwarder"))
    path = str(fmus / f"{name}.fmu")
    if name == "patu655":
        spools = machine.hydraulics.spools
        values = {
            x: s.neutral + 0.3 * (-1) ** i * (s.full - s.neutral)
            for i, (x, s) in enumerate(spools.items())
        }
        control = ValveSignals(machine, [0.0], {x: [y] for x, y in values.items()})
        start = {f"{x}.signal": y for x, y in values.items()}
    elif name == "controlled":  # to references that are 1 cm or 0.01 rad from home
        row = machine.home[machine.closure.active] + 0.01
        law = crane.control.make_controller("pi", machine)
        control = interpolate_references(law, [0.0, 2.0], [row, row])
        start = {f"{x}.reference": y for x, y in zip(machine.active, row, strict=True)}
    else:
        forces = 1.02 * crane.Dynamics(machine).gravity(machine.home[machine.closure.active])
        control = Constant(machine, forces)
        start = {f"{x}.force": y for x, y in zip(machine.active, forces, strict=True)}
    expected = quiet(crane.simulate, machine, control, duration=1.0, step=STEP, tolerance=1e-10)
    found = fmpy.simulate_fmu(
        path, fmi_type="ModelExchange", stop_time=1.0, output_interval=STEP, start_values=start,
        relative_tolerance=1e-9, output=coordinates(machine), solver="CVode", record_events=False,
    )  # fmt: skip
    difference = np.column_stack([found[x] for x in coordinates(machine)]) - expected.q
    assert np.abs(difference).max() < 5e-9


@needs_compiler
@pytest.mark.slow
def test_a_saved_state_goes_on_bit_for_bit(fmus):
    instance = Instance(fmus / "delayed.fmu", X_lift__signal=7.0, slew__signal=4.0)
    names = [x.name for x in instance.description.modelVariables]
    for _ in range(30):
        instance.step()
    instance.set(X_lift__signal=4.0)  # which its spool has not got at the saved state
    instance.step()
    state = instance.fmu.getFMUState()
    data = instance.fmu.serializeFMUState(state)
    time = instance.time
    for _ in range(30):
        instance.step()
    expected = instance.get(*names)
    other = Instance(fmus / "delayed.fmu")
    for target in (instance, other):
        restored = target.fmu.deserializeFMUState(data)
        target.fmu.setFMUState(restored)
        target.fmu.freeFMUState(restored)
        target.time = time
        for _ in range(30):
            target.step()
        assert np.array_equal(target.get(*names), expected)


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("name", ["mini_forwarder", "patu655"])
def test_directional_derivatives_are_those_of_differences(fmus, name):
    instance = Instance(fmus / f"{name}.fmu", co_simulation=False)
    model, n, random = instance.fmu, len(instance.states), np.random.default_rng(1)
    references = [instance.references[x] for x in instance.states]
    outputs = ["tip.position_x", "tip.position_z", "kinetic", "potential"]
    unknowns = [x.variable.valueReference for x in instance.description.derivatives]
    unknowns += [instance.references[x] for x in outputs]
    states = instance.get(*instance.states)
    speeds = [i for i, x in enumerate(instance.states) if x.endswith(".rate")]
    states[speeds] += 0.05 * random.uniform(0.5, 1, len(speeds))  # no joint at rest
    pressures = [i for i, x in enumerate(instance.states) if ".state_pressure" in x]
    states[pressures] += 1e6 * random.uniform(1, 2, len(pressures))  # no void
    instance.rates(states)
    model.enterEventMode()
    (model.updateDiscreteStates if instance.is_fmi3 else model.newDiscreteStates)()
    model.enterContinuousTimeMode()
    nominals = (ctypes.c_double * n)()
    model.getNominalsOfContinuousStates(nominals, n)

    def values(x):
        return np.append(instance.rates(x), instance.get(*outputs))

    for i in (*range(len(speeds)), *speeds, 2 * len(speeds)):
        seed = np.eye(n)[i]
        h = 1e-6 * nominals[i]
        expected = (values(states + h * seed) - values(states - h * seed)) / (2 * h)
        instance.rates(states)
        get = model.getDirectionalDerivative
        found = np.array(get(unknowns, [references[i]], [1.0]))
        sizes = np.abs(expected).max()
        assert np.abs(found - expected).max() <= 1e-6 * sizes, instance.states[i]


@needs_compiler
@pytest.mark.slow
def test_a_payload_is_a_point_mass_at_the_tip(fmus):
    machine = crane.load("patu655").with_payload(Payload("tip", 200.0))
    expected = quiet(crane.simulate, machine, duration=0.3, step=STEP)
    instance = Instance(fmus / "patu655.fmu", payload__mass=500.0)
    instance = Instance(fmus / "patu655.fmu", payload__mass=200.0)
    for _ in range(30):
        instance.step()
    q = instance.get(*coordinates(machine))
    assert np.abs(q - expected.q[-1]).max() < 1e-12
    pressures = ["X_lift.pressure_a", "X_lift.pressure_b"]
    found = [expected.channels[f"pressure_X_lift_{side}"][-1] for side in "ab"]
    assert instance.get(*pressures) == pytest.approx(found, rel=1e-9)


@needs_compiler
@pytest.mark.slow
def test_wrong_values_end_in_a_status_with_a_message(fmus):
    path, failure = fmus / "patu655.fmu", fmpy.fmi1.FMICallException
    for start, text in (
        ({"X_lift__stroke": 9.0}, "the start of X_lift.stroke is 9, set it between"),
        ({"X_lift__signal": np.nan}, "X_lift.signal is set to nan at t = 0 s, give it a finite"),
        ({"payload__mass": -1.0}, "payload.mass is -1, give it at least 0"),
        ({"kinetic": 1.0}, "kinetic cannot be set, it is computed"),
    ):
        log = []
        with pytest.raises(failure):
            Instance(path, log, **start)
        assert text in str(log[-1]), log
    instance = Instance(path)
    for call, text in (
        (lambda: instance.set(X_lift__stroke=0.2), "X_lift.stroke cannot be set, it is a start"),
        (lambda: instance.step(0.0), "the communication step is 0 s, give one above 0"),
        (lambda: instance.fmu.doStep(3.0, STEP), "the step starts at 3 s and the machine is at 0"),
        (lambda: instance.fmu.getFloat64([99999]), "no variable has the value reference 99999"),
    ):
        with pytest.raises(failure):
            call()
        assert text in str(instance.log[-1])
    instance.set(tip__force_z=1e12)
    with pytest.raises(failure):
        instance.step()
    assert "at t = 0 s: the step failed: the motion diverges" in str(instance.log[-1])
    instance.set(tip__force_z=0.0)
    instance.step()  # from the state before
    assert np.isfinite(instance.get("X_lift.stroke")).all()


@pytest.mark.slow
@pytest.mark.skipif(not COMPILER, reason="no C compiler is here")
def test_the_command_adds_a_sketch_and_the_facts(tmp_path, monkeypatch):
    monkeypatch.setattr(fmu_libraries, "find_spec", lambda name: None)
    monkeypatch.setattr(fmu_libraries, "_FLAGS", (*STRICT, "-O0"))
    out = tmp_path / "x.fmu"
    quiet(typed, "export", "mini_forwarder", "--to", "fmu", "--out", str(out))
    members = zipfile.ZipFile(out)
    assert members.read("terminalsAndIcons/icon.png").startswith(b"\x89PNG")
    assert b"image/svg" in members.read("documentation/index.html")
    assert validate_fmu(str(out)) == []


def test_without_a_compiler_one_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(fmu_libraries, "find_spec", lambda name: None)
    monkeypatch.setattr(fmu_libraries, "which", lambda name: None)
    monkeypatch.delenv("CC", raising=False)
    with pytest.raises(InputError, match="no C compiler is here .* pip install"):
        write_fmu("mini_forwarder", tmp_path / "x.fmu")
    with pytest.raises(InputError, match="FMI 1 is not written"):
        write_fmu("mini_forwarder", tmp_path / "x.fmu", 1)


def test_units_are_products_of_base_units():
    assert base_unit("N m s/rad") == {"kg": 1, "m": 2, "s": -1, "rad": -1}
    assert base_unit("m3/Pa/s") == {"kg": -1, "m": 4, "s": 1}
    assert base_unit("1/m") == {"m": -1}
    with pytest.raises(InputError, match="unit 'furlong' is no unit of an FMU"):
        base_unit("furlong")


CONTROLLER = """
from pythonfmu import Fmi2Causality, Fmi2Slave, Real


class Controller(Fmi2Slave):
    def __init__(self, **options):
        super().__init__(**options)
        for kind in ("error", "force", "kp", "ki", "integral"):
            causality = {"error": "input", "force": "output"}.get(kind, "parameter")
            for i in range(3):
                setattr(self, f"{kind}{i}", 0.0)
                found = getattr(Fmi2Causality, causality)
                more = {} if causality != "parameter" else {"variability": TUNABLE}
                self.register_variable(Real(f"{kind}{i}", causality=found, **more))

    def do_step(self, time, length):
        for i in range(3):
            error, integral = getattr(self, f"error{i}"), getattr(self, f"integral{i}")
            force = getattr(self, f"kp{i}") * error + getattr(self, f"ki{i}") * integral
            setattr(self, f"force{i}", force)
            setattr(self, f"integral{i}", integral + length * error)
        return True
""".replace("TUNABLE", "__import__('pythonfmu').Fmi2Variability.tunable")


class SampledPI:
    """The law of `crane.PI` at the samples, with integrals of held errors."""

    def __init__(self, law, integral, period):
        self._law, self._start, self._period = law, integral, period

    def __call__(self, time, q_a, v_a, pressures):
        self._integral = self._start if time == 0 else self._integral
        forces, rates = self._law(time, q_a, v_a, self._integral)
        self._integral = self._integral + self._period * rates
        return forces


def _error(trajectory, i, time, q_a, v_a, pressures):
    return float(trajectory.position(time)[i] - q_a[i])


@pytest.mark.slow
def test_a_pi_controller_of_another_program_controls_as_that_of_crane(tmp_path):
    pytest.importorskip("pythonfmu", reason="pythonfmu is not here")
    (tmp_path / "controller.py").write_text(CONTROLLER)
    command = [sys.executable, "-m", "pythonfmu", "build", "-f", "controller.py"]
    subprocess.run(command, cwd=tmp_path, check=True, timeout=60, env={**os.environ})
    machine, period = crane.load("mini_forwarder"), 0.002
    trajectory = crane.task_trajectory(machine, "lift")
    law, start = crane.PI(machine, trajectory), trajectory.position(0.0)
    integral, (kp, ki) = law.start(start), law.settings.reshape(2, 3)
    run = partial(quiet, crane.simulate, machine, initial=start, duration=0.5, step=period)
    expected = run(SampledCommand(SampledPI(law, integral, period), machine, period))
    numbers = {"kp": kp, "ki": ki, "integral": integral}
    controller = FmuController(
        tmp_path / "Controller.fmu", machine,
        {f"error{i}": partial(_error, trajectory, i) for i in range(3)},
        {joint: f"force{i}" for i, joint in enumerate(machine.active)},
        period,
        {f"{name}{i}": x[i] for name, x in numbers.items() for i in range(3)},
    )  # fmt: skip
    for _ in range(2):  # each run starts a new instance
        assert np.array_equal(run(controller).q, expected.q)
    continuous = quiet(crane.simulate, machine, law, duration=0.5, step=period)
    assert 0 < np.abs(continuous.q - expected.q).max() < 1e-4
    for inputs, outputs, text in (
        ({"speed": "v_X1"}, {}, "no input 'speed'"),
        ({"error0": "w_X1"}, {}, "no quantity 'w_X1', did you mean 'v_X1'"),
        ({}, {"X9": "force0"}, "no valve or drive 'X9'"),
    ):
        with pytest.raises(InputError, match=text):
            FmuController(tmp_path / "Controller.fmu", machine, inputs, outputs)
    broken = FmuController(
        tmp_path / "Controller.fmu", machine, {"error1": lambda *at: np.nan}, {"X1": "force1"},
        period, {"kp1": 1.0},
    )  # fmt: skip
    assert repr(broken).startswith("FmuController(") and len(repr(broken)) <= 200
    with pytest.raises(SimulationError, match="at t = 0 s its outputs are not finite"):
        run(broken)


def test_a_file_that_is_no_fmu_is_refused(tmp_path):
    machine, path = crane.load("mini_forwarder"), tmp_path / "x.fmu"
    with pytest.raises(InputError, match=r"x\.fmu: there is no such FMU"):
        FmuController(path, machine, {}, {})
    path.write_text("nothing")
    with pytest.raises(InputError, match=r"x\.fmu: cannot be loaded: File is not a zip file"):
        FmuController(path, machine, {}, {})
