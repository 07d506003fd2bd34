"""Terms of the identification model and priors by name: in the machine file and in calls."""

import dataclasses
import re
import warnings

import numpy as np
import pytest
import yaml
from command_line import typed
from warned import quiet

import crane
from crane.common.errors import CraneError, CraneWarning, InputError, RecordingError
from crane.description import Friction
from crane.description.estimation_settings import EstimationSettings, ParameterPrior
from crane.formats import write_machine
from crane.identification.mechanics.cross_validation import (
    FOLD_COUNT,
    cross_validate,
    format_trials,
    identify_options,
)
from crane.identification.mechanics.force_comparison import check_shared_samples
from crane.identification.mechanics.identifiability import prior_from_names
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.mechanics.identify import identify
from crane.identification.mechanics.model_terms import (
    ForceDirection,
    FrictionalMemory,
    InertialTerm,
    PreslidingFriction,
    RotorInertiaTerm,
    friction_term,
    root_friction_term,
)
from crane.identification.signals.signal_processing import Motion

STEP = 5e-3
TIME = STEP * np.arange(1600)


@pytest.fixture(scope="module")
def arm():
    return crane.load("tx40").replace(estimation=EstimationSettings())


def moved(machine, seed=0, terms=None, parameters=None):
    """Joints in sines of their own about home, and the forces of parameters, or the described."""
    rng, n = np.random.default_rng(seed), len(machine.active)
    w = 2 * np.pi * rng.uniform(0.3, 0.9, n)
    phase, size = rng.uniform(0, 2 * np.pi, n), 0.1 * (machine.upper - machine.lower)
    angle = TIME[:, None] * w + phase
    q = machine.home[machine.closure.active] + size * np.sin(angle)
    v, a = size * w * np.cos(angle), -size * w**2 * np.sin(angle)
    model = IdentificationModel(machine, terms)
    at = model.samples(q, v, a, STEP)
    tau = model.regressor(at) @ (model.nominal if parameters is None else parameters)
    return Motion(TIME, q, v, a, tau + model.known_forces(at))


def test_names_are_the_terms_that_they_say(arm):
    changes = {
        "q*.coulomb_offset": None, "q*.viscous_offset": None, "q[1-4].rotor_inertia": (),
        "q1.presliding": (1e-3,), "q1.root": (), "q2.memory": (0.2, 0.1), "q3.stiction": (0.1, 1),
        "q6+0.5*q5.coulomb": (), "q6+0.5*q5.rotor_inertia": (), "q4.viscous": None,
    }  # fmt: skip
    both = ForceDirection("q6+0.5*q5", {"q6": 1.0, "q5": 0.5})
    kinds = ("coulomb", "viscous")
    wanted = [
        InertialTerm(arm),
        *(RotorInertiaTerm(arm, joint) for joint in ("q1", "q2", "q3", "q4", both)),
        friction_term(arm, "q1", ("viscous",)),
        root_friction_term(arm, "q1"),
        PreslidingFriction(arm, "q1", 1e-3),
        friction_term(arm, "q2", kinds),
        FrictionalMemory(arm, "q2", 0.2, 0.1),
        friction_term(arm, "q3", kinds, stribeck=(0.1, 1.0)),
        friction_term(arm, "q4", ("coulomb",)),
        friction_term(arm, "q5", kinds),
        friction_term(arm, "q6", kinds),
        friction_term(arm, both, ("coulomb",)),
    ]
    one, other = IdentificationModel(arm, changes), IdentificationModel(arm, wanted)
    assert set(one.names) == set(other.names) and len(one.names) == len(other.names)
    motion = moved(arm)
    columns = [
        dict(zip(m.names, np.moveaxis(m.regressor(m.samples(*x, STEP)), 2, 0), strict=True))
        for m, x in zip((one, other), 2 * [(motion.q, motion.v, motion.a)], strict=True)
    ]
    for name, column in columns[0].items():
        np.testing.assert_array_equal(column, columns[1][name])


