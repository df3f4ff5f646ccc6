"""The training command from end to end, in a tiny size: what it leaves behind, resuming, stopping, and bad input."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dreamer.experience.iteration import credit_rates
from whill_mjx.batch import make_batch
from whill_mjx.devices import choose_devices, join, launched_processes
from whill_mjx.env import make_env
from whill_mjx.evaluation.intervals import wilson_interval
from whill_mjx.evaluation.options import EvaluateOptions
from whill_mjx.evaluation.policies.policy_file import load_policy
from whill_mjx.evaluation.preparation import choose_task
from whill_mjx.io import command_line
from whill_mjx.io.command_line import OptionError
from whill_mjx.io.folders import FolderRefused
from whill_mjx.learning.checks import Stopper, keep_best, read_best
from whill_mjx.learning.options import TrainOptions, choose_preset
from whill_mjx.learning.outcome import diverged_note
from whill_mjx.learning.refusals import check_stop_success
from whill_mjx.learning.setup import find_preset, functional_env, make_evaluation_env, with_repeat
from whill_mjx.learning.shaping import SAFETY, Safety, find_safety, limited_policy, limiter_of, penalty
from whill_mjx.learning.trainings import Trained, best_params
from whill_mjx.tasks.tasks import ObstacleCourse, make_task
from whill_mjx.train import begin, main
from whill_mjx.vehicle.specs import WHILL_CR


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished run of the smoke preset with a built-in vehicle."""
    options = TrainOptions(
        out=tmp_path_factory.mktemp("run"), vehicle=Path("whill_cr_ramp"), preset="smoke", steps=200, episodes=8,
        planner=False, safety="safe", videos=1,
    )  # fmt: skip
    return options, main(options)


def test_a_run_leaves_everything_a_user_needs(run):
    options, evaluation = run
    left = {path.name for path in options.out.iterdir()}
    assert left >= {
        "run.json", "config.json", "vehicle.toml", "metrics.jsonl", "reward_curve.png", "drives.png", "camera.mp4",
        "index.html",
        "prediction.gif",
        "drives.npz", "evaluation.json", "checkpoints", "policy", "best", "best.json", "failures.png", "failures.mp4",
    }  # fmt: skip
    assert {"policy.json", "policy.onnx", "weights.npz", "vehicle.toml"} <= {
        path.name for path in (options.out / "policy").iterdir()
    }
    assert json.loads((options.out / "evaluation.json").read_text())["policy"]["episodes"] == 8
    assert evaluation["env_steps"] == json.loads((options.out / "best.json").read_text())["env_steps"]
    for driver in ("policy", "random"):
        figures = evaluation[driver]
        for name in ("return", "min_clearance_m", "path_length_m", "command_change_rad_s2", "near_misses"):
            low, high = figures[f"{name}_interval_95"]
            assert low <= figures[name] <= high
        assert figures["success"] + figures["collision"] + figures["timeout"] + figures["diverged"] == pytest.approx(1)


def test_an_evaluation_takes_the_task_from_the_run_of_its_policy(run):
    options, _ = run
    trained = find_preset("smoke", "obstacle_course").task
    task = choose_task(EvaluateOptions(str(options.out / "policy")), load_policy(options.out / "policy"))
    assert trained.gates != make_task("obstacle_course").gates  # else nothing would be told
    assert task == dataclasses.replace(trained, layout="randomised")


def test_the_same_command_again_goes_on_from_the_end_and_gives_the_same_policy(run):
    options, before = run
    lines = (options.out / "metrics.jsonl").read_text()
    again = main(dataclasses.replace(options, videos=0))  # the videos of the first time stay
    assert again["env_steps"] == before["env_steps"] and again["updates"] == before["updates"]
    assert again["policy"] == before["policy"]
    assert (options.out / "metrics.jsonl").read_text() == lines


