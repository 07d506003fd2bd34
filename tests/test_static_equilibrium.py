"""Machines that stand: the start of a run in static equilibrium, against statics by hand."""

import numpy as np
import pinocchio as pin
import pytest
import standing_loader
import wheel_loader
import yaml
from command_line import typed
from scipy.optimize import fsolve
from standing_loader import PRECHARGE, RADIUS, STIFFNESS, SUSPENSION, VOLUME, WHEELS

import crane
from crane.common.errors import SimulationError

G = 9.81


@pytest.fixture(scope="module")
def loader(tmp_path_factory):
    return crane.load(standing_loader.write(tmp_path_factory.mktemp("loader")))


@pytest.fixture(scope="module")
def settled(loader):
    return crane.simulation.settle(loader)


def mass_and_centre(machine, q):
    """By Pinocchio [kg], [m]."""
    model, data = machine.model, machine.model.createData()
    return sum(x.mass for x in model.inertias), pin.centerOfMass(
        model, data, machine.coordinates.configuration(q)
    )


def first_pressures(run):
    return {x[9:]: run[x][0] for x in run.channels if x.startswith("pressure_")}


def lift_force(machine, q):
    """dU/dX_lift by virtual work, with the body at rest [N]."""
    q_a, i, h = q[machine.closure.active], machine.active.index("X_lift"), 1e-5
    heights = []
    for sign in (1, -1):
        moved = q_a.copy()
        moved[i] += sign * h
        mass, centre = mass_and_centre(machine, machine.closure.solve(moved))
        heights.append(mass * G * centre[2])
    return (heights[0] - heights[1]) / (2 * h)


def test_four_tyres_carry_a_rigid_body_as_springs_do(loader, settled):
    """Height and pitch from two equations of statics; the wheels press down with k times depth."""
    q_a = settled.q[loader.closure.active]
    mass, home_centre = mass_and_centre(loader, loader.home)
    x, _, z = np.array(list(WHEELS.values())).T
    k = np.array([STIFFNESS[name.partition("_")[0]] for name in WHEELS])

    def unbalanced(unknown):
        height, pitch = unknown
        sin, cos = np.sin(pitch), np.cos(pitch)
        forces = k * (RADIUS - (height - x * sin + z * cos))
        place, centre = x * cos + z * sin, home_centre[0] * cos + home_centre[2] * sin
        return [forces.sum() / (mass * G) - 1, forces @ (place - centre) / (mass * G)]

    height, pitch = fsolve(unbalanced, [0.0, 0.0], xtol=1e-12)
    at = dict(zip(loader.active, q_a, strict=True))
    assert at["base_z"] == pytest.approx(height, rel=1e-8)
    assert at["base_ry"] == pytest.approx(pitch, rel=1e-8)
    assert max(abs(at[name]) for name in ("base_y", "base_rx", "base_rz")) < 1e-12
    forces = {name: settled.run[f"support_{name}"][0] for name in WHEELS}
    assert sum(forces.values()) == pytest.approx(mass * G, rel=1e-12)
    for name, (wheel_x, _, wheel_z) in WHEELS.items():
        depth = RADIUS - (height - wheel_x * np.sin(pitch) + wheel_z * np.cos(pitch))
        stiffness = STIFFNESS[name.partition("_")[0]]
        assert forces[name] == pytest.approx(stiffness * depth, rel=1e-7)


def test_the_suspension_carries_the_boom_by_the_gas_law(loader, settled):
    a, b = wheel_loader.LIFT_AREAS
    force, pressures = lift_force(loader, settled.q), first_pressures(settled.run)
    pressure = (force + b * wheel_loader.TANK) / a
    assert settled.run.tau[0, loader.active.index("X_lift")] == pytest.approx(force, rel=1e-7)
    assert pressures["X_lift_a"] == pytest.approx(pressure, rel=1e-7)
    assert pressures["ride"] == pytest.approx(pressures["X_lift_a"], rel=1e-12)
    assert pressures["X_lift_b"] == pytest.approx(wheel_loader.TANK, abs=1e-6)
    assert pressures["ride"] > PRECHARGE


