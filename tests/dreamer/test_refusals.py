"""What the learner cannot work with is refused by name, before anything is compiled or written."""

from __future__ import annotations

import dataclasses
import re

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dreamer_toys import corridor_env, tiny_config
from gymnasium import spaces as gs

from dreamer import Box, DreamerConfig, from_gym
from dreamer.evaluate import evaluate
from dreamer.experience import iteration
from dreamer.gym import _Host, read_actions, read_observations
from dreamer.policy import of_agent
from dreamer.refusals import as_seeds
from dreamer.train import TrainingOptions, train
from dreamer.training import checkpoint, parallel
from dreamer.training.metrics_log import named_figures

pytestmark = pytest.mark.quick
ENV, CONFIG = corridor_env(4), tiny_config()
NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize("changes, said", [
    ({"total_steps": "64"}, "total_steps = '64': it must be a whole number from 0"),
    ({"total_steps": 64.5}, "total_steps = 64.5"), ({"total_steps": NAN}, "total_steps = nan"),
    ({"total_steps": -5}, "total_steps = -5"), ({"total_steps": None}, "total_steps = None"),
    ({"total_steps": True}, "total_steps = True"), ({"total_steps": 2**31}, "total_steps = 2147483648"),
    ({"seed": 1.5}, "seed = 1.5"), ({"seed": "0"}, "seed = '0'"), ({"seed": None}, "seed = None"),
    ({"seed": 2**40}, "seed = 1099511627776"), ({"seed": []}, "several seeds must be different ones, and at least one"),
    ({"seed": [1, 1]}, "several seeds must be different"), ({"seed": (0.5, 1)}, "seed[0] = 0.5"),
    ({"env": None}, "env is a NoneType; it must be a FunctionalEnv. dreamer.from_gym"),
    ({"config": "cpu"}, "config is a str; it must be a DreamerConfig. dreamer.preset"),
    ({"options": {"progress": False}}, "options is a dict; it must be a TrainingOptions"),
    ({"config": tiny_config(replay_capacity=40)}, "replay_capacity = 40 gives 10 steps to each of 4 instances"),
    ({"config": tiny_config(train_ratio=1e6 - 0.001, replay_capacity=10**6)}, "too small for 32 bits"),
])  # fmt: skip
def test_an_argument_that_cannot_be_meant_is_refused_and_nothing_is_written(changes, said, tmp_path):
    given = {"env": ENV, "config": CONFIG, "out": tmp_path / "run", "total_steps": 64, "seed": 0, **changes}
    with pytest.raises(ValueError, match=re.escape(said)):
        train(**given)
    assert not list(tmp_path.iterdir())


def test_seeds_of_numpy_and_of_ranges_are_seeds():
    assert as_seeds(np.int64(3)) == 3 and as_seeds(-1) == -1
    assert as_seeds(range(2)) == as_seeds(np.arange(2)) == [0, 1]


@pytest.mark.parametrize("name, value", [
    ("eval_every", 0), ("eval_every", -3), ("eval_every", 0.5), ("checkpoint_every_s", NAN), ("checkpoint_every_s", -1),
    ("log_every_s", -1.0), ("log_every_s", None), ("time_limit_s", NAN), ("time_limit_s", "9")])  # fmt: skip
def test_an_interval_that_cannot_be_meant_is_refused(name, value):
    with pytest.raises(ValueError, match=re.escape(f"TrainingOptions.{name} = {value!r}: it must be a")):
        TrainingOptions(**{name: value})


@pytest.mark.parametrize("name", ["learning_starts", "warmup", "lr_decay", "pretrain_steps"])
def test_a_number_beyond_the_counters_of_the_device_is_refused(name):
    with pytest.raises(ValueError, match=f"DreamerConfig.{name} = 10000000000: it must"):
        DreamerConfig(**{name: 10**10})


@pytest.mark.parametrize("changes, said", [
    ({"num_envs": 0}, "FunctionalEnv.num_envs = 0"), ({"num_envs": 1.5}, "FunctionalEnv.num_envs = 1.5"),
    ({"obs_shape": (16.0, 16, 3)}, "each an image (H, W, C) or a vector (D,)"),
    ({"obs_shape": 3}, "each an image"), ({"obs_shape": None}, "each an image"),
    ({"obs_shape": {"a": {"b": (3,)}}}, "each an image"), ({"obs_shape": {1: (3,)}}, "each an image"),
    ({"action_dim": 1.0}, "action_dim = 1.0: it must be"), ({"action_dim": None}, "action_dim = None"),
    ({"action_dim": Box(1.5)}, "action_dim = Box(size=1.5)"), ({"action_dim": gs.Discrete(3)}, "action_dim = Discrete"),
    ({"step": None}, "FunctionalEnv.step = None: it must be a function"),
])  # fmt: skip
def test_an_environment_of_no_known_kind_is_refused_where_it_is_made(changes, said):
    with pytest.raises(ValueError, match=re.escape(said)):
        dataclasses.replace(ENV, **changes)