def test_the_exported_policy_runs_on_the_bridge_and_gives_commands_within_the_limits(run):
    from bridge.policy import Policy

    options, _ = run
    policy = Policy.load(options.out / "policy")
    assert policy.contract.camera["frame"] == "base_footprint"
    policy.reset()
    frames = np.random.default_rng(0).integers(0, 256, (5, 64, 64, 3), dtype=np.uint8)
    for frame in frames:
        v, omega = policy.step(frame)
        assert 0.0 <= v <= 1.0 and -1.0 <= omega <= 1.0


def test_the_exported_policy_keeps_to_the_limits_of_its_training_by_itself(run):
    """Commands of the file change by at most 0.5 m/s and 1 rad/s from one decision (0.5 s) to the next, from rest."""
    from whill_mjx.evaluation.policies.policy_file import load_policy

    policy = load_policy(run[0].out / "policy")
    assert "command" in policy.carry
    step, carry = jax.jit(policy.step), policy.start()
    frames = np.random.default_rng(1).integers(0, 256, (6, 64, 64, 3), dtype=np.uint8)
    command = np.zeros(2)
    for frame in frames:
        carry, action = step(carry, frame)
        new = np.array([(float(action[0]) + 1) / 2, float(action[1])])
        assert (np.abs(new - command) <= np.array([0.5, 1.0]) + 1e-5).all()
        np.testing.assert_allclose(carry["command"], new, atol=1e-6)
        command = new


@pytest.mark.quick
def test_limited_actions_stay_within_reach_and_no_limit_changes_nothing():
    env, _ = make_env("corridor")
    gentle = limiter_of(Safety(acceleration=0.5, yaw_acceleration=1.0), env)
    from_rest, _ = gentle.limited(jnp.array([1.0, -1.0]), jnp.zeros(2), None, {})
    np.testing.assert_allclose(from_rest, [2 * 0.05 / 0.3 - 1, -0.1 / 0.6], atol=1e-6)
    assert limiter_of(Safety(), env) is None
    step, carry = limited_policy(None, len, {})
    assert step is len and carry == {}
    with pytest.raises(ValueError, match="must not be negative"):
        Safety(clearance_gain=-1.0)
    with pytest.raises(ValueError, match="known: none, smooth, safe, monitor"):
        find_safety("bold")


@pytest.mark.quick
def test_penalties_by_hand():
    safety = Safety(clearance_gain=40.0, clearance_margin=0.25, change_gain=0.2)
    lost = penalty(safety, jnp.array(0.15), jnp.array([0.5, -1.0]), 0.1)
    assert float(lost) == pytest.approx(40 * 0.1 * 0.1 + 0.2 * 1.5)
    assert float(penalty(safety, jnp.array(0.3), jnp.zeros(2), 0.1)) == 0.0


@pytest.mark.quick
def test_shaping_changes_the_learners_reward_and_not_the_evaluations():
    """A made-up batch: the wrapper takes the penalty off the reward, except on a first frame and in evaluations."""
    task = ObstacleCourse()
    zero = jnp.zeros(2)
    metrics = dict.fromkeys(("success", "collision", "timeout", "diverged", "time_s", "episode_return"), zero)
    told = SimpleNamespace(obs=zero, reward=jnp.ones(2), first=jnp.array([False, True]), terminated=zero > 0,
                           truncated=zero > 0, metrics={**metrics, "clearance": jnp.full(2, 0.05)})

    @dataclasses.dataclass
    class Step:
        obs: object
        reward: object
        first: object
        terminated: object
        truncated: object
        metrics: object

    commands, scene = jnp.zeros((2, 2)), SimpleNamespace(people=None)

    def step(state, action):
        return SimpleNamespace(env=SimpleNamespace(command=action, scene=scene)), Step(**vars(told))

    batch = SimpleNamespace(count=2, step=step, env=SimpleNamespace(
        task=task, height=8, width=8, model=SimpleNamespace(config=SimpleNamespace(control_dt=0.1), spec=WHILL_CR),
        repaints=False, sensors=()))
    state, action = SimpleNamespace(env=SimpleNamespace(command=commands, scene=scene)), jnp.ones((2, 2))
    new, shaped = functional_env(batch, SAFETY["safe"]).step(state, action)
    np.testing.assert_allclose(new.env.command, [[0.1, 0.2]] * 2, atol=1e-6)  # 1 m/s^2 and 2 rad/s^2 for 0.1 s
    np.testing.assert_allclose(shaped.reward, [1 - 40 * 0.1 * 0.2 - 0.2 * 0.3, 1.0], atol=1e-6)
    _, plain = functional_env(batch, SAFETY["safe"], shaped=False).step(state, action)
    np.testing.assert_allclose(plain.reward, 1.0)


