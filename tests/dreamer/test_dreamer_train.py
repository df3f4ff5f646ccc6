import dataclasses
import json
import multiprocessing
import os
import resource
import signal
import time
from random import Random

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dreamer_toys import corridor_env, counting_env, tiny_config, train_without_end
from filelock import FileLock

from dreamer.experience import iteration
from dreamer.train import TrainingOptions, copied, evaluate, train
from dreamer.training import checkpoint

ENV = corridor_env(4)
CONFIG = tiny_config(lr=1e-3, train_ratio=64.0)
QUIET = TrainingOptions(progress=False, log_every_s=0.0, checkpoint_every_s=1e9)


def lines(out):
    return [json.loads(text) for text in (out / "metrics.jsonl").read_text().splitlines()]


def means(logged):
    """Mean of each figure over the lines that have it."""
    names = {name for line in logged for name in line}
    return {name: np.mean([line[name] for line in logged if name in line]) for name in names}


def assert_equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(a), jax.device_get(b))


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    return train(ENV, CONFIG, tmp_path_factory.mktemp("learned"), 600, 0, QUIET)


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    """An uninterrupted run of 400 steps."""
    return train(ENV, CONFIG, tmp_path_factory.mktemp("straight"), 400, 0, QUIET)


def test_the_corridor_is_learned_to_its_best_return(learned):
    result = evaluate(ENV, CONFIG, learned.agent.params, jax.random.PRNGKey(1), 6)
    np.testing.assert_allclose(result["return"], np.full(6, 1.0 - 0.05 * 3), atol=1e-5)
    np.testing.assert_array_equal(result["length"], 4)
    np.testing.assert_array_equal(result["success"], 1.0)


def test_the_reward_head_knows_the_goal_and_the_value_is_right(learned):
    last = means(lines(learned.out)[-30:])
    assert last["goal_reward_true"] == pytest.approx(1.0, abs=1e-5) and last["goal_reward_predicted"] > 0.9
    assert last["kl"] < 2.0 and 0.1 <= last["policy_std"] < 0.8
    assert last["loss_recon"] < 10.0


def test_the_goal_step_is_stored_with_its_own_frame(learned):
    memory = last_state(learned.out).replay
    terminal, frames = np.asarray(memory.is_terminal), np.asarray(memory.obs)[..., 0, 0, 0]
    assert terminal.sum() > 20
    np.testing.assert_array_equal(frames[terminal], 255)
    np.testing.assert_array_equal(np.asarray(memory.reward)[terminal], 1.0)
    assert np.all(np.asarray(memory.is_last)[terminal])
    after = np.roll(terminal, 1, 0)
    after[0] = after[int(memory.written) % len(after)] = False
    np.testing.assert_array_equal(np.asarray(memory.is_first)[after], True)
    np.testing.assert_array_equal(frames[after], 0)


def test_updates_follow_the_train_ratio_and_nothing_is_caught_up(straight):
    logged = lines(straight.out)
    first = next(line for line in logged if line["updates"])
    assert first["env_steps"] >= CONFIG.learning_starts and first["updates_per_env_step"] <= 2.0
    assert logged[-1]["updates_per_env_step"] == pytest.approx(64.0 / CONFIG.replayed_per_update)
    waited = first["env_steps"] - ENV.num_envs
    assert straight.updates == (400 - waited) * 2