def test_the_memory_of_rest_is_its_differential_equation(arm):
    """At a steady speed from rest w = v (1 - e^(-t / lag)), in parts as in one."""
    v = np.zeros((1600, 6))
    v[:, 0] = -0.3
    q = np.zeros_like(v)
    q[:, 0] = -0.3 * TIME
    term = FrictionalMemory(arm, "q1", 0.2, 0.1)
    model = IdentificationModel(arm, [term])
    found = term.columns(model.samples(q, v, 0 * v, STEP))[:, 0, 0]
    w = 0.3 * (1 - np.exp(-(TIME + STEP) / 0.2))
    np.testing.assert_allclose(found, -np.exp(-w / 0.1), rtol=1e-12)
    parts, memory = [], {}
    for part in (slice(0, 700), slice(700, None)):
        starts = (0,) if part.start == 0 else ()
        at = model.samples(q[part], v[part], 0 * v[part], STEP, starts)
        at = dataclasses.replace(at, term_states=memory)
        parts.append(term.columns(at)[:, 0, 0])
    np.testing.assert_allclose(np.concatenate(parts), found, rtol=1e-13)
    with pytest.raises(InputError, match="'q1.memory' depends on time, give the step"):
        term.columns(model.samples(q, v, 0 * v))


@pytest.mark.parametrize(
    ("terms", "message"),
    [
        ({"q1.rotor": ()}, "term 'q1.rotor': 'rotor' is unknown, known: "),
        ({"presliding": ()}, "term 'presliding' does not say of what, write q1.presliding or q*."),
        ({"": ()}, "term '': '' is unknown, known: "),
        ({"q9.viscous": ()}, "term 'q9.viscous': 'q9' is unknown, known: q1"),
        (
            {"q1.presliding": ()},
            "term 'q1.presliding' has 0 values, give the characteristic distance",
        ),
        ({"q1.viscous": (1.0,)}, "term 'q1.viscous' has 1 values, it takes none"),
        (
            {"q1.presliding": (-1.0,)},
            "a value of term 'q1.presliding' is -1.0, give a number above",
        ),
        (
            {"q1.stiction": (0.1, 0.0)},
            "a value of term 'q1.stiction' is 0.0, give a number above 0",
        ),
        (
            {"q*.stiction": (np.nan,)},
            "a value of term 'q*.stiction' is nan, give a number above 0",
        ),
        (
            {"q1.memory": (np.inf, 1.0)},
            "a value of term 'q1.memory' is inf, give a number above 0",
        ),
        ({"nan*q5+q6.viscous": ()}, "'nan*q5+q6': 'nan' is no factor, write q5+0.5*q6"),
        ({"0*q5+q6.viscous": ()}, "'0*q5+q6': '0' is no factor, write q5+0.5*q6"),
        ({"q5+q5.viscous": ()}, "'q5+q5' names 'q5' twice, give it once with its factor"),
        ({"q1.stiction": ()}, "term 'q1.stiction' needs the velocity over which it fades"),
        ({"q5+x*q6.viscous": ()}, "'q5+x*q6': 'x' is no factor, write q5+0.5*q6"),
        ({"q5+q9.viscous": ()}, "'q5+q9' combines 'q9', which is not active"),
        ({"q1.gas_scale": ()}, "term 'q1.gas_scale': 'q1' is unknown, there are none"),
    ],
)
def test_terms_that_are_none(arm, terms, message):
    with pytest.raises(InputError) as caught:
        model = IdentificationModel(arm, terms)
        model.regressor(model.samples(*np.zeros((3, 2, 6))))
    assert str(caught.value).startswith(message) and str(caught.value).isprintable()


def test_what_is_known_by_name(arm):
    """The last that speaks of a parameter counts; shares are of what is described."""
    rough = arm.replace(friction={"q1": Friction(coulomb=8.0)})
    model = IdentificationModel(rough)
    sizes = np.linspace(1.0, 2.0, len(model.names))
    known = {"*": "30 %", "link[12]": "10 %", "link2.m": "5 +- 0.1", "*.viscous": 7,
             "q1.viscous": "2 +- 50 %"}  # fmt: skip
    mean, std = prior_from_names(
        model, {k: ParameterPrior.parse(x) for k, x in known.items()}, sizes
    )
    by = {name: (mean[i], std[i], sizes[i]) for i, name in enumerate(model.names)}
    assert by["link1.Izz"][1] == pytest.approx(0.1 * by["link1.Izz"][2])
    assert by["link3.m"][1] == pytest.approx(0.3 * by["link3.m"][2])
    assert by["link2.m"][:2] == (5.0, 0.1)
    assert by["q2.viscous"][:2] == (0.0, 7.0) and by["q1.viscous"][:2] == (2.0, 1.0)
    assert by["q1.coulomb"][:2] == (8.0, pytest.approx(2.4))
    assert by["q3.coulomb"][1] == by["q3.coulomb"][2]  # described as none: what can be


