"""Each effect alone: what it does, and that it vanishes at its neutral value."""

from __future__ import annotations

import dataclasses
from functools import lru_cache

import effects_in_hand
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from effects_in_hand import run, yielding
from flax import struct

from whill_mjx.effects import EFFECTS, make_effect
from whill_mjx.effects.acceleration_limit import AccelerationLimit
from whill_mjx.effects.air_drag import AirDrag
from whill_mjx.effects.base import PLACES, Effect, apply_chain, place_of
from whill_mjx.effects.command_delay import CommandDelay
from whill_mjx.effects.lateral_damping import LateralDamping
from whill_mjx.effects.odometry_lag import OdometryLag
from whill_mjx.effects.planar import spin_response
from whill_mjx.effects.rolling_resistance import RollingResistance
from whill_mjx.effects.slip_traction import SlipTraction
from whill_mjx.effects.yaw_scrub import YawScrub
from whill_mjx.vehicle.types import Drive, Odometry, parameter, parameters_of

DRIVES = {name for name, kind in EFFECTS.items() if kind.card.drives}
pytestmark = pytest.mark.quick
motion_at = lru_cache(effects_in_hand.motion_at)
"""Measured once for all tests that ask for the same motion."""


def neutral(kind):
    values = {name: about.neutral for name, about in parameters_of(kind).items()}
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), kind(**values))


@pytest.mark.parametrize("speed", [-1.0, -0.1, 0.1, 1.0])
@pytest.mark.parametrize("effect", [RollingResistance(mu_r=jnp.array(0.01)), AirDrag(jnp.array(1.0), jnp.array(1.0))])
def test_resistance_opposes_motion(effect, speed):
    _, wrench = effect.force((), motion_at(speed))
    assert wrench.fx * speed < 0


def test_rolling_resistance_is_the_coefficient_times_the_weight():
    _, wrench = RollingResistance(mu_r=jnp.array(0.01)).force((), motion_at(1.0))
    np.testing.assert_allclose(wrench.fx, -0.01 * 52 * 9.81, rtol=0.02)


def test_air_drag_grows_with_the_square_of_speed():
    drag = AirDrag(c_d=jnp.array(1.0), area=jnp.array(0.5))
    slow, fast = (drag.force((), motion_at(v))[1].fx for v in (0.5, 1.0))
    np.testing.assert_allclose(fast / slow, 4.0, rtol=1e-4)
    np.testing.assert_allclose(fast, -0.5 * 1.2 * 0.5, rtol=1e-4)


def test_lateral_damping_pushes_against_sideways_motion():
    _, wrench = LateralDamping(c_rear=jnp.array(2.0), c_front=jnp.array(2.0)).force((), motion_at(sideways=0.3))
    np.testing.assert_allclose(wrench.fy, -2.0 * 52 * 0.3, rtol=0.02)


def test_lateral_damping_grows_with_the_load_of_tyres_but_not_of_rollers():
    """Rollers drag by the mass that their axle carries at rest, until they leave the floor."""
    damping, motion = LateralDamping(c_rear=jnp.array(2.0), c_front=jnp.array(2.0)), motion_at(sideways=0.6)
    rear, front = motion.contact_points[0][0], motion.contact_points[0][2]
    at_front = motion.total_mass * (motion.com[0] - rear) / (front - rear)  # [kg]

    def push(sliding, load):
        moved = dataclasses.replace(motion, normal_force=load * motion.normal_force,
                                    contact_vy=0.6 * jnp.array(sliding))
        return damping.force((), moved)[1].fy

    rollers, tyres = ([push(sliding, load) for load in (1.0, 0.6, 0.0)] for sliding in ([0, 0, 1, 1], [1, 1, 0, 0]))
    np.testing.assert_allclose(rollers, -2.0 * 0.6 * at_front * np.array([1.0, 1.0, 0.0]), rtol=0.06)
    np.testing.assert_allclose(tyres, np.array([1.0, 0.6, 0.0]) * tyres[0], rtol=1e-5)
    assert tyres[0] < 0


