"""Which figures `benchmarks.course` makes of finished and of stopped trainings."""

from __future__ import annotations

import argparse
import dataclasses
import json

import pytest

from benchmarks import course
from benchmarks.course_figures import groups, load_run
from dreamer.config import preset
from whill_mjx.learning.trainings import Trained

COURSE, CORRIDOR = {"action_repeat": 1}, {"action_repeat": 1, "box_x": 2.5}


def write_run(path, successes, preset="wallclock", learner="ppo", task=COURSE, note=None, planned=8000):
    """A run's folder as it was left with these evaluations, one a minute and 1000 steps."""
    path.mkdir(parents=True)
    lines = [{"env_steps": 1000 * n, "updates": n, "wall_s": 60.0 * n, "eval/success": share,
              "eval/return": 200 * share, "eval/collision": 1 - share} for n, share in enumerate(successes, 1)]
    (path / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in [{"env_steps": 1}, *lines]))
    command = {"preset": preset, "layout": "randomised", "seed": 3, "learner": learner}
    chosen = {"task": task, "eval_episodes": 1000, "exploring_starts": 0.5, "total_steps": planned}
    (path / "run.json").write_text(json.dumps({"command": command, "preset": chosen}))
    if note is not None:
        (path / "course.json").write_text(json.dumps({**command, "device": "X", "task": task, **note}))
    return path


@pytest.mark.quick
def test_the_time_to_99_percent_is_that_of_the_first_such_evaluation(tmp_path):
    note = {"policy": {"success": 0.97, "return": 210.0, "episodes": 500}, "env_steps": 4000}
    run = load_run(write_run(tmp_path / "0", [0.5, 0.99, 0.98, 1.0], note=note))
    [(name, [_], figures)] = groups([run])
    assert name == "course_wallclock_randomised_ppo"
    assert figures["time_to_99_s_ppo"]["value"] == figures["time_to_99_s"]["value"] == 120.0
    assert figures["wallclock_success_ppo"]["exploring_starts"] == [0.5]
    assert figures["wallclock_success_ppo"]["value"] == 0.97  # of the final evaluation, not of one inside the run
    assert figures["wallclock_training_s_ppo"]["value"] == 240.0
    second = figures["wallclock_success_ppo"]["evaluations"][0][1]
    assert second == {"env_steps": 2000, "wall_s": 120.0, "success": 0.99}


@pytest.mark.quick
def test_a_run_that_never_reached_99_percent_has_no_time_to_it(tmp_path):
    [(_, _, figures)] = groups([load_run(write_run(tmp_path / "0", [0.5, 0.98], learner="dreamer"), "X")])
    assert "time_to_99_s_stopped" not in figures
    success = figures["wallclock_success_stopped"]
    assert (success["value"], success["episodes"], success["env_steps"]) == (0.98, 1000, [2000])
    assert (success["seeds"], success["exploring_starts"]) == ([3], [0.5])


@pytest.mark.quick
def test_a_corridor_trained_with_another_vehicle_in_each_episode_has_figures_of_its_own(tmp_path):
    driven = {"success": 0.99, "collision": 0.01, "return": 200.0, "episodes": 500}
    note = {"policy": driven, "env_steps": 2000, "updates": 9, "preset": "paper"}
    usual = load_run(write_run(tmp_path / "0", [1.0], "paper", "dreamer", CORRIDOR, note))
    varied = {**driven, "success": 0.97}
    other = load_run(write_run(tmp_path / "1", [1.0], "paper", "dreamer", CORRIDOR,
                               {**note, "spread": 0.1, "varied": varied}))
    assert "success_dynamics" not in next(iter(groups([usual])))[2]
    [(name, [_], figures)] = groups([other])
    assert name == "corridor_dynamics"
    assert figures["success_dynamics"]["value"] == 0.99
    assert (figures["success_varied_dynamics"]["value"], figures["success_varied_dynamics"]["spread"]) == (0.97, [0.1])


@pytest.mark.quick
def test_a_run_left_beside_others_keeps_the_spread_of_its_vehicles(tmp_path):
    path = write_run(tmp_path / "0", [1.0], "paper", "dreamer", CORRIDOR)
    begun = json.loads((path / "run.json").read_text())
    (path / "run.json").write_text(json.dumps({**begun, "command": {**begun["command"], "spread": 0.1}}))
    assert load_run(path, "X")["spread"] == 0.1


@pytest.mark.quick
def test_learners_worlds_and_stopped_runs_are_told_apart(tmp_path):
    note = {"policy": {"success": 1.0, "return": 220.0, "episodes": 500}, "env_steps": 2000}
    whole = load_run(write_run(tmp_path / "0", [1.0], note=note))
    stopped = load_run(write_run(tmp_path / "1", [1.0]), "X")
    corridor = load_run(write_run(tmp_path / "2", [0.9], "paper", "dreamer", CORRIDOR), "X")
    found = {name: figures for name, _, figures in groups([whole, stopped, corridor])}
    baseline = "course_wallclock_randomised_ppo"
    assert set(found) == {baseline, f"{baseline}_stopped", "corridor_stopped"}
    assert found["corridor_stopped"]["collisions_stopped"]["value"] == pytest.approx(0.1)


@pytest.mark.quick
def test_a_finished_run_without_a_note_is_that_of_its_final_evaluation(tmp_path):
    path = write_run(tmp_path / "0", [0.5, 1.0])
    left = {"policy": {"success": 0.8, "return": 190.0, "episodes": 100}, "env_steps": 2000, "task": COURSE, "seed": 3}
    (path / "evaluation.json").write_text(json.dumps(left))
    [(name, _, figures)] = groups([load_run(path, "X")])
    assert name == "course_wallclock_randomised_ppo"
    assert (figures["wallclock_success_ppo"]["value"], figures["wallclock_success_ppo"]["device"]) == (0.8, "X")


