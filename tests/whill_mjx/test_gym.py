"""The Gymnasium adapters: one vehicle, and many."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, AutoresetMode

from whill_mjx.gym import WhillEnv, kinds
from whill_mjx.gym.kinds import as_actions
from whill_mjx.gym.vector import WhillVectorEnv
from whill_mjx.sensors.goal import Goal
from whill_mjx.tasks.map_goal import MapGoal
from whill_mjx.tasks.point_goal import PointGoal
from whill_mjx.tasks.tasks import TASKS, ObstacleCourse

SHORT = ObstacleCourse(max_steps=4)
SMALL = {"task": SHORT, "height": 8, "width": 8}
STILL = np.array([0.0, 0.0], np.float32)
FRESH = """
import sys
import gymnasium, jax
import whill_mjx.gym
compiled = []
jax.monitoring.register_event_duration_secs_listener(
    lambda name, seconds, **about: name.endswith("backend_compile_duration") and compiled.append(about.get("fun_name")))
for seed in range(2):
    env = gymnasium.make("WhillObstacleCourse-v0", height=8, width=8)
    env.reset(seed=seed)
    env.step(env.action_space.sample())
    print(len(compiled))
print("mujoco" in sys.modules, file=sys.stderr)
"""


@pytest.fixture(scope="module")
def env():
    return WhillEnv(**SMALL, render_mode="rgb_array")


def test_gymnasiums_own_checker_is_satisfied(env):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*spec.*")  # not made by gymnasium.make
        check_env(env, skip_render_check=True)


def test_seeds_decide_the_world_and_info_tells_the_pose(env):
    one, info = env.reset(seed=3)
    other, _ = env.reset(seed=3)
    third, _ = env.reset(seed=4)
    np.testing.assert_array_equal(one, other)
    assert (one != third).any()
    assert {"x", "y", "yaw", "v", "omega", "collision", "success"} <= set(info)
    assert info["x"] == pytest.approx(0.0, abs=1e-4) and info["collision"] is False
    obs, reward, terminated, truncated, info = env.step(np.array([1.0, 0.0]))
    assert info["v"] > 0.05 and isinstance(reward, float) and terminated is False and truncated is False
    np.testing.assert_array_equal(env.render(), obs)


def test_observations_are_the_users_own(env):
    image, _ = env.reset(seed=3)
    image[:] = 7
    again, *_ = env.step(STILL)
    assert (image == 7).all() and (again != 7).any()
    again[:] = 7
    assert (env.render() != 7).any()


def test_misuse_is_explained(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    fresh = WhillEnv(**SMALL)
    assert fresh.render() is None
    with pytest.raises(RuntimeError, match="reset"):
        fresh.step(np.zeros(2))
    with pytest.raises(ValueError, match="display.*rgb_array"):
        WhillEnv(render_mode="human")
    with pytest.raises(ValueError, match="rgb_array"):
        WhillEnv(render_mode="ansi")
    with pytest.raises(ValueError, match="num_envs is 0"):
        WhillVectorEnv(0)


def test_actions_of_a_wrong_shape_are_refused(env):
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"\(3,\)"):
        env.step(np.zeros(3))


def test_every_known_task_has_an_id_and_ids_make_environments():
    assert all(f"Whill{name.title().replace('_', '')}-v0" in gymnasium.registry for name in TASKS)
    made = gymnasium.make("whill_mjx.gym:WhillCorridor-v0", layout="fixed", height=8, width=8)
    assert made.unwrapped.env.task.name == "corridor" and made.observation_space.shape == (8, 8, 3)
    many = gymnasium.make_vec("WhillCorridor-v0", num_envs=3, layout="fixed", height=8, width=8)
    assert isinstance(many.unwrapped, WhillVectorEnv) and many.observation_space.shape == (3, 8, 8, 3)


def test_environments_of_one_kind_share_what_is_compiled(env):
    other = WhillEnv(**SMALL)
    env.reset(seed=0)
    assert other._kind is env._kind
    sizes = env._kind.reset._cache_size()
    other.reset(seed=0)
    assert env._kind.reset._cache_size() == sizes
    env.step(STILL)
    other.step(STILL)
    other.step(STILL)  # from a state of a step, not of a reset
    assert env._kind.step._cache_size() == 1
    assert WhillEnv(task="obstacle_course", height=8, width=8)._kind is not env._kind


def test_a_fresh_process_compiles_a_reset_and_a_step_and_a_further_environment_nothing():
    """Each small program beside these two, such as one that makes a number an array, would cost a tenth of a second on
    an accelerator."""
    found = subprocess.run([sys.executable, "-c", FRESH], capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["2", "2"]
    assert found.stderr.split()[-1] == "False"  # our own step needs no MuJoCo, whose import takes as long


def test_a_pickled_or_copied_environment_goes_on_where_it_was(env):
    env.reset(seed=5)
    env.step(np.array([1.0, 0.5]))
    others = [pickle.loads(pickle.dumps(env)), copy.deepcopy(env)]
    wanted = env.step(np.array([1.0, -0.5]))
    for other in others:
        found = other.step(np.array([1.0, -0.5]))
        np.testing.assert_array_equal(found[0], wanted[0])
        assert found[1:] == wanted[1:]
        assert other.np_random.integers(2**31) == copy.deepcopy(env.np_random).integers(2**31)


def test_a_copied_vector_of_a_map_goes_on_where_it_was():
    """Its state knows the map's walls, and they must be those in which the next episode begins."""
    env = WhillVectorEnv(1, MapGoal(map="made:1", max_steps=2), observations=("goal",))
    env.reset(seed=0)
    env.step(STILL[None])
    for other in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        for _ in range(3):
            theirs = other.step(STILL[None])
        assert theirs[0]["goal"].shape == (1, 2)
        assert other._kind.step_or_reset._cache_size() == 1  # nothing is compiled again
    for _ in range(3):
        ours = env.step(STILL[None])
    np.testing.assert_array_equal(ours[0]["goal"], theirs[0]["goal"])


