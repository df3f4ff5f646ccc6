"""Variants of the vehicle by their own signatures: casters, skid steering, and the drive as the maker documents it."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.vehicle.dynamics import drive, forces, place
from whill_mjx.vehicle.model import build_model
from whill_mjx.vehicle.parameters import set_values
from whill_mjx.vehicle.presets import preset, preset_params
from whill_mjx.vehicle.specs import HUSKY
from whill_mjx.vehicle.types import VehicleParams


def roll(spec, params, commands):
    """Drives of B vehicles (leaves with B in front) under commands (B, T, 2): what is seen after each period."""
    model = build_model(spec)

    def one(params, commands):
        def period(state, command):
            state = drive(model, params, state, command)
            motion = forces(model, params, state, command)[2]
            seen = {"x": state.qpos[0], "y": state.qpos[1], "yaw": motion.heading, "v": motion.velocity[0],
                    "omega": motion.angular_velocity[2], "side": motion.contact_vy, "counted": state.odometry.yaw,
                    "reported": state.odometry.v, "gyro": jnp.asarray(state.odometry.gyro)}  # fmt: skip
            return state, seen

        return jax.lax.scan(period, place(model, params, 0.0, 0.0, 0.0), commands)[1]

    return jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(params, jnp.asarray(commands, jnp.float32)))


def copies(params: VehicleParams, count: int) -> VehicleParams:
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *jnp.shape(leaf))), params)


def test_casters_kick_a_reversing_chair_once_and_then_trail():
    """Forward and back: without the kick the chair keeps its heading; with it the chair swerves within a few trails of
    the reversal, and drives straight again when the casters have turned round."""
    spec, params = preset("whill_cr_castored")
    batch = copies(params, 2)
    batch = set_values(batch, ["caster_kick.force_limit"], jnp.array([[0.0, 20.0]]))
    commands = np.repeat([[0.5, 0.0], [-0.4, 0.0]], [20, 40], axis=0)
    seen = roll(spec, batch, np.stack([commands, commands]))
    free, kicked = seen["omega"]
    np.testing.assert_allclose(free, 0.0, atol=1e-3)
    np.testing.assert_allclose(kicked[:20], 0.0, atol=0.02)  # trailing from the start
    pulse = np.abs(kicked[20:])
    assert pulse.max() > 0.02 and 0 < pulse.argmax() < 25
    assert pulse[-5:].max() < 0.3 * pulse.max()


def test_a_skid_steered_vehicle_drags_its_wheels_sideways_and_turns_less_than_they_say():
    params = preset_params(HUSKY, "physical")
    commands = np.repeat([[[0.5, 0.0]], [[0.0, 0.8]], [[0.4, 0.8]]], 30, axis=1)
    seen = roll(HUSKY, copies(params, 3), commands)
    straight, spot, curve = ({key: value[index] for key, value in seen.items()} for index in range(3))
    np.testing.assert_allclose([straight["y"][-1], straight["yaw"][-1]], 0.0, atol=1e-4)
    assert straight["x"][-1] > 1.2
    assert np.hypot(spot["x"][-1], spot["y"][-1]) < 0.02  # about its middle, not about an axle
    rear, front = spot["side"][-1][:2], spot["side"][-1][2:]
    assert (front > 0.04).all() and (rear < -0.04).all()
    np.testing.assert_allclose(front, -rear, rtol=0.05)
    for turning in (spot, curve):
        unwrapped = np.unwrap(turning["yaw"])[-1]
        assert 0.2 * turning["counted"][-1] < unwrapped < 0.97 * turning["counted"][-1]


def test_the_documented_drive_ramps_and_clamps_its_commands_and_lets_them_lapse():
    """1.7 m/s^2; at most 1.667 m/s; a command that is not repeated lapses after 200 ms; speeds in words."""
    spec, params = preset("whill_cr_documented")
    batch = copies(params, 3)
    batch = set_values(batch, ["command_expiry.resend"], jnp.array([[0.1, 0.1, 2.0]]))
    commands = np.zeros((3, 30, 2))
    commands[0, :, 0], commands[1, :, 0], commands[2, :, 0] = 0.8, 3.0, 0.8
    seen = roll(spec, batch, commands)
    steady, fast, lapsed = seen["v"]
    assert 0.3 < (steady[4] - steady[2]) / 0.2 / 1.7 < 1.1
    np.testing.assert_allclose(steady[-1], 0.8, atol=0.02)
    np.testing.assert_allclose(fast[-1], 1.667, atol=0.03)
    assert lapsed[1:4].max() > 0.1 and abs(lapsed[12]) < 0.1  # 0.2 s on the ramp, then back to rest
    words = seen["reported"] / (0.004 / 3.6 / 2)  # the mean of two wheels: half words
    np.testing.assert_allclose(words, np.round(words), atol=0.02)


def test_every_effect_of_the_documented_drive_can_be_taken_out():
    spec, params = preset("whill_cr_documented")
    _, plain = preset("whill_cr_physical")
    kept = {effect.name for effect in plain.effects}
    stripped = replace(params, effects=tuple(effect for effect in params.effects if effect.name in kept))
    jax.tree.map(np.testing.assert_array_equal, stripped, plain)