@pytest.mark.quick
def test_runs_that_cannot_be_recorded_are_refused(tmp_path):
    path = write_run(tmp_path / "0", [0.5], "paper", "dreamer")
    with pytest.raises(ValueError, match=r"has no course.json.*--device"):
        load_run(path)
    with pytest.raises(ValueError, match=r"seed 3 of the preset paper was stopped.*ablation"):
        list(groups([load_run(path, "X")]))
    note = {"policy": {"success": 0.0}, "env_steps": 1}
    with pytest.raises(ValueError, match="seed 3: trainings of the preset smoke have no figures"):
        list(groups([load_run(write_run(tmp_path / "2", [0.5], "smoke", note=note))]))
    with pytest.raises(ValueError, match="stopped before its first evaluation"):
        load_run(write_run(tmp_path / "1", []), "X")


@pytest.mark.quick
def test_a_training_to_its_last_step_without_its_final_evaluation_is_no_stopped_one(tmp_path):
    successes = [0.5] * 17 + [0.9, 1.0]
    run = load_run(write_run(tmp_path / "0", successes, "paper", "dreamer", planned=19_000), "X")
    [(name, _, figures)] = groups([run])
    assert name == "course_paper_randomised"
    assert figures["return_at_18000_median"]["value"] == pytest.approx(190.0)
    assert figures["success_at_22000"]["value"] == 1.0


@pytest.mark.quick
def test_an_ablation_tells_late_evaluations_settings_and_what_whole_runs_came_to(tmp_path, monkeypatch):
    recorded = {}
    monkeypatch.setattr(course, "record", lambda name, claim, figures: recorded.update(figures))
    final = {"policy": {"success": 0.97, "collision": 0.02, "return": 190.0, "episodes": 1000}}
    paths = [write_run(tmp_path / "told_0", [0.1, 0.2, 0.9, 1.0], "paper", "dreamer", CORRIDOR, final),
             write_run(tmp_path / "told_1", [0.1, 0.3, 0.4, 0.5], "paper", "dreamer", CORRIDOR)]
    for path in paths:
        config = dataclasses.asdict(dataclasses.replace(preset("size12m"), vector_scale=5.0))
        (path / "config.json").write_text(json.dumps(config))
        run = json.loads((path / "run.json").read_text())
        run["command"]["task"], run["preset"]["second_tries"] = "corridor", 0.5
        (path / "run.json").write_text(json.dumps(run))
    course.ablation(argparse.Namespace(runs=paths, metric="success", device="X"))
    entry = recorded["ablation_told_success"]
    assert entry["repeats"] == pytest.approx([0.95, 0.45]) and entry["steps"] == [4000, 4000]
    assert entry["changed"] == {"vector_scale": 5.0}
    assert entry["whole"] == {"0": {"episodes": 1000, "success": 0.97, "collision": 0.02, "return": 190.0}}
    told = {"task": "corridor", "layout": "randomised", "exploring_starts": 0.5, "second_tries": 0.5}
    assert entry["environment"] == told


@pytest.mark.quick
def test_a_training_alone_ends_with_its_last_evaluation_and_is_recorded_like_a_whole_run(tmp_path, monkeypatch):
    def train(options, preset, vehicle):
        assert vehicle.exists() and preset.learner.lr == 1e-3
        evaluations = ((18_000, 0.5, 90.0), (22_000, 1.0, 210.0))
        lines = [{"env_steps": steps, "updates": 7, "wall_s": 80.0, "eval/success": share,
                  "eval/collision": 1.0 - share, "eval/return": reward} for steps, share, reward in evaluations]
        (options.out / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        return Trained(params={}, env_steps=22_000, updates=7, wall_s=80.0)

    monkeypatch.setattr(course, "train_policy", train)
    monkeypatch.setattr(course, "main", lambda options: pytest.fail("the whole command was run"))
    asked = ["run", "--preset", "paper", "--layout", "fixed", "--seed", "2", "--out", str(tmp_path / "run"),
             "--vehicle", "whill_cr_ramp", "--lr", "1e-3", "--training-only"]
    monkeypatch.setattr("sys.argv", ["course", *asked])
    course.run(course.parse())
    run = load_run(tmp_path / "run")
    [(name, _, figures)] = groups([run])
    assert name == "course_paper_fixed" and run["policy"] == {"success": 1.0, "collision": 0.0, "return": 210.0,
                                                              "episodes": 200}
    assert figures["wallclock_s_fixed"]["value"] == 80.0 and figures["return_at_18000_median_fixed"]["value"] == 150.0
    assert not [name for name in figures if "blinded" in name]


@pytest.mark.quick
@pytest.mark.parametrize("warm", [False, True])
def test_only_trainings_that_compiled_their_programs_tell_their_time(warm, tmp_path, monkeypatch):
    recorded = {}
    monkeypatch.setattr(course, "record", lambda name, claim, figures: recorded.update({name: figures}))
    monkeypatch.setattr(course, "draw", lambda runs, path: None)
    note = {"policy": {"success": 0.9, "collision": 0.1, "episodes": 500}, "env_steps": 1000, "updates": 1}
    path = write_run(tmp_path / "0", [1.0], "paper", "dreamer", CORRIDOR, note)
    course.collect(argparse.Namespace(runs=[path], device=None, warm=warm))
    assert recorded["corridor"]["success"]["value"] == 0.9
    assert ("wallclock_s" in recorded["corridor"]) == (not warm)