def test_a_run_of_it_moves_nothing(loader, settled):
    run = crane.simulate(loader, duration=0.5, step=0.01)
    assert run.start.startswith("in static equilibrium on its contacts")
    assert np.abs(run.v[1] / 0.01).max() < 1e-6  # the mean acceleration of the first step
    energy = run["kinetic"] + run["potential"]
    assert run["kinetic"].max() < 1e-16 and np.ptp(energy) < 1e-9
    assert np.ptp(run["pressure_ride"]) < 1e-3
    assert run.q[-1] == pytest.approx(settled.q[loader.closure.active], abs=1e-12)


def test_gas_that_gives_its_heat_away_holds_oil_by_boyle(tmp_path):
    warm = SUSPENSION.replace("exponent", "time_constant: 30, exponent")
    machine = crane.load(standing_loader.write(tmp_path, suspension=warm))
    run = crane.simulate(machine, duration=0.02, step=0.01)
    oil = VOLUME * (1 - PRECHARGE / run["pressure_ride"][0])
    assert run["oil_ride"] == pytest.approx(oil, rel=1e-9)


def test_an_accumulator_at_the_unloaded_side_keeps_its_pressure(tmp_path):
    """Its chamber takes that pressure, and the other one bears it, too."""
    kept = 2.0e6
    both = SUSPENSION.replace(
        "  elements:", f"    back: {{volume: 2e-3, precharge: 1e6, pressure: {kept}}}\n  elements:"
    ).replace("to: tank", "to: back")
    path = standing_loader.write(tmp_path, suspension=both)
    settled = crane.simulation.settle(crane.load(path))
    a, b = wheel_loader.LIFT_AREAS
    p = first_pressures(settled.run)
    assert p["back"] == pytest.approx(kept, abs=1.0)
    assert p["X_lift_b"] == pytest.approx(p["back"], rel=1e-12)
    load = lift_force(settled.machine, settled.q)
    assert p["ride"] == pytest.approx((load + b * p["back"]) / a, rel=1e-7)
    assert any("X_lift_b, back" in text for text in settled.undetermined)


def test_on_a_slope_tyres_hold_it_without_creep(tmp_path):
    slope = 0.05
    path = standing_loader.write(tmp_path, "start: equilibrium\n", slope)
    settled = crane.simulation.settle(crane.load(path))
    machine, angle = settled.machine, np.arctan(slope)
    mass, _ = mass_and_centre(machine, settled.q)
    normal = sum(settled.run[f"support_{name}"][0] for name in WHEELS)
    push = [sum(settled.run[f"load_{name}_force_{x}"][0] for name in WHEELS) for x in "xyz"]
    assert normal == pytest.approx(mass * G * np.cos(angle), rel=1e-10)
    assert push @ np.array([np.cos(angle), 0, np.sin(angle)]) == pytest.approx(
        mass * G * np.sin(angle), rel=1e-10
    )
    run = crane.simulate(machine, duration=0.5, step=0.01)
    assert np.abs(run.v).max() < 1e-10


SPRING = "\nforces: [{joint: slide, stiffness: 800, rest: 0.1}]"
HOOK = """<robot name="hook"><link name="wall"/>
<joint name="slide" type="prismatic"><parent link="wall"/><child link="block"/><axis xyz="0 0 1"/>
<limit lower="-2" upper="2" effort="0" velocity="9"/></joint>
<link name="block"><inertial><mass value="7"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="sway" type="revolute"><parent link="block"/><child link="load"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="0" velocity="9"/></joint>
<link name="load"><inertial><origin xyz="0.3 0 -0.4"/><mass value="3"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""


def hook(folder, start):
    (folder / "hook.urdf").write_text(HOOK)
    (folder / "hook.yaml").write_text(f"""
