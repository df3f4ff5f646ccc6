"""The fused physics step: the closed form of the rigid bodies, and functions evaluated on single elements."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from whill_mjx.effects import make_effect
from whill_mjx.vehicle import rigid
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.dynamics import drive, nominal_world, place
from whill_mjx.vehicle.kinematics import rotation_from_quaternion
from whill_mjx.vehicle.model import VehicleModel, WheelBodies, build_model, mujoco_model
from whill_mjx.vehicle.presets import preset
from whill_mjx.vehicle.scalars import apart, scan_apart
from whill_mjx.vehicle.specs import SPECS

quick = pytest.mark.quick


def wheels_of(host):
    left = host.body("left_wheel")
    armature = host.dof_armature[host.joint("left_wheel").dofadr[0]]
    return WheelBodies(left.pos[0], left.pos[1], left.mass[0], left.inertia[1], armature)


@quick
@pytest.mark.parametrize("name", SPECS)
def test_the_wheels_are_bodies_as_mujoco_compiles_them(name):
    assert build_model(SPECS[name]).wheels == wheels_of(mujoco_model(SPECS[name]))


@quick
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_accelerations_equal_those_of_c_mujoco_for_any_state_and_heavy_wheels(seed):
    spec, params = preset("whill_cr_physical")
    host = mujoco_model(spec, body=params.body)
    host.body_mass[2:], host.body_inertia[2:] = 3.0, 0.05
    host.body_ipos[1] = [0.1, -0.05, 0.2]
    host.opt.gravity[:] = [0.3, -0.5, -9.7]
    data = mujoco.MjData(host)
    random = np.random.default_rng(seed)
    data.qpos[:], data.qvel[:], data.qfrc_applied[:] = (random.normal(size=size) for size in (9, 8, 8))
    data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
    mujoco.mj_forward(host, data)
    model = VehicleModel(spec, VehicleConfig(), wheels_of(host))
    with jax.enable_x64(True):
        mass, inertia, com, gravity, qpos, qvel, force = (
            jnp.asarray(np.array(value))
            for value in (host.body_mass[1], host.body_inertia[1], host.body_ipos[1], host.opt.gravity, data.qpos,
                          data.qvel, data.qfrc_applied)
        )  # fmt: skip
        rotation = rotation_from_quaternion(qpos[3:7])
        world = replace(nominal_world(model), gravity=gravity)
        found = rigid.accelerations(model, rigid.Chassis(mass, inertia, com), world, rotation, qvel, force)
    np.testing.assert_allclose(found, data.qacc, rtol=1e-9, atol=1e-9)


@quick
@pytest.mark.parametrize("rate", [(0.0, 0.0, 0.0), (1e-9, 0.0, 0.0), (0.3, -2.0, 5.0), (20.0, 30.0, -40.0)])
def test_a_body_turns_as_mujoco_integrates_it(rate):
    quaternion = np.array([0.5, -0.1, 0.7, 0.2]) / np.linalg.norm([0.5, -0.1, 0.7, 0.2])
    expected = quaternion.copy()
    mujoco.mju_quatIntegrate(expected, np.array(rate), 0.005)
    with jax.enable_x64(True):
        found = rigid.turned(jnp.asarray(quaternion), jnp.asarray(rate), 0.005)
    np.testing.assert_allclose(found, expected, atol=1e-14)


def test_the_fused_step_and_the_kernel_follow_mjx_for_ten_seconds():
    """Positions and speeds within 1e-6 in float64, with a payload, a tilted centre of mass and slip."""
    with jax.enable_x64(True):
        spec, params = preset("whill_cr_physical")
        payload = make_effect("payload_shift", mass=20.0, x=0.1, y=0.15, z=0.3)
        params = replace(params, effects=(*params.effects, payload))
        times = np.arange(100) * 0.1
        commands = jnp.asarray(np.stack([0.6 * np.sin(0.7 * times) + 0.3, 0.8 * np.sin(1.1 * times)], axis=1))
        ends = {}
        for dynamics, kernel in (("fused", False), ("fused", True), ("mjx", False)):
            build_model.cache_clear()
            model = build_model(spec, VehicleConfig(dynamics=dynamics, kernel=kernel))

            def period(state, command, model=model):
                return drive(model, params, state, command), None

            start = place(model, params, 0.0, 0.0, 0.3)
            ends[dynamics, kernel], _ = jax.jit(lambda s, period=period: jax.lax.scan(period, s, commands))(start)
        build_model.cache_clear()
    expected = ends.pop(("mjx", False))
    assert np.abs(expected.qpos[:2]).max() > 1.0  # it went somewhere
    for end in ends.values():
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), end, expected)


@quick
def test_an_unknown_kind_of_dynamics_is_refused():
    with pytest.raises(ValueError, match="dynamics is 'warp'; it must be 'fused' or 'mjx'"):
        VehicleConfig(dynamics="warp")


# Functions on single elements


def mixture(matrix, vector, flag):
    """One of every kind of operation, constants among them."""
    a, b, c = vector
    edge = jax.lax.pad(vector, 0.5, [(-1, 2, 1)])[1:4] + jax.lax.pad(matrix, c, [(1, -1, 0), (0, 1, 0)])[1, 1:]
    matrix = matrix + jnp.diag(edge) * jnp.stack(jnp.unstack(matrix, axis=1)).sum()
    table = jnp.concatenate([jnp.stack([a * 0.0, b * 1.0]), vector[1:] / 2.0, jnp.zeros(2)])
    product = matrix @ vector + matrix.T[::-1] @ jnp.flip(vector)
    chosen = jnp.where(flag, jnp.tanh(product), jnp.arctan2(product, 0.5 + vector**2))
    bounds = jnp.clip(chosen, -0.4, vector.max()), (matrix > 0.1).any(), jnp.isfinite(matrix).all(1)
    unknown = jnp.cumsum(vector) + jnp.linalg.det(matrix) + jax.nn.softplus(c)
    return {"table": table.reshape(3, 2), "sum": matrix.sum(0) - matrix.prod(), "bounds": bounds, "unknown": unknown}


@quick
def test_a_function_taken_apart_gives_the_same_values_and_derivatives():
    random = np.random.default_rng(0)
    matrix, vector = jnp.asarray(random.normal(size=(3, 3)), jnp.float32), jnp.asarray([0.3, -0.2, 0.9])
    for flag in (True, False):
        expected = mixture(matrix, vector, jnp.array(flag))
        found = apart(mixture)(matrix, vector, jnp.array(flag))
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-6, atol=1e-7), found, expected)

    def total(function, vector):
        result = function(matrix, vector, jnp.array(True))
        return result["table"].sum() + result["bounds"][0].sum() + result["unknown"].sum()

    slopes = [jax.jacfwd(lambda v, f=f: total(f, v))(vector) for f in (mixture, apart(mixture))]
    np.testing.assert_allclose(slopes[1], slopes[0], rtol=1e-5, atol=1e-6)


@quick
def test_a_function_taken_apart_can_be_batched():
    matrix, vectors = jnp.eye(3), jnp.arange(12.0).reshape(4, 3) / 10
    flags = jnp.array([True, False, True, False])
    found = jax.vmap(apart(mixture), in_axes=(None, 0, 0))(matrix, vectors, flags)
    expected = jax.vmap(mixture, in_axes=(None, 0, 0))(matrix, vectors, flags)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-6, atol=1e-7), found, expected)


@quick
def test_what_is_left_is_arithmetic_on_single_numbers():
    """No slice, stack, product or sum of arrays between the inputs and the outputs."""

    def equation(matrix, vector):
        turned = jnp.stack(jnp.unstack(matrix, axis=1))  # (3, 2)
        diagonal = jnp.diag(vector)[1:, :2] * turned[1:]
        return (matrix @ vector).sum() * jnp.array([1.0, 0.0]) + vector[1:] + diagonal.sum(0)

    operations = jax.make_jaxpr(apart(equation))(jnp.ones((2, 3)), jnp.ones(3))
    names = [one.primitive.name for one in operations.eqns]
    assert not {"dot_general", "reduce_sum", "unstack", "stack", "pad", "iota", "select_n"} & set(names[:-3])
    assert names.count("mul") == 7  # the product's and one of the diagonal; times 1 and times 0 are folded


@quick
def test_a_scan_of_single_elements_equals_a_loop():
    def one(carry, x):
        big, small, count = carry
        return (big + x[0], jnp.stack([small[1] * 0.9, small[0] + x[1]]), count + 1), small * x

    start = jnp.zeros((20, 20)), jnp.array([0.1, 0.2]), jnp.array(0)  # the first stays whole
    xs = jnp.arange(10.0).reshape(5, 2)
    expected = jax.lax.scan(one, start, xs)
    found = scan_apart(one, start, xs)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), found, expected)
    assert found[0][2].dtype == start[2].dtype
