"""The model-free baseline: advantages by hand, a tiny problem it must learn from pixels, and its exported step."""

from __future__ import annotations

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from half_lit import TINY, half_lit_env

from dreamer.train import TrainingOptions
from whill_mjx.batch import make_batch
from whill_mjx.env import make_env
from whill_mjx.learning.ppo import (
    Network,
    PpoConfig,
    Rollout,
    advantages,
    empty_frames,
    first_scale,
    init_state,
    iterate,
    policy_carry,
    policy_step,
    push,
    track,
)
from whill_mjx.learning.ppo_training import Length, train_ppo
from whill_mjx.learning.setup import check_learner, find_preset
from whill_mjx.sensors.camera import Camera
from whill_mjx.sensors.goal import Goal

QUIET = TrainingOptions(progress=False)


def test_ppo_learns_to_point_at_the_lit_half_from_pixels():
    env, iterations = half_lit_env(16), 40
    state = jax.jit(lambda: init_state(env, TINY, 0))()
    run = jax.jit(lambda state: iterate(env, TINY, iterations, state), donate_argnums=0)
    rewards = []
    for _ in range(iterations):
        state, metrics = run(state)
        rewards.append(float(metrics["reward"]))
    # Four of five steps earn a reward (the fifth resets): 0.4 by chance, 0.8 at best.
    assert rewards[0] < 0.5 and np.mean(rewards[-5:]) > 0.68
    step = jax.jit(lambda carry, image: policy_step(TINY, state.params, carry, image))
    for side, columns in ((-1.0, slice(0, 4)), (1.0, slice(4, 8))):
        image = np.zeros((8, 8, 3), np.uint8)
        image[:, columns] = 255
        _, action = step(policy_carry(TINY, (8, 8, 3)), image)
        assert float(action[0]) * side > 0.5


@pytest.mark.quick
def test_advantages_by_hand():
    """A truncated end bootstraps from its own frame, a terminal one does not, and neither looks into the next one."""
    config = PpoConfig(discount=0.5, gae_lambda=1.0)
    column = lambda *values: jnp.array(values, jnp.float32)[:, None]  # noqa: E731
    rollout = Rollout(
        None, None, None, value=column(1.0, 2.0, 4.0), reward=column(1.0, 0.0, 8.0),
        terminal=column(0.0, 0.0, 1.0), last=column(0.0, 1.0, 1.0), used=None,
    )  # fmt: skip
    advantage, target = advantages(config, rollout, jnp.array([100.0]))
    # Back to front: 8 - 4 = 4; then 0 + 0.5 * 4 - 2 = 0, cut off; then 1 + 0.5 * 2 - 1 + 0.5 * 0 = 1.
    np.testing.assert_allclose(advantage[:, 0], [1.0, 0.0, 4.0])
    np.testing.assert_allclose(target[:, 0], [2.0, 2.0, 8.0])


@pytest.mark.quick
def test_rewards_are_scaled_by_the_spread_of_the_return():
    config = PpoConfig(discount=0.0)
    scale, rng, seen = first_scale(50), np.random.default_rng(0), []
    assert float(scale.std()) == 1.0
    for _ in range(20):
        rewards = rng.normal(2.0, 3.0, 50)
        seen.append(rewards)
        scale = track(config, scale, jnp.asarray(rewards, jnp.float32), jnp.zeros(50, bool))
    np.testing.assert_allclose(float(scale.std()), np.std(seen, ddof=1), rtol=1e-3)


@pytest.mark.quick
def test_frames_are_stacked_and_an_episode_begins_with_black_ones():
    frames = jnp.full((2, 1, 1, 6), 7, jnp.uint8)
    obs = jnp.full((2, 1, 1, 3), 9, jnp.uint8)
    stacked = push(frames, obs, jnp.array([True, False]))
    np.testing.assert_array_equal(stacked[:, 0, 0], [[0, 0, 0, 9, 9, 9], [7, 7, 7, 9, 9, 9]])


