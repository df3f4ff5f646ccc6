"""Numbers from Python and from the command line that cannot be meant are refused before anything is compiled."""

from __future__ import annotations

import dataclasses
import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx import Task, evaluate, make_env, train
from whill_mjx.effects import make_effect
from whill_mjx.env.make import as_vehicle
from whill_mjx.evaluation.policies.policy_world import find_policy
from whill_mjx.io import command_line
from whill_mjx.learning.options import TrainOptions, choose_preset
from whill_mjx.learning.refusals import check
from whill_mjx.tasks.check import check_task
from whill_mjx.vehicle.types import VehicleParams

pytestmark = pytest.mark.quick


@pytest.mark.parametrize(("name", "values", "said"), [
    ("command_delay", {"delay": -0.1}, "effect 'command_delay': delay is -0.1; it must lie within 0 to 5 s"),
    ("command_delay", {"delay": float("nan")}, "effect 'command_delay': delay is nan"),
    ("command_delay", {"delay": np.inf}, "effect 'command_delay': delay is inf"),
    ("command_delay", {"delay": "0.1"}, "effect 'command_delay': delay is '0.1'; it must be a number"),
    ("actuator_lag", {"cascade": 1.5}, "effect 'actuator_lag': cascade is 1.5; it must lie within 0 to 1"),
])  # fmt: skip
def test_an_effect_out_of_its_range_is_refused(name, values, said):
    with pytest.raises(ValueError, match=re.escape(said)):
        make_effect(name, **values)


def test_effects_take_values_of_a_trace_as_they_are():
    traced = jax.eval_shape(lambda delay: make_effect("command_delay", delay=delay).delay, 0.1)
    assert traced.shape == () and make_effect("command_delay", delay=np.float32(0.1)).delay == np.float32(0.1)


@pytest.mark.parametrize(("part", "value"), [("mass", -1.0), ("mass", jnp.nan), ("com_x", jnp.array([0.1, 30.0]))])
def test_a_vehicle_with_a_parameter_out_of_its_range_is_refused(part, value):
    spec, params = as_vehicle("whill_cr_ramp")
    wrong = VehicleParams(dataclasses.replace(params.body, **{part: value}), params.effects)
    with pytest.raises(ValueError, match=f"vehicle '{spec.name}': body.{part} is .*; it must"):
        make_env("corridor", (spec, wrong))
    assert make_env("corridor", (spec, params))[1] is params


def task_of(rewards):
    kind = type("Own", (Task,), {"rewards": lambda self, moment: rewards(moment)})
    return dataclasses.dataclass(frozen=True)(kind)()


@pytest.mark.parametrize(("rewards", "said"), [
    (lambda moment: {"a": moment.time_s, "time": jnp.asarray(jnp.nan)}, "'time' is always nan"),
    (lambda moment: {"b": jnp.log(jnp.zeros(())), "a": moment.time_s}, "'b' is always -inf"),
    (lambda moment: {"a": 2.0 * jnp.asarray(jnp.inf)}, "'a' is always inf"),
])  # fmt: skip
def test_a_reward_that_is_always_the_same_and_no_finite_number_is_refused(rewards, said):
    with pytest.raises(ValueError, match=f"task 'own': rewards: {said}; it must be a finite number. Correct the"):
        check_task(task_of(rewards))


def test_constant_rewards_and_those_of_a_moment_are_the_tasks_own():
    check_task(task_of(lambda moment: {"time": jnp.asarray(-0.05), "far": 1.0 / moment.goal_distance}))


def test_the_check_of_constant_rewards_computes_no_others():
    called = []

    def measured(time):
        called.append(time)
        return np.float32(1.0)

    check_task(task_of(lambda moment: {
        "time": jnp.asarray(-0.05),
        "other": jax.pure_callback(measured, jax.ShapeDtypeStruct((), np.float32), moment.time_s)}))
    assert not called


@pytest.mark.parametrize(("options", "words", "said"), [
    (TrainOptions, ["--steps", "1e6"], "--steps 1e6: must be a whole number, in digits alone. Correct it."),
    (TrainOptions, ["--seed", "1.0"], "--seed 1.0: must be a whole number"),
    (TrainOptions, ["--lr", "fast"], "--lr fast: must be a number. Correct it."),
    (evaluate.EvaluateOptions, ["planner", "--near=x"], "--near x: must be a number"),
])  # fmt: skip
def test_a_word_that_is_no_number_is_named_with_the_rule(options, words, said, capsys):
    with pytest.raises(SystemExit) as ended:
        command_line.run(options, lambda options: pytest.fail("begun"), None, args=words, positional=False)
    assert ended.value.code == command_line.REFUSED and said in capsys.readouterr().err


@pytest.mark.parametrize(("changes", "said"), [
    ({"steps": 5 * 10**9}, "total_steps = 5000000000: it must be a whole number from 0 to"),
    ({"instances": 4096}, "replay_capacity = 60000 gives 14 steps to each of 4096 instances"),
    ({"change": ("learning_starts=10000000000",)}, "DreamerConfig.learning_starts = 10000000000"),
])  # fmt: skip
def test_a_training_that_could_not_count_or_remember_is_refused_and_nothing_is_written(changes, said, tmp_path):
    options = TrainOptions(out=tmp_path / "run", vehicle=Path("whill_cr_ramp"), preset="cpu", **changes)
    with pytest.raises(ValueError, match=re.escape(said)):
        check(options, choose_preset(options))
    with pytest.raises(command_line.OptionError):
        train.main(options)
    assert not list(tmp_path.iterdir())


def test_a_file_of_the_users_with_the_name_of_a_library_does_not_stand_for_it(tmp_path):
    for name in ("json", "random", "numpy"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('the file of the user')\n")
    (tmp_path / "hall.py").write_text("mine = 3\n")
    words = [sys.executable, "-m", "whill_mjx.evaluate", "planner", "--task"]
    for task, said in (("nope", "--task nope: unknown"), ("hall:mine", "3 is no task")):
        ended = subprocess.run([*words, task], cwd=tmp_path, capture_output=True, text=True)
        assert ended.returncode == command_line.REFUSED and said in ended.stderr, ended.stderr


@pytest.mark.parametrize(("words", "code", "said"), [
    (["sysid"], command_line.DONE, "python -m sysid.fit"),
    (["sysid", "fit"], command_line.REFUSED, "fit: takes no words. Type python -m sysid.fit."),
    (["whill_mjx", "go"], command_line.REFUSED, "go: takes no words. Leave it out for the list."),
])  # fmt: skip
def test_a_list_of_commands_is_shown_beside_any_file_and_takes_no_words(words, code, said, tmp_path):
    (tmp_path / "ast.py").write_text("raise RuntimeError('the file of the user')\n")
    ended = subprocess.run([sys.executable, "-m", *words], cwd=tmp_path, capture_output=True, text=True)
    assert ended.returncode == code and said in ended.stdout + ended.stderr


def test_a_run_without_a_policy_yet_is_refused_with_the_way_on(tmp_path):
    (tmp_path / "run.json").write_text("{}")
    with pytest.raises(command_line.OptionError, match="no policy in this folder.*give its command again to go on"):
        find_policy(tmp_path)