@pytest.mark.quick
def test_a_run_stops_after_two_good_evaluations_or_for_a_file(tmp_path):
    stopper = Stopper(tmp_path, 0.9)
    lines = [{"env_steps": step, "eval/success": share} for step, share in ((1, 0.95), (2, 0.5), (3, 0.9), (4, 1.0))]
    assert [stopper(line) for line in lines] == [False, False, False, True]
    assert Stopper(tmp_path, 0.9).total_steps(10) == 4 and Stopper(tmp_path, 0.99).total_steps(10) == 10
    assert not Stopper(tmp_path, None)(lines[3])
    (tmp_path / "stop").touch()
    assert Stopper(tmp_path, None)(lines[0])


@pytest.mark.quick
def test_the_best_parameters_are_those_of_most_successes_then_of_most_return(tmp_path):
    told = iter([(0.5, 10.0), (0.4, 90.0), (0.5, 20.0), (0.5, 15.0)])
    preset = find_preset("smoke", "corridor")
    names = ("success", "return")
    evaluate = keep_best(tmp_path, preset, lambda params, steps: dict(zip(names, next(told), strict=True)))
    for steps in (1, 2, 3, 4):
        evaluate({"w": jnp.full(2, float(steps))}, steps)
    assert read_best(tmp_path)["env_steps"] == 3
    from dreamer.training import checkpoint

    state, _ = checkpoint.load(tmp_path / "best" / f"{3:012d}", {"params": {"w": jnp.zeros(2)}}, preset.learner)
    np.testing.assert_array_equal(state["params"]["w"], 3.0)


@pytest.mark.quick
def test_launchers_are_recognised_and_half_told_ones_refused():
    assert launched_processes({}) == (1, "") and launched_processes({"SLURM_STEP_NUM_TASKS": "1"}) == (1, "")
    assert launched_processes({"SLURM_STEP_NUM_TASKS": "4"}) == (4, "SLURM")
    assert launched_processes({"OMPI_COMM_WORLD_SIZE": "2"}) == (2, "Open MPI")
    assert join({}) == 1
    with pytest.raises(ValueError, match="JAX_COORDINATOR_ADDRESS is None"):
        join({"JAX_NUM_PROCESSES": "2", "JAX_PROCESS_ID": "0"})
    with pytest.raises(ValueError, match="devices = 99"):
        choose_devices(99)
    assert choose_devices(1) == ()


@pytest.mark.quick
def test_a_bad_vehicle_file_is_refused_before_anything_is_written(tmp_path):
    bad = tmp_path / "vehicle.toml"
    bad.write_text("schema = 9\nkind = 'micromobility-vehicle'\n")
    with pytest.raises(ValueError, match="schema is 9; this version reads schema 1"):
        main(TrainOptions(out=tmp_path / "run", vehicle=bad, preset="smoke"))
    assert not (tmp_path / "run").exists()


@pytest.mark.quick
def test_a_share_of_successes_that_can_never_come_is_refused():
    class Won(ObstacleCourse):
        def endings(self, moment):
            return {"collision": moment.collided, "won": moment.reached}

    with pytest.raises(OptionError, match=r"--stop-success 0.9: .* no ending 'success' \(it has: collision, won\)"):
        check_stop_success(0.9, Won())
    check_stop_success(None, Won())
    check_stop_success(0.9, ObstacleCourse())
    check_stop_success(0.9, make_task("follow"))


