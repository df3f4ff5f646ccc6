"""TrainingOptions that are off unless asked for: no decoder, and targets that only the decoder sees."""

import dataclasses
import json
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dreamer_toys import SHAPE, corridor_env, tiny_config

from dreamer.config import DreamerConfig
from dreamer.experience.iteration import compile_init, train_iteration
from dreamer.layers import sensors
from dreamer.model import agent
from dreamer.model.rssm import Latent
from dreamer.train import TrainingOptions, train
from dreamer.training import checkpoint
from dreamer.training.progress import Progress

KEY = jax.random.PRNGKey(0)
CONFIG = tiny_config()
SHAPES = {"camera": SHAPE, "depth": (16, 16, 1), "goal": (2,)}


def shapes_of(config, obs_shape):
    params = jax.eval_shape(lambda k: agent.init_params(config, obs_shape, 2, k), KEY)
    return jax.tree.map(lambda leaf: leaf.shape, params)


@pytest.mark.quick
def test_agreement_is_nothing_where_every_dimension_is_its_own_copy_and_costs_one_where_it_is_not():
    tokens = jnp.asarray(np.linalg.qr(np.random.default_rng(0).normal(size=(64, 5)) - 0.0)[0])
    tokens = tokens - tokens.mean(0)
    tokens = jnp.asarray(np.linalg.qr(np.asarray(tokens))[0], jnp.float32)  # centred and uncorrelated
    assert float(sensors.barlow_loss(3.0 * tokens + 7.0, tokens, 5e-4)) == pytest.approx(0.0, abs=1e-4)
    shuffled = jnp.roll(tokens, 1, -1)  # every dimension agrees with another one
    assert float(sensors.barlow_loss(shuffled, tokens, 0.1)) == pytest.approx(5.0 + 0.1 * 5.0, rel=1e-3)
    gradient = jax.grad(lambda t: sensors.barlow_loss(shuffled, t, 0.1))(tokens)
    np.testing.assert_array_equal(gradient, 0.0)


@pytest.mark.quick
def test_without_a_decoder_there_are_no_parameters_of_one():
    config = dataclasses.replace(CONFIG, representation="barlow")
    with_decoder, without = shapes_of(CONFIG, SHAPE), shapes_of(config, SHAPE)
    width = sensors.token_size(config, SHAPE)
    assert set(without["dec"]) == {"project"} and without["dec"]["project"]["w"] == (config.deter + 16, width)
    assert {k: v for k, v in without.items() if k != "dec"} == {k: v for k, v in with_decoder.items() if k != "dec"}
    latent, tokens = Latent(jnp.zeros((3, 2, 32)), jnp.zeros((3, 2, 16))), jnp.ones((3, 2, width))
    params = sensors.init_decoder(config, SHAPE, KEY)
    assert set(sensors.representation_losses(config, params, latent, None, tokens)) == {"barlow"}


@pytest.mark.quick
def test_what_only_the_decoder_sees_changes_neither_the_encoder_nor_what_acting_needs():
    config = dataclasses.replace(CONFIG, decode_only=("depth", "goal"))
    plain, helped = shapes_of(CONFIG, SHAPE), shapes_of(config, SHAPES)
    for part in ("enc", "dyn", "policy", "value", "reward", "continue"):
        assert helped[part] == plain[part]
    assert helped["dec"]["vector"]["out"]["w"][1] == 2
    assert helped["dec"]["patch"]["w"][1] == plain["dec"]["patch"]["w"][1] * 4 // 3  # depth is a fourth channel
    params = sensors.init_encoder(config, SHAPES, KEY)
    camera = jnp.full((1, *SHAPE), 9, jnp.uint8)
    both = {"camera": camera, "depth": jnp.ones((1, 16, 16, 1), jnp.uint8), "goal": jnp.ones((1, 2))}
    np.testing.assert_array_equal(
        sensors.encode(config, params, both), sensors.encode(config, params, {"camera": camera})
    )
    np.testing.assert_array_equal(sensors.encode(config, params, both), sensors.encode(config, params, camera))


@pytest.mark.quick
def test_targets_without_a_decoder_or_of_unknown_name_are_refused():
    with pytest.raises(ValueError, match="decode_only"):
        DreamerConfig(representation="barlow", decode_only=("depth",))
    with pytest.raises(ValueError, match="shows no bearing"):
        sensors.check(dataclasses.replace(CONFIG, decode_only=("bearing",)), SHAPES)
    with pytest.raises(ValueError, match="there must be observations"):
        sensors.check(dataclasses.replace(CONFIG, decode_only=("goal",)), {"goal": (2,)})