@pytest.mark.parametrize("omega", [-1.0, 1.0])
def test_yaw_scrub_opposes_turning(omega):
    _, wrench = YawScrub(torque=jnp.array(4.0)).force((), motion_at(omega=omega))
    np.testing.assert_allclose(wrench.tz, -4.0 * np.sign(omega), rtol=1e-3)


def test_slip_force_never_exceeds_the_friction_circle():
    motion = motion_at(v=0.5, omega=0.5, sideways=0.8)
    motion = motion.replace(spin=motion.spin * 4, drive_torque=jnp.array([500.0, -500.0]))
    values = {"mu": 0.6, "slip_speed": 0.02, "side_slip_speed": 0.05, "mu_free": 0.0}
    _, wrench = SlipTraction(**{name: jnp.array(value) for name, value in values.items()}).force((), motion)
    driven_load = float(motion.normal_force[:2].sum())
    assert np.hypot(float(wrench.fx), float(wrench.fy)) <= 0.6 * driven_load * 1.001


def slip_pull(motion, **values):
    """Slip forces (2,) along and across over mu N of the driven wheels, of a law with these values."""
    values = {"mu": 0.6, "mu_free": 0.0, **values}
    _, wrench = SlipTraction(**{name: jnp.array(value) for name, value in values.items()}).force((), motion)
    return np.array([wrench.fx, wrench.fy]) / (0.6 * float(motion.normal_force[:2].sum()))


STIFFNESSES = pytest.mark.parametrize("along, across", [(0.002, 0.05), (0.02, 0.02), (0.05, 0.001)])


@STIFFNESSES
def test_a_wheel_that_slides_is_held_against_the_way_that_it_slides(along, across):
    """Coulomb's law, however differently stiff a creeping wheel is along and across."""
    motion = motion_at(v=5.0, sideways=1.0).replace(spin=jnp.zeros(2), dt=1e-6)
    pull = slip_pull(motion, slip_speed=along, side_slip_speed=across)
    np.testing.assert_allclose(pull, -np.array([5.0, 1.0]) / 26**0.5, rtol=0.02)


@STIFFNESSES
def test_what_a_wheel_creeps_it_does_not_slide(along, across):
    motion = motion_at(v=0.5, sideways=0.1).replace(spin=jnp.zeros(2), dt=1e-6)
    pull = slip_pull(motion, slip_speed=along, side_slip_speed=across)
    slides = np.array([0.5, 0.1]) + pull * np.array([along, across])
    np.testing.assert_allclose(pull, -slides / np.hypot(*slides), rtol=0.02)


@pytest.mark.parametrize("across, along", [(0.0, 0.0995), (0.006, 0.0991), (0.02, 0.0879)])
def test_a_wheel_that_creeps_across_grips_along_but_for_what_the_friction_circle_takes(across, along):
    """Creep along is a tenth of s0, which without creep across gives a tenth of mu N."""
    motion = motion_at(v=0.5, sideways=-across)
    motion = motion.replace(spin=motion.spin + 0.1 * 0.001 / motion.wheel_radius, dt=1e-7)
    pull = slip_pull(motion, slip_speed=0.001, side_slip_speed=0.1)
    np.testing.assert_allclose(pull, [along, across / 0.1], rtol=0.03, atol=1e-4)


def test_acceleration_limit_ramps_the_command():
    limit = AccelerationLimit(linear=jnp.array(1.7), angular=jnp.array(3.0))
    memory = limit.init()
    for _ in range(20):  # 0.1 s
        memory, command = limit.command(memory, jnp.array([1.0, -1.0]), motion_at())
    np.testing.assert_allclose(command, [0.17, -0.3], rtol=1e-4)