@pytest.mark.quick
def test_the_last_line_says_why_episodes_diverged():
    assert "diverged: 75% of the episodes: a reward, a" in diverged_note({"policy": {"diverged": 0.75}})
    assert diverged_note({"policy": {"diverged": 0.0}}) == ""


def contents(folder):
    """Every file below a folder and its bytes, but for the locks."""
    files = (path for path in folder.rglob("*") if path.is_file() and "lock" not in path.name)
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def heavier(folder, path):
    """The vehicle file of a run with another mass, as a file of its own."""
    text = (folder / "vehicle.toml").read_text()
    body = text.index("[body.mass]")
    path.write_text(text[:body] + text[body:].replace("value = 52.0", "value = 140.0", 1))
    return path


@pytest.mark.parametrize("name, words", [
    ("vehicle", r"vehicle is whill_cr \w+ there and whill_cr \w+ here"),
    ("seed", "seed is 0 there and 7 here"),
    ("learner", "learner is dreamer there and ppo here"),
    ("layout", "task.layout is randomised there and fixed here"),
    ("lr", "dreamer.lr is 0.0003 there and 0.01 here"),
])  # fmt: skip
def test_another_run_in_the_same_folder_is_refused_and_nothing_is_touched(run, name, words, tmp_path):
    options, _ = run
    value = {"vehicle": heavier(options.out, tmp_path / "heavy.toml"), "seed": 7, "learner": "ppo", "layout": "fixed",
             "lr": 0.01}[name]  # fmt: skip
    before = contents(options.out)
    with pytest.raises(FolderRefused, match=f"holds another run: .*{words}.*Choose another --out, or give the old"):
        main(dataclasses.replace(options, **{name: value}))
    assert contents(options.out) == before


def test_a_vehicle_file_that_was_changed_in_the_folder_of_a_run_is_refused(run, tmp_path):
    options, _ = run
    target = options.out / "vehicle.toml"
    before = target.read_text()
    heavier(options.out, target)
    try:
        for given in (None, options.vehicle):
            with pytest.raises(OptionError, match=r"whill_cr \w+.* whill_cr \w+"):
                main(dataclasses.replace(options, vehicle=given))
    finally:
        target.write_text(before)


def test_more_steps_and_what_changes_no_result_may_be_asked_of_a_run(run):
    options, _ = run
    more = dataclasses.replace(options, steps=400, episodes=3, export="last", vehicle=None)
    before = contents(options.out)
    with begin(more, choose_preset(more)) as vehicle:
        assert vehicle == options.out / "vehicle.toml"
    assert contents(options.out) == before


@pytest.mark.parametrize("loss", ["no folder", "no file", "broken file", "broken arrays"])
def test_lost_best_parameters_do_not_cost_a_finished_training_its_export(run, loss, tmp_path, capsys):
    options, _ = run
    shutil.copytree(options.out / "best", tmp_path / "best")
    told = json.loads((options.out / "best.json").read_text())
    (tmp_path / "best.json").write_text("{" if loss == "broken file" else json.dumps(told))
    if loss == "no folder":
        shutil.rmtree(tmp_path / "best")
    elif loss == "no file":
        (tmp_path / "best.json").unlink()
    elif loss == "broken arrays":
        largest = max((tmp_path / "best").rglob("*"), key=lambda path: path.stat().st_size * path.is_file())
        largest.write_bytes(b"")
    asked = dataclasses.replace(options, out=tmp_path)
    assert best_params(asked, choose_preset(asked), Trained({}, 10**6, 0, 0.0)) is None
    assert loss == "no file" or "best" in capsys.readouterr().err


def test_colleagues_can_read_what_the_users_umask_lets_them(run):
    options, _ = run
    umask = os.umask(0)
    os.umask(umask)
    for path in options.out.rglob("*"):
        if path.is_dir() and "policy" not in path.parts:
            assert path.stat().st_mode & 0o777 == 0o777 & ~umask, path