def test_options_change_the_episode_and_unknown_ones_are_refused(env):
    env.reset(seed=1)
    _, info = env.reset(seed=1, options={"start_y": 0.25})
    assert info["y"] == pytest.approx(0.25, abs=1e-3)
    unknown, text = "no option 'start_z'.*known: .*start_y", "light is 'dim'; it must be a number"
    for wrong, words in (({"start_z": 1.0}, unknown), ({"light": "dim"}, text)):
        with pytest.raises(ValueError, match=words):
            env.reset(options=wrong)


def test_a_vector_begins_in_the_worlds_of_single_environments(env):
    many = WhillVectorEnv(2, **SMALL)
    obs, _ = many.reset(seed=7)
    single = [env.reset(seed=7 + index)[0] for index in range(2)]
    np.testing.assert_array_equal(obs, np.stack(single))


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_each_mode_begins_anew_as_gymnasium_defines_it(mode):
    many = WhillVectorEnv(2, **SMALL, autoreset_mode=mode)
    assert many.metadata["autoreset_mode"] == mode
    many.reset(seed=0)
    drive = np.array([[1.0, 0.0], [0.2, 0.0]], np.float32)
    for _ in range(3):
        _, _, _, truncated, info = many.step(drive)
        assert not truncated.any()
    before = info["x"]
    obs, reward, terminated, truncated, info = many.step(drive)
    assert truncated.all() and not terminated.any() and reward.shape == (2,)
    if mode == AutoresetMode.SAME_STEP:
        assert info["x"] == pytest.approx([0.0, 0.0], abs=1e-3)
        assert info["_final_obs"].all() and info["final_obs"][0].shape == obs[0].shape
        assert info["final_info"]["x"][0] > before[0]
        return
    assert (info["x"] > before).all()
    if mode == AutoresetMode.NEXT_STEP:
        _, reward, _, truncated, info = many.step(drive)
        assert not truncated.any() and not reward.any() and info["x"] == pytest.approx([0.0, 0.0], abs=1e-3)
        return
    with pytest.raises(RuntimeError, match="reset_mask"):
        many.step(drive)
    _, info = many.reset(options={"reset_mask": np.array([True, False])})
    assert info["x"][0] == pytest.approx(0.0, abs=1e-3) and info["x"][1] > 0.01
    assert info["_x"].tolist() == [True, False]
    with pytest.raises(ValueError, match="reset_mask has shape"):
        many.reset(options={"reset_mask": np.array([True])})