@pytest.mark.parametrize("feasible", [False, True])
def test_a_parameter_that_is_known_stays_where_it_is(arm, feasible):
    """And it may be one of a body: its mass, of which forces say nothing, is what was weighed."""
    prior = {"bodies": "30 %", "link6.m": "0.5 +- 1e-7", "q2.viscous": "3 +- 1e-7"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        found = identify(arm, moved(arm), prior=prior, feasible=feasible, bandwidth=10.0)
    values = dict(zip(found.model.names, found.parameters, strict=True))
    assert values["link6.m"] == pytest.approx(0.5, abs=1e-4)
    assert values["q2.viscous"] == pytest.approx(3.0, abs=1e-4)
    i = found.names.index("q2.viscous")
    assert found.std[i] <= 2e-6  # of the estimate that is printed, not of one without a prior


def test_the_machine_file_says_it_and_keeps_it(arm, tmp_path):
    kr300 = crane.load("kr300")
    assert (
        "q1.memory" in IdentificationModel(kr300).names
        and "q1.coulomb" not in IdentificationModel(kr300).names
    )
    again = crane.load(write_machine(kr300, tmp_path / "out"))
    assert again.estimation == kr300.estimation
    assert IdentificationModel(again).names == IdentificationModel(kr300).names
    held = crane.load("kr300", lock={"q6": 0.0})  # what is said of a locked joint is of nobody
    assert not [name for name in IdentificationModel(held).names if name.startswith("q6")]


@pytest.mark.parametrize("word", ["{}", "'{}'", '"{}"'])
@pytest.mark.parametrize(("off", "on"), [("off", "on"), ("no", "Yes"), ("FALSE", "true")])
def test_on_and_off_may_be_quoted(edited, word, off, on):
    terms = f"{{crank.rotor_inertia: {word.format(on)}, rocker.viscous: {word.format(off)}}}"
    machine = edited(
        "four_bar.yaml",
        "tip: coupler_pin",
        f"tip: coupler_pin\nidentification: {{terms: {terms}}}",
        "viscous: 0.1, smoothing",
        f"viscous: 0.1, viscous_offset: 0.2, drives: {word.format(on)}, smoothing",
    )
    assert machine.estimation.terms == {"crank.rotor_inertia": (), "rocker.viscous": None}


def test_numbers_that_yaml_reads_as_text_are_numbers(edited):
    terms = "identification: {terms: {crank.presliding: 2e5}}"
    machine = edited("four_bar.yaml", "tip: coupler_pin", f"tip: coupler_pin\n{terms}")
    assert machine.estimation.terms == {"crank.presliding": (2e5,)}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{term: {}}", "unknown key 'term' in 'identification', did you mean 'terms'?"),
        ("{terms: {q1.root: maybe}}", "'q1.root' of 'terms' is 'maybe', give on, off, a number"),
        ("{terms: {q1.root: }}", "'q1.root' of 'terms' is empty, give its value"),
        ("{prior: {q1.viscous: about 5}}", "'q1.viscous' of 'prior': 'about 5' says no standard"),
        ("{bandwidth: 0}", "'bandwidth' is 0, give one in Hz"),
        ("{min_speed: {q1: -1}}", "'q1' of 'min_speed' is -1, give at least 0"),
    ],
)
def test_a_section_that_is_wrong(edited, text, message):
    with pytest.raises(CraneError) as caught:
        edited("four_bar.yaml", "tip: coupler_pin", f"tip: coupler_pin\nidentification: {text}")
    assert message in str(caught.value) and "four_bar.yaml:" in str(caught.value)


# --- what becomes of them in a machine file ---------------------------------------------------