@pytest.mark.parametrize("wanted, rate", [(1.0, 1.0), (0.2, 2.0), (-0.2, 2.0), (-0.5, 1.0), (-1.0, 1.0)])
def test_a_limit_for_slowing_down_holds_unless_as_much_is_asked_for_the_other_way(wanted, rate):
    limit = AccelerationLimit(linear=jnp.array(1.0), angular=jnp.array(1.0), slowing=jnp.array(2.0))
    memory = (jnp.array([0.5, 0.0]), jnp.array([0.5, 0.5]))
    _, command = limit.command(memory, jnp.array([wanted, 0.0]), motion_at())
    np.testing.assert_allclose(abs(command[0] - 0.5), rate * motion_at().dt, rtol=1e-3)


def test_a_limit_of_the_wheels_bounds_the_faster_wheel():
    motion = motion_at()
    limit = AccelerationLimit(wheel=jnp.array(1.0), angular=jnp.array(jnp.inf))
    _, command = limit.command(limit.init(), jnp.array([1.0, 1.0]), motion)
    left, right = command[0] - command[1] * motion.track / 2, command[0] + command[1] * motion.track / 2
    np.testing.assert_allclose([left, right], motion.dt, rtol=1e-3)


@pytest.mark.parametrize("delay", [0.0, 0.02, 0.1, 0.22])
def test_a_delayed_command_arrives_after_its_delay(delay):
    effect, motion = CommandDelay(delay=jnp.array(delay)), motion_at()
    sent = jnp.zeros((80, 2)).at[10:].set(jnp.array([1.0, 0.5]))
    heard = run(effect, sent)[:, 0].tolist()
    arrival = next(step for step, value in enumerate(heard) if value > 0.5)
    assert arrival == 10 + round(delay / motion.dt)
    assert heard[-1] == 1.0


def test_a_delay_keeps_the_order_of_commands_that_are_under_way():
    sent = np.repeat([0.1, 0.2, 0.3, 0.4, 0.4, 0.4, 0.4, 0.4], 20)
    heard = run(CommandDelay(delay=jnp.array(0.3)), jnp.stack([sent, 0 * sent], axis=1))[:, 0]
    np.testing.assert_allclose(heard[61:], sent[1:-60], atol=1e-5)


@pytest.mark.parametrize("delay", [0.0, 0.004, 0.01, 0.0125, 0.037])
def test_commands_that_are_known_are_delayed_ahead_as_step_by_step(delay):
    """Several changes under way at once, a long hold, and the derivative by the delay."""
    sent = np.repeat(np.random.default_rng(1).normal(size=(40, 2)), [1, 2, 1, 5] * 10, axis=0).astype(np.float32)
    motion = dataclasses.replace(motion_at(), dt=0.005)

    def one_by_one(delay):
        effect = make_effect("command_delay", delay=delay)
        return jax.lax.scan(lambda memory, command: effect.command(memory, command, motion), effect.init(), sent)[1]

    def ahead(delay):
        return make_effect("command_delay", delay=delay).ahead(jnp.asarray(sent), 0.005)

    np.testing.assert_allclose(ahead(delay), one_by_one(delay), atol=2e-4)
    if delay % 0.005 > 1e-3:
        slopes = [jax.jacfwd(function)(jnp.asarray(delay)) for function in (ahead, one_by_one)]
        assert np.abs(slopes[0]).max() > 1.0
        np.testing.assert_allclose(*slopes, rtol=1e-3)


def test_odometry_lag_filters_speeds_and_leaves_the_pose():
    lag = OdometryLag(time_constant=jnp.array(0.05))
    reading = Odometry(*(jnp.array(value) for value in (1.0, 2.0, 3.0, 0.5, 0.4)))
    memory = lag.init()
    for _ in range(10):
        memory, filtered = lag.sensing(memory, reading, motion_at())
    expected = 0.5 * (1 - (0.05 / 0.055) ** 10)
    np.testing.assert_allclose(filtered.v, expected, rtol=1e-4)
    assert (filtered.x, filtered.y, filtered.yaw) == (1.0, 2.0, 3.0)


