"""The law of each effect of the catalogue: its own equation, in hand-made motions."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from effects_in_hand import DT, WEIGHT, chair, motion_at, path, quick, reading, run, step_command, still

from whill_mjx.effects import make_effect
from whill_mjx.effects.command_quantisation import MAKER
from whill_mjx.effects.gyro_range import MAKER as GYRO
from whill_mjx.vehicle.dynamics import add_payload, measure, nominal_world, place
from whill_mjx.vehicle.types import Payload

# Commands


@quick
@pytest.mark.parametrize(("sent", "heard"), [(0.03, 0.0), (-0.03, 0.0), (0.061, 0.061), (-0.5, -0.5), (0.0, 0.0)])
def test_a_dead_zone_loses_small_commands_and_leaves_large_ones(sent, heard):
    effect = make_effect("command_dead_zone", linear=0.05)
    _, command = effect.command(effect.init(), jnp.array([sent, 0.02]), still())
    np.testing.assert_array_equal(command, np.float32([heard, 0.02]))


@quick
def test_a_dead_zone_of_each_wheel_stops_the_inner_wheel_of_a_bend():
    half = still().track / 2
    effect = make_effect("command_dead_zone", wheel=0.05)
    _, (v, omega) = effect.command(effect.init(), jnp.array([0.3, 0.29 / half]), still())  # wheels at 0.01, 0.59 m/s
    np.testing.assert_allclose([v - half * omega, v + half * omega], [0.0, 0.59], atol=1e-6)


@quick
@pytest.mark.parametrize("axis", ["linear", "wheel"])
def test_a_dead_zone_lets_go_of_a_command_later_than_it_takes_it(axis):
    """Wakes at 0.1 m/s and falls asleep at 0.04 m/s."""
    ramp = jnp.concatenate([jnp.linspace(0.0, 0.2, 201), jnp.linspace(0.2, 0.0, 201)])
    sent = jnp.stack([ramp, 0 * ramp], axis=-1)
    heard = np.asarray(run(make_effect("command_dead_zone", **{axis: 0.1, "release": 0.4}), sent))[:, 0]
    passing = heard > 0.5 * np.maximum(ramp, 1e-6)
    np.testing.assert_allclose(ramp[np.argmax(passing)], 0.1, atol=0.01)
    np.testing.assert_allclose(ramp[200 + np.argmax(~passing[200:])], 0.04, atol=0.01)


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


# World


@quick
def test_one_smaller_wheel_rolls_slower_and_the_nominal_radius_stays():
    model, params = chair()
    _, world = make_effect("wheel_radius_difference", difference=0.02, common=-0.01).world((), nominal_world(model))
    np.testing.assert_allclose(world.geometry.wheel_radius, [0.1325, 0.1325 * 0.98], rtol=1e-6)
    motion = measure(model, params, world, place(model, params, 0.0, 0.0, 0.0, (0.5, 0.0)))
    assert motion.wheel_radius == 0.1325
    _, wrench = make_effect("rolling_contact", grip=1.0).force((), motion)
    spin = motion.spin + wrench.spin_torque * DT / motion.wheel_inertia
    # The ground's speed on each side is that after the step, under the wheels' own push and the chassis's small pitch.
    gained = DT * (wrench.fx / motion.total_mass + (motion.rotation.T @ motion.world.gravity)[0])
    turned = DT * (wrench.tz - motion.com[0] * wrench.fy + motion.com[1] * wrench.fx) / motion.yaw_inertia
    ground = 0.5 + gained + turned * (motion.com[1] - motion.world.geometry.contact_y[:2])
    np.testing.assert_allclose(spin, ground / jnp.array([0.1325, 0.1325 * 0.98]), rtol=1e-4)
    np.testing.assert_allclose(ground, 0.5, rtol=1e-3)


@quick
def test_a_wider_track_turns_the_wheels_faster_for_the_same_yaw_rate():
    model, params = chair()
    _, world = make_effect("track_width", error=0.05).world((), nominal_world(model))
    motion = measure(model, params, world, place(model, params, 0.0, 0.0, 0.0, (0.0, 1.0)))
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
@pytest.mark.parametrize(
    ("name", "freedom", "passive"), [("whill_cr", 1.0, 0.0), ("whill_cr", 0.5, 0.124), ("husky", 1.0, 0.275)]
)
def test_a_pivot_takes_the_roll_from_the_passive_wheels(name, freedom, passive):
    model, params = chair(name)
    _, world = make_effect("axle_pivot", freedom=freedom).world((), nominal_world(model))
    half = model.spec.track / 2
    np.testing.assert_allclose(world.geometry.contact_y, [half, -half, passive, -passive], rtol=1e-6, atol=1e-7)
    leaning = place(model, params, 0.0, 0.0, 0.0)
    roll = jnp.array([1.0, 1e-3, 0.0, 0.0])  # quaternion of 2 mrad to the right
    load = measure(model, params, world, leaning.replace(qpos=leaning.qpos.at[3:7].set(roll))).normal_force
    share = (load[3] - load[2]) / (load[1] - load[0])
    np.testing.assert_allclose(share, passive / half, atol=0.02)


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
def test_dry_friction_of_small_slow_wheels_is_as_sharp_as_that_of_large_ones():
    effect, large = make_effect("dry_friction", coulomb=8.0), motion_at(0.03)
    slow = replace(large, wheel_radius=large.wheel_radius / 4, contact_vx=large.contact_vx / 4)
    np.testing.assert_allclose(effect.force((), slow)[1].fx, effect.force((), large)[1].fx, rtol=1e-6)
    assert abs(effect.force((), replace(slow, wheel_radius=large.wheel_radius))[1].fx) < 6.0


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
def test_a_sharp_caster_pushes_nearly_all_at_a_small_angle():
    def push(**values):
        return np.abs(kick(0.5, 0.05, start_angle=0.2, **values)[1][0]) / 2

    assert push() < 3.0
    assert 8.0 < push(sharpness=30.0) < 10.0


@quick
def test_casters_parked_across_swivel_over_a_few_trails():
    """From 90 degrees, d(delta)/ds = -sin(delta) / L: tan(delta / 2) falls by e over each trail."""
    angle, _ = kick(0.5, 0.30, start_angle=np.pi / 2)
    np.testing.assert_allclose(np.tan(angle[-1] / 2), np.exp(-2), atol=0.04)


@quick
@pytest.mark.parametrize("growth", [0.0, 2.0])
@pytest.mark.parametrize("v", [0.5, -1.0])
def test_speed_dependent_losses_follow_their_power_law(v, growth):
    _, rolling = make_effect("rolling_resistance_speed", mu_1=0.01, growth=growth).force((), motion_at(v))
    _, drag = make_effect("quadratic_drag", coefficient=2.0).force((), motion_at(v))
    np.testing.assert_allclose(rolling.fx, -0.01 * (1 + growth * abs(v)) * v * WEIGHT, rtol=0.02)
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
def test_speeds_may_be_older_than_the_pose_they_come_with():
    true = path(*SPEEDS)
    late = run(make_effect("sensor_delay", delay=0.02, speed=0.015), true)
    for field, age in (("x", 0.02), ("y", 0.02), ("yaw", 0.02), ("v", 0.035), ("omega", 0.035)):
        expected = np.interp(TIMES[100:] - age, TIMES, np.asarray(getattr(true, field)))
        np.testing.assert_allclose(getattr(late, field)[100:], expected, atol=1e-3, err_msg=field)


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