def test_a_seed_with_a_mask_leaves_the_random_numbers_of_the_other_instances():
    """As Gymnasium's SyncVectorEnv, which resets those of the mask alone."""
    some, none = (WhillVectorEnv(num_envs=2, **SMALL) for _ in range(2))
    for many in (some, none):
        many.reset(seed=0)
    masked, _ = some.reset(seed=9, options={"reset_mask": np.array([True, False])})
    afresh, _ = WhillVectorEnv(num_envs=2, **SMALL).reset(seed=9)
    np.testing.assert_array_equal(masked[0], afresh[0])
    (first, _), (second, _) = some.reset(), none.reset()
    np.testing.assert_array_equal(first[1], second[1])
    assert (first[0] != second[0]).any()


def test_sensors_make_a_dict_and_its_spaces_hold_what_is_shown():
    env = WhillEnv(task=SHORT, observations=("goal", "lidar", "odometry", "commands"), render_mode="rgb_array",
                   height=8, width=8)  # fmt: skip
    obs, _ = env.reset(seed=0)
    assert set(obs) == {"goal", "lidar", "odometry", "commands"} and env.observation_space.contains(obs)
    obs = env.step(np.array([1.0, 0.0]))[0]
    assert env.observation_space.contains(obs) and env.render().shape == (8, 8, 3)


@pytest.mark.filterwarnings("ignore:.*fork.*")
def test_forked_workers_are_refused_at_once_with_the_remedy(env):
    env.reset(seed=0)
    workers = AsyncVectorEnv([lambda: WhillEnv(**SMALL)] * 2, context="fork")
    try:
        with pytest.raises(RuntimeError, match='context="spawn"'):
            workers.reset(seed=0)
    finally:
        workers.close(terminate=True)


@pytest.mark.quick
def test_a_video_runs_at_the_speed_of_the_simulation():
    assert WhillEnv(**SMALL).metadata["render_fps"] == 10.0
    slow = {**SMALL, "task": ObstacleCourse(max_steps=4, action_repeat=5)}
    assert WhillEnv(**slow).metadata["render_fps"] == WhillVectorEnv(1, **slow).metadata["render_fps"] == 2.0
    assert WhillEnv.metadata["render_fps"] == 10


def test_a_video_is_recorded(tmp_path):
    pytest.importorskip("moviepy")
    made = gymnasium.make("WhillCorridor-v0", layout="fixed", height=8, width=8, render_mode="rgb_array")
    recorded = gymnasium.wrappers.RecordVideo(made, str(tmp_path), video_length=2, disable_logger=True)
    recorded.reset(seed=0)
    for _ in range(3):
        recorded.step(STILL)
    recorded.close()
    assert list(tmp_path.glob("*.mp4"))


@pytest.mark.quick
@pytest.mark.parametrize(
    "actions",
    [None, 0, np.zeros(3), "ab", ["1", "2"], {"a": 1}, object(), [10**400, 0], [[0], [0, 0]], np.zeros(2, complex)],
    ids=["none", "zero", "three", "letters", "texts", "table", "object", "huge", "ragged", "complex"],
)
def test_actions_that_are_no_numbers_are_refused_in_one_line(actions):
    with pytest.raises(ValueError, match="^the action .*must be numbers of shape") as refused:
        as_actions(actions, (2,))
    assert len(str(refused.value)) < 250


