"""Several seeds in one program are the runs of each seed alone."""

import dataclasses
import json

import jax
import numpy as np
import pytest
from dreamer_toys import tiny_config

from benchmarks import grid_env
from dreamer.train import TrainingOptions, evaluate, train
from dreamer.training import seeds

ENV = grid_env.make(4)
# Learning starts with the last of nine iterations: rounding, which grows with every update, has no time to.
CONFIG = tiny_config(patch=4, train_ratio=16.0, learning_starts=36, warmup=1)
QUIET = TrainingOptions(progress=False, log_every_s=0.0, checkpoint_every_s=1e9)
SEEDS = (3, 5)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A run of two seeds to the end, and one that was stopped by the clock and begun again."""
    folder = tmp_path_factory.mktemp("seeds")

    def figures(params, steps):
        result = evaluate(ENV, CONFIG, params, jax.random.PRNGKey(2), 6)
        return {f"return_{seed}": value for seed, value in zip(SEEDS, result["return"].mean(-1), strict=True)}

    straight = train(ENV, CONFIG, folder / "a", 36, SEEDS, dataclasses.replace(QUIET, eval_fn=figures))
    halted = train(ENV, CONFIG, folder / "b", 36, SEEDS, dataclasses.replace(QUIET, time_limit_s=0.0))
    resumed = train(ENV, CONFIG, folder / "b", 36, SEEDS, QUIET)
    return straight, halted, resumed


def test_two_seeds_side_by_side_are_the_two_runs_alone(runs, tmp_path):
    both = runs[0]
    alone = train(ENV, CONFIG, tmp_path, 36, SEEDS[1], QUIET)
    assert both.updates == alone.updates == 2
    mine = seeds.pick(both.agent.params, 1)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=2e-4), mine, alone.agent.params)
    assert np.any(both.agent.params["enc"]["vector"]["layer0"]["w"][0] != mine["enc"]["vector"]["layer0"]["w"])


def test_a_run_of_several_seeds_stops_by_the_clock_and_goes_on_bit_for_bit(runs):
    straight, halted, resumed = runs
    assert halted.env_steps == 4 and resumed.env_steps == 36
    jax.tree.map(np.testing.assert_array_equal, straight.agent, resumed.agent)


def test_every_seed_has_its_own_evaluation_and_the_log_holds_means(runs):
    straight, *_ = runs
    params = straight.agent.params
    assert seeds.count(params) == 2 and seeds.count(seeds.pick(params, 0)) == 0
    last = json.loads((straight.out / "metrics.jsonl").read_text().splitlines()[-1])
    alone = evaluate(ENV, CONFIG, seeds.pick(params, 0), jax.random.PRNGKey(2), 6)["return"].mean()
    assert last["eval/return_3"] == pytest.approx(alone, abs=1e-5)
    assert last["updates"] == 2 and last["updates_per_env_step"] == pytest.approx(2 / 4)


@pytest.mark.quick
def test_counters_stay_shared():
    shape = jax.eval_shape(lambda: seeds.init_states(ENV, CONFIG, SEEDS))
    shared = (shape.env_steps, shape.credit, shape.replay.written, shape.replay.online_next, shape.agent.opt.count)
    assert {leaf.shape for leaf in shared} == {()} and shape.replay.reward.shape[0] == 2