@pytest.mark.quick
@pytest.mark.parametrize("name", ["report.html", "vehicle.toml", "policy"])
def test_a_folder_with_somebodys_files_is_refused_before_the_training(tmp_path, name):
    (tmp_path / name).write_text("mine")
    with pytest.raises(FolderRefused, match=f"holds {name} of something else"):
        main(TrainOptions(out=tmp_path, vehicle=Path("whill_cr"), preset="smoke"))
    assert contents(tmp_path) == {name: b"mine"}


@pytest.mark.quick
@pytest.mark.parametrize("identity", ["{}", '{"seed": NaN}', '{"data": [1]}', '{"vehicle": {}}'])
def test_a_folder_whose_identity_lacks_what_every_training_has_is_refused(identity, tmp_path):
    (tmp_path / "run.json").write_text(f'{{"kind": "whill_mjx.train", "identity": {identity}}}')
    before = contents(tmp_path)
    with pytest.raises(FolderRefused, match="run.json does not say which run this is: it has no (data|vehicle)"):
        main(TrainOptions(out=tmp_path, vehicle=Path("whill_cr"), preset="smoke"))
    assert {**contents(tmp_path), ".lock": b""} == {**before, ".lock": b""}


@pytest.mark.quick
@pytest.mark.parametrize("words, told", [
    ("--steps 0", "--steps 0: must be at least 1"), ("--seed -1", "--seed -1: must be at least 0"),
    ("--lr nan", "--lr nan: must be above 0"), ("--lr -1", "--lr -1"), ("--episodes 0", "--episodes 0"),
    ("--train-ratio inf", "--train-ratio inf"), ("--stop-success 2", "--stop-success 2.0: must be at least 0 and"),
    ("--checkpoint-every-s nan", "--checkpoint-every-s nan"), ("--instances 0", "--instances 0"),
    ("--devices 99", "devices = 99"),
    ("--task nope", r"--task nope: unknown \(known: among_people, corridor, .*obstacle_course.*\)"),
    ("--preset nope", "--preset nope: unknown"), ("--safety nope", "--safety nope: unknown"),
    ("--vehicle nope", "unknown vehicle 'nope'.*whill_cr_paper"), ("--change lr=NaN", "lr=NaN"),
    ("--change batch_size=0", "batch_size = 0: it must be a whole number in 1"),
    ("--change batch_size=9999999999999", "batch_size = 9999999999999: it must"),
    ("--change batch_size=true", "batch_size = True"),
    ("--change min_std=2", "min_std = 2: it must be at most max_std"),
    ("--change batch_size=1000000 batch_length=1000", r"GB, .* for batch_size \(1000000\) x batch_length \(1000\)"),
    ("--instances 10000000 --change replay_capacity=1", r"GB, .* for instances \(10000000\)"),
    ("--learner ppo --change rollout=1000000", r"GB, .* for rollout \(1000000\)"),
    ("--learner ppo --change lr=true", "PpoConfig: lr is True"),
    ("--learner ppo --targets", "--targets: has an effect only with --learner dreamer"),
    ("--learner ppo --train-ratio 5", "--train-ratio: has an effect only with --learner dreamer"),
    ("--steps 5 --steps 6", "--steps: is given twice"), ("--planner --no-planner", "--no-planner: is given twice"),
    ("--set gates=1 --set goal_x=3", "--set: is given twice"), ("--vehicle ~/vehicle.toml", "put your home folder"),
    ("--lr 1e-3 --change lr=1e-3", "--lr gives it too"),
    ("--set action_repeat=2 --action-repeat 3", "--action-repeat gives it too"),
    ("--task map_goal --set map=a.osm", "a.osm: does not exist"),
    ("--set layout=fixed", "the layout has an option of its own"), ("--episodes 10000000", "--episodes 10000000"),
    ("--task :X", "is no name of a task"), ("--task ..a:X", "is no name of a task"),
    ("--change nope=1", "changes no setting"),
    ("--change mults=3", "give a finite value like it"), ("--log nowhere", "--log nowhere: no such dataset"),
    ("--log Makefile", "Makefile: "), ("--change lr=0.1 lr=0.2", "lr is given twice"),
    ("--steps 99999999999999999999", "at most 1000000000000"),
    ("--vehicle whill_cr --log .", "nothing is fitted"),
    ("--learner ppo --instances 3 --change minibatches=7", "split"),
])  # fmt: skip
def test_a_mistake_in_the_command_ends_with_one_line_and_writes_nothing(words, told, tmp_path, capsys):
    preset = [] if "--preset" in words else ["--preset", "smoke"]
    command = [*preset, "--out", str(tmp_path / "run"), *words.split()]
    with pytest.raises(SystemExit, match=f"error: .*{told}") as ended:
        command_line.run(TrainOptions, main, None, args=command)
    assert ended.value.code == command_line.REFUSED and capsys.readouterr().err.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.quick