def changed(where, change):
    """The corridor whose `where`, "reset" or "step", returns `change(state, transition)`, or both."""
    def of(name):
        plain = getattr(ENV, name)
        return (lambda *given: change(*plain(*given))) if where in (name, "both") else plain

    return dataclasses.replace(ENV, reset=of("reset"), step=of("step"))


def part(**values):
    return lambda state, seen: (state, dataclasses.replace(seen, **{k: f(seen) for k, f in values.items()}))


@pytest.mark.parametrize("where, change, said", [
    ("both", part(reward=lambda seen: seen.reward[:, None]), "reset: reward is float32[4, 1]; it must be an array of"),
    ("step", part(reward=lambda seen: jnp.float32(1)), "step: reward is float32[]"),
    ("step", part(reward=lambda seen: None), "step: reward is a NoneType"),
    ("step", part(reward=lambda seen: (seen.reward > 0).astype(int)), "the Transition: .reward is int32[4] after"),
    ("both", part(is_last=lambda seen: seen.is_last.astype(float)), "reset: is_last is float32[4]; it must be an array "
     "of bool"),
    ("both", part(metrics=lambda seen: None), "reset: metrics is None; it must be a dict"),
    ("both", part(metrics=lambda seen: {"a": jnp.zeros((4, 2))}), "reset: a is float32[4, 2]"),
    ("step", part(metrics=lambda seen: {"other": seen.reward}), "the Transition: .metrics['success'] is missing after"),
    ("step", part(obs=lambda seen: seen.obs.astype(jnp.int32)), "Images are uint8"),
    ("step", part(obs=lambda seen: seen.obs[:, :8]), "Images are uint8"),
    ("step", lambda state, seen: (dataclasses.replace(state, count=1.0 * state.count), seen), "the state of the "
     "environment: .count is float32[4] after a step, and int32[4] before it"),
    ("step", lambda state, seen: seen, "FunctionalEnv.step returns a Transition; it must return the state and a"),
    ("reset", lambda state, seen: (state, seen.obs), "FunctionalEnv.reset returns a tuple"),
])  # fmt: skip
def test_what_an_environment_returns_is_checked_while_it_is_traced(where, change, said):
    env = changed(where, change)

    def begin_and_collect():
        state = iteration.init_state(env, CONFIG, 0)
        return iteration.collect(env, CONFIG, state, jax.random.key(0))

    with pytest.raises(ValueError, match=re.escape(said)):
        jax.eval_shape(begin_and_collect)


def test_rewards_of_any_type_of_number_are_read():
    env = changed("both", part(reward=lambda seen: (seen.reward > 0)))
    state = jax.eval_shape(lambda: iteration.init_state(env, CONFIG, 0))
    after, _ = jax.eval_shape(lambda state: iteration.collect(env, CONFIG, state, jax.random.key(0)), state)
    assert after.transition.reward.dtype == bool and after.replay.reward.dtype == jnp.float32


def test_an_evaluation_of_no_whole_number_of_episodes_and_figures_of_no_kind_are_refused():
    for episodes in (0, 1.5, "3"):
        with pytest.raises(ValueError, match=f"episodes = {episodes!r}: it must be a whole number"):
            evaluate(ENV, CONFIG, {}, jax.random.key(0), episodes)
    assert named_figures({"a": np.float32(1)}) == {"a": 1.0}
    for wrong in (None, {"a": "x"}, 3.0):
        with pytest.raises(ValueError, match="eval_fn returned .*; it must return a dict of numbers"):
            named_figures(wrong)


def test_a_device_that_is_there_twice_is_refused():
    with pytest.raises(ValueError, match="one of them is there twice"):
        parallel.make_mesh([jax.devices()[0]] * 2, 4, 4)


@pytest.mark.parametrize("value", [NAN, INF])
def test_a_network_that_has_diverged_replaces_no_checkpoint(value, tmp_path):
    good = {"agent": {"params": {"w": np.ones(3, np.float32)}, "other": np.full(2, INF)},
            "env_state": {"params": {"limit": np.float32(INF)}}}
    kept = checkpoint.save(tmp_path, good, CONFIG, checkpoint.Moment(10))
    bad = {"agent": {**good["agent"], "params": {"w": np.array([1, value], np.float32)}}}
    with pytest.raises(checkpoint.CheckpointError, match="agent.params.w.*diverged.*NaN.*here: 000000000010"):
        checkpoint.save(tmp_path, bad, CONFIG, checkpoint.Moment(20))
    assert [kept] == list(tmp_path.iterdir())


def test_one_diverged_seed_of_several_ends_no_training_but_is_told(tmp_path):
    def state(*values):
        return {"agent": {"params": {"w": np.array([[1, value] for value in values], np.float32)}}}

    with pytest.warns(UserWarning, match=r"diverged for 1 of 3 seeds \(places 1, counted from 0\): agent.params.w"):
        assert checkpoint.save(tmp_path, state(1, np.nan, 2), CONFIG, checkpoint.Moment(10), seeds=3).exists()
    with pytest.raises(checkpoint.CheckpointError, match="diverged"):
        checkpoint.save(tmp_path, state(INF, np.nan), CONFIG, checkpoint.Moment(20), seeds=2)