def test_every_effect_acts_at_exactly_one_place():
    assert {place_of(neutral(kind)) for kind in EFFECTS.values()} <= set(PLACES)


def test_an_effect_without_a_place_is_refused():
    class Nothing:
        pass

    with pytest.raises(TypeError, match="exactly one of"):
        place_of(Nothing())


RETURNS = {
    "c": ("returns .*Tracer", "the pair .memory, command."),
    "(memory, c[:1])": ("command is float32 of shape .1,.", "it must be float32 of shape .2,."),
    "(memory, c.astype(int))": ("command is int32", "it must be float32"),
    "(c, c)": ("memory is .*Tracer", "it must be tuple"),
    "(memory, c if c[0] > 0 else -c)": ("TracerBoolConversionError", "jnp.where for if"),
    "(memory, nothing)": ("command.*: NameError: name 'nothing'", "Correct the method"),
}


@pytest.mark.parametrize("returned", RETURNS)
def test_an_effect_of_ones_own_that_returns_what_no_vehicle_takes_is_named_with_the_rule(returned):
    """A command of one number would be taken for both, and one of whole numbers would be cut."""
    method = eval(f"lambda self, memory, c, motion: {returned}")
    kind = struct.dataclass(type("Mine", (Effect,), {
        "__annotations__": {"size": jax.Array}, "size": parameter("-", 0.0, 1.0, 0.0, "size"), "name": "mine",
        "command": method, "__module__": "mine"}))
    for said in RETURNS[returned]:
        with pytest.raises(ValueError, match=f"effect 'mine': .*(?:{said})"):
            jax.eval_shape(lambda c: apply_chain((kind(0.1),), ((),), "command", c, None)[1], jnp.ones(2))


@pytest.mark.parametrize("name", sorted(set(EFFECTS) - DRIVES))
def test_every_effect_vanishes_exactly_at_its_neutral_value(name):
    """To the last bit. The two drives are no disturbances: at zero gain they give no force, tested apart."""
    effect = neutral(EFFECTS[name])
    motion = motion_at(0.7, 0.4, 0.1)
    memory = effect.init()
    match place_of(effect):
        case "force":
            _, wrench = effect.force(memory, motion)
            assert all((np.asarray(leaf) == 0).all() for leaf in jax.tree.leaves(wrench))
        case "command":
            for value in ([0.3, 0.2], [0.3, 0.2], [-0.1, 0.7]):
                memory, command = effect.command(memory, jnp.array(value), motion)
                np.testing.assert_array_equal(command, np.float32(value))
        case "actuation":
            drive = Drive(jnp.array([0.1, 0.2]), jnp.array([3.0, 4.0]), jnp.array([5.0, 6.0]))
            _, after = effect.actuation(memory, drive, motion)
            assert jax.tree.all(jax.tree.map(lambda a, b: (a == b).all(), drive, after))
        case "sensing":
            reading = Odometry(*(jnp.array(value) for value in (1.0, 2.0, 3.0, 0.5, 0.4)))
            _, after = effect.sensing(memory, reading, motion)
            assert jax.tree.all(jax.tree.map(lambda a, b: a == b, reading, after))


@pytest.mark.parametrize("name", sorted(DRIVES))
def test_a_drive_with_zero_gains_gives_no_force(name):
    effect = neutral(EFFECTS[name])
    drive = Drive(jnp.array([0.5, 0.2]), jnp.zeros(2), jnp.zeros(2))
    _, after = effect.actuation(effect.init(), drive, motion_at(0.3))
    np.testing.assert_array_equal(after.force, 0.0)
    np.testing.assert_array_equal(after.torque, 0.0)