def test_an_average_follows_the_parameters_and_learning_does_not_notice():
    env = corridor_env(2)
    config = dataclasses.replace(CONFIG, average_rate=0.25, learning_starts=0)
    plain = dataclasses.replace(config, average_rate=0.0)
    step = jax.jit(lambda state: train_iteration(env, config, state)[0])
    plain_step = jax.jit(lambda state: train_iteration(env, plain, state)[0])
    state, other = (compile_init(env, one, 0)() for one in (config, plain))
    assert other.agent.average is None and other.agent.acting is other.agent.params
    expected, updates = state.agent.params, 0
    for _ in range(14):
        state, other = step(state), plain_step(other)
        done, updates = int(state.agent.updates) - updates, int(state.agent.updates)
        assert done <= 1
        if done:
            expected = jax.tree.map(lambda slow, fast: slow + 0.25 * (fast - slow), expected, state.agent.params)
    assert updates >= 3
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), state.agent.average, expected)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), state.agent.params, other.agent.params)
    assert state.agent.acting is state.agent.average


@pytest.mark.long
def test_an_evaluation_made_ahead_is_compiled_when_it_is_due_and_leaves_the_run_as_it_was(tmp_path):
    env, config = corridor_env(2), tiny_config()
    traced, ahead, due = [], [], []

    @jax.jit
    def size(params):
        traced.append(1)
        return sum(jnp.abs(leaf).sum() for leaf in jax.tree.leaves(params))

    quiet = TrainingOptions(eval_every=32, progress=False, log_every_s=1e9)
    plain = train(env, config, tmp_path / "plain", 64, 0, quiet)
    watched = dataclasses.replace(quiet, eval_fn=lambda params, _: due.append(float(size(params))) or {},
                      eval_ahead=lambda params: ahead.append(float(size(params))))
    run = train(env, config, tmp_path / "ahead", 64, 0, watched)
    assert len(traced) == len(ahead) == 1 and len(due) == 2
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(run.agent), jax.device_get(plain.agent))
    watched = dataclasses.replace(quiet, eval_fn=lambda *_: {}, eval_ahead=ahead.append)
    train(env, config, tmp_path / "ahead", 64, 0, watched)
    assert len(ahead) == 1  # nothing is left to train


def test_another_seed_runs_the_programs_that_were_kept(tmp_path, programs):
    for seed in (0, 1):
        programs.clear()
        env = corridor_env(2)  # as in another process, nothing is traced already
        train(env, tiny_config(), tmp_path / str(seed), 64, seed, TrainingOptions(progress=False))
    assert programs["cache_misses"] == 0 and programs["cache_hits"] >= 2


def test_training_goes_on_while_an_evaluation_waits_for_its_compilation(tmp_path, monkeypatch):
    env, config = corridor_env(2), tiny_config()
    over, stopped_at = threading.Event(), []

    class Bar(Progress):
        def show(self, done, figures):
            if done >= 64:
                over.set()

    def run(folder, **ahead):
        made = []
        options = TrainingOptions(
            eval_every=16, log_every_s=1e9, progress=False, **ahead,
            eval_fn=lambda params, steps: made.append((steps, over.is_set())) or {
                "size": float(sum(jnp.abs(leaf).sum() for leaf in jax.tree.leaves(params)))},
            stop=lambda line: stopped_at.append(line["env_steps"]) or False,
        )  # fmt: skip
        train(env, config, folder, 64, 0, options)
        lines = [json.loads(text) for text in (folder / "metrics.jsonl").read_text().splitlines()]
        return made, [(line["env_steps"], line["eval/size"]) for line in lines]

    at_once, plain = run(tmp_path / "plain")
    assert at_once == [(16, False), (32, False), (48, False), (64, False)]
    monkeypatch.setattr("dreamer.train.Progress", Bar)
    late, lines = run(tmp_path / "ahead", eval_ahead=lambda params: over.wait(600))
    assert late == [(16, True), (32, True), (48, True), (64, True)]
    assert lines == plain and len({size for _, size in lines}) > 1  # each of the parameters of its time
    assert stopped_at == [16, 32, 48, 64] * 2


def test_a_run_interrupted_again_while_it_evaluates_what_was_due_leaves_a_checkpoint(tmp_path):
    def interrupted(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        options = TrainingOptions(eval_every=16, progress=False, eval_fn=interrupted)
        train(corridor_env(2), tiny_config(), tmp_path, 64, 0, options)
    [kept] = checkpoint.complete(tmp_path / "checkpoints")
    assert kept.name == f"{16:012d}"


def test_evaluations_take_the_average(tmp_path):
    seen = []
    config = dataclasses.replace(CONFIG, average_rate=0.25)
    options = TrainingOptions(eval_fn=lambda params, _: seen.append(params) or {}, progress=False)
    run = train(corridor_env(2), config, tmp_path, 64, 0, options)
    jax.tree.map(np.testing.assert_array_equal, seen[-1], run.agent.average)
    changed = jax.tree.map(lambda a, b: bool((a != b).any()), run.agent.average, run.agent.params)
    assert any(jax.tree.leaves(changed))
    with pytest.raises(ValueError, match="average_rate"):
        DreamerConfig(average_rate=1.0)
