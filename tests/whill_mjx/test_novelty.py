"""Surprise: beliefs that contradict one another raise it, and those of a vehicle that drives do not."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dreamer.model import agent as agents
from dreamer.spaces import vector_size
from whill_mjx.env import make_env
from whill_mjx.evaluation.policies.novelty import (
    BELIEVED,
    RATE,
    SURPRISE,
    contradiction,
    largest_surprise,
    limits,
    watched,
)
from whill_mjx.learning.setup import TRUTH, dreamer_policy, find_preset, obs_shape_of, with_truth

pytestmark = pytest.mark.quick
SECONDS = 0.1


def beliefs(pose, goal=(4.0, 1.0), v=0.5, omega=0.8):
    """What a vehicle at a pose that sees well believes of a goal in the room."""
    x, y, yaw = pose
    dx, dy = goal[0] - x, goal[1] - y
    ahead, aside = dx * np.cos(yaw) + dy * np.sin(yaw), dy * np.cos(yaw) - dx * np.sin(yaw)
    return jnp.array([ahead, aside, v, omega])


def drive(steps, v=0.5, omega=0.8):
    poses = [(0.0, 0.0, 0.3)]
    for _ in range(steps):
        x, y, yaw = poses[-1]
        poses.append((x + v * SECONDS * np.cos(yaw), y + v * SECONDS * np.sin(yaw), yaw + omega * SECONDS))
    return poses


def test_true_beliefs_of_a_vehicle_that_turns_do_not_contradict_one_another():
    poses = drive(8)
    for one, other in zip(poses[:-1], poses[1:], strict=True):
        assert contradiction(beliefs(one), beliefs(other), SECONDS) < 1e-5
    jumped = beliefs(poses[1]) + jnp.array([0.3, -0.4, 0.0, 0.0])
    assert contradiction(beliefs(poses[0]), jumped, SECONDS) == pytest.approx(0.5, abs=1e-5)


def test_a_watched_policy_acts_as_before_and_carries_the_mean_jump():
    seen = [beliefs(pose) for pose in drive(6)]
    seen[3] = seen[3] + jnp.array([0.0, 1.0, 0.0, 0.0])

    def step(weights, carry, image):
        return {"count": carry["count"] + 1}, weights * image

    act, carry = watched(step, {"count": jnp.zeros(())}, SECONDS, lambda weights, carry: seen[int(carry["count"]) - 1])
    assert carry[SURPRISE] == 0 and not carry[BELIEVED].any()
    surprise = []
    for _ in seen:
        carry, action = act(2.0, carry, 3.0)
        surprise.append(float(carry[SURPRISE][0]))
        assert action == 6.0
    np.testing.assert_allclose(surprise[:3], 0.0, atol=1e-5)  # the first frame contradicts nothing
    jump, back = RATE * 1.0, RATE * (1.0 - RATE) + RATE
    np.testing.assert_allclose(surprise[3:5], [jump, back], atol=1e-5)
    assert surprise[5] < surprise[4]


def test_a_policy_that_is_surprised_by_its_first_frames_has_that_in_its_limits():
    """The bridge compares each decision with the limits, the first ones too."""
    env, params = make_env("point_goal", height=8, width=8)

    def act(weights, carry, image):
        count = carry["count"] + 1
        return {"count": count, SURPRISE: jnp.where(count == 2, weights, 0.1)[None]}, jnp.zeros(2)

    carry = {"count": jnp.zeros((), jnp.int32), SURPRISE: jnp.zeros(1)}
    largest, arrived = largest_surprise(env, params, act, 0.7, carry, jax.random.split(jax.random.key(0), 2))
    np.testing.assert_allclose(largest, 0.7, rtol=1e-6)
    assert not arrived.any()


def test_limits_are_those_of_ordinary_episodes_and_rise():
    slow, stop = limits(np.linspace(0.0, 1.0, 101), np.ones(101))
    assert (slow, stop) == pytest.approx((0.9, 0.99))
    slow, stop = limits(np.full(5, 0.2), np.ones(5))
    assert 0 < slow < stop


def test_drives_that_do_not_arrive_do_not_raise_the_limits():
    """Where a policy fails in its own world it is surprised, and such a drive is one to stop."""
    calm, lost = np.linspace(0.0, 1.0, 101), np.full(20, 9.0)
    arrived = np.r_[np.ones(101), np.zeros(20)]
    assert limits(np.r_[calm, lost], arrived) == pytest.approx((0.9, 0.99))
    slow, stop = limits(lost, np.zeros(20))  # a policy that never arrives has limits all the same
    assert 0 < slow < stop


def test_the_exported_network_of_a_watched_policy_is_one_that_evaluations_compile():
    """Its file is what `whill_mjx.evaluate` reads."""
    from dreamer.policy_files.network import Network as Exported
    from dreamer.policy_files.network import parity, to_onnx
    from whill_mjx.evaluation.policies.onnx_network import Network

    def step(weights, carry, image):
        mean = jnp.mean(image.astype(jnp.float32)) / 255.0
        return {"seen": carry["seen"] + mean}, jnp.tanh(jnp.stack([mean, -mean]))

    act, carry = watched(step, {"seen": jnp.zeros(1)}, SECONDS, lambda _, carry: jnp.concatenate([carry["seen"]] * 4))
    shapes = {name: jax.ShapeDtypeStruct(value.shape, jnp.float32) for name, value in carry.items()}

    def named(carry, obs):
        carry, action = act(None, carry, obs["image"])
        return carry, (action,)

    exported = Exported(named, shapes, {"image": jax.ShapeDtypeStruct((8, 8, 3), jnp.uint8)})
    data = to_onnx(exported)
    assert parity(data, exported, 5)["max_abs_action_difference"] < 1e-5
    image = np.full((8, 8, 3), 51, np.uint8)
    given = [image, *(np.ones(shape.shape, np.float32) for shape in shapes.values())]
    for ours, theirs in zip(jax.jit(Network(data))(*given), _in_order(act, given, shapes), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-5)


def _in_order(act, given, shapes):
    """Outputs of a step in the order of the file: the action, and the carry by name."""
    carry, action = act(None, dict(zip(shapes, given[1:], strict=True)), given[0])
    return [action, *(carry[name] for name in shapes)]


def test_the_surprise_of_a_policy_with_several_sensors_is_of_the_goal_that_it_believes_in():
    """Its decoder predicts the commands and the goal sensor first; beliefs are what it predicts of the truth."""
    preset = find_preset("smoke", "corridor")
    preset = dataclasses.replace(preset, learner=dataclasses.replace(preset.learner, decode_only=(TRUTH,)))
    env, _ = make_env("corridor", looks="rich", height=16, width=16, observations=("camera", "commands", "goal"))
    shape = with_truth(obs_shape_of(env))
    params = agents.init_params(preset.learner, shape, 2, jax.random.key(0))
    out = params["dec"]["vector"]["out"]
    place = vector_size({name: one for name, one in shape.items() if name < TRUTH})
    bias = jnp.zeros_like(out["b"]).at[place : place + 4].set(jnp.log1p(jnp.array([40.0, 10.0, 3.0, 2.0])))
    params["dec"]["vector"]["out"] = {"w": jnp.zeros_like(out["w"]), "b": bias}
    step, carry = dreamer_policy(preset, env)
    obs = {name: jnp.zeros(one, jnp.uint8 if len(one) == 3 else jnp.float32)
           for name, one in shape.items() if name != TRUTH}  # fmt: skip
    carry, _ = step(params, carry, obs)
    assert place > 0
    np.testing.assert_allclose(carry[BELIEVED], [4.0, 1.0, 0.3, 0.2], rtol=1e-4)