@pytest.mark.parametrize("windup", [0.0, 0.5, 1.0])
def test_the_integral_of_the_torque_drive_goes_on_at_its_limit_as_windup_says(windup):
    drive, motion = make_effect("torque_drive", kp=4.0, ki=2.0, limit=10.0, windup=windup), motion_at()
    memory, out = drive.actuation(drive.init(), Drive(jnp.array([1.0, 0.1]), jnp.zeros(2), jnp.zeros(2)), motion)
    error = np.array([1.0, 0.1]) / 0.1325  # rad/s: the left side asks for 30 N m, the right side for 3 N m
    # The speed errors of the step's middle are less by what the chair gains in 2.5 ms.
    np.testing.assert_allclose(memory.integral, error * [windup, 1.0] * motion.dt, rtol=0.05)
    # The right side expects the left one to push with all it wants: both modes, each braked by its own response.
    half = motion.dt / 2
    wanted = (4.0 + 2.0 * half) * error
    mean, against = np.array([wanted.sum(), wanted[1] - wanted[0]]) / 2 / (1 + half * 4.0 * spin_response(motion))
    np.testing.assert_allclose(out.torque, [10.0, mean + against], rtol=1e-4)


def test_the_torque_drive_acts_on_the_speed_in_the_middle_of_the_step():
    """Free of friction, a chair of two equal wheels gains speed as kp (e - gain / 2): the trapezoid of its equation."""
    drive, motion = make_effect("torque_drive", kp=4.0, ki=0.0), motion_at()
    memory, out = drive.actuation(drive.init(), Drive(jnp.array([1.0, 1.0]), jnp.zeros(2), jnp.zeros(2)), motion)
    error = 1.0 / 0.1325
    gain = float(out.torque[0]) / (0.02 + 52 / 2 * 0.1325**2) * motion.dt  # rad/s over the step
    np.testing.assert_allclose(out.torque, 4.0 * (error - gain / 2) * np.ones(2), rtol=1e-5)
    np.testing.assert_allclose(memory.expected, gain * np.ones(2), rtol=1e-5)
    # A load that takes away the whole gain leaves the speed as it was, and the torque as a sampled controller has it.
    _, out = drive.actuation(memory, Drive(jnp.array([1.0, 1.0]), jnp.zeros(2), jnp.zeros(2)), motion)
    loaded = 4.0 * (error + gain / 2) / (1 + 4.0 * motion.dt / 2 / (0.02 + 52 / 2 * 0.1325**2))
    np.testing.assert_allclose(out.torque, loaded * np.ones(2), rtol=1e-4)


def spins_with_a_sampled_controller(kp, ki, period, target, inertia, steps, dt):
    """Spins (steps,) at the ends of steps of dt under a controller that runs every period and holds its torque."""
    fine = 1e-5
    spin = integral = torque = 0.0
    spins = []
    for k in range(round(steps * dt / fine)):
        if k % round(period / fine) == 0:
            integral += (target - spin) * period
            torque = kp * (target - spin) + ki * integral
        spin += torque / inertia * fine
        spins.append(spin)
    return np.array(spins)[round(dt / fine) - 1 :: round(dt / fine)]


@pytest.mark.parametrize("dt", [0.0025, 0.005])
@pytest.mark.parametrize("period", [0.002, 0.004, 0.01])
def test_a_controller_that_is_sampled_acts_on_the_spin_of_half_a_period_ago(period, dt):
    kp, ki, steps, inertia = 9.0, 12.0, round(0.3 / dt), 0.02 + 52 / 2 * 0.1325**2
    motion, target = dataclasses.replace(motion_at(), dt=dt), jnp.array([1.0, 1.0])
    expected = spins_with_a_sampled_controller(kp, ki, period, 1.0 / 0.1325, inertia, steps, motion.dt)

    def error(period, kff):
        drive = make_effect("torque_drive", kp=kp, ki=ki, kff=kff, period=period)

        def step(carry, _):
            memory, spin = carry
            turning = dataclasses.replace(motion, spin=spin)
            memory, out = drive.actuation(memory, Drive(target, jnp.zeros(2), jnp.zeros(2)), turning)
            spin = spin + out.torque / inertia * motion.dt
            return (memory, spin), spin[0]

        _, spins = jax.lax.scan(step, (drive.init(), jnp.zeros(2)), length=steps)
        return np.abs(spins[2:] - expected[2:]).max() / (1.0 / 0.1325)

    assert error(period, ki * period / 2) < 0.008  # of the target; within a hold the spin runs ahead of its mean
    assert error(0.0, 0.0) > 2 * error(period, ki * period / 2)


