"""Gymnasium environments on the host, and the policy that comes out of a training."""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dreamer_toys import tiny_config
from gymnasium import spaces as gs

from dreamer import spaces
from dreamer.evaluate import Rounds, evaluate
from dreamer.experience import iteration
from dreamer.gym import from_gym, read_actions, read_observations
from dreamer.model import agent
from dreamer.policy import Policy, of_agent, save
from dreamer.policy_files.export import PolicyContract, export_policy
from dreamer.spaces import Box, Discrete
from dreamer.train import TrainingOptions, train


class Corridor(gymnasium.Env):
    """Three cells to walk; the last one pays 1. Seen as a class and a number; actions are 5 (back) and 6 (on)."""

    observation_space = gs.Dict({"place": gs.Discrete(4, start=1), "range": gs.Box(-np.inf, np.inf, (1, 1))})
    action_space = gs.Discrete(2, start=5)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.count, self.done = 0, 0, False
        return self.observe(), {}

    def observe(self):
        return {"place": self.place + 1, "range": np.array([[10.0 * self.place]], np.float32)}

    def step(self, action):
        assert action in (5, 6) and not self.done
        self.place, self.count = max(0, self.place + (1 if action == 6 else -1)), self.count + 1
        goal, late = self.place == 3, self.count >= 8
        self.done = goal or late
        return self.observe(), 1.0 if goal else -0.05, goal, late and not goal, {}


CONFIG = tiny_config(lr=1e-3, train_ratio=64.0)
QUIET = TrainingOptions(progress=False, log_every_s=1.0, checkpoint_every_s=1e9)


@pytest.mark.quick
def test_spaces_become_images_vectors_and_classes():
    shapes, convert = read_observations(
        gs.Dict(
            camera=gs.Box(0, 255, (4, 6), np.uint8),
            pose=gs.Box(-1, 1, (2, 3), np.float32),
            gear=gs.Discrete(3),
            on=gs.MultiBinary(2),
        )
    )
    assert shapes == {"camera": (4, 6, 1), "pose": (6,), "gear": (3,), "on": (2,)}
    obs = convert({"camera": np.ones((4, 6)), "pose": np.ones((2, 3)), "gear": 2, "on": np.array([1, 0])})
    assert {name: value.shape for name, value in obs.items()} == shapes and obs["camera"].dtype == np.uint8
    np.testing.assert_array_equal(obs["gear"], [0, 0, 1])
    kind, act = read_actions(gs.Box(np.array([0.0, -2.0], np.float32), np.array([1.0, 2.0], np.float32)))
    assert kind == Box(2)
    np.testing.assert_allclose(act(np.array([-1.0, 0.5])), [0.0, 1.0])
    kind, act = read_actions(gs.Discrete(3, start=4))
    assert kind == Discrete(3) and act(np.int32(2)) == 6


@pytest.mark.quick
@pytest.mark.parametrize(
    "read, space",
    [
        (read_actions, gs.MultiDiscrete([2, 3])),
        (read_actions, gs.Box(-np.inf, 1, (1,))),
        (read_observations, gs.Text(3)),
    ],
)
def test_a_space_that_is_not_known_is_refused_with_a_remedy(read, space):
    with pytest.raises(ValueError, match="known are.*Wrap the environment"):
        read(space)


def test_episodes_of_the_host_arrive_whole_and_begin_anew():
    env = from_gym(Corridor, 2)
    actions = jnp.array([[1, 0], [1, 0], [1, 0], [0, 0], [0, 1]], jnp.int32)  # the first reaches its goal in 3 steps

    @jax.jit
    def play(key):
        state, first = env.reset(key)
        state, steps = jax.lax.scan(lambda state, action: env.step(state, action), state, actions)
        return first, steps, state

    first, steps, calls = play(jax.random.PRNGKey(0))
    spaces.check(env.obs_shape, first.obs, 2)
    assert int(calls) == 5 and np.all(first.is_first) and not np.any(first.reward)
    np.testing.assert_array_equal(steps.obs["range"][..., 0], [[10, 0], [20, 0], [30, 0], [0, 0], [0, 10]])
    np.testing.assert_array_equal(steps.is_terminal[:, 0], [False, False, True, False, False])
    np.testing.assert_array_equal(steps.is_first[:, 0], [False, False, False, True, False])
    np.testing.assert_allclose(steps.reward[:, 0], [-0.05, -0.05, 1.0, 0.0, -0.05])


