"""Unnamed wrenches: planted ones are found with their quantity and their few terms, and nothing is found in noise."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from sysid.errors.features import BIN
from sysid.errors.noise import Whitener
from sysid.errors.space import make_space
from sysid.follow_up.unnamed import UnnamedReplays, as_report, fit_unnamed, tables, vehicle_of, with_start_angles
from sysid.follow_up.wrench_tables import (
    Products,
    Term,
    WrenchTable,
    columns_of,
    few_terms,
    gains_without,
    in_words,
    shift,
)
from sysid.logs.manoeuvre_library import make_command
from sysid.logs.records import OdometryStream, PoseStream, Start, Trial
from sysid.missing.catalogue import base_values
from sysid.missing.unexplained import PHASES, align, best_gain, held_back_gains, wave_turns
from sysid.pages import loop_report
from sysid.pages.loop_page import describe_unnamed
from sysid.pages.loop_page import wrench as wrench_section
from sysid.replay.models import with_effects
from sysid.replay.rollout import vehicle_plant
from whill_mjx.effects.unnamed import KNOTS, MAP
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.parameters import get_values
from whill_mjx.vehicle.presets import preset
from whill_mjx.vehicle.vehicle_file import load_vehicle, save_vehicle

quick = pytest.mark.quick
TIME = 9.0
ROOM = 2.0  # m, of which the drives cover a square about their start
DRIVES = ("straight", "turn", "circle", "s_curve", "reversal")
ANGLES = np.arange(KNOTS) * 2 * np.pi / KNOTS


def trial_of(name, heading):
    t = np.arange(0.0, TIME + 1e-9, 0.05)
    return Trial(f"{name}_1", name, make_command(name, 0.5, 0.8, TIME - 2.0), OdometryStream(t, None, None, None, t, t),
                 PoseStream(t, ROOM * np.cos(t), ROOM * np.sin(t), t), Start(yaw=heading))


@pytest.fixture(scope="module")
def bench():
    """Five manoeuvres of the chair, with a reference that knows their noise."""
    spec, params = preset("whill_cr_physical")
    space = make_space(params, spec, ["torque_drive.kp", "rolling_resistance.mu_r"])
    scale = np.array([0.004, 0.008, 0.01, 0.01, 0.01])
    reference = SimpleNamespace(
        width=BIN, gyro=False,
        params=params, space=space, u=space.to_unit(space.initial), factors=np.ones((4, 5)),
        whitener=Whitener(scale, np.zeros((1, 5, 5)), np.eye(5)), target_of=lambda drives: drives.target)
    trials = tuple(trial_of(name, heading) for heading, name in enumerate(DRIVES))
    base = SimpleNamespace(u=reference.u, residual=None, jacobian=None)
    result = SimpleNamespace(
        log=SimpleNamespace(spec=spec, training=trials), reference=reference,
        plant=vehicle_plant(spec, VehicleConfig(physics_dt=0.01)),
        search=SimpleNamespace(base=base, verdict="unexplained", excess=(0.0, 0.0)),
        evidence=SimpleNamespace(groups=tuple((i,) for i in range(len(trials))), precision=400.0 * np.eye(2)))
    made = UnnamedReplays(result)
    slopes = made.drives.linearised(made.values, made.u, np.full(2, 0.02))[1]
    base.jacobian = made.white(slopes, made.drives.mask)
    return made


def measure(bench, table=None, wrench=None, phases=None, seed=0):
    """Let the drives show a wrench and noise of unit size, and nothing else."""
    count = len(DRIVES)
    table = table or WrenchTable("speed", "push", 0.0, 1.0)
    wrench = np.zeros(2 * KNOTS) if wrench is None else wrench
    nothing = np.zeros(2 * KNOTS)
    phases, still = np.zeros(count, int) if phases is None else phases, np.zeros(count, int)
    bench.target = np.zeros_like(bench.target)
    seen = -bench.residual([(bench.u, wrench)], table, phases)[0]
    noise = np.random.default_rng(seed).standard_normal(seen.shape)
    bench.target = seen + noise
    search = bench.result.search
    search.base.residual = bench.residual([(bench.u, nothing)], table, still)[0]
    search.excess = (float(np.square(search.base.residual).mean()) - 1, 0.0)


def test_friction_that_fades_with_time_is_found_as_such(bench, tmp_path):
    truth = WrenchTable("time in the drive", "brake", 0.0, TIME)
    measure(bench, truth, np.concatenate([-40 * np.exp(-truth.knots / 2.5), np.zeros(KNOTS)]))
    found = fit_unnamed(bench)
    assert (found.table.quantity, found.table.kind) == ("time in the drive", "brake") and found.kept
    assert [term.form for term in found.terms] == ["decay"]
    at = np.interp([1.2, 2.0], found.table.knots, found.wrench[:KNOTS])
    np.testing.assert_allclose(at, -40 * np.exp(-np.array([1.2, 2.0]) / 2.5), rtol=0.25)  # rolling takes a part of it
    assert found.cost[1] < 1.1 < found.cost[0]
    report = as_report(found)
    assert "exp(-z" in report["symbolic"]["force"] and report["units"]["quantity"] == "s"
    assert "time in the drive" in describe_unnamed(report) and "<svg" in wrench_section(report)
    vehicle = vehicle_of(bench.result, report["parameters"])
    save_vehicle(tmp_path / "vehicle.toml", bench.result.log.spec, vehicle)
    _, read, _ = load_vehicle(tmp_path / "vehicle.toml")
    for name, value in report["parameters"].items():
        np.testing.assert_allclose(get_values(read, [name])[0], value, rtol=1e-6)


@quick
def test_the_vehicle_of_a_wrench_has_what_a_refit_to_poses_added():
    _, params = preset("whill_cr_physical")
    result = SimpleNamespace(reference=SimpleNamespace(params=params))
    plain = vehicle_of(result, {})
    refitted = with_effects(plain, ("sensor_delay", "lateral_damping"))
    values = {**base_values(refitted), "lateral_damping.c_rear": 3.0}
    found = vehicle_of(result, values)
    assert [one.name for one in found.effects] == [one.name for one in refitted.effects]
    assert base_values(found) == pytest.approx(values)


def test_a_wheel_out_of_balance_is_found_though_every_drive_starts_at_another_angle(bench):
    truth = WrenchTable("left wheel's angle", "push", 0.0, 1.0)
    force = 12 * np.sin(ANGLES)
    starts = np.array([3, 17, 8, 22, 12])
    measure(bench, truth, np.concatenate([force, -0.25 * force]), starts)
    found = fit_unnamed(bench)
    assert (found.table.quantity, found.table.kind) == ("left wheel's angle", "push") and found.kept
    assert found.gain > 0.5
    wave = np.fft.rfft(found.wrench[:KNOTS])[1] * 2 / KNOTS
    np.testing.assert_allclose(abs(wave), 12, rtol=0.15)
    text = as_report(found)["symbolic"]["force"]
    assert "sin(z)" in text  # counted from where the wave rises through zero, and so are the starts
    np.testing.assert_allclose(np.cos(found.angles - PHASES[starts]), 1.0, atol=0.1)


def test_soft_places_in_the_room_are_fitted_on_a_map(bench, monkeypatch):
    truth = WrenchTable(MAP, "brake", -ROOM, ROOM, -ROOM, ROOM)
    assert {MAP, "x in the room", "y in the room"} <= {one.quantity for one in tables(bench.result)}
    soft = np.where(truth.knots.prod(-1) > 0, -60.0, 0.0)  # two corners: neither x nor y by itself tells them
    measure(bench, truth, np.concatenate([soft, np.zeros(KNOTS)]))
    monkeypatch.setattr("sysid.follow_up.unnamed.tables", lambda _: [truth])  # five drives are too few to choose by,
    monkeypatch.setattr("sysid.follow_up.wrench_tables.SMOOTHING", (0.01,))  # the smoothing too
    found = fit_unnamed(bench)
    assert found.cost[1] < 1.1 < 1.3 < found.cost[0] and not found.terms
    assert found.wrench[:KNOTS][soft < 0].mean() < -20 < found.wrench[:KNOTS][soft == 0].mean()
    report = as_report(found)
    assert report["symbolic"] is None and np.shape(report["knots"]) == (KNOTS, 2)
    assert "place in the room" in describe_unnamed(report) and "y = " in wrench_section(report)


def test_nothing_is_kept_of_noise(bench):
    measure(bench, seed=3)
    found = fit_unnamed(bench)
    assert not found.kept
    assert describe_unnamed(as_report(found)).startswith("no wrench over one quantity explains it")


def test_a_plant_places_the_wheels_as_each_trial_found_them(bench):
    trials, angles = bench.result.log.training, np.linspace(0.5, 4.5, len(DRIVES))
    plant = with_start_angles(bench.result.plant, trials, angles)
    for trial, angle in zip(trials, angles, strict=True):
        start = jnp.array([trial.start.x, trial.start.y, trial.start.yaw, 0.0, 0.0])
        state = plant.place(bench.params, start)
        np.testing.assert_allclose(state.memory[-1].angle, angle, rtol=1e-6)
        np.testing.assert_array_equal(state.qpos, bench.result.plant.place(bench.params, start).qpos)


def products_of(columns, residual, groups=4):
    """Products of columns (B, n, S) with no base parameter but one that does nothing."""
    design = np.concatenate([np.zeros((*columns.shape[:2], 1)), columns], axis=-1)
    parts = np.array_split(np.arange(len(design)), groups)
    flat = [design[part].reshape(-1, design.shape[-1]) for part in parts]
    rest = [residual[part].reshape(-1) for part in parts]
    return Products(np.stack([x.T @ x for x in flat]), np.stack([x.T @ r for x, r in zip(flat, rest, strict=True)]),
                    np.array([r @ r for r in rest]))


@quick
def test_few_terms_stand_for_a_table_that_is_one_and_not_for_one_that_is_none():
    random = np.random.default_rng(1)
    table = WrenchTable("left wheel's angle", "push", 0.0, 1.0)
    columns = random.standard_normal((8, 60, 2 * KNOTS))
    planted = np.concatenate([3 * np.sin(2 * ANGLES + 0.4), np.zeros(KNOTS)])
    rough = np.concatenate([random.choice([-3.0, 3.0], KNOTS), np.zeros(KNOTS)])
    gains = {}
    for name, wrench in (("planted", planted), ("rough", rough)):
        residual = columns @ wrench + random.standard_normal((8, 60))
        products = products_of(columns, residual)
        short, terms = few_terms(products, np.eye(1), table)
        whole = gains_without(products, 1e-3 * np.eye(1 + 2 * KNOTS), 1)
        gains[name] = short.sum() / whole.sum()
        if name == "planted":
            assert terms == (Term("harmonic", 2.0),)
    assert gains["planted"] > 0.95 and gains["rough"] < 0.75


@quick
def test_held_back_gains_of_noise_are_negative():
    random = np.random.default_rng(2)
    columns, residual = random.standard_normal((8, 60, 2 * KNOTS)), random.standard_normal((8, 60))
    assert gains_without(products_of(columns, residual), 1e-3 * np.eye(1 + 2 * KNOTS), 1).sum() < 0


@quick
def test_what_one_drive_alone_leaves_is_not_called_a_function_of_anything():
    spec, _ = preset("whill_cr_physical")
    alone, again = (trial_of("straight", 0.0),), (trial_of("straight", 0.0), trial_of("straight", 0.0))
    left = np.tile(np.sin(np.arange(round(TIME / BIN)) * BIN)[:, None], (1, 5)).reshape(1, -1)
    assert set(held_back_gains(alone, spec, 5 * left, BIN).values()) == {0.0}
    assert best_gain(alone, spec, 5 * left, BIN) == 0.0
    assert best_gain(again, spec, np.concatenate([5 * left, 5 * left]), BIN) > 10


@quick
def test_a_quantity_that_predicts_nothing_is_no_place_where_the_rest_lives(monkeypatch):
    gains = {"speed": 0.0, "yaw rate": 8.0, "time in the drive": -3.0}
    monkeypatch.setattr(loop_report, "held_back_gains", lambda *_: gains)
    found = SimpleNamespace(final=SimpleNamespace(residual=np.ones((2, 50))), excess=(0.5, 1.0))
    result = SimpleNamespace(search=found, log=SimpleNamespace(training=(), spec=None),
                             reference=SimpleNamespace(width=BIN, channels=5))
    assert [one["quantity"] for one in loop_report.where_it_lives(result)] == ["yaw rate"]


@quick
def test_the_angle_that_each_drive_starts_at_is_found_up_to_one_for_all():
    random = np.random.default_rng(4)
    turns, truth = wave_turns(2, False), random.integers(0, len(PHASES), 12)
    shape, products, moments = np.array([1.0, 0.3, -0.5, 0.4]), [], []
    for phase in truth:
        angle = random.uniform(0, 20, 200)
        columns = np.stack([np.sin(angle), np.cos(angle), np.sin(2 * angle), np.cos(2 * angle)], axis=-1)
        start = angle + PHASES[phase]
        seen = np.stack([np.sin(start), np.cos(start), np.sin(2 * start), np.cos(2 * start)], axis=-1) @ shape
        products.append(columns.T @ columns)
        moments.append(columns.T @ (seen + 0.3 * random.standard_normal(200)))
    solution, found = align(np.stack(products), np.stack(moments)[..., None], turns, 1e-3 * np.eye(4))
    away = (found - truth - found[0] + truth[0] + 12) % len(PHASES) - 12
    assert np.abs(away).max() <= 1
    np.testing.assert_allclose(np.hypot(*solution[:2, 0]), np.hypot(*shape[:2]), rtol=0.1)


@quick
def test_a_shifted_table_is_the_table_at_a_shifted_angle():
    values = np.random.default_rng(5).standard_normal(KNOTS)
    for knots in (0, 3, 11):
        moved = shift(knots * 2 * np.pi / KNOTS) @ values
        np.testing.assert_allclose(moved, np.roll(values, -knots), atol=1e-9)
    half = shift(1.5 * 2 * np.pi / KNOTS) @ values
    np.testing.assert_allclose(half, (np.roll(values, -1) + np.roll(values, -2)) / 2, atol=1e-9)


@quick
def test_sums_are_written_as_they_are_computed():
    terms, knots = (Term("power", 0.0), Term("decay", 2.0), Term("sign", 0.1)), np.linspace(0.0, 3.0, KNOTS)
    basis, parts = columns_of(terms, knots)
    assert basis.shape == (2 * KNOTS, 6) and [len(part) for part in parts] == [2, 2, 2]
    coefficients = [np.array([1.5, 0.0]), np.array([-4.0, 2.0]), np.array([0.25, 0.0])]
    force = (basis @ np.concatenate(coefficients))[:KNOTS]
    np.testing.assert_allclose(force, 1.5 - 4 * np.exp(-knots / 2) + 0.25 * np.tanh(knots / 0.1))
    assert in_words(terms, coefficients, 0) == "1.5 - 4 exp(-z / 2) + 0.25 tanh(z / 0.1)"