@pytest.mark.quick
def test_the_exported_step_sees_what_the_network_was_trained_on():
    params = Network(TINY, 2).init(jax.random.key(0), jnp.zeros((1, 8, 8, 6), jnp.uint8))
    images = np.random.default_rng(0).integers(0, 256, (3, 8, 8, 3), dtype=np.uint8)
    carry, frames = policy_carry(TINY, (8, 8, 3)), jnp.zeros((1, 8, 8, 6), jnp.uint8)
    for count, image in enumerate(images):
        carry, action = policy_step(TINY, params, carry, image)
        frames = push(frames, image[None], jnp.array([count == 0]))
        np.testing.assert_allclose(action, Network(TINY, 2).apply(params, frames)[0][0], atol=1e-6)


def test_the_exported_network_acts_like_the_trained_one(tmp_path):
    from dreamer.policy_files.export import PolicyContract, export_policy
    from whill_mjx.evaluation.policies.policy_file import load_policy

    params = Network(TINY, 2).init(jax.random.key(0), jnp.zeros((1, 8, 8, 6), jnp.uint8))
    params["params"]["Dense_1"]["kernel"] *= 1e4  # a new network's actions are all near zero
    contract = PolicyContract((0.0, -0.6), (0.3, 0.6), height=8, width=8)

    def step(carry, image):
        return policy_step(TINY, params, carry, image)

    export_policy(tmp_path / "policy", step, policy_carry(TINY, (8, 8, 3)), params, contract, check_steps=5)
    policy = load_policy(tmp_path / "policy")
    ours, theirs = policy_carry(TINY, (8, 8, 3)), policy.start()
    for image in np.random.default_rng(0).integers(0, 256, (3, 8, 8, 3), dtype=np.uint8):
        (ours, action), (theirs, same) = step(ours, image), policy.step(theirs, image)
        np.testing.assert_allclose(action, same, atol=1e-5)
        np.testing.assert_array_equal(ours["frames"], theirs["frames"])
    assert float(jnp.abs(action).max()) > 0.05


@pytest.mark.quick
def test_minibatches_that_do_not_divide_a_rollout_are_refused():
    with pytest.raises(ValueError, match="minibatches"):
        init_state(half_lit_env(3), PpoConfig(rollout=5, minibatches=8), 0)
    with pytest.raises(ValueError, match="epochs"):
        PpoConfig(epochs=0)


def test_an_evaluation_made_ahead_is_compiled_when_it_is_due(tmp_path):
    env, traced, asked = half_lit_env(4), [], []

    @jax.jit
    def spread(params):
        traced.append(1)
        return jnp.std(jax.tree.leaves(params)[-1])

    def evaluate(params, env_steps):
        asked.append(env_steps)
        return {"spread": float(spread(params))}

    each = 4 * TINY.rollout
    ahead = lambda params: evaluate(params, 0)  # noqa: E731
    train_ppo(env, TINY, tmp_path, Length(2 * each), 0, TrainingOptions(evaluate, ahead, each, progress=False))
    assert len(traced) == 1 and asked == [0, each, 2 * each]
    rows = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [row["env_steps"] for row in rows] == asked[1:] and all("eval/spread" in row for row in rows)


def test_another_seed_and_more_steps_run_the_programs_that_were_kept(tmp_path, programs):
    env, each = half_lit_env(4), 4 * TINY.rollout
    for seed, steps in ((0, 2 * each), (1, 3 * each)):
        programs.clear()
        train_ppo(env, TINY, tmp_path / str(seed), Length(steps), seed, QUIET)
    assert programs["cache_misses"] == 0 and programs["cache_hits"] >= 2