def test_a_motor_of_two_joints_is_written_as_a_rotor_that_a_coupling_turns(arm, tmp_path):
    """The machine that is read back has its forces, by Pinocchio and by the formulas."""
    terms = {"q5+q6.rotor_inertia": (), "q5+q6.viscous": (), "q5+q6.coulomb": (),
             "q*.rotor_inertia": (), "q*.viscous_offset": None}  # fmt: skip
    model = IdentificationModel(arm, terms)
    truth = model.nominal.copy()
    for i, name in enumerate(model.names):
        kind = name.rpartition(".")[2]
        truth[i] += {"rotor_inertia": 0.2, "viscous": 3.0, "coulomb": 5.0}.get(kind, 0.0)
    motion = moved(arm, terms=terms, parameters=truth)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        found = identify(arm, motion, terms=terms, feasible=True, bandwidth=40.0, trust=True)
        machine = crane.load(crane.identification.write_identified(found, tmp_path / "out"))
    assert machine.active == arm.active and "q5+q6" in machine.joints
    assert machine.tree.joints["q5+q6"].rotor_inertia == pytest.approx(0.2, rel=0.02)
    assert machine.friction["q5+q6"].coulomb == pytest.approx(5.0, rel=0.05)
    dynamics = crane.Dynamics(machine)
    forces = dynamics.inverse(motion.q, motion.v, motion.a, friction=True)
    moving = (np.abs(motion.v) > 0.05).all(axis=1)
    gap = np.linalg.norm((forces - motion.tau)[moving], axis=0)
    assert (gap < 0.01 * np.linalg.norm(motion.tau[moving], axis=0)).all()


HISTORY = Friction(
    coulomb=1.0, coulomb_offset=0.3, viscous=2.0, viscous_offset=-0.5, stiction=-0.4, stribeck=0.1,
    stiction_2=0.7, stribeck_2=0.5, root=3.0, presliding=4.0, presliding_length=0.02, memory=2.0,
    memory_time=0.15, memory_speed=0.2,
)  # fmt: skip


def test_the_written_machine_predicts_as_the_parameters_do(arm, tmp_path):
    """Friction with a history, of joints and of a motor of two; predicted as by the parameters."""
    terms = {
        "q1.presliding": (1e-3,), "q1.coulomb": (), "q2.root": (), "q3.stiction": (0.1, 0.4),
        "q4.memory": (0.2, 0.1), "q5+q6.rotor_inertia": (), "q5+q6.presliding": (2e-3,),
        "q5+q6.root": (), "q5+q6.memory": (0.1, 0.3),
    }  # fmt: skip
    motion = moved(arm)
    found = quiet(
        identify, arm, motion, terms=terms, prior={"bodies": "10 %"},
        bandwidth=40.0, trust=True,
    )  # fmt: skip
    values = found.parameters.copy()
    for i, (name, nominal) in enumerate(zip(found.model.names, found.model.nominal, strict=True)):
        kind = name.rpartition(".")[2]
        values[i] = nominal if i < 10 * len(found.model.bodies) else {"rotor_inertia": 0.2}.get(
            kind, 1.0 + 0.01 * i
        )  # fmt: skip
    found = dataclasses.replace(found, parameters=values)
    machine = crane.load(crane.identification.write_identified(found, tmp_path / "out"))
    assert machine.friction["q1"].presliding_length == 1e-3
    assert machine.friction["q5+q6"].memory_speed == 0.3
    given = motion.q, motion.v, motion.a
    forces = crane.Dynamics(machine).inverse(*given, friction=True, step=STEP)
    np.testing.assert_allclose(forces, found.predict(*given, STEP), rtol=0, atol=1e-9)
    steady = crane.Dynamics(machine).inverse(*given, friction=True)
    assert np.abs(steady - forces).max() > 0.5  # it has no history
    written = IdentificationModel(machine, {"q1.presliding": (1e-3,)})
    law, nominal = machine.friction["q1"], dict(zip(written.names, written.nominal, strict=True))
    assert nominal["q1.presliding"] == law.presliding > 1