@pytest.mark.parametrize(
    ("name", "task", "message"), [("gpu", "corridor", "unknown preset"), ("cpu", "x", "unknown task")]
)
def test_unknown_presets_and_tasks_are_named(name, task, message):
    with pytest.raises(ValueError, match=message):
        find_preset(name, task)


@pytest.mark.quick
@pytest.mark.parametrize("task", ["corridor", "obstacle_course"])
def test_the_presets_have_the_papers_limits_and_split_over_devices(task):
    from dreamer.experience.replay import rows_for

    paper, fast = find_preset("paper", task), find_preset("wallclock", task)
    assert paper.total_steps == {"corridor": 200_000, "obstacle_course": 22_000}[task] and paper.instances == 16
    assert (paper.task.v_min, paper.task.v_max) == {"corridor": (0.0, 0.3), "obstacle_course": (-1.0, 1.0)}[task]
    assert fast.task == paper.task and fast.stop_success == 0.99
    for preset in (paper, fast):
        assert rows_for(preset.learner, preset.instances) * preset.instances >= preset.learner.learning_starts
        assert preset.instances % 8 == 0 and preset.learner.batch_size % 8 == 0
        assert preset.instances * preset.ppo.rollout % preset.ppo.minibatches == 0


@pytest.mark.quick
@pytest.mark.parametrize("name, task, layout, looks, worlds", [
    ("paper", "corridor", "randomised", None, 3), ("paper", "corridor", "fixed", None, 1),
    ("paper", "obstacle_course", "randomised", None, 1), ("paper", "corridor", "randomised", "plain", 1),
    ("transfer", "corridor", "randomised", None, 1), ("transfer", "corridor", "randomised", "plain", 1),
    ("transfer", "obstacle_course", "randomised", "plain", 1), ("paper", "corridor", "fixed", "rich", 3),
    ("transfer", "obstacle_course", "randomised", None, 3),
])  # fmt: skip
def test_the_mirror_shows_no_more_worlds_than_there_are(name, task, layout, looks, worlds):
    options = TrainOptions(preset=name, task=task, layout=layout, looks=looks)
    preset = choose_preset(options)
    batch = make_evaluation_env(preset.task, "whill_cr_ramp", 1, preset.looks)
    learned = functional_env(batch, redraw=preset.learner.redraw)
    assert preset.learner.mirror == worlds <= learned.mirror.worlds
    drawn_anew = name == "transfer" and task == "corridor" and looks is None
    assert preset.learner.redraw == drawn_anew and preset.learner.recon_scale == (0.1 if name == "transfer" and
                                                                                  task == "corridor" else 1.0)
    assert preset.task.layout == layout and preset.looks == (looks or ("rich" if name == "transfer" else None))