def test_an_iteration_is_one_program_that_never_asks_the_host():
    state = jax.jit(lambda: iteration.init_state(ENV, CONFIG, 0))()
    program = jax.jit(lambda state: iteration.train_iteration(ENV, CONFIG, state))
    traced = program.trace(state)
    assert "callback" not in str(traced.jaxpr) and "outfeed" not in str(traced.jaxpr)
    step = traced.lower().compile()
    with jax.transfer_guard("disallow"):
        for _ in range(CONFIG.learning_starts // ENV.num_envs + 10):
            state, metrics = step(state)
    assert int(state.agent.updates) > 0


@pytest.mark.quick
@pytest.mark.parametrize("num_envs, ratio", [(16, 512.0), (4096, 16.0), (3, 0.7), (1, 33.3)])
def test_credit_buys_exactly_the_ratio(num_envs, ratio):
    config = tiny_config(train_ratio=ratio)
    gain, price = iteration.credit_rates(config, num_envs)
    assert gain / price == pytest.approx(num_envs * ratio / config.replayed_per_update, rel=1e-6)
    assert gain + price < 2**31


def test_a_resumed_run_equals_an_uninterrupted_one_bit_for_bit(straight, tmp_path):
    train(ENV, CONFIG, tmp_path, 200, 0, dataclasses.replace(QUIET, tensorboard=True))
    resumed = train(ENV, CONFIG, tmp_path, 400, 0, dataclasses.replace(QUIET, tensorboard=True))
    assert_equal(resumed.agent, straight.agent)
    drawn = curve(tmp_path / "tensorboard", "updates_per_env_step")
    logged = {line["env_steps"]: line["updates_per_env_step"] for line in lines(tmp_path)}
    assert drawn == pytest.approx(logged) and len(drawn) > 30
    assert [line["env_steps"] for line in lines(tmp_path)] == [line["env_steps"] for line in lines(straight.out)]
    rates = {line["updates_per_env_step"] for line in lines(tmp_path)[30:]}
    assert rates == {2.0}
    times = [line["wall_s"] for line in lines(tmp_path)]
    assert times == sorted(times)


def curve(folder, name):
    """{step: value} of one curve in TensorBoard's files: records of length, checksum, event, checksum."""
    from tensorboardX.proto.event_pb2 import Event

    points = {}
    for path in sorted(folder.iterdir()):
        data, at = path.read_bytes(), 0
        while at < len(data):
            size = int.from_bytes(data[at : at + 8], "little")
            event = Event.FromString(data[at + 12 : at + 12 + size])
            points |= [(event.step, value.simple_value) for value in event.summary.value if value.tag == name]
            at += size + 16
    return points


@pytest.mark.parametrize("kills", [3, pytest.param(10, marks=pytest.mark.long)])
def test_a_run_killed_again_and_again_gives_the_curve_and_the_state_of_an_uninterrupted_one(straight, tmp_path, kills):
    random, processes = Random(7), multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload(["dreamer.train"])  # each child starts with everything imported

    def newest():
        return max((int(path.name) for path in checkpoint.complete(tmp_path / "checkpoints")), default=0)

    for kill in range(kills):
        wanted = newest() + ENV.num_envs * random.randint(1, 5)
        # It waits four iterations later: however late it is killed here, it is not beyond the uninterrupted run.
        child = processes.Process(target=train_without_end, args=(CONFIG, tmp_path, wanted + 4 * ENV.num_envs))
        child.start()
        deadline = time.monotonic() + 300
        while kill % 5 and child.is_alive() and newest() < wanted and time.monotonic() < deadline:
            time.sleep(0.01)
        time.sleep(random.uniform(0.0, 0.03 if kill % 5 else 1.0))  # the first falls anywhere in its start
        child.kill()
        child.join()
        assert child.exitcode == -signal.SIGKILL, "it ended by itself"
    assert 0 < newest() < 400
    train(ENV, CONFIG, tmp_path, 400, 0, QUIET)
    assert_equal(last_state(tmp_path), last_state(straight.out))
    assert [told(line) for line in lines(tmp_path)] == [told(line) for line in lines(straight.out)]


def last_state(out):
    state = jax.jit(lambda: iteration.init_state(ENV, CONFIG, 0))()
    return checkpoint.restore(out / "checkpoints", state, CONFIG)[0]


def told(line):
    """What a logged line says, but for times."""
    return {name: value for name, value in line.items() if not name.endswith(("_s", "wall_s"))}


@pytest.fixture
def saved(tmp_path):
    """A folder with two small checkpoints and the function that reads them."""
    state = {"a": np.arange(5000.0), "key": jax.random.key(3), "empty": np.zeros((0, 2))}
    for steps in (100, 200, 300):
        checkpoint.save(tmp_path, {**state, "a": state["a"] + steps}, CONFIG, checkpoint.Moment(steps))
    return tmp_path, lambda config=CONFIG, state=state: checkpoint.restore(tmp_path, state, config)


def damage(folder, steps):
    victim = max((folder / f"{steps:012d}" / "state").rglob("*"), key=lambda p: p.stat().st_size * p.is_file())
    data = bytearray(victim.read_bytes())
    data[len(data) // 2] ^= 0xFF
    victim.write_bytes(data)


def test_the_last_two_checkpoints_are_kept_and_the_newest_is_read(saved):
    folder, read = saved
    assert sorted(path.name for path in folder.iterdir()) == ["000000000200", "000000000300"]
    state, meta = read()
    np.testing.assert_array_equal(state["a"], np.arange(5000.0) + 300)
    np.testing.assert_array_equal(jax.random.key_data(state["key"]), jax.random.key_data(jax.random.key(3)))
    assert meta["env_steps"] == 300


def test_a_damaged_checkpoint_is_passed_over_with_a_warning(saved):
    folder, read = saved
    damage(folder, 300)
    with pytest.warns(UserWarning, match="000000000300.*damaged"):
        assert read()[1]["env_steps"] == 200


def test_with_no_whole_checkpoint_left_the_error_names_file_rule_and_remedy(saved):
    folder, read = saved
    damage(folder, 200)
    (folder / "000000000300" / "meta.json").write_text("{")
    with pytest.warns(UserWarning), pytest.raises(checkpoint.CheckpointError, match="000000000200.*checksum.*Delete"):
        read()


def test_an_unfinished_checkpoint_is_not_seen(saved):
    folder, read = saved
    (folder / ".unfinished-x").mkdir()
    (folder / "000000000900").mkdir()  # without meta.json, which is written last
    assert read()[1]["env_steps"] == 300


def test_a_full_disk_is_an_os_error_that_names_the_checkpoint_and_the_older_ones_stay(saved, capfd):
    folder, read = saved
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))
    try:
        with pytest.raises(OSError, match="File too large.*000000000400"):
            checkpoint.save(folder, {"a": np.random.default_rng(0).normal(size=5000)}, CONFIG, checkpoint.Moment(400))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert sorted(path.name for path in folder.iterdir()) == ["000000000200", "000000000300"]
    assert read()[1]["env_steps"] == 300 and "Traceback" not in capfd.readouterr().err


