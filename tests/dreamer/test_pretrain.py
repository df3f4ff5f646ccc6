"""Pretraining of the world model on random drives, which are not counted."""

import dataclasses
import json

import jax
import numpy as np
import pytest
from dreamer_toys import choice_env, tiny_config

from dreamer.experience import iteration, pretrain
from dreamer.train import TrainingOptions, train
from dreamer.training import checkpoint, seeds
from dreamer.types import Mirror


def blind_env(num_envs):
    """The corridor with three classes without its camera: programs compile in half the time."""
    seen = choice_env(num_envs)

    def without(state_and_transition):
        state, transition = state_and_transition
        obs = {name: value for name, value in transition.obs.items() if name != "camera"}
        return state, dataclasses.replace(transition, obs=obs)

    return dataclasses.replace(
        seen,
        obs_shape={name: shape for name, shape in seen.obs_shape.items() if name != "camera"},
        reset=lambda key: without(seen.reset(key)),
        step=lambda state, action: without(seen.step(state, action)),
    )


ENV = blind_env(4)
CONFIG = tiny_config(
    lr=2e-3, warmup=5, pretrain_steps=62, pretrain_updates=40, average_rate=0.1, learning_starts=64, train_ratio=16.0,
    vector_layers=1,
)  # fmt: skip
QUIET = TrainingOptions(progress=False, log_every_s=0.0, checkpoint_every_s=1e9)
COUNTED = 24


def lines(out):
    return [json.loads(text) for text in (out / "metrics.jsonl").read_text().splitlines()]


def assert_equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(a), jax.device_get(b))


def changed(a, b):
    return any(jax.tree.leaves(jax.tree.map(lambda x, y: bool(np.any(np.asarray(x) != np.asarray(y))), a, b)))


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    """An uninterrupted run."""
    return train(ENV, CONFIG, tmp_path_factory.mktemp("straight"), COUNTED, 0, QUIET)


@pytest.fixture(scope="module")
def pretrained(tmp_path_factory):
    """A run without a counted step: its first state, and what pretraining made of it."""
    first = jax.jit(lambda: iteration.init_state(ENV, CONFIG, 0))()
    result = train(ENV, CONFIG, tmp_path_factory.mktemp("pretrained"), 0, 0, QUIET)
    return first, checkpoint.restore(result.out / "checkpoints", first, CONFIG)[0], result


def test_pretraining_changes_the_world_model_and_nothing_else_of_the_agent(pretrained):
    first, after, result = pretrained
    for part in ("enc", "dyn", "dec", "reward", "continue"):
        assert changed(after.agent.params[part], first.agent.params[part])
    for part in ("policy", "value"):
        assert_equal(after.agent.params[part], first.agent.params[part])
    assert_equal(after.agent.slow_value, first.agent.slow_value)
    assert_equal(after.agent.return_norm, first.agent.return_norm)
    assert_equal(after.agent.opt, first.agent.opt)  # bias corrections of the policy's first updates need a count of 0
    assert_equal(after.agent.average, after.agent.params)
    assert result.env_steps == result.updates == int(after.env_steps) == int(after.credit) == 0


def test_random_drives_fill_the_replay_and_are_reported_apart(pretrained, straight):
    _, after, result = pretrained
    assert int(after.replay.written) == 16 and int(after.pretrained.steps) == 64  # 62 in whole steps of 4 instances
    counts = np.asarray(after.replay.action)[:16].sum((0, 1))
    assert counts.sum() == 64 and counts.min() >= 10  # of three classes, each as likely
    logged = lines(result.out)
    assert {line["env_steps"] for line in logged} == {0} and {line["updates"] for line in logged} == {0}
    assert logged[-1]["pretrain_steps"] == 64 and logged[-1]["pretrain_updates"] == 40
    loss = [line["pretrain/loss"] for line in logged if "pretrain/loss" in line]
    assert len(loss) == 5 and loss[-1] < 0.7 * loss[0]
    names = ("env_steps", "updates", "wall_s", "pretrain_steps", "pretrain_updates")
    assert all(name in names or name.startswith("pretrain/") for line in logged for name in line)
    counted = [line for line in lines(straight.out) if line["env_steps"]]
    assert [line["env_steps"] for line in counted] == list(range(4, COUNTED + 1, 4))
    assert all(line["pretrain_updates"] == 40 and "loss_policy" in line for line in counted[-2:])


def test_random_steps_before_the_counted_ones_are_those_that_learning_waits_for(straight):
    gain, price = iteration.credit_rates(CONFIG, 4)
    assert straight.updates == COUNTED // 4 * gain // price > 0
    late = dataclasses.replace(CONFIG, learning_starts=64 + 8)
    state = jax.eval_shape(lambda: iteration.init_state(ENV, late, 0))
    for steps, started in ((4, False), (8, True)):
        now = dataclasses.replace(state, env_steps=steps, pretrained=iteration.Pretrained(64, 40))
        assert bool(iteration.started(late, now)) is started