def test_an_interrupted_baseline_goes_on_to_the_bits_of_an_uninterrupted_one(tmp_path):
    env, each = half_lit_env(4), 4 * TINY.rollout

    def trained(out, stop=None):
        def figures(params, env_steps):
            return {"norm": float(jnp.linalg.norm(jax.tree.leaves(params)[-1]))}

        return train_ppo(env, TINY, tmp_path / out, Length(6 * each), 0,
                         TrainingOptions(figures, eval_every=each, stop=stop, checkpoint_every_s=60.0, progress=False))

    def lines(out):
        text = (tmp_path / out / "metrics.jsonl").read_text()
        return [{**json.loads(line), "wall_s": 0.0} for line in text.splitlines()]

    def interrupt(line):
        if line["env_steps"] == 3 * each:
            raise KeyboardInterrupt

    straight = trained("straight")
    with pytest.raises(KeyboardInterrupt):
        trained("broken", interrupt)
    with (tmp_path / "broken" / "metrics.jsonl").open("a") as file:
        file.write('{"env_steps": ')  # cut off by a kill
    resumed = trained("broken")
    jax.tree.map(np.testing.assert_array_equal, resumed[:3], straight[:3])
    assert lines("broken") == lines("straight") and len(lines("broken")) == 6
    again = trained("broken")
    jax.tree.map(np.testing.assert_array_equal, again[:3], straight[:3])
    assert lines("broken") == lines("straight")


def test_another_setting_of_the_baseline_is_refused_on_resuming(tmp_path):
    from dreamer.training.checkpoint import CheckpointError

    env, each = half_lit_env(4), 4 * TINY.rollout
    train_ppo(env, TINY, tmp_path, Length(each), 0, QUIET)
    with pytest.raises(CheckpointError, match="lr: saved 0.003, now 0.1"):
        train_ppo(env, dataclasses.replace(TINY, lr=0.1), tmp_path, Length(2 * each), 0, QUIET)


@pytest.mark.quick
@pytest.mark.parametrize("wrong", [{"lr": float("nan")}, {"lr": 0.0}, {"discount": 1.5}, {"entropy_scale": -1.0}])
def test_settings_that_cannot_be_meant_are_refused(wrong):
    with pytest.raises(ValueError, match=f"PpoConfig: {next(iter(wrong))} is .*; it must"):
        PpoConfig(**wrong)


SENSING = dataclasses.replace(TINY, readings=3, scan=16)
SHAPES = {"camera": (8, 8, 3), "goal": (2,), "lidar": (16,)}


def sensed(rng, count):
    """Observations of `count` instances, with an image, a vector and a scan."""
    image = rng.integers(0, 256, (count, 8, 8, 3), dtype=np.uint8)
    return {"camera": image, **{name: rng.normal(size=(count, *SHAPES[name])).astype(np.float32)
                                for name in ("goal", "lidar")}}  # fmt: skip


@pytest.mark.quick
def test_scans_and_vectors_are_remembered_and_an_episode_begins_with_copies_of_the_first():
    first, second = (sensed(np.random.default_rng(seed), 2) for seed in (0, 1))
    frames = push(empty_frames(SENSING, SHAPES, (2,)), first, jnp.array([True, True]))
    np.testing.assert_array_equal(frames["vector"], np.tile(first["goal"], 3))
    frames = push(frames, second, jnp.array([False, True]))
    np.testing.assert_array_equal(frames["vector"][0], np.concatenate([first["goal"][0]] * 2 + [second["goal"][0]]))
    np.testing.assert_array_equal(frames["scan"][0], np.stack([first["lidar"][0]] * 2 + [second["lidar"][0]], -1))
    np.testing.assert_array_equal(frames["scan"][1], np.stack([second["lidar"][1]] * 3, -1))


@pytest.mark.quick
@pytest.mark.parametrize("config", [TINY, SENSING, dataclasses.replace(SENSING, scan=0)])
def test_the_exported_step_remembers_what_the_network_was_trained_on(config):
    empty = empty_frames(config, SHAPES, (1,))
    params = Network(config, 2).init(jax.random.key(0), empty)
    params["params"]["Dense_1"]["kernel"] *= 1e2  # a new network's actions are all near zero
    carry, frames, rng = policy_carry(config, SHAPES), empty, np.random.default_rng(0)
    for count in range(4):
        obs = sensed(rng, 1)
        carry, action = policy_step(config, params, carry, {name: value[0] for name, value in obs.items()})
        frames = push(frames, obs, jnp.array([count == 0]))
        expected = jnp.clip(Network(config, 2).apply(params, frames)[0][0], -1.0, 1.0)
        np.testing.assert_allclose(action, expected, atol=1e-5)