def test_what_a_killed_process_left_of_a_checkpoint_is_removed_by_the_next(saved):
    folder, _ = saved
    (folder / ".unfinished-000000000400" / "state").mkdir(parents=True)
    checkpoint.save(folder, {"a": np.zeros(3)}, CONFIG, checkpoint.Moment(500))
    assert sorted(path.name for path in folder.iterdir()) == ["000000000300", "000000000500"]


def test_a_checkpoint_has_the_rights_that_the_users_umask_lets_it_have(saved):
    folder, _ = saved
    umask = os.umask(0)
    os.umask(umask)
    folders = [path for path in folder.rglob("*") if path.is_dir()]
    assert folders and {path.stat().st_mode & 0o777 for path in folders} == {0o777 & ~umask}


@pytest.mark.quick
def test_another_seed_or_a_second_process_in_the_folder_of_a_run_is_refused(tmp_path):
    checkpoint.save(tmp_path / "checkpoints", {"a": np.zeros(3)}, CONFIG, checkpoint.Moment(100))
    (tmp_path / "config.json").write_text(json.dumps({"seed": 0}))
    with pytest.raises(ValueError, match="begun with seed 0, not 1. Give that seed, or another folder"):
        train(ENV, CONFIG, tmp_path, 400, 1, QUIET)
    with FileLock(tmp_path / ".training.lock"):
        with pytest.raises(ValueError, match="another process trains there"):
            train(ENV, CONFIG, tmp_path, 400, 0, QUIET)


@pytest.mark.quick
@pytest.mark.parametrize("wrong", [{"lr": float("nan")}, {"lr": 0.0}, {"batch_size": 0}, {"horizon": float("inf")},
                                   {"entropy_scale": -1.0}, {"blocks": 0}])  # fmt: skip
def test_settings_that_cannot_be_meant_are_refused_by_name(wrong):
    with pytest.raises(ValueError, match=f"DreamerConfig.{next(iter(wrong))} = .*: it must"):
        dataclasses.replace(CONFIG, **wrong)


def test_another_configuration_or_environment_is_refused_by_name(saved):
    _, read = saved
    with pytest.raises(checkpoint.CheckpointError, match="lr: saved 0.001, now 0.5"):
        read(config=dataclasses.replace(CONFIG, lr=0.5))
    with pytest.raises(checkpoint.CheckpointError, match="no array 'b'"):
        read(state={"b": np.zeros(3)})
    with pytest.raises(checkpoint.CheckpointError, match="array 'a' is .*5000.* where .*10, 2"):
        read(state={"a": np.zeros((10, 2))})


def test_each_instance_counts_one_episode_however_short():
    env = counting_env(4, (3, 5, 9, 2))
    config = tiny_config()
    params = jax.jit(lambda: iteration.init_state(env, config, 0).agent.params)()
    result = evaluate(env, config, params, jax.random.PRNGKey(0), 6)
    np.testing.assert_array_equal(result["length"], [3, 5, 9, 2, 3, 5])
    np.testing.assert_array_equal(result["return"], [3, 5, 9, 2, 3, 5])
    np.testing.assert_array_equal(result["mark"], [3, 5, 9, 2, 3, 5])
    assert np.all(result["finished"])


def test_several_steps_in_one_dispatch_are_the_same_run(straight):
    config = dataclasses.replace(CONFIG, steps_per_iter=10)
    state = jax.jit(lambda: iteration.init_state(ENV, config, 0))()
    iterate = iteration.compile_iteration(ENV, config, state)
    updates = episodes = 0
    for _ in range(10):
        state, metrics = iterate(state)
        updates, episodes = updates + int(metrics["updates"]), episodes + float(metrics["episodes"])
    assert int(state.env_steps) == 400 and int(state.agent.updates) == updates == straight.updates
    assert episodes == sum(line["episodes"] for line in lines(straight.out))


@pytest.mark.quick
def test_what_a_sum_adds_up_is_traced_once():
    """An update of the learner is such a body, and the larger part of what a training traces."""
    traced = []

    def body(i, carry):
        traced.append(i)
        return carry * 2, {"seen": carry, "index": i.astype(jnp.float32)}

    carry, sums = jax.jit(lambda count, carry: iteration.sum_over(count, body, carry))(3, jnp.ones(2))
    assert len(traced) == 1
    np.testing.assert_array_equal(carry, [8, 8])
    np.testing.assert_array_equal(sums["seen"], [7, 7])
    assert sums["index"] == 3


@pytest.mark.quick
def test_parameters_are_copied_into_memory_of_their_own_by_one_program(programs):
    params = {size: jnp.full(size, float(size)) for size in range(211, 216)}
    programs.clear()
    other = copied(params)
    assert programs["cache_misses"] + programs["cache_hits"] == 1
    for size, leaf in params.items():
        leaf.delete()  # as a training that goes on does
        np.testing.assert_array_equal(other[size], float(size))