def test_friction_with_a_history_is_its_differential_equations(arm):
    """Against scipy's integration over time; both backends at steady speeds."""
    from scipy.integrate import solve_ivp

    step, law = 2e-4, HISTORY
    time = np.arange(0.0, 2.0, step)
    q, v = np.zeros((2, len(time), 6))
    q[:, 0], v[:, 0] = 0.1 * (1 - np.cos(5 * time)), 0.5 * np.sin(5 * time)
    rough, smooth = (
        crane.Dynamics(arm.replace(friction=laws)) for laws in ({"q1": law}, {"q1": Friction()})
    )
    found = (rough.inverse(q, v, 0 * q, True, step) - smooth.inverse(q, v, 0 * q))[:, 0]

    def rates(t, x):
        speed = 0.5 * np.sin(5 * t)
        z, w = x
        return (speed - abs(speed) * z) / law.presliding_length, (abs(speed) - w) / law.memory_time

    z, w = solve_ivp(rates, (0, 2), (0.0, 0.0), t_eval=time, rtol=1e-10, atol=1e-12).y
    x, sign = v[:, 0], np.sign(v[:, 0])

    def expected(z, w):
        excess = -0.4 * np.exp(-((x / 0.1) ** 2)) + 0.7 * np.exp(-((x / 0.5) ** 2))
        return (
            4.0 * z + (1.0 + excess + 2.0 * np.exp(-w / 0.2)) * sign + 0.3 + 2.0 * x
            - 0.5 * np.abs(x) + 3.0 * sign * np.sqrt(np.abs(x))
        )  # fmt: skip

    np.testing.assert_allclose(found[1:], expected(z, w)[1:], atol=0.02)
    some = slice(1, None, 400)
    for backend in ("compiled", "pinocchio"):
        dynamics = crane.Dynamics(arm.replace(friction={"q1": law}), backend=backend)
        force = dynamics.friction(q[some], v[some])[:, 0]
        np.testing.assert_allclose(force, expected(sign, np.abs(x))[some], atol=1e-9)
    for options, message in (
        ({"step": 0.1}, "a step is that of a motion"),
        ({"step": 0.0, "friction": True}, "the step is 0|step is 0"),
    ):
        with pytest.raises(InputError, match=message):
            rough.inverse(q, v, 0 * q, **options)


def test_friction_at_rest_may_not_push(arm):
    with pytest.raises(InputError, match="friction at rest is -1, the sum of coulomb, presliding"):
        Friction(coulomb=1.0, stiction=-2.0)


# --- the command line -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["--term", "crank.root=x"],
            "--term is 'crank.root=x', write NAME, NAME=NUMBERS or NAME=o",
        ),
        (["--term", "crank.root", "--term", "crank.root=off"], "--term names 'crank.root' twice"),
        (["--term", "crank.rot"], "term 'crank.rot': 'rot' is unknown, did you mean 'root'?"),
        (["--prior", "a=b"], "--prior is 'a=b', write NAME=STD, as in bodies=10%"),
        (["--prior", "0.3", "--prior", "0.1"], "--prior says two things of '*', give one"),
        (["--prior", "q8.m=1"], "prior 'q8.m' is unknown, known: "),
        (["--min-speed", "crank=1e3"], "no joint moves faster than what counts as standstill"),
        (
            ["--min-speed", "crank=1e3", "--try", "bandwidth=8,12"],
            "no joint moves faster than what ",
        ),
        (["--min-speed", "crank=1e3", "--feasible"], "no joint moves faster than what counts as"),
        (["--train", "5"], "--train is '5', write FROM:TO in seconds, as 0:13.5"),
        (["--train", "90:99"], "nothing lies between 90 and 99 s, the recording goes from 0 to "),
        (["--try", "bandwidth=x"], "--try is 'bandwidth=x', write each NAME=VALUES once"),
        (["--try", "5"], "--try is '5', write each NAME=VALUES once, as bandwidth=2,5,10"),
        (["--columns", "none.txt"], "none.txt: no such file or directory, give a file of columns"),
    ],
)
def test_options_that_are_wrong_are_one_line(tmp_path, crank, arguments, message):
    done = typed("identify", *crank, "--out", tmp_path / "out", *arguments)
    lines = [line for line in done.stderr.splitlines() if not line.startswith("warning")]
    assert (done.returncode, done.stdout, len(lines)) == (2, "", 1), done.stderr
    assert lines[0].startswith("error: ") and message in lines[0]
    assert not (tmp_path / "out").exists()


