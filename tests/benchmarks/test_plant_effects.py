"""Every effect of the contact plant changes the log, and in the direction that its form says."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks.plant.base import Effect
from benchmarks.plant.chair import COULOMB, SLOW, Chair, Nominal
from benchmarks.plant.commands import nine
from benchmarks.plant.effects import EFFECTS, in_proportion
from benchmarks.plant.first_day import SMALL, SmallPlant
from benchmarks.plant.sensors import odometry
from benchmarks.plant.trial import Noise, Plant

TABLES = nine(0)
QUIET = Noise().scaled(0.0)
STRONGEST = {  # the manoeuvre that shows an effect best; the change of a channel there, in its own units
    "command_dead_zone": "creep", "dry_friction": "creep", "wheel_radius_difference": "straight",
    "track_width": "circle", "command_scale": "stop_and_go", "yaw_scrub": "circle", "omni_roller_friction": "circle",
    "caster_kick": "circle", "side_force": "straight", "rolling_resistance_speed": "straight",
    "soft_patch": "creep", "warm_up": "creep", "rest_friction": "creep", "command_coupling": "circle",
    "command_dropouts": "s_curve", "carpet_nap": "creep", "odometry_scale": "stop_and_go", "wheel_ripple": "circle",
    "slope": "creep", "wind": "creep", "quadratic_drag": "straight",
}  # fmt: skip


@cache
def drive(manoeuvre, name="", size=0.0, yaw=0.0):
    """Noise-free drive, its odometry, its effects."""
    chair, effects = Chair(), []
    if name:
        chair = EFFECTS[name].make.change(chair, size)
        effects = [EFFECTS[name].make(size, np.random.default_rng(0), chair)]
    log = Plant(chair).drive(TABLES[manoeuvre], (0.0, 0.0, yaw), effects, QUIET, np.random.default_rng(1))
    return log, odometry(log, effects, QUIET, np.random.default_rng(2))


def base(manoeuvre, name, factor=1.0, yaw=0.0):
    return drive(manoeuvre, name, factor * EFFECTS[name].base, yaw)


def at(log, low, high, plain=None):
    """True speeds (K, 3) within a time window, less those of another drive."""
    window = (log.t > low) & (log.t < high)
    return log.speed[window] - (0.0 if plain is None else plain.speed[window])


@pytest.mark.parametrize("name", EFFECTS)
def test_every_effect_shows_at_its_base_size(name):
    manoeuvre = STRONGEST.get(name, "random")
    (plain, plain_rows), (log, rows) = drive(manoeuvre), base(manoeuvre, name)
    same = np.column_stack([np.interp(plain_rows[:, 0], rows[:, 0], column) for column in rows.T])
    x = 0.001 if manoeuvre in ("straight", "creep", "stop_and_go") else 0.005  # m; what bends the path spreads it
    reported = np.sqrt(((same - plain_rows)[:, 1:] ** 2).mean(axis=0)) / [x, 0.005, 0.003, 0.004, 0.0065]
    moved = np.sqrt(((log.pose - plain.pose) ** 2).mean(axis=0)) / [0.005, 0.005, 0.0045]
    assert max(*reported, *moved) > 1.5  # of the spread of replicates


@pytest.mark.parametrize("name", EFFECTS)
def test_every_effect_fades_with_its_size(name):
    manoeuvre = "circle"
    plain, faint = drive(manoeuvre)[0], base(manoeuvre, name, 1e-4)[0]
    assert np.abs(faint.speed - plain.speed)[250:4500].max() < 0.03  # a tick of delay is 0.015 m/s


def test_dry_friction_of_a_small_robot_slows_its_wheels_and_does_not_shake_them():
    table = np.array([[0.0, 0.0, 0.0], [0.5, 0.1, 0.5], [2.0, 0.0, 0.0], [2.5, 0.0, 0.0]])
    size = in_proportion("dry_friction", 2.0, SMALL)
    reported = []
    for effects in ([], [EFFECTS["dry_friction"].make(size, np.random.default_rng(0), SMALL)]):
        log = SmallPlant(SMALL, COULOMB).drive(table, (0.0, 0.0, 0.0), effects, QUIET, np.random.default_rng(1))
        reported.append(odometry(log, effects, QUIET, np.random.default_rng(2))[:, 4:])
    without, slowed = reported
    assert np.abs(slowed).max() <= 1.05 * np.abs(without).max()
    rising = slice(27, 33)  # within a few frames after the command
    assert slowed[rising, 0].mean() < without[rising, 0].mean()


def test_half_of_the_known_effects_have_another_law_than_the_catalogue():
    known = [entry for entry in EFFECTS.values() if entry.known]
    assert sum(entry.other_form for entry in known) >= len(known) / 2
    assert len(EFFECTS) - len(known) >= 6
    assert all(entry.form and entry.unit and entry.base > 0 for entry in EFFECTS.values())
    assert all(issubclass(entry.make, Effect) for entry in EFFECTS.values())


@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_delay_shifts_the_response_by_its_size(factor):
    plain, late = drive("stop_and_go")[0], base("stop_and_go", "command_delay", factor)[0]
    start = [np.interp(0.3, log.speed[250:400, 0], log.t[250:400]) for log in (plain, late)]
    assert start[1] - start[0] == pytest.approx(factor * 0.06, rel=0.25)


def test_larger_left_wheel_turns_the_chair_right_and_odometry_does_not_see_it():
    plain, (log, rows) = drive("straight"), base("straight", "wheel_radius_difference")
    distance = plain[0].pose[-1, 0]
    assert log.pose[-1, 2] - plain[0].pose[-1, 2] == pytest.approx(-0.006 * distance / Nominal.track, rel=0.15)
    assert abs(rows[-1, 3] - plain[1][-1, 3]) < 0.01
    mirrored = base("straight", "wheel_radius_difference", -1.0)[0]
    assert mirrored.pose[-1, 2] > 0.05


def test_slope_pulls_downhill_in_the_room():
    uphill = at(base("straight", "slope")[0], 1.1, 1.5, drive("straight")[0])[:, 0].mean()
    downhill = at(base("straight", "slope", yaw=np.pi)[0], 1.1, 1.5, drive("straight", yaw=np.pi)[0])[:, 0].mean()
    assert uphill < -0.001 and downhill > 0.001
    held = base("straight", "slope")[0]
    assert np.abs(held.pose[:250, 0]).max() < 0.01  # the controllers hold it before the start


def test_wind_pushes_along_the_room_and_its_gusts_differ():
    log = base("creep", "wind", 3.0, yaw=np.pi)[0]
    slower = at(log, 0.0, 1.0)[:, 0]
    assert slower.min() < -0.001  # facing -x, it is pushed back


@pytest.mark.parametrize("name", ["track_width", "yaw_scrub"])
def test_wider_track_and_scrub_cost_true_yaw(name):
    plain, log = drive("circle")[0], base("circle", name)[0]
    assert log.pose[4500, 2] < plain.pose[4500, 2] - 0.03
    share = log.pose[4500, 2] / plain.pose[4500, 2] - 1
    assert -0.06 < share < (-0.015 if name == "track_width" else -0.003)


def test_acceleration_limit_makes_ramps_of_constant_slope():
    log = base("straight", "acceleration_limit")[0]
    rate = np.gradient(log.speed[:, 0], 0.004)
    assert np.median(rate[(log.t > 1.15) & (log.t < 1.4)]) == pytest.approx(2.0, rel=0.15)  # 1 / 0.5 s^2/m
    assert np.max(np.gradient(drive("straight")[0].speed[:, 0], 0.004)[260:330]) > 2.8


def test_jerk_limit_and_lag_slow_the_rise():
    for name in ("jerk_limit", "actuator_lag", "payload_shift", "torque_saturation"):
        assert at(base("straight", name)[0], 1.05, 1.2, drive("straight")[0])[:, 0].mean() < -0.01, name


def test_scales_show_where_they_act():
    plain, plain_rows = drive("stop_and_go")
    log, rows = base("stop_and_go", "odometry_scale")
    assert rows[-1, 1] / plain_rows[-1, 1] == pytest.approx(1.01, abs=0.001)
    assert log.pose[-1] == pytest.approx(plain.pose[-1], abs=1e-9)
    log = base("stop_and_go", "command_scale")[0]
    assert log.pose[-1, 0] / plain.pose[-1, 0] == pytest.approx(1.02, abs=0.003)


def test_stale_and_misstamped_reports_leave_the_drive_alone():
    plain, plain_rows = drive("stop_and_go")
    rising = slice(20, 40)
    for name in ("sensor_delay", "clock_offset"):
        log, rows = base("stop_and_go", name)
        assert np.array_equal(log.pose, plain.pose)
        reported = np.interp(plain_rows[:, 0], rows[:, 0], rows[:, 4])
        assert (reported - plain_rows[:, 4])[rising].mean() < -0.01, name
    early = base("stop_and_go", "clock_offset", -1.0)[1]
    assert early[0, 0] >= 0 and early[1, 0] - early[0, 0] == pytest.approx(0.05, abs=0.001)


def test_side_force_drifts_left_and_gain_difference_to_the_weaker_side():
    assert base("straight", "side_force")[0].pose[-1, 2] > drive("straight")[0].pose[-1, 2] + 0.005
    strong = at(base("straight", "drive_gain_difference")[0], 1.05, 1.3, drive("straight")[0])
    assert strong[:, 2].mean() < -0.001  # the stronger left drive turns it right


def test_dead_zone_loses_the_slow_start_of_creeping():
    log, plain = base("creep", "command_dead_zone")[0], drive("creep")[0]
    assert np.abs(at(log, 1.5, 3.0)[:, 0]).max() < 0.005 < at(plain, 1.5, 3.0)[:, 0].min()
    assert at(log, 12.0, 14.0, plain)[:, 0].mean() == pytest.approx(0.0, abs=0.01)


def test_wheel_ripple_follows_the_wheel_angle():
    log = base("straight", "wheel_ripple")[0]
    window = (log.t > 8) & (log.t < 18)
    yaw_rate = log.speed[window, 2] - log.speed[window, 2].mean()
    spectrum = np.abs(np.fft.rfft(yaw_rate * np.hanning(len(yaw_rate))))
    frequency = np.fft.rfftfreq(len(yaw_rate), 0.004)[spectrum.argmax()]
    turns = log.speed[window, 0].mean() / Nominal.radius / (2 * np.pi)
    assert frequency == pytest.approx(turns, rel=0.1)


def test_soft_patch_brakes_only_on_the_strip():
    log, plain = base("creep", "soft_patch", 2.0)[0], drive("creep")[0]
    before, inside = (log.pose[:, 0] < 0.3), (log.pose[:, 0] > 0.48) & (log.pose[:, 0] < 0.56)
    difference = log.speed[:, 0] - plain.speed[:, 0]
    assert np.abs(difference[before]).max() < 1e-3 and difference[inside].min() < -0.003


def test_warm_up_and_fade_change_within_a_trial():
    plain = drive("stop_and_go")[0]
    cold = [at(base("stop_and_go", "warm_up")[0], t, t + 0.3, plain)[:, 0].mean() for t in (1.05, 16.05)]
    assert cold[0] < 2 * cold[1] < 0
    faded = [at(base("stop_and_go", "gain_fade")[0], t, t + 0.3, plain)[:, 0].mean() for t in (1.05, 16.05)]
    assert faded[1] < 4 * faded[0] < 0


def test_rest_friction_needs_a_rest():
    plain, log = drive("reverse")[0], base("reverse", "rest_friction")[0]
    started = at(log, 1.0, 1.2, plain)[:, 0].mean()
    reversed_ = at(log, 4.1, 4.6, plain)[:, 0].mean()
    assert started < -0.005 and abs(reversed_) < abs(started) / 2


def test_dropouts_lose_the_stated_share_of_messages_in_bursts():
    table = np.column_stack([np.arange(20000) * 0.1, np.zeros((20000, 2))])
    kept = EFFECTS["command_dropouts"].make(0.1, np.random.default_rng(0), Chair()).messages(table)
    gaps = np.round(np.diff(kept[:, 0]) / 0.1).astype(int) - 1
    assert 1 - len(kept) / 20000 == pytest.approx(0.1, abs=0.02)
    assert gaps[gaps > 0].mean() == pytest.approx(4.0, rel=0.2)


def test_coupling_needs_both_commands():
    plain, log = drive("straight")[0], base("straight", "command_coupling")[0]
    assert np.array_equal(plain.speed, log.speed)
    assert at(base("circle", "command_coupling")[0], 10, 19, drive("circle")[0])[:, 0].mean() < -0.01


def test_backlash_delays_the_push_and_vanishing_grip_slides():
    assert at(base("reverse", "backlash")[0], 4.02, 4.06, drive("reverse")[0])[:, 0].mean() != 0
    log = base("stop_and_go", "traction_limit", 2.0)[0]
    braking = (log.t > 3.55) & (log.t < 3.7)
    sliding = log.speed[braking, 0] - Nominal.radius * np.gradient(log.encoder.mean(axis=1), 0.004)[braking]
    assert sliding.max() > 0.1


@pytest.mark.parametrize(
    ("contact", "play", "coasts"), [(SLOW, 0.02, True), (SLOW, 0.01, False), (COULOMB, 0.02, False)]
)
def test_large_play_costs_the_chair_its_grip_only_where_tyres_grip_again_late(contact, play, coasts):
    """After a stop from 0.2 m/s the wheels report rest. Where the controller hunts, the chair slides on."""
    table = np.array([[0.0, 0.0, 0.0], [0.5, 0.2, 0.0], [2.0, 0.0, 0.0], [2.9, 0.0, 0.0]])
    log = Plant(replace(Chair(), play=play), contact).drive(table, (0.0, 0.0, 0.0), [], QUIET, np.random.default_rng(1))
    after = (log.t > 2.25) & (log.t < 2.75)
    reported = Nominal.radius * np.gradient(log.encoder.mean(axis=1), 0.004)[after].mean()
    assert abs(reported) < 0.02
    assert (log.speed[after, 0].mean() > 0.08) == coasts
    assert coasts or abs(log.speed[after, 0].mean()) < 0.01


def test_caster_kick_follows_a_reversal():
    change = at(base("reverse", "caster_kick")[0], 4.0, 5.5, drive("reverse")[0])[:, 2]
    calm = at(base("reverse", "caster_kick")[0], 7.0, 7.9, drive("reverse")[0])[:, 2]
    assert np.abs(change).max() > 3 * np.abs(calm).mean()


def test_supply_sags_over_the_session():
    make = EFFECTS["supply_sag"].make(0.2, np.random.default_rng(0), Chair())
    from benchmarks.plant.base import Moment

    fresh, spent = make.torque(Moment(session=0.0), 5.0, 5.0), make.torque(Moment(session=500.0), 5.0, 5.0)
    assert spent[0] < 0.9 * fresh[0]