@pytest.mark.quick
@pytest.mark.parametrize("options, said", [
    (TrainOptions(preset="paper", task="corridor", looks="plain", change=("mirror=3",)), "mirror = 3.* than 1 other"),
    (TrainOptions(preset="smoke", task="corridor", looks="rich", change=("mirror=16",)), "mirror = 16.* than 15 other"),
    (TrainOptions(preset="transfer", task="corridor", looks="plain", change=("redraw=true",)), "cannot be drawn anew"),
    (TrainOptions(preset="paper", task="corridor", change=("redraw=true",)), "mirror = 3: with redraw.*to 1"),
    (TrainOptions(preset="smoke", task="corridor", change=('decode_only=["odour"]',)), "shows no odour"),
    (TrainOptions(preset="smoke", change=("pretrain_steps=20", "pretrain_updates=2")), "pretrain_steps = 20"),
    (TrainOptions(preset="smoke", learner="ppo", change=("minibatches=7",)), "do not split into 7 minibatches"),
    (TrainOptions(preset="smoke", task="map_goal", looks="rich", steps=10), "no lane of three walls"),
])  # fmt: skip
def test_what_no_environment_of_the_training_has_is_refused_before_anything_is_written(options, said, tmp_path):
    out = tmp_path / "run"
    with pytest.raises(OptionError, match=said):
        main(dataclasses.replace(options, out=out))
    assert not out.exists()


@pytest.mark.quick
def test_the_falling_rate_spans_the_run_whatever_its_train_ratio():
    for ratio in (256.0, 512.0, 1024.0):
        learner = choose_preset(TrainOptions(preset="paper", train_ratio=ratio)).learner
        assert learner.lr_decay == 22_000 * ratio / (learner.batch_size * learner.batch_length)
        changed = choose_preset(TrainOptions(preset="paper", change=(f"train_ratio={ratio}",))).learner
        assert changed == learner
    half = choose_preset(TrainOptions(preset="paper", change=("batch_size=16",))).learner
    assert half.lr_decay == 2 * choose_preset(TrainOptions(preset="paper")).learner.lr_decay
    given = choose_preset(TrainOptions(preset="paper", change=("train_ratio=40", "lr_decay=5000"))).learner
    assert given.lr_decay == 5000


@pytest.mark.quick
def test_a_train_ratio_that_would_never_update_is_refused():
    least = choose_preset(TrainOptions(preset="cpu", train_ratio=0.001)).learner
    assert credit_rates(least, 1) == (1, 1000 * least.replayed_per_update)
    for asked in ({"train_ratio": 4e-4}, {"change": ("train_ratio=4e-4",)}):
        with pytest.raises(ValueError, match=r"train_ratio = 0\.0004: it must be a number in 0\.001\.\."):
            choose_preset(TrainOptions(preset="cpu", **asked))


@pytest.mark.parametrize("learner", ["dreamer", "ppo"])
def test_only_training_episodes_begin_anywhere(learner, tmp_path, monkeypatch):
    """Evaluations, inside the run and after it, are driven from the start, in a new world each."""
    shares, tries = [], []

    class Enough(Exception):
        pass

    def stop(*args, **kwargs):
        raise Enough

    def noted(*args, exploring_starts=0.0, **others):
        shares.append(exploring_starts)
        return make_env(*args, **others)

    def batched(*args):
        tries.append(args[5])
        return make_batch(*args)

    monkeypatch.setattr("whill_mjx.learning.setup.make_batch", batched)
    monkeypatch.setattr("whill_mjx.learning.setup.make_env", noted)
    monkeypatch.setattr("whill_mjx.learning.trainings.train", stop)
    monkeypatch.setattr("whill_mjx.learning.trainings.train_ppo", stop)
    options = TrainOptions(out=tmp_path, vehicle=Path("whill_cr_ramp"), preset="smoke", exploring_starts=0.5,
                           second_tries=0.25, learner=learner)
    with pytest.raises(Enough):
        main(options)
    assert shares[-2:] == [0.5, 0.0]  # the training, and the evaluations inside it
    assert tries[:2] == [0.25, 0.0]