def halt(**at):
    """Raises when the log has come so far."""

    def watch(line):
        if all(line[name] >= value for name, value in at.items()):
            raise KeyboardInterrupt

    return watch


def test_a_run_interrupted_in_each_phase_goes_on_bit_for_bit(straight, tmp_path):
    for at in (dict(pretrain_steps=20), dict(pretrain_updates=16), dict(pretrain_updates=40), dict(env_steps=8)):
        with pytest.raises(KeyboardInterrupt):
            train(ENV, CONFIG, tmp_path, COUNTED, 0, dataclasses.replace(QUIET, on_metrics=halt(**at)))
    resumed = train(ENV, CONFIG, tmp_path, COUNTED, 0, dataclasses.replace(QUIET, tensorboard=True))
    assert_equal(resumed.agent, straight.agent)
    whole, mine = lines(straight.out), lines(tmp_path)
    for name in ("env_steps", "pretrain_steps", "pretrain_updates", "pretrain/loss", "loss"):
        assert [line.get(name) for line in mine] == [line.get(name) for line in whole]


def test_a_killed_pretraining_goes_on_from_its_last_checkpoint(straight, tmp_path):
    def kill(line):
        if line["pretrain_updates"] >= 24:
            raise RuntimeError("killed")  # nothing is saved on the way out

    with pytest.raises(RuntimeError, match="killed"):
        train(ENV, CONFIG, tmp_path, COUNTED, 0, dataclasses.replace(QUIET, checkpoint_every_s=0.0, on_metrics=kill))
    left = [path.name for path in checkpoint.complete(tmp_path / "checkpoints")]
    assert left == [f"{0:012d}.{64 + updates:012d}" for updates in (8, 16)]
    resumed = train(ENV, CONFIG, tmp_path, COUNTED, 0, dataclasses.replace(QUIET, checkpoint_every_s=0.0))
    assert_equal(resumed.agent, straight.agent)
    assert [path.name for path in checkpoint.complete(tmp_path / "checkpoints")][-1] == f"{COUNTED:012d}"


@pytest.mark.long
def test_seeds_side_by_side_pretrain_as_each_alone_with_a_mirror_and_targets(tmp_path):
    mirror = Mirror(
        lambda state, obs, worlds: jax.tree.map(lambda x: x[None], obs), lambda action, worlds: action[None, :, ::-1]
    )
    env = dataclasses.replace(blind_env(2), mirror=mirror)
    config = tiny_config(
        lr=2e-3, warmup=5, mirror=1, decode_only=("range",), pretrain_steps=20, pretrain_updates=3, steps_per_iter=4,
        vector_layers=1,
    )  # fmt: skip
    both = train(env, config, tmp_path / "both", 0, (3, 5), QUIET)
    alone = train(env, config, tmp_path / "alone", 0, 5, QUIET)
    mine = seeds.pick(both.agent.params, 1)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=2e-4), mine, alone.agent.params)
    first = jax.jit(lambda: iteration.init_state(env, config, 5))()
    after = checkpoint.restore(tmp_path / "alone" / "checkpoints", first, config)[0]
    assert_equal(after.agent.params["policy"], first.agent.params["policy"])
    assert changed(after.agent.params["dec"], first.agent.params["dec"])
    actions = np.asarray(after.replay.action)[:10]
    np.testing.assert_array_equal(actions[:, 2:], actions[:, :2, ::-1])
    assert int(after.pretrained.steps) == 20 and lines(tmp_path / "both")[-1]["pretrain_steps"] == 20


@pytest.mark.quick
@pytest.mark.parametrize(
    "change, rule",
    [
        (dict(pretrain_updates=0), "together with pretrain_updates"),
        (dict(pretrain_steps=0), "together with pretrain_updates"),
        (dict(pretrain_steps=-5, pretrain_updates=-5), "must be a whole number in 0"),
        (dict(pretrain_steps=801), "fit replay_capacity"),
    ],
)
def test_pretraining_that_cannot_be_is_refused(change, rule):
    with pytest.raises(ValueError, match=rule):
        dataclasses.replace(CONFIG, **change)


@pytest.mark.quick
def test_too_few_random_steps_for_one_sequence_are_refused():
    config = dataclasses.replace(CONFIG, pretrain_steps=32)
    with pytest.raises(ValueError, match="pretrain_steps = 32.*above 32"):
        jax.eval_shape(lambda: iteration.init_state(ENV, config, 0))


@pytest.mark.quick
def test_pretraining_has_its_place_before_the_first_counted_step():
    def place(**line):
        return pretrain.position(CONFIG, {"env_steps": 0, **line})

    assert place(pretrain_steps=0, pretrain_updates=0) == -102
    assert place(pretrain_steps=60, pretrain_updates=0) == -42
    assert place(pretrain_steps=64, pretrain_updates=39) == -1
    assert place(pretrain_steps=64, pretrain_updates=40) == 0
    assert place(env_steps=4, pretrain_steps=64, pretrain_updates=40) == 4
    assert pretrain.position(tiny_config(), {"env_steps": 7}) == 7
