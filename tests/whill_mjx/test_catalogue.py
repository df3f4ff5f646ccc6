"""The catalogue of effects: neutral values, signatures with known answers, derivatives, and many at once."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.effects import EFFECTS, make_effect
from whill_mjx.effects.base import place_of
from whill_mjx.effects.command_quantisation import MAKER
from whill_mjx.effects.gyro_range import MAKER as GYRO
from whill_mjx.kinematics import body_twist
from whill_mjx.model import build_model
from whill_mjx.presets import preset
from whill_mjx.specs import HUSKY
from whill_mjx.types import Drive, Odometry, Payload, parameters_of
from whill_mjx.vehicle import add_payload, drive, measure, nominal_world, place

DRIVES = {"pid_drive", "torque_drive"}  # no disturbances: without them nothing drives
BASE = {"air_drag", "forward_slip", "lateral_damping", "odometry_lag", "rolling_contact", "rolling_resistance",
        "slip_traction"}  # fmt: skip
CATALOGUE = sorted(set(EFFECTS) - DRIVES)
NAMED = {
    "command_delay", "command_dead_zone", "acceleration_limit", "jerk_limit", "command_scale", "command_quantisation",
    "actuator_lag", "torque_saturation", "supply_sag", "drive_gain_difference", "dry_friction",
    "wheel_radius_difference", "track_width", "payload_shift", "yaw_scrub", "omni_roller_friction", "caster_kick",
    "traction_limit", "turn_efficiency", "rolling_resistance_speed", "quadratic_drag", "side_force", "slope", "wind",
    "backlash", "odometry_scale", "sensor_delay", "clock_offset", "gyro_bias", "command_expiry", "encoder_resolution",
    "gyro_range", "state_rate", "incline", "ramp", "bump",
}  # fmt: skip
DT = 0.005  # s
WEIGHT = 52 * 9.81  # N
quick = pytest.mark.quick


@lru_cache
def chair(name="whill_cr"):
    spec, params = preset(name)
    return build_model(spec), params


def motion_at(v=0.0, omega=0.0, sideways=0.0, yaw=0.0, name="whill_cr"):
    """Motion of a vehicle rolling at v [m/s], omega [rad/s], with a sideways speed added."""
    model, params = chair(name)
    state = place(model, params, 0.0, 0.0, yaw, v, omega)
    shift = sideways * jnp.array([-np.sin(yaw), np.cos(yaw)])
    return measure(model, params, nominal_world(model), replace(state, qvel=state.qvel.at[:2].add(shift)))


@lru_cache
def still():
    return motion_at()


def signal(force=(0.0, 0.0), torque=(0.0, 0.0)):
    return Drive(jnp.zeros(2), jnp.asarray(force, jnp.float32), jnp.asarray(torque, jnp.float32))


def reading(x=0.0, y=0.0, yaw=0.0, v=0.0, omega=0.0, gyro=0.0):
    return Odometry(*(jnp.asarray(value) for value in (x, y, yaw, v, omega, gyro)))


def path(v, omega):
    """Odometry (T leaves) of speeds (T,) every 5 ms, from the origin."""
    v, omega = jnp.asarray(v), jnp.asarray(omega)
    yaw = jnp.cumsum(omega) * DT
    x, y = (jnp.cumsum(v * along(yaw - omega * DT / 2)) * DT for along in (jnp.cos, jnp.sin))
    return Odometry(x, y, yaw, v, omega, omega)


def run(effect, inputs, motion=None):
    """Outputs of a command, actuation or sensing effect for a sequence of inputs (leaves with T in front)."""
    method = getattr(effect, place_of(effect))
    motion = motion or still()
    return jax.lax.scan(lambda memory, value: method(memory, value, motion), effect.init(), inputs)[1]


def step_command(v, omega=0.0, steps=200):
    return jnp.broadcast_to(jnp.array([v, omega]), (steps, 2))


@quick
def test_every_named_effect_is_in_the_catalogue():
    assert set(EFFECTS) == NAMED | BASE | DRIVES


@quick
@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_usual_values_lie_in_the_range_of_a_fit_and_have_a_source(name):
    kind = EFFECTS[name]
    about = parameters_of(kind)
    assert kind.source and kind.typical and set(kind.typical) <= set(about)
    for field, (low, high) in kind.typical.items():
        assert about[field].low <= low <= high <= about[field].high
    assert any({low, high} != {about[field].neutral} for field, (low, high) in kind.typical.items())


@quick
@pytest.mark.parametrize("name", CATALOGUE)
def test_every_effect_vanishes_to_the_last_bit_at_its_neutral_value(name):
    effect = make_effect(name)
    motion = motion_at(0.7, 0.4, 0.1)
    phase = jnp.arange(30.0)
    wave = 1.7 * jnp.sin(phase[:, None] * jnp.array([1.0, 0.7]))
    match place_of(effect):
        case "command":
            np.testing.assert_array_equal(run(effect, wave, motion), wave)
        case "actuation":
            drives = Drive(wave, 300 * wave, 40 * wave[:, ::-1])
            jax.tree.map(np.testing.assert_array_equal, run(effect, drives, motion), drives)
        case "sensing":
            readings = path(0.5 + wave[:, 0], wave[:, 1])
            jax.tree.map(np.testing.assert_array_equal, run(effect, readings, motion), readings)
        case "force":
            memory = effect.init()
            for _ in range(3):
                memory, wrench = effect.force(memory, motion)
                jax.tree.map(lambda leaf: np.testing.assert_array_equal(leaf, 0.0), wrench)
        case "world":
            before = nominal_world(chair()[0])
            _, after = effect.world(effect.init(), before)
            jax.tree.map(np.testing.assert_array_equal, replace(after, payload=None, ground=()), before)
            for surface in after.ground:  # that the motion is the same to the last bit: test_ground.py
                for part in surface.height(jnp.array([0.7, -1.2]), jnp.array([0.1, 30.0])):
                    np.testing.assert_array_equal(part, 0.0)
            if after.payload is not None:
                body = jnp.array(60.3), jnp.array([5.1, 4.2, 3.3]), jnp.array([0.1, -0.02, 0.3])
                jax.tree.map(np.testing.assert_array_equal, add_payload(*body, after.payload), body)


@quick
@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_every_effect_is_on_the_page_of_effects_with_its_parameters(name):
    page = (Path(__file__).parents[2] / "docs" / "effects.md").read_text().splitlines()
    rows = [line for line in page if line.startswith(f"| `{name}` |")]
    remedy = "write the page again: python -m benchmarks.effects page"
    assert len(rows) == 1, remedy
    for field, about in parameters_of(EFFECTS[name]).items():
        assert f"`{field}` [{about.unit}]" in rows[0], remedy


@quick
def test_an_unknown_effect_or_parameter_names_the_known_ones():
    with pytest.raises(ValueError, match="unknown effect 'gravity'.*yaw_scrub"):
        make_effect("gravity")
    with pytest.raises(ValueError, match="no parameter 'force'.*torque"):
        make_effect("yaw_scrub", force=1.0)


# Commands


@quick
@pytest.mark.parametrize(("sent", "heard"), [(0.03, 0.0), (-0.03, 0.0), (0.061, 0.061), (-0.5, -0.5), (0.0, 0.0)])
def test_a_dead_zone_loses_small_commands_and_leaves_large_ones(sent, heard):
    _, command = make_effect("command_dead_zone", linear=0.05).command((), jnp.array([sent, 0.02]), still())
    np.testing.assert_array_equal(command, np.float32([heard, 0.02]))


@quick
def test_a_jerk_limit_makes_an_s_shaped_ramp_of_the_expected_time():
    """From 0 to 1 m/s at 10 m/s^3: 2 sqrt(1 / 10) = 0.63 s, with at most sqrt(10) m/s^2 halfway."""
    v = np.asarray(run(make_effect("jerk_limit", linear=10.0), step_command(1.0)))[:, 0]
    acceleration = np.diff(v, prepend=0.0) / DT
    assert abs(np.argmax(v > 0.999) * DT - 0.63) < 0.05
    assert v.max() < 1.002 and v[-1] == 1.0
    np.testing.assert_allclose(acceleration.max(), np.sqrt(10), rtol=0.05)
    assert np.abs(np.diff(acceleration)).max() / DT < 10.1
    np.testing.assert_allclose(v[np.argmax(acceleration)], 0.5, atol=0.05)


@quick
def test_command_scale_multiplies_each_component():
    _, command = make_effect("command_scale", linear=1.1, angular=0.8).command((), jnp.array([0.5, -0.5]), still())
    np.testing.assert_allclose(command, [0.55, -0.4], rtol=1e-6)


@quick
@pytest.mark.parametrize(
    ("sent", "words"), [((0.0123, 0.0123), (11, 5)), ((-0.0123, -0.0123), (-11, -5)), ((0.0011, -0.0022), (0, 0))]
)
def test_quantisation_truncates_towards_zero(sent, words):
    effect = make_effect("command_quantisation", **MAKER)
    _, command = effect.command((), jnp.array(sent), still())
    np.testing.assert_allclose(command, np.array(words) * [1.1111e-3, 2.2401e-3], rtol=1e-4, atol=1e-9)


@quick
def test_quantisation_clamps_at_the_limits_of_the_chair():
    effect = make_effect("command_quantisation", **MAKER)
    fast, slow = (effect.command((), jnp.array(sent), still())[1] for sent in ((2.0, 2.0), (-2.0, -2.0)))
    np.testing.assert_allclose(fast, [1.667, 1.68], atol=2.3e-3)
    np.testing.assert_allclose(slow, [-0.556, -1.68], atol=2.3e-3)


def expiry(commands, **values):
    return np.asarray(run(make_effect("command_expiry", **values), jnp.asarray(commands)))[:, 0]


@quick
def test_a_command_lapses_200_ms_after_the_last_packet():
    """A sender that repeats itself every 0.5 s moves the vehicle for 0.2 s of each; a new command starts at once."""
    heard = expiry(step_command(1.0, steps=260).at[210:].set(0.5), validity=0.2, resend=0.5)
    on = np.flatnonzero(heard)
    np.testing.assert_allclose([on[0], on[40], on[80]], [0, 100, 200])
    assert (heard[:100] > 0).sum() * DT == 0.2
    np.testing.assert_array_equal(heard[210:250], 0.5)


@quick
def test_a_command_that_is_repeated_in_time_never_lapses():
    np.testing.assert_array_equal(expiry(step_command(1.0, steps=400), validity=0.2, resend=0.1), 1.0)


@quick
def test_lost_packets_leave_gaps_and_the_expected_share():
    """Packets 0.1 s apart, valid for 0.05 s: each lost one is a gap, the same ones every time."""
    commands = step_command(1.0, steps=20 * 2000)
    heard = expiry(commands, validity=0.09, resend=0.1, loss=0.3)
    lost = (heard.reshape(2000, 20)[:, 1] == 0).mean()
    assert 0.27 < lost < 0.33
    np.testing.assert_array_equal(heard, expiry(commands, validity=0.09, resend=0.1, loss=0.3))


# Drive; each law holds for the force of the paper's drive and for the torque of the physical one


def both(effect, force, motion=None):
    """What comes out for a force, and for the torque of that force at the wheel, as a force again."""
    motion = motion or still()
    radius = motion.wheel_radius
    force = np.asarray(force)
    _, pushed = effect.actuation(effect.init(), signal(force=force), motion)
    _, turned = effect.actuation(effect.init(), signal(torque=force * radius), motion)
    np.testing.assert_allclose(turned.torque / radius, pushed.force, rtol=1e-4)
    return np.asarray(pushed.force)


@quick
def test_actuator_lag_reaches_63_percent_after_its_time_constant():
    drives = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (40, 2)), signal((100.0, -50.0), (10.0, 5.0)))
    lagged = run(make_effect("actuator_lag", time_constant=0.1), drives)
    np.testing.assert_allclose(lagged.force[19] / drives.force[19], 1 - np.exp(-1), atol=0.02)
    np.testing.assert_allclose(lagged.torque[19] / drives.torque[19], 1 - np.exp(-1), atol=0.02)


@quick
def test_saturation_limits_each_side():
    effect = make_effect("torque_saturation", limit=80.0)
    np.testing.assert_allclose(both(effect, [1000.0, -1000.0]), [80.0, -80.0], rtol=1e-3)
    np.testing.assert_allclose(both(effect, [20.0, -10.0]), [20.0, -10.0], rtol=2e-3)


@quick
def test_traction_limit_is_the_grip_of_the_driven_wheels():
    motion = still()
    load = float(motion.normal_force[:2].sum())
    effect = make_effect("traction_limit", mu=0.3)
    np.testing.assert_allclose(both(effect, [5e3, 5e3]).sum(), 0.3 * load, rtol=1e-3)
    np.testing.assert_allclose(both(effect, [5.0, -5.0]), [5.0, -5.0], rtol=2e-3)


@quick
def test_traction_limit_counts_all_wheels_of_a_skid_drive():
    forces = both(make_effect("traction_limit", mu=0.3), [5e4, 5e4], motion_at(name="husky"))
    np.testing.assert_allclose(forces.sum(), 0.3 * HUSKY.mass * 9.81, rtol=0.02)


@quick
def test_supply_sags_with_time():
    drives = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (2001, 2)), signal((100.0, -50.0), (10.0, 5.0)))
    weak = run(make_effect("supply_sag", per_second=0.01), drives)
    np.testing.assert_array_equal(weak.force[0], drives.force[0])
    np.testing.assert_allclose(weak.force[-1], drives.force[-1] / 1.1, rtol=1e-3)
    np.testing.assert_allclose(weak.torque[-1], drives.torque[-1] / 1.1, rtol=1e-3)


@quick
@pytest.mark.parametrize(("v", "gain"), [(1.0, 1 / 1.2), (-1.0, 1.0), (0.0, 1.0)])
def test_supply_sags_with_the_power_drawn_and_not_with_power_fed_back(v, gain):
    """Two sides of 100 N at 1 m/s are 200 W."""
    forces = both(make_effect("supply_sag", per_watt=0.001), [100.0, 100.0], motion_at(v))
    np.testing.assert_allclose(forces, 100.0 * gain, rtol=1e-3)


@quick
def test_a_gain_difference_strengthens_the_left_drive():
    np.testing.assert_allclose(both(make_effect("drive_gain_difference", difference=0.1), [100.0, 100.0]), [105, 95])


@quick
def test_backlash_loses_a_reversal_for_the_time_to_cross_the_gap():
    """sqrt(4 beta I / T): 0.05 rad, 0.02 kg m^2 and 4 N m give 32 ms."""
    torque = jnp.concatenate([jnp.full((40, 2), 4.0), jnp.full((40, 2), -4.0)])
    drives = Drive(jnp.zeros_like(torque), jnp.zeros_like(torque), torque)
    passed = np.asarray(run(make_effect("backlash", play=0.05), drives).torque)[:, 0]
    np.testing.assert_allclose(passed[39], 4.0, rtol=1e-3)
    np.testing.assert_allclose(passed[-1], -4.0, rtol=1e-3)
    lost = (1 - np.abs(passed[40:]) / 4.0).sum() * DT
    assert abs(lost - np.sqrt(4 * 0.05 * 0.02 / 4)) < 2 * DT
    assert passed[40:].max() == 0.0 and np.abs(passed[40:44]).max() == 0.0


# World


@quick
def test_one_smaller_wheel_rolls_slower_and_the_nominal_radius_stays():
    model, params = chair()
    _, world = make_effect("wheel_radius_difference", difference=0.02, common=-0.01).world((), nominal_world(model))
    np.testing.assert_allclose(world.geometry.wheel_radius, [0.1325, 0.1325 * 0.98], rtol=1e-6)
    motion = measure(model, params, world, place(model, params, 0.0, 0.0, 0.0, 0.5))
    assert motion.wheel_radius == 0.1325
    _, wrench = make_effect("rolling_contact", grip=1.0).force((), motion)
    spin = motion.spin + wrench.spin_torque * DT / motion.wheel_inertia
    np.testing.assert_allclose(spin, [0.5 / 0.1325, 0.5 / 0.1325 / 0.98], rtol=1e-4)


@quick
def test_a_wider_track_turns_the_wheels_faster_for_the_same_yaw_rate():
    model, params = chair()
    _, world = make_effect("track_width", error=0.05).world((), nominal_world(model))
    motion = measure(model, params, world, place(model, params, 0.0, 0.0, 0.0, 0.0, 1.0))
    np.testing.assert_allclose(motion.contact_vx[1] - motion.contact_vx[0], 0.496 * 1.05, rtol=1e-3)
    assert motion.track == 0.496


@quick
@pytest.mark.parametrize(("name", "free"), [("whill_cr", 0.248), ("husky", 0.275 / 0.8)])
def test_turn_efficiency_moves_the_driven_contacts_out(name, free):
    model, _ = chair(name)
    _, world = make_effect("turn_efficiency", efficiency=0.8).world((), nominal_world(model))
    driven = model.spec.track / 2 / 0.8
    np.testing.assert_allclose(world.geometry.contact_y, [driven, -driven, free, -free], rtol=1e-6)


@quick
def test_a_payload_adds_its_mass_and_inertia_about_the_common_centre():
    """52 kg at the origin and 13 kg 0.5 m ahead: centre at 0.1 m; I_z grows by 52 x 0.1^2 + 13 x 0.4^2."""
    payload = Payload(*(jnp.array(value) for value in (13.0, 0.5, 0.0, 0.0)))
    mass, inertia, com = add_payload(jnp.array(52.0), jnp.array([5.0, 6.0, 7.0]), jnp.zeros(3), payload)
    np.testing.assert_allclose(mass, 65.0)
    np.testing.assert_allclose(com, [0.1, 0.0, 0.0], rtol=1e-6)
    np.testing.assert_allclose(inertia, [5.0, 6.0 + 2.6, 7.0 + 2.6], rtol=1e-6)


@quick
def test_a_slope_pulls_downhill_with_the_whole_weight():
    _, world = make_effect("slope", along_x=0.05, along_y=-0.02).world((), nominal_world(chair()[0]))
    np.testing.assert_allclose(np.linalg.norm(world.gravity), 9.81, rtol=1e-6)
    np.testing.assert_allclose(world.gravity[:2], [-9.81 * np.sin(0.05), 9.81 * np.sin(0.02)], rtol=1e-5)


# Forces


@quick
@pytest.mark.parametrize(("v", "expected"), [(0.5, -16.0), (-0.5, 16.0), (0.0, 0.0), (0.05, -(16 + 8 * np.exp(-1)))])
def test_dry_friction_opposes_motion_and_is_larger_near_rest(v, expected):
    effect = make_effect("dry_friction", coulomb=8.0, excess=4.0, stribeck_speed=0.05)
    _, wrench = effect.force((), motion_at(v))
    np.testing.assert_allclose(wrench.fx, expected, rtol=0.02, atol=1e-3)


@quick
def test_dry_friction_resists_turning_at_the_arm_of_the_driven_wheels():
    _, wrench = make_effect("dry_friction", coulomb=8.0).force((), motion_at(omega=1.0))
    np.testing.assert_allclose(wrench.tz, -2 * 8 * 0.248, rtol=1e-3)
    np.testing.assert_allclose(wrench.fx, 0.0, atol=1e-3)


@quick
def test_omni_rollers_resist_sideways_motion_of_the_free_wheels_only():
    motion = motion_at(sideways=0.3)
    _, wrench = make_effect("omni_roller_friction", mu_t=0.05, viscous=10.0).force((), motion)
    np.testing.assert_allclose(wrench.fy, -0.05 * motion.normal_force[2:].sum() - 2 * 10 * 0.3, rtol=1e-3)
    _, none = make_effect("omni_roller_friction", mu_t=0.05).force((), motion_at(sideways=0.3, name="husky"))
    np.testing.assert_allclose(none.fy, 0.0)


def kick(v, path_length, **values):
    """Swivel angle of a caster, and the sideways force, along a straight drive at v."""
    effect, motion = make_effect("caster_kick", force_limit=10.0, trail=0.15, **values), motion_at(v)

    def one(memory, _):
        memory, wrench = effect.force(memory, motion)
        return memory, (memory[2], wrench.fy)

    return [np.asarray(out) for out in jax.lax.scan(one, effect.init(), None, int(path_length / abs(v) / DT))[1]]


@quick
def test_casters_that_trail_do_not_push():
    angle, fy = kick(0.5, 1.5)
    np.testing.assert_allclose(fy[-1], 0.0, atol=0.01)
    assert np.abs(angle).max() < 0.05


@quick
def test_casters_kick_after_a_reversal_until_they_have_swivelled():
    angle, fy = kick(-0.5, 2.5)
    np.testing.assert_allclose(np.abs(fy).max(), 10.0, rtol=0.03)  # two casters; F_k sin cos is half of F_k at most
    np.testing.assert_allclose(np.cos(angle[-1]), -1.0, atol=0.01)
    np.testing.assert_allclose(fy[-1], 0.0, atol=0.05)


@quick
def test_casters_parked_across_swivel_over_a_few_trails():
    """From 90 degrees, d(delta)/ds = -sin(delta) / L: tan(delta / 2) falls by e over each trail."""
    angle, _ = kick(0.5, 0.30, start_angle=np.pi / 2)
    np.testing.assert_allclose(np.tan(angle[-1] / 2), np.exp(-2), atol=0.04)


@quick
@pytest.mark.parametrize("v", [0.5, -1.0])
def test_speed_dependent_losses_follow_their_power_law(v):
    _, rolling = make_effect("rolling_resistance_speed", mu_1=0.01).force((), motion_at(v))
    _, drag = make_effect("quadratic_drag", coefficient=2.0).force((), motion_at(v))
    np.testing.assert_allclose(rolling.fx, -0.01 * v * WEIGHT, rtol=0.02)
    np.testing.assert_allclose(drag.fx, -2.0 * abs(v) * v, rtol=1e-3)


@quick
@pytest.mark.parametrize(("yaw", "fx", "fy"), [(0.0, 5.0, 2.0), (np.pi / 2, 2.0, -5.0), (np.pi, -5.0, -2.0)])
def test_wind_is_fixed_in_the_room_and_a_side_force_in_the_vehicle(yaw, fx, fy):
    motion = motion_at(yaw=yaw)
    _, blown = make_effect("wind", along_x=5.0, along_y=2.0).force((), motion)
    _, pushed = make_effect("side_force", sideways=7.0).force((), motion)
    np.testing.assert_allclose([blown.fx, blown.fy], [fx, fy], atol=1e-4)
    assert (pushed.fx, pushed.fy) == (0.0, 7.0)


# Sensing

TIMES = np.arange(400) * DT
SPEEDS = 0.5 + 0.3 * np.sin(2 * TIMES), 0.8 * np.sin(1.5 * TIMES)


@quick
def test_odometry_scale_reports_the_path_that_the_scaled_speeds_add_up_to():
    v, omega = SPEEDS
    scaled = run(make_effect("odometry_scale", linear=1.02, angular=0.9), path(v, omega))
    expected = path(1.02 * v, 0.9 * omega)
    for field in ("x", "y", "yaw", "v", "omega"):
        np.testing.assert_allclose(getattr(scaled, field), getattr(expected, field), atol=2e-4, err_msg=field)


@quick
@pytest.mark.parametrize("delay", [0.012, 0.1, 0.3])
def test_a_late_reading_is_that_of_an_earlier_time(delay):
    true = path(*SPEEDS)
    late = run(make_effect("sensor_delay", delay=delay), true)
    for field in ("x", "y", "yaw", "v", "omega"):
        expected = np.interp(TIMES[100:] - delay, TIMES, np.asarray(getattr(true, field)))
        np.testing.assert_allclose(getattr(late, field)[100:], expected, atol=1e-3, err_msg=field)
    np.testing.assert_array_equal(late.gyro, true.gyro)  # another sensor


@quick
@pytest.mark.parametrize("offset", [-0.04, 0.04])
def test_a_clock_offset_shifts_the_odometry_either_way(offset):
    true = path(*SPEEDS)
    shifted = run(make_effect("clock_offset", offset=offset), true)
    for field in ("x", "y", "yaw", "v", "omega"):
        expected = np.interp(TIMES[100:-20] - offset, TIMES, np.asarray(getattr(true, field)))
        np.testing.assert_allclose(getattr(shifted, field)[100:-20], expected, atol=4e-3, err_msg=field)


@quick
def test_a_gyro_bias_shows_in_the_gyro_alone():
    given = reading(1.0, 2.0, 3.0, 0.5, 0.4, 0.4)
    _, wrong = make_effect("gyro_bias", bias=0.01, scale=1.1).sensing((), given, still())
    np.testing.assert_allclose(wrong.gyro, 0.45, rtol=1e-6)
    assert replace(wrong, gyro=given.gyro) == given


@quick
def test_encoder_steps_never_add_up():
    v, omega = SPEEDS
    true = path(0.05 * v, 0.05 * omega)
    stepped = run(make_effect("encoder_resolution", angle=0.01, speed=0.002), true)
    step = 0.01 * 0.1325
    assert np.abs(stepped.x - true.x).max() <= step / 2 + 1e-5
    np.testing.assert_array_less(np.abs(stepped.yaw - true.yaw), step / 0.496 + 1e-5)
    assert np.abs(stepped.yaw - true.yaw).max() > step / 0.496 / 2
    wheels = (stepped.v - stepped.omega * 0.248) / 0.002
    np.testing.assert_allclose(wheels, np.round(wheels), atol=2e-3)


@quick
def test_the_gyro_is_cut_off_at_its_range_and_comes_in_steps():
    effect = make_effect("gyro_range", **GYRO)
    for rate, expected in ((3.0, 2.1817), (-3.0, -2.1817), (1e-4, 7.636e-5), (0.0, 0.0)):
        _, read = effect.sensing((), reading(omega=0.4, gyro=rate), still())
        np.testing.assert_allclose(read.gyro, expected, rtol=1e-3)
        assert read.omega == 0.4


@quick
def test_states_come_at_their_rate():
    true = path(*SPEEDS)
    seen = run(make_effect("state_rate", period=0.02), true)
    np.testing.assert_array_equal(seen.v[::4], true.v[::4])
    np.testing.assert_array_equal(seen.v[3::4], true.v[::4])
    np.testing.assert_array_equal(seen.gyro, true.gyro)


# Derivatives

ROUNDING = {"encoder_resolution", "gyro_range", "state_rate", "command_expiry"}
"""Made of steps: their derivatives are finite, and differences across a step mean nothing."""


@lru_cache
def wide_inputs():
    """Sequences of every kind of input in float64; call with 64-bit types enabled."""
    spec, params = preset("whill_cr_physical")
    model = build_model(spec)
    t = jnp.arange(60.0)
    v, omega, sideways = 0.8 * jnp.sin(0.11 * t + 0.3), 0.7 * jnp.cos(0.17 * t), 0.3 * jnp.sin(0.23 * t)

    def one(v, omega, sideways):
        state = place(model, params, 0.0, 0.0, 0.4, v, omega)
        return measure(model, params, nominal_world(model), replace(state, qvel=state.qvel.at[1].add(sideways)))

    motions = jax.vmap(one)(v, omega, sideways)
    # Held for 6 steps each; some of them small, for the dead zone's edge.
    held = jnp.array([[2.1, 0.3], [0.026, 1.0], [-2.1, 0.05], [1.1, -0.05], [0.4, 0.9]])
    commands = jnp.repeat(jnp.concatenate([held, -0.98 * held]), 6, axis=0)
    wave = jnp.stack([jnp.sin(0.31 * t + 0.1), 0.7 * jnp.cos(0.27 * t)], axis=1)
    inputs = {"command": commands, "actuation": Drive(wave, 150 * wave, 20 * wave), "force": t, "world": t,
              "sensing": path(v, omega)}  # fmt: skip
    return model, motions, inputs


@pytest.mark.parametrize("name", CATALOGUE)
def test_forward_mode_derivatives_of_every_effect_agree_with_central_differences(name):
    """In float64 over 60 steps of changing motion, at usual values and, finite only, at the neutral ones."""
    with jax.enable_x64(True):
        kind, about = EFFECTS[name], parameters_of(EFFECTS[name])
        model, motions, inputs = wide_inputs()
        where = place_of(make_effect(name))
        usual = {field: low + 0.37 * (high - low) for field, (low, high) in kind.typical.items()}
        values = np.array([usual.get(field, about[field].neutral) for field in about])

        def outcome(values):
            effect = kind(*values)

            def one(memory, given):
                value, motion = given
                if where == "world":
                    return effect.world(memory, nominal_world(model))
                rest = (motion,) if where == "force" else (value, motion)
                return getattr(effect, where)(memory, *rest)

            outputs = jax.lax.scan(one, effect.init(), (inputs[where], motions))[1]
            return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(outputs)])

        jacobian = jax.jit(jax.jacfwd(outcome))
        forward = np.asarray(jacobian(values))
        steps = 1e-6 * np.maximum(np.abs(values), 1e-2)
        points = np.concatenate([values + np.diag(steps), values - np.diag(steps)])
        results = np.asarray(jax.jit(jax.vmap(outcome))(points))
        central = ((results[: len(values)] - results[len(values) :]) / (2 * steps[:, None])).T
        neutral = np.asarray(jacobian(np.array([about[field].neutral for field in about])))
    assert np.isfinite(neutral).all() and np.isfinite(forward).all()
    if name in ROUNDING:
        return
    assert np.abs(central).max() > 0
    np.testing.assert_allclose(forward, central, rtol=1e-4, atol=1e-5 * np.abs(central).max())


# All at once


def test_all_effects_act_together_in_one_compiled_model():
    """At their neutral values the chair drives as without them; at usual ones it goes elsewhere, and stays finite."""
    spec, params = preset("whill_cr_physical")
    model = build_model(spec)
    have = {effect.name for effect in params.effects}
    more = [name for name in CATALOGUE if name not in have]
    neutral = replace(params, effects=(*params.effects, *(make_effect(name) for name in more)))

    def usual(name):
        # Gentle: a fifth of the way from the neutral value, or from the far end where that is infinite.
        about, values = parameters_of(EFFECTS[name]), {}
        for field, (_, high) in EFFECTS[name].typical.items():
            start = about[field].neutral if np.isfinite(about[field].neutral) else high
            values[field] = start + 0.2 * (high - start)
        return make_effect(name, **values)

    changed = replace(params, effects=(*params.effects, *(usual(name) for name in more)))
    period = jax.jit(lambda params, state, command: drive(model, params, state, command))
    plain = jax.jit(lambda params, state, command: drive(model, params, state, command))
    twists = {}
    for label, vehicle, step in (("plain", params, plain), ("neutral", neutral, period), ("usual", changed, period)):
        state = place(model, vehicle, 0.0, 0.0, 0.0)
        for command in ((0.6, 0.5),) * 8 + ((-0.3, -0.5),) * 8:
            state = step(vehicle, state, jnp.array(command))
        assert not state.diverged
        assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(state))
        twists[label] = np.array([*body_twist(model, state.qpos, state.qvel), state.odometry.gyro, *state.qpos[:2]])
    assert period._cache_size() == 1
    np.testing.assert_allclose(twists["neutral"], twists["plain"], atol=1e-3)
    assert np.abs(twists["usual"] - twists["plain"]).max() > 0.02