def test_the_exported_network_of_several_readings_drives_through_the_bridge_like_the_trained_one(tmp_path):
    """Two episodes: the second begins with its own first readings, whatever the first one ended with."""
    from bridge.policy import Policy
    from dreamer.policy_files.export import PolicyContract, SensingPolicy, export_sensing

    empty = empty_frames(SENSING, SHAPES, (1,))
    params = Network(SENSING, 2).init(jax.random.key(0), empty)
    params["params"]["Dense_1"]["kernel"] *= 1e2  # a new network's actions are all near zero

    def step(carry, obs):
        return policy_step(SENSING, params, carry, obs)

    sensors = {"camera": {"kind": "camera"}, "goal": {"kind": "goal"}, "lidar": {"kind": "lidar"}}
    exported = SensingPolicy(step, policy_carry(SENSING, SHAPES), SHAPES, params, sensors)
    policy = Policy.load(export_sensing(tmp_path / "policy", exported, PolicyContract((0.0, -0.6), (0.3, 0.6))))
    assert set(policy.sensors) == set(SHAPES)
    rng, commands = np.random.default_rng(0), []
    for _ in range(2):
        policy.reset()
        frames = empty
        for count in range(SENSING.readings + 2):
            obs = sensed(rng, 1)
            frames = push(frames, obs, jnp.array([count == 0]))
            expected = np.clip(Network(SENSING, 2).apply(params, frames)[0][0], -1.0, 1.0)
            commands.append(policy.step({name: value[0] for name, value in obs.items()}))
            np.testing.assert_allclose(commands[-1], [0.15 * (expected[0] + 1.0), 0.6 * expected[1]], atol=1e-4)
    assert np.ptp(commands, axis=0).max() > 0.05


@pytest.mark.quick
def test_scans_of_several_lengths_are_refused():
    with pytest.raises(ValueError, match="one length"):
        empty_frames(SENSING, {"front": (16,), "rear": (20,)}, (1,))


@pytest.mark.quick
@pytest.mark.parametrize("learner", ["dreamer", "ppo"])
@pytest.mark.parametrize(("sensors", "said"), [
    ({"front": Camera(8, 16), "rear": Camera(16, 8)}, "all images must have one height and width"),
    ({"action": Goal()}, "observation 'action': the exported policy has another tensor of this name"),
])  # fmt: skip
def test_observations_that_could_not_be_learned_or_exported_are_refused_before_the_training(learner, sensors, said):
    preset = find_preset("smoke", "point_goal")
    env, params = make_env(preset.task, observations=sensors)
    with pytest.raises(ValueError, match=said):
        check_learner(preset, learner, make_batch(env, params, preset.instances))


@pytest.mark.quick
@pytest.mark.parametrize("instances", [1, 16, 2048])
@pytest.mark.parametrize("reward", [-0.05, 0.0, 1.0])
def test_a_first_reward_that_all_instances_share_stays_a_number_of_ordinary_size(instances, reward):
    """Variance of Gymnasium's NormalizeReward after one reward r: (1e-4 + r^2 1e-4 / 1.0001) / 1.0001."""
    scale = track(PpoConfig(), first_scale(instances), jnp.full(instances, reward), jnp.zeros(instances, bool))
    by_hand = np.sqrt((1e-4 + reward**2 * 1e-4 / 1.0001) / 1.0001 + 1e-8)
    assert float(scale.std()) == pytest.approx(by_hand, rel=1e-3)
    assert abs(reward) / float(scale.std()) < 100.0