@pytest.mark.parametrize("moved", ["evaluated", "resumed"])
def test_instances_that_were_moved_meanwhile_begin_anew(moved):
    """Else the frame after an action would be one of another episode, without a mark."""
    env = from_gym(Corridor, 2)
    on = jnp.array([1, 1], jnp.int32)
    state, _ = env.step(env.reset(jax.random.key(0))[0], on)
    if moved == "evaluated":
        other, _ = env.reset(jax.random.key(1))
        env.step(other, on)
    else:
        env = from_gym(Corridor, 2)
        env.reset(jax.random.key(0))  # as the template of a restored state does
    state, step = env.step(state, on)
    assert np.all(step.is_first) and not np.any(step.reward)
    np.testing.assert_array_equal(step.obs["range"], 0.0)
    _, step = env.step(state, on)
    assert not np.any(step.is_first)
    np.testing.assert_array_equal(step.obs["range"], 10.0)


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    folder = tmp_path_factory.mktemp("gym")
    train(from_gym(Corridor, 4), CONFIG, folder / "run", 300, 0, QUIET)
    return folder, train(from_gym(Corridor, 4), CONFIG, folder / "run", 500, 0, QUIET)  # resumed with new instances


def test_an_environment_of_the_host_is_learned_also_across_a_resume(learned):
    _, run = learned
    result = evaluate(from_gym(Corridor, 2), CONFIG, run.agent.params, jax.random.PRNGKey(1), 2, Rounds(20))
    np.testing.assert_allclose(result["return"], 1.0 - 0.05 * 2, atol=1e-5)


def test_the_saved_policy_walks_the_corridor_by_itself(learned):
    folder, run = learned
    adapter = from_gym(Corridor, 1)
    save(folder / "policy", CONFIG, run.agent.params, adapter.obs_shape, adapter.action_dim)
    policy, carry = Policy.load(folder / "policy"), None
    convert, (_, act) = read_observations(Corridor.observation_space)[1], read_actions(Corridor.action_space)
    env = Corridor()
    obs, _ = env.reset()
    for _ in range(3):
        action, carry = policy.step(convert(obs), carry)
        obs, reward, terminated, *_ = env.step(act(action))
    assert terminated and reward == 1.0
    with pytest.raises(ValueError, match="trained with.*Convert it"):
        policy.step({"place": np.zeros(4, np.float32)}, carry)


def test_a_policy_in_a_file_acts_as_the_agent_in_memory(tmp_path):
    config = tiny_config(policy_outscale=1.0, compute_dtype="bfloat16")
    shape = {"camera": (16, 16, 3), "speed": (2,)}
    params = jax.jit(lambda: agent.init_params(config, shape, 3, jax.random.PRNGKey(0)))()
    loaded = Policy.load(save(tmp_path / "policy", config, params, shape, 3))
    memory = of_agent(config, params, shape, 3)
    rng, carries = np.random.default_rng(0), [None, None]
    for _ in range(3):
        obs = {"camera": rng.integers(0, 256, (16, 16, 3), np.uint8), "speed": rng.normal(size=2).astype(np.float32)}
        (a, carries[0]), (b, carries[1]) = loaded.step(obs, carries[0]), memory.step(obs, carries[1])
        np.testing.assert_array_equal(a, b)
    assert a.shape == (3,) and np.all(np.abs(a) <= 1.0) and np.any(np.asarray(carries[0]["deter"]))


def test_a_vehicles_policy_file_is_read_by_the_same_call(tmp_path):
    contract = PolicyContract(action_low=(0.0, -1.0), action_high=(0.5, 1.0), height=4, width=4)

    def step(carry, image):
        h = carry["h"] + jnp.mean(image.astype(jnp.float32)) / 255
        return {"h": h}, jnp.tanh(h * jnp.array([1.0, -1.0]))

    path = export_policy(tmp_path / "p", step, {"h": np.zeros((), np.float32)}, {}, contract, check_steps=2)
    policy = Policy.load(path)
    image = np.full((4, 4, 3), 51, np.uint8)
    _, carry = policy.step(image)
    command, _ = policy.step(image, carry)
    action = np.tanh(0.4 * np.array([1.0, -1.0]))
    np.testing.assert_allclose(command, [0.25 * (action[0] + 1), action[1]], atol=1e-6)


@pytest.mark.quick
def test_a_folder_without_a_policy_names_file_and_remedy(tmp_path):
    with pytest.raises(ValueError, match="policy.json.*dreamer.policy.save"):
        Policy.load(tmp_path)


def test_the_first_state_of_a_run_needs_one_reset_of_the_host():
    env = from_gym(Corridor, 2)
    state = jax.jit(lambda: iteration.init_state(env, CONFIG, 0))()
    assert int(state.env_state) == 0 and np.all(state.transition.is_first)