@pytest.mark.quick
def test_any_setting_of_the_learner_can_be_changed_and_a_wrong_one_is_refused_by_name():
    asked = TrainOptions(preset="cpu", change=("greedy_share=0.25", "mults=[1, 2]", "online=false"))
    learner = choose_preset(asked).learner
    assert learner.greedy_share == 0.25 and learner.mults == (1, 2) and learner.online is False
    preset = choose_preset(TrainOptions(preset="cpu", learner="ppo", change=("discount=0.9",)))
    assert preset.ppo.discount == 0.9
    for wrong, told in (("greedy=1", "greedy_share"), ("greedy_share=a", "JSON"), ("greedy_share", "JSON"),
                        ("greedy_share=2", "must be a number in 0..1")):
        with pytest.raises(ValueError, match=told):
            choose_preset(TrainOptions(preset="cpu", change=(wrong,)))


@pytest.mark.quick
def test_targets_are_for_the_decoder_alone():
    plain, told = (choose_preset(TrainOptions(preset="cpu", targets=asked)).learner for asked in (False, True))
    assert plain.decode_only == () and told == dataclasses.replace(plain, decode_only=("truth",))


def test_wilson_interval_known_values():
    """98 of 100: 0.930 to 0.994 (Wilson, 95 %), from the closed form worked by hand."""
    np.testing.assert_allclose(wilson_interval(98, 100), (0.930, 0.9945), atol=5e-4)
    low, high = wilson_interval(0, 20)
    assert low == pytest.approx(0.0, abs=1e-12) and 0.15 < high < 0.17


@pytest.mark.quick
@pytest.mark.parametrize("name", ["paper", "cpu"])
@pytest.mark.parametrize("factor", [2, 4])
def test_a_longer_hold_keeps_the_budget_in_control_periods(name, factor):
    short = find_preset(name, "obstacle_course")
    long = with_repeat(short, factor * short.task.action_repeat)
    assert long.total_steps * long.task.action_repeat == short.total_steps * short.task.action_repeat
    assert long.learner.horizon * factor == short.learner.horizon
    updates = [one.total_steps * one.learner.train_ratio / one.learner.replayed_per_update for one in (short, long)]
    assert updates[1] == pytest.approx(updates[0], rel=0.05)
    assert long.learner.learning_starts * factor == pytest.approx(short.learner.learning_starts, abs=factor)
    assert long.ppo.discount == pytest.approx(short.ppo.discount**factor)
    iterations = [one.total_steps / (one.instances * one.ppo.rollout) for one in (short, long)]
    assert iterations[1] == pytest.approx(iterations[0]) and long.ppo.minibatches == short.ppo.minibatches


@pytest.mark.quick
def test_a_decision_must_hold():
    with pytest.raises(ValueError, match="action_repeat is 0"):
        with_repeat(find_preset("paper", "obstacle_course"), 0)


def test_figures_and_limits_of_a_policy_are_computed_with_all_bits(monkeypatch):
    """As the vehicle's runtime does: a GPU would round the factors of a product to TF32."""
    from whill_mjx.evaluation.policies.novelty import SURPRISE
    from whill_mjx.learning import outcome

    class Computed(Exception):
        pass

    def compute(*args):
        raise Computed(jax.config.jax_default_matmul_precision)

    options = TrainOptions(preset="smoke", planner=False)
    preset, result = choose_preset(options), Trained({}, 0, 0, 0.0)
    monkeypatch.setattr(outcome, "policy_of", lambda *args: (None, {SURPRISE: jnp.zeros(1)}))
    monkeypatch.setattr(outcome, "evaluate_drivers", compute)
    monkeypatch.setattr(outcome, "largest_surprise", compute)
    with pytest.raises(Computed, match="highest"):
        outcome.evaluate_policy(options, preset, "whill_cr_ramp", result)
    with pytest.raises(Computed, match="highest"):
        outcome.export(options, preset, "whill_cr_ramp", result, Path("policy"))