def test_a_torque_yields_to_a_wheel_that_turns_faster_than_foreseen_and_stays_within_its_limit():
    drive, motion = make_effect("torque_drive", kp=4.0, ki=0.0, limit=10.0), motion_at()
    _, out = drive.actuation(drive.init(), Drive(jnp.array([0.2, 1.0]), jnp.zeros(2), jnp.zeros(2)), motion)
    for faster in (0.0, 1.0, 5.0, 1000.0):
        spin = out.yielding.foreseen + faster
        change, inside = out.yielding.change(spin)
        # The mean of the speeds before and after the step is what the controller sees, at rest before.
        wanted = 4.0 * (np.array([0.2, 1.0]) / 0.1325 - np.asarray(spin) / 2)
        np.testing.assert_allclose(out.torque + change, np.clip(wanted, -10.0, 10.0), rtol=1e-4, atol=1e-4)
        np.testing.assert_array_equal(inside, np.abs(wanted) < 10.0)


@pytest.mark.parametrize(
    "name, fields, share",
    [
        ("supply_sag", {}, 1.0),
        ("drive_gain_difference", {"difference": 0.2}, None),  # that of the torque
        ("actuator_lag", {"time_constant": 0.015}, 0.25),
        ("torque_saturation", {"limit": 10.0}, 0.0),
        ("traction_limit", {"mu": 0.01}, 0.0),
    ],
)
def test_what_weakens_a_torque_weakens_how_it_yields(name, fields, share):
    effect, motion = make_effect(name, **fields), motion_at()
    drive = yielding(jnp.zeros(2), jnp.zeros(2), jnp.full(2, 8.0))
    _, after = effect.actuation(effect.init(), drive, motion)
    expected = after.torque / drive.torque if share is None else np.full(2, share)
    np.testing.assert_allclose(after.yielding.factor, expected, atol=0.01)


@pytest.mark.parametrize("limit", [0.5, 0.02])
def test_the_papers_integral_stops_at_its_limit(limit):
    drive, motion = make_effect("pid_drive", ki=2.0, integral_limit=limit), motion_at()
    memory, wanted = drive.init(), Drive(jnp.array([1.0, -1.0]), jnp.zeros(2), jnp.zeros(2))
    for _ in range(10):
        memory, out = drive.actuation(memory, wanted, motion)
    integral = min(limit, 10 * motion.dt)  # m
    np.testing.assert_allclose(out.force, 52 / 2 * 2.0 * integral * np.array([1, -1]), rtol=1e-5)


def test_forward_slip_scales_the_traction_alone():
    drive = Drive(jnp.array([0.5, 0.2]), jnp.array([30.0, -20.0]), jnp.array([4.0, 5.0]))
    _, after = make_effect("forward_slip", eta=0.84).actuation((), drive, motion_at())
    np.testing.assert_allclose(after.force, [25.2, -16.8], rtol=1e-6)
    np.testing.assert_array_equal(after.torque, drive.torque)


@pytest.mark.parametrize("kind", EFFECTS.values())
def test_every_parameter_has_a_unit_a_range_and_a_description(kind):
    assert parameters_of(kind)
    assert {field.name for field in dataclasses.fields(kind)} == set(parameters_of(kind))
    for about in parameters_of(kind).values():
        assert about.unit and about.description and about.low < about.high