class Line(gymnasium.Env):
    """Returns what it is told to."""

    observation_space, action_space = gs.Box(-1, 1, (2,)), gs.Box(-1, 1, (1,))

    def __init__(self, first=None, after=None):
        self.first = (np.zeros(2, np.float32), {}) if first is None else first
        self.after = (np.zeros(2), 1.0, False, False, {}) if after is None else after

    def reset(self, *, seed=None, options=None):
        return self.first

    def step(self, action):
        return self.after


SAME = Line()


@pytest.mark.parametrize("make, instances, said", [
    (Line, 0, "instances = 0: it must be a whole number of at least 1"), (Line, 1.5, "instances = 1.5"),
    (None, 1, "make is a NoneType; it must be a name for gymnasium.make or a function"),
    (lambda: 3, 1, "make returned a int without observation_space"),
    (lambda: SAME, 2, "make returned the same environment twice"),
])  # fmt: skip
def test_instances_that_cannot_be_stepped_side_by_side_are_refused(make, instances, said):
    with pytest.raises(ValueError, match=re.escape(said)):
        from_gym(make, instances)


def test_instances_of_other_spaces_are_refused():
    first, other = Line(), Line()
    other.action_space = gs.Discrete(2)
    with pytest.raises(ValueError, match="action_space of instance 1 is Discrete.*all must have the same"):
        _Host([first, other])


GOOD = np.zeros(2, np.float32)


@pytest.mark.parametrize("first, after, said", [
    (GOOD, None, "reset of instance 0 returned a ndarray; it must be (obs, info), as in Gymnasium. An environment of "
     "the older Gym"),
    (None, (GOOD, 1.0, False, {}), "step of instance 0 returned a tuple of 4"),
    (None, (GOOD, NAN, False, False, {}), "step of instance 0: the reward is nan; it must be one finite number"),
    (None, (GOOD, None, False, False, {}), "the reward is None"),
    (None, (GOOD, [1.0, 2.0], False, False, {}), "the reward is [1.0, 2.0]"),
    (None, ([0.0, NAN], 1.0, False, False, {}), "the observation has values from nan to nan; they must be finite"),
    (None, (np.zeros(3), 1.0, False, False, {}), "the observation is float64 of shape (3,); its space says numbers of "
     "shape (2,)"),
    (None, (None, 1.0, False, False, {}), "the observation is object of shape ()"),
])  # fmt: skip
def test_what_an_environment_of_the_host_returns_is_checked_at_every_step(first, after, said):
    host = _Host([Line(first, after)])
    with pytest.raises(ValueError, match=re.escape(said)):
        host.step(host.reset(0)[0], np.zeros((1, 1)))


def test_an_error_of_the_host_is_the_last_line_of_what_jax_says():
    env = from_gym(lambda: Line(GOOD), 1)
    with pytest.raises(jax.errors.JaxRuntimeError) as raised:
        jax.block_until_ready(jax.jit(env.reset)(jax.random.key(0)))
    assert "must be (obs, info)" in str(raised.value).splitlines()[-1]


def test_bytes_and_classes_keep_to_their_spaces():
    image, seen = read_observations(gs.Box(0, 255, (2, 2, 3), np.uint8))[1], np.full((2, 2, 3), 0.5)
    with pytest.raises(ValueError, match="values from 0.5 to 0.5; they must be whole numbers from 0 to 255"):
        image(seen)
    with pytest.raises(ValueError, match="from 300 to 300"):
        image(np.full((2, 2, 3), 300))
    with pytest.raises(ValueError, match=re.escape("float64 of shape (3, 2, 2)")):
        image(np.zeros((3, 2, 2)))
    with pytest.raises(ValueError, match="the observation is 7; its space has the classes 2 to 4"):
        read_observations(gs.Discrete(3, start=2))[1](7)
    with pytest.raises(ValueError, match="has no 'b', which its space has"):
        read_observations(gs.Dict(a=gs.Discrete(2), b=gs.Discrete(2)))[1]({"a": 1})


def test_actions_reach_the_bounds_of_their_space_and_no_further():
    _, whole = read_actions(gs.Box(0, 10, (1,), np.int32))
    assert [int(whole(np.array([a]))[0]) for a in (-1.0, -0.97, 0.96, 1.0)] == [0, 0, 10, 10]
    most = np.finfo(np.float32).max
    _, wide = read_actions(gs.Box(-most, most, (1,), np.float32))
    np.testing.assert_array_equal([wide(np.array([a]))[0] for a in (-1.0, 0.0, 1.0)], [-most, 0.0, most])
    _, narrow = read_actions(gs.Box(0.1, 0.7, (1,), np.float32))
    assert gs.Box(0.1, 0.7, (1,), np.float32).contains(narrow(np.array([1.0])))


def test_a_policy_refuses_an_observation_that_is_no_number():
    policy = of_agent(CONFIG, {}, {"speed": (2,)}, 1)
    with pytest.raises(ValueError, match="speed.*is not finite"):
        policy.step({"speed": np.array([0.0, NAN], np.float32)})
