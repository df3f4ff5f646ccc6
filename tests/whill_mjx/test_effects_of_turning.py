"""The laws of skid-steered vehicles: how wheels, load and turning go together, in drives of a robot."""

from dataclasses import replace
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from effects_in_hand import DT, chair, motion_at, quick, run, signal, step_command
from scipy.optimize import brentq

from whill_mjx.effects import EFFECTS, make_effect
from whill_mjx.effects.card import Scale
from whill_mjx.effects.planar import at_contacts, at_wheels, loads_of_wheels
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.dynamics import nominal_world, place, substep
from whill_mjx.vehicle.kinematics import body_twist
from whill_mjx.vehicle.model import build_model
from whill_mjx.vehicle.presets import preset_params
from whill_mjx.vehicle.specs import WARTHOG, WHILL_CR

NAMES = ("motor_line", "side_slip", "turn_efficiency_speed", "turn_lag", "turning_slip")
STEP, SETTLED = 0.01, 300


@lru_cache
def robot():
    """A Warthog with all effects of this file, and a compiled drive of one command until it is steady."""
    params = preset_params(WARTHOG, "physical")
    more = (make_effect(name) for name in (*NAMES, "turn_efficiency", "middle_wheels"))
    params = replace(params, effects=(*params.effects, *more))
    model = build_model(WARTHOG, VehicleConfig(physics_dt=STEP, limited=False))

    @jax.jit
    def steady(params, command):
        state = place(model, params, 0.0, 0.0, 0.0)
        state = jax.lax.scan(lambda s, _: (substep(model, params, s, command), None), state, None, length=SETTLED)[0]
        yaw = 2 * jnp.arctan2(state.qpos[6], state.qpos[3])
        left = -jnp.sin(yaw) * state.qvel[0] + jnp.cos(yaw) * state.qvel[1]
        v, omega = body_twist(model, state.qpos, state.qvel)
        return jnp.stack([v, left, omega, state.encoder.v, state.encoder.omega, *(state.qvel[6:8] * 0.3)])

    return params, steady


def driven(command, **values):
    """Speed ahead, to the left, yaw rate; those of the odometry; speeds of the wheels. `values`: effect=parameters."""
    params, steady = robot()
    effects = tuple(make_effect(one.name, **values[one.name]) if one.name in values else one for one in params.effects)
    return np.asarray(steady(replace(params, effects=effects), jnp.array(command)), float)


@quick
def test_the_yaw_rate_lags_and_the_speed_does_not():
    out = np.asarray(run(make_effect("turn_lag", time_constant=0.2), step_command(0.5, 1.0)))
    np.testing.assert_array_equal(out[:, 0], 0.5)
    t = np.arange(1, len(out) + 1) * DT
    np.testing.assert_allclose(out[:, 1], 1 - np.exp(-t / 0.2), atol=0.02)


@quick
def test_the_motor_line_falls_from_the_stall_force_to_nothing_and_lets_brakes_be():
    line = make_effect("motor_line", no_load_speed=2.0, droop=0.02)
    for v in (0.0, 0.5, 1.0, 1.5):
        motion = motion_at(v=v)
        radius = motion.wheel_radius
        extra = float(motion.dt * radius**2 / (2 * motion.wheel_inertia))
        _, out = line.actuation((), signal(torque=(200.0, -200.0)), motion)
        high, low = (2.0 - v) / (0.02 + extra), -(2.0 + v) / (0.02 + extra)
        np.testing.assert_allclose(out.torque, [radius * high, radius * low], rtol=1e-4)
        _, out = line.actuation((), signal(torque=(0.9 * radius * high, 0.9 * radius * low)), motion)
        np.testing.assert_allclose(out.torque, [0.9 * radius * high, 0.9 * radius * low], rtol=1e-5)


def test_a_motor_on_its_line_is_slower_the_more_it_has_to_push():
    line = {"no_load_speed": 4.0, "droop": 0.002}
    straight = driven((6.0, 0.0), motor_line=line)[5:]
    bend = driven((3.0, 2.5), motor_line=line)[5:]
    assert 3.4 < straight.min() <= straight.max() < 4.0
    assert bend[1] < straight[1] - 0.15  # the outer side turns the vehicle
    assert driven((2.0, 0.0), motor_line=line)[3] == pytest.approx(driven((2.0, 0.0))[3], abs=0.02)
    assert driven((6.0, 0.0), motor_line={"no_load_speed": 4.0, "droop": 0.0})[3] == pytest.approx(4.0, abs=0.05)


