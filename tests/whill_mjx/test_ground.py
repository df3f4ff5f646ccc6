"""The ground: surfaces, equilibrium on slopes, ramps and bumps crossed, energy."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.effects import make_effect
from whill_mjx.vehicle.dynamics import drive, forces, measure, nominal_world, place
from whill_mjx.vehicle.kinematics import camera_pose
from whill_mjx.vehicle.model import build_model
from whill_mjx.vehicle.presets import preset
from whill_mjx.vehicle.types import parameters_of

quick = pytest.mark.quick
SURFACES = {"incline": {"along_x": 0.08, "along_y": -0.05}, "ramp": {"rise": 0.1, "length": 1.5, "direction": 0.7},
            "bump": {"rise": 0.03, "width": 0.4}}  # fmt: skip


@lru_cache
def chair():
    spec, params = preset("whill_cr_physical")
    return build_model(spec), params


@quick
@pytest.mark.parametrize("name", SURFACES)
def test_the_slopes_of_a_surface_are_the_derivatives_of_its_height(name):
    surface = make_effect(name, **SURFACES[name])
    for x, y in ((1.3, 0.2), (1.9, -0.3), (0.7, 1.5)):
        height, along_x, along_y = surface.height(jnp.array(x), jnp.array(y))
        expected = jax.grad(lambda at: surface.height(at[0], at[1])[0])(jnp.array([x, y]))
        np.testing.assert_allclose([along_x, along_y], expected, atol=1e-6)
        assert height.shape == ()


@quick
def test_a_ramp_joins_two_levels_without_a_kerb():
    surface = make_effect("ramp", rise=0.2, length=2.0, distance=1.0)
    x = jnp.linspace(0.0, 4.0, 401)
    height, slope, _ = surface.height(x, 0 * x)
    np.testing.assert_allclose(height[jnp.array([0, 100, 200, 300, 400])], [0.0, 0.0, 0.1, 0.2, 0.2], atol=1e-6)
    np.testing.assert_allclose(slope[jnp.array([0, 100, 300, 400])], 0.0, atol=1e-6)
    np.testing.assert_allclose(slope.max(), 1.5 * 0.2 / 2.0, rtol=1e-3)


@quick
def test_surfaces_at_their_neutral_values_change_no_bit_of_the_motion():
    model, params = chair()
    state = place(model, params, 0.3, -0.2, 0.8, (0.5, 0.3))
    shake = jnp.array([0.0, 0.1, -0.03, 0.02, 0.05, 0.0, 0.2, -0.1])
    state = state.replace(qvel=state.qvel + shake, qpos=state.qpos.at[3:7].add(jnp.array([0.0, 0.01, -0.02, 0.0])))
    flat = world = nominal_world(model)
    for name in SURFACES:
        _, world = make_effect(name).world((), world)
    assert len(world.ground) == 3
    expected, found = measure(model, params, flat, state), measure(model, params, world, state)
    for field in ("ground_axes", "contact_vx", "contact_vy", "normal_force"):
        np.testing.assert_array_equal(getattr(found, field), getattr(expected, field), err_msg=field)
    for contact in range(4):
        np.testing.assert_array_equal(found.contact_axes[:, :, contact], expected.contact_axes)
    jax.tree.map(np.testing.assert_array_equal, found.contact_points[:2], expected.contact_points[:2])


@quick
@pytest.mark.parametrize(("yaw", "elevation"), [(0.0, 0.1), (np.pi, -0.1), (np.pi / 2, 0.0)])
def test_the_camera_tilts_with_a_vehicle_on_an_incline(yaw, elevation):
    model, params = chair()
    params = params.replace(body=params.body.replace(com_x=jnp.array((model.spec.rear_x + model.spec.front_x) / 2)))
    uphill = replace(params, effects=(make_effect("incline", along_x=0.1),))
    position, rotation = camera_pose(model, place(model, uphill, 2.0, 0.0, yaw).qpos)
    down = model.spec.camera.pitch
    np.testing.assert_allclose(np.arcsin(rotation[2, 2]), elevation - down, atol=2e-3)
    flat, _ = camera_pose(model, place(model, params, 2.0, 0.0, yaw).qpos)
    np.testing.assert_allclose(position[2] - flat[2], np.tan(0.1) * position[0], atol=0.01)


# One compiled drive for all grounds

DRIVES = {
    "flat": ({}, 0.0), "incline": ({"incline": {"along_x": 0.07}}, 0.0), "slope": ({"slope": {"along_x": 0.07}}, 0.0),
    "cross incline": ({"incline": {"along_y": 0.05}}, 0.0), "cross slope": ({"slope": {"along_y": 0.05}}, 0.0),
    "ramp": ({"ramp": {"rise": 0.1, "length": 1.0, "distance": 0.8}}, 0.0),
    "bump": ({"bump": {"rise": 0.02, "width": 0.2, "x": 1.1, "y": 0.248}}, 0.0),
    "turned bump": ({"bump": {"rise": 0.02, "width": 0.2, "x": -0.248, "y": 1.1}}, np.pi / 2),
}  # fmt: skip
PERIODS = 50


@lru_cache
def drives():
    """Heights, attitudes and loads over time of 5 s at 0.5 m/s on each ground."""
    with jax.enable_x64(True):
        spec, params = preset("whill_cr_physical")
        model = build_model(spec)
        kinds = ("incline", "slope", "ramp", "bump")

        def vehicle(changes):
            return replace(params, effects=(*params.effects, *(make_effect(k, **changes.get(k, {})) for k in kinds)))

        def one(params, yaw):
            state = place(model, params, 0.0, 0.0, yaw)

            def period(state, command):
                state = drive(model, params, state, command)
                motion = forces(model, params, state, command)[2]
                seen = {"position": state.qpos[:3], "attitude": motion.rotation[2], "v": motion.velocity[0],
                        "load": motion.normal_force, "odometry": state.odometry.v}  # fmt: skip
                return state, seen

            commands = jnp.tile(jnp.array([0.5, 0.0]), (PERIODS, 1)).at[:5].set(0.0)
            return jax.lax.scan(period, state, commands)[1]

        batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(vehicle(changes) for changes, _ in DRIVES.values()))
        yaws = jnp.array([yaw for _, yaw in DRIVES.values()])
        seen = jax.jit(jax.vmap(one))(batch, yaws)
        seen = jax.tree.map(np.asarray, seen)
    return {name: {key: seen[key][index] for key in seen} for index, name in enumerate(DRIVES)}


@pytest.mark.parametrize(("ground", "gravity"), [("incline", "slope"), ("cross incline", "cross slope")])
def test_an_incline_is_the_same_motion_as_tilted_gravity(ground, gravity):
    """Loads, speed and odometry; the path is that of the slope's plane turned into the room."""
    tilted, pulled = drives()[ground], drives()[gravity]
    np.testing.assert_allclose(tilted["load"][2:], pulled["load"][2:], rtol=2e-3)
    np.testing.assert_allclose(tilted["v"][2:], pulled["v"][2:], atol=1e-4)
    np.testing.assert_allclose(tilted["odometry"][2:], pulled["odometry"][2:], atol=1e-4)
    if ground == "incline":
        np.testing.assert_allclose(tilted["position"][-1, 2] - tilted["position"][4, 2], np.sin(0.07) * (
            pulled["position"][-1, 0] - pulled["position"][4, 0]), atol=1e-3)  # fmt: skip
    resting = tilted["load"][4]
    np.testing.assert_allclose(resting.sum(), 52 * 9.81 * np.cos(0.07 if ground == "incline" else 0.05), rtol=5e-3)
    flat, weight, height = drives()["flat"]["load"][4], 52 * 9.81, 0.1325
    if ground == "incline":  # the rear axle takes over what the pull downhill shifts
        shift, gained = weight * np.sin(0.07) * height / 0.6, resting[:2].sum() - flat[:2].sum() * np.cos(0.07)
    else:  # the left side is uphill
        shift, gained = -weight * np.sin(0.05) * height / 0.496, resting[[0, 2]].sum() - flat[[0, 2]].sum()
    np.testing.assert_allclose(gained, shift, atol=0.6)


