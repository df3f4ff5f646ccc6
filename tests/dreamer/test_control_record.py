"""What the benchmark on foreign tasks writes down of its runs."""

import argparse

import pytest

from benchmarks import cartpole
from dreamer.experience.iteration import credit_rates

OPTIONS = argparse.Namespace(task="grid", sight="image", preset="tiny", episodes=4, instances=2, steps=40, ratio=None,
                             unroll=None)  # fmt: skip


def line(steps, updates, **returns):
    found = {f"eval/return_{seed[1:]}": value for seed, value in returns.items()}
    return {"env_steps": steps, "updates": updates, "updates_per_s": 5.0, "wall_s": 60.0 * steps, **found}


@pytest.mark.parametrize("separate", [False, True])
def test_the_curve_holds_every_seed_as_far_as_all_of_them_are(separate):
    task = cartpole.make_task(OPTIONS)
    config = cartpole.make_config(OPTIONS, task)
    both = [line(0, 0), line(10, 3, s0=0.5, s1=0.25), line(20, 6, s0=1.0, s1=0.5)]
    first = [line(0, 0), line(10, 3, s0=0.5), line(20, 6, s0=1.0), line(30, 9, s0=1.5)]
    second = [line(0, 0), line(10, 3, s1=0.25), line(20, 6, s1=0.5)]
    runs = [((0,), first), ((1,), second)] if separate else [((0, 1), both)]
    figures = cartpole.summary(OPTIONS, task, config, runs)
    main = figures["grid_tiny_return"]
    assert main["curve"] == [[10, [0.5, 0.25]], [20, [1.0, 0.5]]]
    assert main["repeats"] == [1.0, 0.5] and main["steps"] == 20 and main["updates"] == 6
    assert main["updates_per_step"] == 0.3
    assert figures["grid_tiny_updates_per_s"]["value"] == (5.0 if separate else 10.0)
    assert 0.0 < figures["grid_tiny_random_return"]["value"] + 0.4 < 2.0
    assert cartpole.summary(OPTIONS, task, config, [((0,), [])]) == {}


@pytest.mark.quick
def test_the_usual_ratio_makes_the_updates_of_the_published_curves():
    """100,000 steps of the suite are 50,000 decisions of two steps, and 25,000 updates less those before the start."""
    options = argparse.Namespace(task="balance", sight="image", preset="size12m", episodes=4, instances=16,
                                 steps=100_000, ratio=None, unroll=None)  # fmt: skip
    task = cartpole.make_task(options)
    config = cartpole.make_config(options, task)
    gain, price = credit_rates(config, 1)
    decisions = options.steps // task.repeat
    assert decisions * gain / price == 25_000
    assert (decisions - config.learning_starts) * gain // price == 24_488