def test_a_speed_difference_turns_the_vehicle_less_at_speed():
    for v in (0.5, 2.0):
        plain = driven((v, 0.6))
        seen = driven((v, 0.6), turn_efficiency_speed={"per_speed": -0.08})
        same = driven((v, 0.6), turn_efficiency={"efficiency": 1 - 0.08 * seen[0]})
        np.testing.assert_allclose(seen, same, atol=0.03)  # of a turn that is not quite steady
        assert np.abs(same - seen).max() < 0.5 * np.abs(plain - seen).max()


def test_a_turn_of_the_wheels_moves_the_vehicle_less_far_in_a_bend():
    def share(omega, **values):
        seen = driven((1.5, omega), **values)
        return seen[0] / seen[3], seen[2]

    for omega in (0.0, 0.6):
        before, rate = share(omega)
        after, _ = share(omega, turning_slip={"per_yaw_rate": 0.1})
        assert after == pytest.approx(before / (1 + 0.1 * abs(rate)), rel=0.01)


@pytest.mark.parametrize("command", [(1.5, 0.6), (-1.5, 0.6), (1.5, -0.6), (1.5, 0.0)])
def test_in_a_bend_the_vehicle_slides_outwards(command):
    before = driven(command)
    v, left, omega = driven(command, side_slip={"per_yaw_rate": 0.1})[:3]
    assert left - before[1] == pytest.approx(-0.1 * v * omega, abs=0.02)
    assert v == pytest.approx(before[0], abs=0.02)


@quick
@pytest.mark.parametrize("name", NAMES)
def test_the_loop_looks_for_them_on_skid_drives_alone(name):
    card = EFFECTS[name].card
    assert card.variants_of(Scale(WARTHOG, frozenset())) and not card.variants_of(Scale(WHILL_CR, frozenset()))


@quick
@pytest.mark.parametrize("share", [0.0, 0.2, 1 / 3])
def test_wheels_in_the_middle_turn_the_vehicle_as_coulombs_law_says(share):
    """On the spot, without creep: the moments of friction along and across the wheels are in balance."""
    half, ahead = WARTHOG.track / 2, WARTHOG.wheelbase / 2

    def balance(slide):  # along the wheels, per yaw rate [m]
        return share * half + (1 - share) * (half * slide - ahead**2) / np.hypot(slide, ahead)

    coulomb = {"mu": 0.3, "slip_speed": 0.0005, "side_slip_speed": 0.001, "mu_free": 0.0}
    found = driven([0.0, 1.0], slip_traction=coulomb, yaw_scrub={"torque": 0.0}, rolling_resistance={"mu_r": 0.0},
                   middle_wheels={"share": share})
    assert found[2] / found[4] == pytest.approx(half / (half + brentq(balance, 1e-6, 5.0)), rel=0.01)


@quick
def test_six_wheels_share_the_load_evenly_and_their_forces_keep_sum_and_moments():
    motion = motion_at(omega=1.0, name="husky")
    assert at_wheels(motion, motion.normal_force) is motion.normal_force is loads_of_wheels(motion)
    model, _ = chair("husky")
    _, world = make_effect("middle_wheels", share=1 / 3).world((), nominal_world(model))
    motion = replace(motion, world=world)
    np.testing.assert_allclose(loads_of_wheels(motion), np.full(6, 50 * 9.81 / 6), rtol=0.01)
    places = at_wheels(motion, world.geometry.contact_x)
    forces = jnp.array([1.0, 2.0, -3.0, 5.0, 7.0, -1.0])
    corners = at_contacts(forces)
    np.testing.assert_allclose(corners[::2].sum(), forces[::2].sum(), rtol=1e-6)
    np.testing.assert_allclose(world.geometry.contact_x @ corners, places @ forces, atol=1e-5)
    tilted = replace(motion, normal_force=jnp.array([10.0, 100.0, 90.0, 100.0]))
    carried = loads_of_wheels(tilted)  # the rear left wheel is lifted
    np.testing.assert_allclose(carried[::2], [0.0, 20.0, 80.0], atol=1e-4)
    _, world = make_effect("middle_wheels", share=1 / 3).world((), nominal_world(chair()[0]))
    carried = loads_of_wheels(replace(motion_at(), world=world))
    np.testing.assert_array_equal(carried[2:4], 0.0)  # no wheels there on a differential drive