def test_settings_are_selected_on_the_command_line(tmp_path, crank):
    done = typed("identify", *crank, "--prior", "bodies=auto", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    (title,) = [
        x for x in done.stdout.splitlines() if x.startswith("settings by cross-validation")
    ]
    assert "errors of 5 blocks of time that are left out, all rows in motion" in title
    done = typed("identify", *crank, "--prior", "bodies=automatic", "--out", tmp_path / "no")
    assert done.returncode == 2 and "--prior is 'bodies=automatic', write" in done.stderr


def test_a_window_is_trained_on_and_the_rest_judges(tmp_path, crank):
    done = typed(
        "identify", *crank, "--train", "0:5", "--prior", "0.3", "--term", "crank.rotor_inertia",
        "--out", tmp_path / "out", "--feasible", "--try", "bandwidth=8,12",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "cross-validation within the training" in done.stdout
    assert (
        "validation, samples near standstill excluded" in done.stdout
        and "mean of the joints" in done.stdout
    )
    data = yaml.safe_load((tmp_path / "out" / "machine" / "four_bar.yaml").read_text())
    assert data["rotor_inertia"]["crank"] > 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--train", "0:9"], "nothing of use lies outside of --train 0:9, so nothing judges"),
        (
            ["--train", "0:7.7", "--bandwidth", "10"],
            "1 of 1 held-out recordings are too short for a low-pass of 10 Hz and are not used",
        ),
        (
            ["--train", "0:6", "--min-speed", "crank=1.03", "--bandwidth", "40"],  # else 4 rows
            "no held-out recording moves faster than",
        ),
    ],
)
def test_what_judges_nothing_is_told(tmp_path, crank, arguments, message):
    """The machine is identified, and no report claims a validation."""
    done = typed("identify", *crank, *arguments, "--prior", "0.3",
                 "--out", tmp_path / "out")  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert (
        message in done.stderr
        and "validation, samples near standstill excluded" not in done.stdout
    )
    assert "<dt>validation</dt>" not in (tmp_path / "out" / "report.html").read_text()


def test_a_rest_that_stands_still_does_not_judge(tmp_path, crank):
    machine, path = crank
    moving = crane.recordings.read_measured(crane.load(machine), path)
    held = {name: getattr(moving, name).copy() for name in ("q", "v", "tau")}
    for values in held.values():
        values[1180:] = values[1180]
    held["v"][1180:] = 0.0
    dataclasses.replace(moving, **held).to_csv(tmp_path / "rests.csv")
    done = typed("identify", machine, tmp_path / "rests.csv", "--train", "0:5.9", "--prior", "0.3",
                 "--out", tmp_path / "out")  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "5.905 to 7.975 s, judges nothing: no joint moves" in done.stderr


@pytest.fixture(scope="module")
def crank(tmp_path_factory):
    """A machine and a recording of it, as arguments."""
    from broken_machines import DATA

    folder = tmp_path_factory.mktemp("crank")
    machine = crane.load(DATA / "four_bar.yaml")
    q = 0.6 + 0.3 * np.sin(2 * TIME) + 0.1 * np.sin(5.3 * TIME + 1)
    v = 0.6 * np.cos(2 * TIME) + 0.53 * np.cos(5.3 * TIME + 1)
    a = -1.2 * np.sin(2 * TIME) - 2.809 * np.sin(5.3 * TIME + 1)
    tau = crane.Dynamics(machine).inverse(q[:, None], v[:, None], a[:, None], friction=True)
    recording = crane.Recording(
        time=TIME, joints=("crank",), q=q[:, None], v=v[:, None], tau=tau, units={"crank": "rad"}
    )
    recording.to_csv(folder / "crank.csv")
    return DATA / "four_bar.yaml", folder / "crank.csv"


# --- settings by cross-validation --------------------------------------------------------------


def test_the_prior_that_predicts_is_chosen(arm):
    """Bodies are as described: held to that they predict what is left out, free they do not."""
    rng, motion = np.random.default_rng(3), moved(arm)
    tau = motion.tau + 0.05 * motion.tau.std(axis=0) * rng.normal(size=motion.tau.shape)
    given = dataclasses.replace(motion, tau=tau)
    trials = cross_validate(arm, given, {"bodies": ["1 %", "10000 %"]}, bandwidth=5.0)
    assert [trial.settings["bodies"] for trial in trials] == ["1 %", "10000 %"]
    assert trials[0].mean_error < trials[1].mean_error and trials[0].errors.shape == (FOLD_COUNT,)
    assert "bodies=1 %" in format_trials(trials).splitlines()[2]
    with pytest.raises(
        InputError, match="there are no candidates, give values such as bandwidth=2,5,10"
    ):
        cross_validate(arm, given, {})
    few = {name: getattr(given, name)[:200] for name in ("time", "q", "v", "a", "tau")}
    with pytest.raises(InputError, match="200 samples are too few for 5 folds, give at least 250"):
        cross_validate(arm, Motion(**few), {"bandwidth": [5.0]})