name: hook
chains: [{{name: hook, urdf: hook.urdf}}]
active: []
free: [slide, sway]
{start}
""")
    return folder / "hook.yaml"


def test_springs_and_hanging_loads_start_at_rest_where_the_file_asks_for_it(tmp_path):
    machine = crane.load(hook(tmp_path, "start: equilibrium" + SPRING))
    run = crane.simulate(machine, duration=1.0, step=0.01)
    assert run["slide"] == pytest.approx(0.1 - 10 * G / 800, rel=1e-9)
    assert run["sway"] == pytest.approx(np.arctan2(0.3, 0.4), rel=1e-9)
    assert np.abs(run.v).max() < 1e-8
    assert run.start.startswith("in static equilibrium, sway +0.6435 rad from home")
    for start in ("", "start: home"):
        falling = crane.simulate(crane.load(hook(tmp_path, start + SPRING)), duration=0.1)
        assert not falling.start and falling.q[0] == pytest.approx(0.0)
    written = crane.load(crane.write_machine(machine, tmp_path / "written"))
    assert written.start == "equilibrium"


def test_what_does_not_stand_says_why(tmp_path):
    path = hook(tmp_path, "start: equilibrium")
    with pytest.raises(SimulationError, match="'hook' has no static equilibrium.*'slide' leaves"):
        crane.simulate(path, duration=0.1)
    above = standing_loader.write(tmp_path)
    text = above.read_text()
    above.write_text(text.replace("normal: [-0.0, 0, 1]", "height: -9"))
    with pytest.raises(SimulationError, match="no contact reaches the ground where 'base_z'"):
        crane.simulation.settle(crane.load(above))
    lines = [x for x in text.splitlines(keepends=True) if "frame: rear" not in x]
    above.write_text("".join(lines))
    with pytest.raises(SimulationError, match="no static equilibrium near home: .*'base_ry'"):
        crane.simulation.settle(crane.load(above))
    above.write_text(text.replace(f"relief: {wheel_loader.RELIEF}", "relief: 1e6"))
    with pytest.raises(SimulationError, match="oil has no static equilibrium: pressure_X_lift_a"):
        crane.simulation.settle(crane.load(above))
    hill = standing_loader.write(tmp_path, slope=0.02, tyres=False)
    with pytest.raises(SimulationError, match="only friction in motion holds 'base_x'"):
        crane.simulation.settle(crane.load(hill))
    above.write_text(text + "start: rest\n")
    with pytest.raises(crane.CraneError, match="'start' of the machine file: 'rest' is unknown"):
        crane.load(above)


def test_stated_pressures_stay_without_start_equilibrium(tmp_path):
    given = SUSPENSION.replace("exponent", "pressure: 3e6, exponent")
    machine = crane.load(standing_loader.write(tmp_path, suspension=given))
    assert crane.simulate(machine, duration=1e-3)["pressure_ride"][0] == pytest.approx(3e6)
    path = standing_loader.write(tmp_path, "start: equilibrium\n", suspension=given)
    run = crane.simulate(path, duration=1e-3)
    assert run["pressure_ride"][0] == pytest.approx(run["pressure_X_lift_a"][0], rel=1e-12)


def test_the_command_prints_and_writes_it(tmp_path, settled):
    path = standing_loader.write(tmp_path)
    done = typed("settle", path, "--write")
    assert done.returncode == 0 and not done.stderr
    tyre, oil = "| front_left | 26079.4 N | 28.977 mm |", "| ride | 18.066 bar | 0 bar/s |"
    for text in (tyre, oil, "not determined: deflections along the ground of front_left"):
        assert text in done.stdout
    home = yaml.safe_load(path.read_text())["home"]
    assert home["base_z"] == pytest.approx(settled.q[settled.machine.column("base_z")], abs=1e-12)
    again = typed("settle", path, "--at", "X_lift=0.4")
    assert again.returncode == 0 and "| X_lift | 31667.2 N |" not in again.stdout
    wrong = typed("settle", path, "--write", "--set", "supply.pressure=2e7")
    assert wrong.returncode == 2 and "--set does not go with --write" in wrong.stderr