@pytest.mark.quick
def test_a_vector_is_pickled_and_refuses_what_it_cannot_mean():
    vector = WhillVectorEnv(2, task="point_goal", observations=["goal"], autoreset_mode="Disabled")
    other = pickle.loads(pickle.dumps(vector))
    assert other.num_envs == 2 and other.autoreset_mode == vector.autoreset_mode
    assert other.observation_space == vector.observation_space
    for seed in ([1], "ab", 1.5, [1, "x"]):
        with pytest.raises(ValueError, match="^seed is .*it must be a whole number, or a list of 2"):
            vector.reset(seed=seed)
    for options in (3, [1], {"reset_mask": [1, 0]}, {"reset_mask": "x"}):
        with pytest.raises(ValueError, match="options is|reset_mask has"):
            vector.reset(options=options)
    for count in (0, True, 1.5, 10**12, "3"):
        with pytest.raises(ValueError, match="num_envs is"):
            WhillVectorEnv(count)
    with pytest.raises(ValueError, match="a pair is a VehicleSpec and its VehicleParams"):
        WhillVectorEnv(2, vehicle=(1, 2))


@pytest.mark.quick
@pytest.mark.parametrize(("arguments", "said"), [
    ({"vehicle": 3}, "^vehicle is 3; it must be a vehicle file, the name of"),
    ({"vehicle": {"mass": 3}}, "^vehicle is {'mass': 3}; it must be"),
    ({"vehicle": [1, 2]}, r"^vehicle is \[1, 2\]"),
    ({"vehicle": (None, None)}, "^vehicle is .NoneType, NoneType.; a pair"),
    ({"observations": {"a": {"x": 1}}}, "^observation 'a' is {'x': 1}, no sensor"),
    ({"observations": {1: Goal(), "1": Goal()}}, "a name is there twice"),
    ({"observations": ("gaol",)}, "^unknown sensor 'gaol'"),
    ({"layout": ["fixed"]}, "layout is"), ({"task": PointGoal}, "^task is <class .*give a Task such as"),
])  # fmt: skip
def test_arguments_of_a_wrong_kind_are_refused_in_one_line(arguments, said):
    for kind in (WhillEnv, lambda **given: WhillVectorEnv(2, **given)):
        with pytest.raises(ValueError, match=said) as caught:
            kind(**({"task": "point_goal"} | arguments))
        assert "\n" not in str(caught.value)


@pytest.mark.quick
def test_an_edited_file_of_a_task_is_read_anew_in_the_same_process(tmp_path):
    path = tmp_path / "edited.py"
    text = ("from dataclasses import dataclass\nfrom whill_mjx import Task\n\n"
            "@dataclass(frozen=True)\nclass Mine(Task):\n    max_steps: int = ")
    for steps in (60, 30):
        path.write_text(f"{text}{steps}\n")
        assert WhillEnv(f"{path}:Mine").env.task.max_steps == steps
    assert type(WhillEnv(f"{path}:Mine").env.task) is type(WhillEnv(f"{path}:Mine").env.task)


@pytest.mark.quick
def test_names_of_observations_may_be_of_several_types_and_modes_of_no_kind_are_refused():
    assert set(WhillEnv("point_goal", observations={1: Goal(), "a": Goal()}).observation_space) == {"1", "a"}
    with pytest.raises(ValueError, match="autoreset_mode is 'same_step'; use one of .*'SameStep'"):
        WhillVectorEnv(2, task="point_goal", autoreset_mode="same_step")


@pytest.mark.quick
def test_options_that_are_no_dict_are_refused():
    from whill_mjx.gym.kinds import condition_of

    with pytest.raises(ValueError, match="must be a dict"):
        condition_of([1])


@pytest.mark.quick
@pytest.mark.parametrize(("name", "value"), [
    ("light", -1), ("light", 1e9), ("start_x", float("nan")), ("start_y", "0.2"), ("start_yaw_deg", 1e6),
    ("obstacle_x", True), ("start_x", 10**400),
])  # fmt: skip
def test_an_option_out_of_its_range_is_refused_by_name_and_value(name, value):
    with pytest.raises(ValueError, match=f"reset: option {name} is .* it must"):
        kinds.condition_of({name: value})



def test_options_are_those_that_an_episode_can_begin_with():
    assert "start_yaw_deg" in kinds.OPTIONS and "latency" not in kinds.OPTIONS