@pytest.mark.parametrize(
    ("tried", "options", "message"),
    [
        ({"link9": ["1 %"]}, {}, "prior 'link9' is unknown, did you mean 'link"),
        ({"bodies": ["1 %", "3"]}, {}, "prior 'bodies' is 3, of bodies give a share"),
        ({"bandwidth": [np.nan, 5.0]}, {}, "the bandwidth is nan Hz, give a number above 0"),
        ({"bandwidth": [5.0, -5.0]}, {}, "the bandwidth is -5.0 Hz, give a number above 0"),
        ({"bandwidth": ["x"]}, {}, "bandwidth is 'x', give numbers in Hz"),
        (
            {"bodies": ["1 %"]},
            {"prior": (0, 1)},
            "the prior is an array of all parameters, give it",
        ),
        (
            {"bandwidth": [5.0]},
            {"method": "x"},
            "some fold of the training data is not determined",
        ),
    ],
)
def test_what_cannot_be_tried(arm, tried, options, message):
    """An unknown name is an error, not a setting with a bad prediction."""
    with pytest.raises(InputError) as caught:
        cross_validate(arm, moved(arm), tried, **options)
    assert str(caught.value).startswith(message)
    assert "method" not in options or "(lastly: method 'x' is unknown" in str(caught.value)


def test_a_part_at_rest_judges_nothing(arm):
    """The other parts are validated."""
    motion, rest = moved(arm), slice(640, 960)
    held = {name: getattr(motion, name).copy() for name in ("time", "q", "v", "a", "tau")}
    held["q"][rest] = held["q"][640]
    held["v"][rest] = held["a"][rest] = 0.0
    (trial,) = cross_validate(
        arm, Motion(**held), {"bodies": ["1 %"]}, bandwidth=5.0, min_speed={"q*": 0.01}
    )
    assert np.isnan(trial.errors).tolist() == [False, False, True, False, False]
    assert trial.mean_error < 0.1 and " - " in format_trials([trial])


def test_a_share_of_everything_stands_beside_what_is_tried(arm):
    (trial,) = cross_validate(arm, moved(arm), {"bodies": ["1 %"]}, prior=0.3, bandwidth=5.0)
    assert trial.mean_error < 0.1
    assert identify_options(arm, trial.settings, {"prior": 0.3})["prior"] == {
        "*": ParameterPrior(0.3, relative=True), "bodies": ParameterPrior(0.01, relative=True)
    }  # fmt: skip


def test_what_is_given_counts_after_what_the_machine_file_says(arm):
    """Also where both say something of the same name: the last that speaks counts."""
    known = {
        "*": ParameterPrior(0.3, relative=True),
        "bodies": ParameterPrior(0.01, relative=True),
    }
    told = arm.replace(estimation=EstimationSettings(prior=known))
    ours, plain = (
        identify(machine, moved(arm), prior=prior, bandwidth=5.0).parameters
        for machine, prior in ((told, 0.5), (arm, {"*": "50 %"}))
    )
    np.testing.assert_array_equal(ours, plain)


def test_parts_are_predicted_by_the_others_alone(arm):
    """A part whose forces are twice as large is predicted as badly as they say, others hardly."""
    motion = moved(arm)
    tau = motion.tau.copy()
    tau[640:960] *= 2.0  # the third of five parts
    given = dataclasses.replace(motion, tau=tau)
    (trial,) = cross_validate(arm, given, {"bandwidth": [5.0]}, prior={"bodies": "1 %"})
    assert trial.errors.argmax() == 2 and trial.errors[2] > 0.4


