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
from command_line import typed
from warned import quiet

import crane
from crane.common.errors import InputError, SimulationError
from crane.control import FmuController, SampledCommand, ValveSignals
from crane.export import fmu_libraries, write_fmu
from crane.export.fmu_variables import base_unit
from crane.machine.payload import Payload

fmpy = pytest.importorskip("fmpy", reason="FMPy is not here")
validate_fmu = pytest.importorskip("fmpy.validation").validate_fmu
COMPILER = shutil.which("gcc") or shutil.which("clang")
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O1", "-shared")
STEP = 0.01
needs_compiler = pytest.mark.skipif(not COMPILER, reason="no C compiler is here")


@pytest.fixture(scope="module")
def fmus(tmp_path_factory):
    """FMUs of a machine with forces and of one with valves, by this computer's compiler."""
    folder = tmp_path_factory.mktemp("fmus")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fmu_libraries, "find_spec", lambda name: None)
        patch.setenv("CC", COMPILER)
        patch.setattr(fmu_libraries, "_FLAGS", STRICT)
        for name, fmi in (("mini_forwarder", 2), ("patu655", 3)):
            quiet(write_fmu, name, folder / f"{name}.fmu", fmi)
    return folder


class Instance:
    """An instance of an FMU of FMI 2 or 3, by the names of its variables."""

    def __init__(self, path, log=None, co_simulation=True, **start):
        self.description = d = fmpy.read_model_description(str(path))
        self.folder = fmpy.extract(str(path))
        kind = "Slave" if co_simulation else "Model"
        self.is_fmi3 = d.fmiVersion == "3.0"
        module = fmpy.fmi3 if self.is_fmi3 else fmpy.fmi2
        self.fmu = getattr(module, f"FMU{d.fmiVersion[0]}{kind}")(
            guid=d.guid,
            unzipDirectory=self.folder,
            modelIdentifier=d.modelExchange.modelIdentifier,
        )
        self.log = [] if log is None else log
        self.fmu.instantiate(**self._logger())
        self.references = {x.name: x.valueReference for x in d.modelVariables}
        self.states = [x.variable.derivative.name for x in d.derivatives]
        self.set(**start)
        if not self.is_fmi3:
            self.fmu.setupExperiment(startTime=0.0)
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()
        self.time = 0.0

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
    members = zipfile.ZipFile(path).namelist()
    assert {"sources/fmu.c", "documentation/index.html", "modelDescription.xml"} <= {*members}


@needs_compiler
@pytest.mark.slow
def test_co_simulation_of_eight_instances_is_that_of_simulate(fmus):
    machine, times = crane.load("patu655"), STEP * np.arange(101)
    moved = signals(machine, times)
    table = np.column_stack([*moved.values()])
    command = SampledCommand(lambda t, *motion: table[round(t / STEP)], machine, STEP)
    expected = quiet(crane.simulate, machine, command, duration=1.0, step=STEP)
    instances = [Instance(fmus / "patu655.fmu") for _ in range(8)]
    worst = 0.0
    for i in range(100):
        for instance in instances:
            instance.set(**{f"{x}__signal": table[i, j] for j, x in enumerate(moved)})
            instance.step()
        found = [x.get(*coordinates(machine)) for x in instances]
        assert all(np.array_equal(x, found[0]) for x in found)
        worst = max(worst, np.abs(found[0] - expected.q[i + 1]).max())
    assert worst < 1e-12  # [m], [rad]


@needs_compiler
@pytest.mark.slow
def test_inputs_with_slopes_are_those_of_valve_signals(fmus, tmp_path):
    machine = crane.load("mini_forwarder")
    forces = 1.02 * crane.Dynamics(machine).gravity(machine.home[machine.closure.active])
    expected = quiet(crane.simulate, machine, Constant(machine, forces), duration=0.5, step=STEP)
    instance = Instance(fmus / "mini_forwarder.fmu")
    names = [f"{x}.force" for x in machine.active[1:]]
    references = [instance.references[x] for x in names]
    for i in range(50):  # forces that jump to half and go to their value and back in a step
        instance.set(**{f"{machine.active[0]}__torque" if 0 else "q1__force": forces[0]})
        instance.set(**dict(zip((x.replace(".", "__") for x in names), forces[1:], strict=True)))
        instance.fmu.setRealInputDerivatives(references, [1] * 2, [0.0] * 2)
        instance.step()
        assert np.abs(instance.get(*coordinates(machine)) - expected.q[i + 1]).max() < 1e-12


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("name", ["mini_forwarder", "patu655"])
def test_model_exchange_by_cvode_is_that_of_simulate(fmus, name):
    machine, path = crane.load(name), str(fmus / f"{name}.fmu")
    if name == "patu655":
        spools = machine.hydraulics.spools
        values = {
            x: s.neutral + 0.3 * (-1) ** i * (s.full - s.neutral)
            for i, (x, s) in enumerate(spools.items())
        }
        control = ValveSignals(machine, [0.0], {x: [y] for x, y in values.items()})
        start = {f"{x}.signal": y for x, y in values.items()}
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
    instance = Instance(fmus / "patu655.fmu", X_lift__signal=7.0, slew__signal=4.0)
    names = [x.name for x in instance.description.modelVariables]
    for _ in range(30):
        instance.step()
    state = instance.fmu.getFMUState()
    data = instance.fmu.serializeFMUState(state)
    time = instance.time
    for _ in range(30):
        instance.step()
    expected = instance.get(*names)
    other = Instance(fmus / "patu655.fmu")
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
        ({"payload__mass": -1.0}, "payload.mass is -1 kg, give it at least 0"),
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