def test_a_ramp_lifts_the_vehicle_and_leaves_it_level():
    seen, flat = drives()["ramp"], drives()["flat"]
    rise = seen["position"][:, 2] - flat["position"][:, 2]
    np.testing.assert_allclose(rise[[0, -1]], [0.0, 0.1], atol=2e-3)
    np.testing.assert_allclose(seen["attitude"][[4, -1]], flat["attitude"][[4, -1]], atol=2e-3)
    assert seen["attitude"][:, 0].max() > 0.08  # the nose points up on the way
    assert np.diff(rise).min() > -1e-3
    np.testing.assert_allclose(seen["load"][-1], flat["load"][-1], rtol=0.02)


def test_a_bump_under_the_left_wheels_rolls_the_vehicle_and_lets_it_return():
    seen, flat = drives()["bump"], drives()["flat"]
    np.testing.assert_allclose(seen["position"][-1, 2], flat["position"][-1, 2], atol=1e-3)
    np.testing.assert_allclose(seen["attitude"][-1], flat["attitude"][-1], atol=2e-3)
    roll = seen["attitude"][:, 1] - flat["attitude"][:, 1]
    assert roll.max() > 0.01 and roll.min() > -0.01  # left side up; 0.02 m over a track of 0.5 m, shared by two axles
    assert (seen["load"] > 0).all()


def test_the_ground_stays_in_the_room_when_the_vehicle_turns():
    """The same bump crossed at a right angle to the first: the same loads."""
    np.testing.assert_allclose(drives()["turned bump"]["load"], drives()["bump"]["load"], rtol=1e-6)


@quick
@pytest.mark.parametrize("name", SURFACES)
def test_every_surface_can_be_fitted(name):
    about = parameters_of(make_effect(name))
    assert {one.neutral for one in about.values()} and all(one.low <= one.neutral <= one.high for one in about.values())