def test_two_recordings_teach_as_one(arm):
    """Two short validation parts are judged together."""
    one, two = moved(arm, seed=0), moved(arm, seed=1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        both = identify(arm, [one, two], [one, two], prior={"bodies": "10 %"}, bandwidth=5.0)
        alone = identify(arm, one, [two], prior={"bodies": "10 %"}, bandwidth=5.0)
    assert len(both.training.time) == 2 * len(alone.training.time)
    assert (np.diff(both.training.time) > 0).all()
    np.testing.assert_allclose(both.training.modelled, both.validation.modelled, rtol=1e-12)
    assert both.validation.overall_relative_error < 1e-3


def test_what_is_learned_does_not_judge_and_is_learned_once(arm):
    """A part of a recording is the recording; other forces at the same times are not."""
    one, other = moved(arm, seed=0), moved(arm, seed=1)
    part = Motion(*(x[400:] for x in (one.time, one.q, one.v, one.a, one.tau)))
    known = {"prior": {"bodies": "10 %"}, "bandwidth": 5.0}
    with pytest.raises(
        RecordingError, match="100% of recording 2's samples are in recording 1 as"
    ):
        identify(arm, [one, part], **known)
    with pytest.raises(RecordingError, match="75% of recording 2's samples are in recording 1 as"):
        identify(arm, [part, one], **known)
    with pytest.warns(CraneWarning, match="100% of the held-out samples are training data: their"):
        identify(arm, one, [other, part], **known)
    with warnings.catch_warnings():
        warnings.simplefilter("error", CraneWarning)  # errors of rounding are none, either
        identify(arm, one, other, **known)


def test_times_in_another_unit_are_refused(arm):
    """Milliseconds that are said to be seconds are no harm to forces, but to velocities."""
    good = moved(arm)
    recording = crane.Recording(
        time=1e-3 * TIME, joints=arm.active, q=good.q, v=1e3 * good.v, tau=good.tau,
        units=dict.fromkeys(arm.active, "rad"),
    )  # fmt: skip
    with pytest.raises(RecordingError) as caught:
        identify(arm, recording)
    assert re.match(
        r"'q1' moves at \S+ rad/s on the whole, its limit is 5.01 rad/s: ", str(caught.value)
    )
    assert "look at the unit of the time; if the recording is right" in str(caught.value)


def test_rests_that_are_alike_are_no_shared_samples(arm):
    one, other = moved(arm, seed=0), moved(arm, seed=1)
    for motion in (one, other):
        motion.tau[:640] = 1.0
    check_shared_samples([one, other], [], False)
    with pytest.raises(RecordingError, match="100% of recording 2's samples are in recording 1"):
        check_shared_samples([one, one], [], False)


def test_which_of_several_cannot_serve_is_said(arm):
    good = moved(arm)
    recording = crane.Recording(
        time=TIME[:20], joints=arm.active, q=good.q[:20], v=good.v[:20], tau=-good.tau[:20],
        units=dict.fromkeys(arm.active, "rad"),
    )  # fmt: skip
    known = {"prior": {"bodies": "10 %"}, "bandwidth": 5.0}
    for given, message in (
        ((recording,), "20 samples are too few"),
        (([good, recording],), "recording 2 of 2: 20 samples are too few"),
        ((good, recording), "validation 1 of 1: 20 samples are too few"),
    ):
        with pytest.raises(RecordingError) as caught:
            identify(arm, *given, **known)
        assert str(caught.value).startswith(message)


@pytest.mark.parametrize(
    ("slow", "message"),
    [
        ([0.1, 0.2], "min_speed has the shape (2,), give (6,)"),
        ([0.1] * 5 + [np.nan], "min_speed is nan at q6"),
        (-0.1, "min_speed of 'q1' is -0.1, it must not be negative"),
    ],
)
def test_velocities_of_standstill_that_are_none(arm, slow, message):
    with pytest.raises(InputError) as caught:
        identify(arm, moved(arm), min_speed=slow, bandwidth=5.0)
    assert str(caught.value).startswith(message)


def test_a_body_without_mass_cannot_be_a_share_of_itself(tmp_path, arm):
    """A body without mass causes one line, no numpy warning."""
    text = (arm.chains[0].urdf).read_text()
    (tmp_path / "arm.urdf").write_text(text.replace('<mass value="0.2"/>', '<mass value="0"/>'))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        machine = crane.load(tmp_path / "arm.urdf")
        motion = moved(machine)
        with pytest.raises(InputError, match="'link6' is described without mass, give it a rough"):
            identify(machine, motion, feasible=True, trust=True, bandwidth=10.0)
