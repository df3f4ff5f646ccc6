"""A task of a user's own, outside the package: the one that docs/tasks.md shows, and wrong ones."""

from __future__ import annotations

import json
import re
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import jax
import jax.numpy as jnp
import marker_seeker
import numpy as np
import pytest

from whill_mjx.env import make_env, reset, reset_state, step, step_state, view_of
from whill_mjx.evaluation.options import EvaluateOptions
from whill_mjx.evaluation.policies.policy_file import load_policy
from whill_mjx.evaluation.preparation import choose_task
from whill_mjx.io.command_line import OptionError
from whill_mjx.io.registry import Registry
from whill_mjx.learning.setup import find_preset
from whill_mjx.sensors.base import Reading, Sensor, check_sensor
from whill_mjx.tasks import tasks
from whill_mjx.tasks.base import Budget, Task
from whill_mjx.tasks.corridor import Corridor
from whill_mjx.tasks.options import named_task, read_fields
from whill_mjx.tasks.tasks import TASKS, find_task, make_task, register_task, source_of, unregister_task
from whill_mjx.world import solids

PAGE = Path(__file__).parents[2] / "docs" / "tasks.md"
LINES = 60
"""Most lines that a task of one's own may take."""


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """The page's task as a file."""
    text = re.search(r"```python\n(\"\"\"parking.py.*?)```", PAGE.read_text(), re.DOTALL).group(1)
    path = tmp_path_factory.mktemp("user") / "parking.py"
    path.write_text(text)
    return path


@pytest.mark.quick
@pytest.mark.parametrize("changed", [False, True])
def test_an_evaluation_says_whether_the_task_is_that_of_the_training(file, tmp_path, capsys, changed):
    name = f"{file}:Parking"
    folder = marker_seeker.write(tmp_path / "policy", task=name)
    task_file = "0" * 64 if changed else source_of(make_task(name))
    note = {"identity": {"task_file": task_file}, "preset": {"task": {"bay_x": 2.5}}}
    (tmp_path / "run.json").write_text(json.dumps(note))
    assert choose_task(EvaluateOptions(str(folder)), load_policy(folder)).bay_x == 2.5
    said = "".join(capsys.readouterr())
    assert ("its file has changed since the training" in said) == changed
    assert ("as in the training" in said) != changed


@pytest.mark.quick
def test_the_pages_task_is_short_and_found_by_its_file(file):
    assert len(file.read_text().splitlines()) <= LINES
    task = make_task(f"{file}:Parking", bay_x=2.5)
    assert task.name == "parking" and task.bay_x == 2.5 and len(source_of(task)) == 64
    assert source_of(Corridor()) is None
    assert find_preset("cpu", task).total_steps == 100_000 and find_preset("cpu", task).instances == 32
    assert task.sweeps and type(find_task(f"{file}:Parking")) is type(task)


def test_its_rewards_endings_and_observations_are_those_of_the_step(file):
    env, params = make_env(f"{file}:Parking", layout="fixed")
    state = jax.jit(lambda key: reset_state(env, params, key))(jax.random.key(0))
    step = jax.jit(lambda state, action: step_state(env, params, state, action))
    still = jnp.array([-1 / 3, 0.0])  # 0 m/s between -0.4 and 0.8
    _, outcome = step(state, still)
    assert float(outcome.reward) == pytest.approx(-0.05, abs=0.02)
    assert set(outcome.metrics) >= {"lost", "success", "collision"} and not outcome.metrics["lost"]
    far = jnp.zeros_like(state.vehicle.qpos).at[0].set(-4.0)
    moved = type(state.vehicle)(**{**vars(state.vehicle), "qpos": state.vehicle.qpos + far})
    _, outcome = step(type(state)(**{**vars(state), "vehicle": moved}), still)
    assert outcome.metrics["lost"] == 1 and bool(outcome.terminated) and not outcome.metrics["collision"]
    assert [name for name, _ in env.sensors] == ["goal", "lidar", "odometry"]


@pytest.mark.quick
def test_the_commands_take_its_file_and_its_fields(file):
    from whill_mjx.evaluation.options import EvaluateOptions
    from whill_mjx.evaluation.preparation import choose_task
    from whill_mjx.learning.options import TrainOptions, choose_preset

    options = TrainOptions(task=f"{file}:Parking", preset="cpu", layout="fixed", set=("bay_x=2.8", "action_repeat=3"))
    task = choose_preset(options).task
    assert (task.bay_x, task.layout, task.action_repeat) == (2.8, "fixed", 3)
    chosen = choose_task(EvaluateOptions(policy="random", task=f"{file}:Parking", set=("max_steps=20",)), None)
    assert chosen.name == "parking" and chosen.max_steps == 20


@pytest.mark.long
def test_it_is_trained_and_evaluated_from_the_command_line(file, tmp_path):
    from whill_mjx import evaluate, train

    reference, run = f"{file}:Parking", tmp_path / "run"
    train.main(train.TrainOptions(
        out=run, task=reference, vehicle=Path("whill_cr_ramp"), preset="smoke", learner="ppo", steps=64, eval_every=64,
        episodes=4, planner=False, videos=0, set=("bay_x=2.8",),
    ))  # fmt: skip
    trained = json.loads((run / "evaluation.json").read_text())
    assert trained["task"]["bay_x"] == 2.8 and "lost" in trained["policy"]
    table = json.loads((run / "policy" / "policy.json").read_text())
    assert table["observation"] == {"goal": [2], "lidar": [24], "odometry": [5]} and table["task"] == reference
    found = evaluate.main(evaluate.EvaluateOptions(policy=str(run), out=tmp_path / "eval", episodes=4, videos=0))
    assert found["task"]["name"] == "parking" and found["task"]["bay_x"] == 2.8
    assert {"lost", "success"} <= set(found["drivers"]["policy"])


@pytest.mark.quick
@pytest.mark.parametrize(("text", "reference", "said"), [
    ("", "{file}:Parkign", "has no task 'Parkign' .known: none"),
    ("x = ", "{file}:Parking", "cannot be imported: SyntaxError"),
    ("import whill_mjx_nowhere", "{file}:Parking", "line 1: cannot be imported: No module named 'whill_mjx_nowhere'"),
    ("import math\nx = float('0,5')", "{file}:Parking", "{file}, line 2: cannot be imported: ValueError: could.*0,5"),
    ("from dataclasses import dataclass\n@dataclass\nclass Parking:\n    bay: list = []", "{file}:Parking",
     "{file}, line 2: cannot be imported: ValueError: mutable default.*Correct the file"),
    ("raise RuntimeError('two\\nlines.')", "{file}:Parking", "line 1: cannot be imported: RuntimeError: two lines. C"),
    ("Parking = 3", "{file}:Parking", "3 is no task"),
    ("", "nowhere.py:Parking", "no such file nowhere.py"),
    ("", "no_module_at_all:Parking", "No module named 'no_module_at_all'"),
    ("", "parkign", "known: .*corridor.*obstacle_course"),
])  # fmt: skip
def test_a_task_that_cannot_be_had_is_one_line(text, reference, said, tmp_path):
    path = tmp_path / f"wrong_{abs(hash((text, reference)))}.py"
    path.write_text(text)
    reference = reference.format(file=path)
    with pytest.raises(OptionError, match=said.format(file=path)) as caught:
        named_task(reference)
    assert "\n" not in str(caught.value) and str(caught.value).startswith(f"--task {reference}: ")


@pytest.mark.quick
def test_a_module_that_cannot_be_imported_is_named_with_its_line(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "wrong_room").mkdir()
    (tmp_path / "wrong_room" / "bays.py").write_text("import math\nimport whill_mjx_nowhere")
    with pytest.raises(ValueError, match="wrong_room.bays, line 2: cannot be imported: No module named .*Install it"):
        find_task("wrong_room.bays:Parking")
    with pytest.raises(ValueError, match="No module named 'wrong_room.bay'. Give package.module:TASK"):
        find_task("wrong_room.bay:Parking")


HEAD = """from dataclasses import dataclass
import jax.numpy as jnp, numpy as np
from whill_mjx import Task, World

class Base(Task):  # a helper that is no task of its own must not stand in the way of the others
    pass

@dataclass(frozen=True)
class Mine(Task):
"""


def refused(folder, body, said):
    """The file of a task with this line in its class, after a command has refused it in one line."""
    path = folder / f"wrong_{abs(hash(body))}.py"
    path.write_text(f"{HEAD}    {body}\n")
    with pytest.raises(OptionError, match=said) as caught:
        named_task(f"{path}:Mine")
    assert "\n" not in str(caught.value)
    return path


@pytest.mark.quick
@pytest.mark.parametrize(("method", "said"), [
    ("sample_world(self, key): raise KeyError('pillar')", "sample_world, line 10: KeyError: 'pillar'"),
    ("sample_world(self, key): return 1", "sample_world: returns .*must be a World"),
    ("sample_world(self, key): return World(Task().sample_world(key).scene, jnp.zeros(2))", r"start has shape .2,."),
    ("rewards(self, moment): return {'a': moment.goal_distnce}", "rewards, line 10: AttributeError: .*goal_distnce"),
    ("rewards(self, moment): return {'a': moment.twist}", r"'a' is float32 of shape .2,."),
    ("rewards(self, moment): return moment.goal_distance", "rewards: returns float32.*a dict of numbers"),
    ("rewards(self, moment): return {'a': 1.0 if moment.collided else 0.0}", "jnp.where for if"),
    ("rewards(self, moment): return {'a': np.exp(moment.goal_distance)}", "jax.numpy for numpy"),
    ("endings(self, moment): return {'success': moment.goal_distance}", "'success' is float32"),
    ("endings(self, moment): pass", "endings: returns NoneType"),
    ("rewards(self, moment): return {}", "rewards: returns an empty dict"),
    ("rewards(self, moment): return {1: moment.time_s}", "rewards: has the name 1; it must be a text"),
    ("rewards(self, moment): raise SystemExit(0)", "rewards, line 10: SystemExit"),
    ("observations(self): return None", "observations: TypeError"),
    ("observations(self): return ['nope']", "observations: ValueError: unknown sensor 'nope'"),
    ("goal(self, scene): return 1.0", "goal: returns .*array .2,."),
    ("reward(self, moment): return {}", "'reward' is never used; 'rewards' would be"),
    ("sample_world(self, key): return World(None, jnp.zeros(3))", "scene of its World is NoneType.*must be a Scene"),
    ("sample_world(self, key): return World(Task().sample_world(key).scene, [0, 0, 0])", "start is list; it must be"),
    ("endings(self, moment): return {'sucess': moment.reached}", "'sucess' is not counted as 'success'"),
    ("endings(self, moment): return {'colision': moment.collided}", "'colision' is not counted as 'collision'"),
    ("rewards(self, moment): return {'a': moment.time_s}\n    per_period = ('tiem',)", "per_period has 'tiem'.* a."),
])  # fmt: skip
def test_a_method_that_cannot_work_is_named_before_anything_is_compiled(method, said, tmp_path):
    path = refused(tmp_path, f"def {method}", said)
    with pytest.raises(ValueError, match=said):
        make_env(find_task(f"{path}:Mine"))


@pytest.mark.quick
@pytest.mark.parametrize(("body", "said"), [
    ("max_steps = 50", "its 'max_steps' has no type, so that the default 150 would stay. Write max_steps: int = "),
    ("max_step: int = 50", "'max_step' is never used; 'max_steps' would be"),
    ("v_maxx: float = 0.5", "'v_maxx' is never used; 'v_max' would be"),
    ("look = 'paper'", "'look' is never used; 'looks' would be"),
    ("budget = {}", "'budget' is never used; 'budgets' would be"),
])  # fmt: skip
def test_a_name_that_the_library_would_pass_over_is_refused(body, said, tmp_path):
    refused(tmp_path, body, said)


@pytest.mark.quick
def test_names_of_ones_own_may_be_like_those_of_the_library_where_something_reads_them(tmp_path):
    path = tmp_path / "alike.py"
    path.write_text(f"{HEAD}    max_step: int = 50\n    stop_reward: float = 3.0\n    v_max: float = 0.5\n"
                    "    def reward(self, moment): return self.max_step * moment.time_s\n"
                    "    def rewards(self, moment): return {'a': self.reward(moment), 'b': stopped(self, moment)}\n"
                    "def stopped(task, moment): return task.stop_reward * moment.time_s\n")  # fmt: skip
    assert named_task(f"{path}:Mine").v_max == 0.5


@pytest.mark.quick
@pytest.mark.parametrize(("body", "said"), [
    ("    bay: list = None\n    def __post_init__(self): object.__setattr__(self, 'bay', [])", "unhashable"),
    ("    name = 'a b'", "its name is 'a b'; it must be letters"), ("    name = 3", "its name is 3"),
    ("    name = 'corridor'", "it is called 'corridor', as one of whill_mjx"),
    ("    budgets = 3", "budgets is 3; it must be a dict of Budgets"),
    ("    sweeps = 3", "sweeps is 3; it must be a tuple"),
    ("    walls = '3'", "walls is '3'; it must be a whole number"),
    ("    lane = 'no'", "lane is 'no'; it must be True"),
    ("    from whill_mjx.io.fields import Field\n    ranges = (Field('nope', 'm', 0, 1),)",
     "ranges is .*names of its fie"),
    ("    def __post_init__(self): raise KeyError('x')", "KeyError: 'x'"),
    ("    def __post_init__(self): raise SystemExit(0)", "SystemExit: 0"),
    ("    import sys; sys.exit(0)", "SystemExit: 0"),
    ("    bay: float = field(kw_only=True)", "missing 1 required keyword-only argument: 'bay'"),
])
def test_a_task_that_cannot_be_made_is_one_line(body, said, tmp_path):
    path = tmp_path / f"unmade_{abs(hash(body))}.py"
    path.write_text(f"{HEAD.replace('import dataclass', 'import dataclass, field')}{body}\n")
    with pytest.raises(OptionError, match=said):
        named_task(f"{path}:Mine")


@pytest.mark.quick
@pytest.mark.parametrize("budgets", [{"smok": Budget(10)}, {"smoke": 400}])
def test_a_budget_of_no_preset_or_of_no_kind_is_refused(budgets):
    kind = type("Mistaken", (Task,), {"budgets": budgets})
    with pytest.raises(ValueError, match="budgets has 'smok"):
        find_preset("smoke", dataclass(frozen=True)(kind)())


@pytest.mark.quick
@pytest.mark.parametrize("name", ["fields", "learner", "ppo"])
def test_settings_of_a_budget_that_are_no_dict_are_refused(name):
    with pytest.raises(ValueError, match=f"budget: {name} is 3; it must be a dict"):
        Budget(100, **{name: 3})


SENSOR = """
@dataclass(frozen=True)
class Own(Sensor):
    def begin(self, view): return jnp.zeros(1)
    def reading(self, env): {reading}
    def measure(self, memory, view, key): {measure}
"""
SHAPE, VALUE = "return Reading((2,))", "return memory, view.moment.pose[:2]"


@pytest.mark.quick
@pytest.mark.parametrize(("reading", "measure", "said"), [
    (SHAPE, "return memory, view.moment.pose", "measured .3,., but its reading says .2,."),
    (SHAPE, "return view.moment.pose[:2]", "it must be the pair"),
    (SHAPE, "return None", "measure returns NoneType; it must be the pair"),
    (SHAPE, "return (), view.moment.pose[:2]", "both must be alike"),
    (SHAPE, "raise KeyError('x')", "KeyError: 'x'"), (SHAPE, "raise SystemExit(0)", "SystemExit: 0"),
    ("return None", VALUE, "reading returns NoneType; it must be a Reading"), ("return Reading((-1,))", VALUE, "shape"),
    ("return Reading((2,), low=5, high=-5)", VALUE, "the lower bound"), ("raise KeyError('x')", VALUE, "KeyError"),
    ("return Reading((10**12,))", VALUE, "at most 100000000"), ("return Reading((2,), dtype='x')", VALUE, "TypeError"),
])  # fmt: skip
def test_a_sensor_that_cannot_work_is_named_before_anything_is_compiled(reading, measure, said, seen):
    found = {"Sensor": Sensor, "Reading": Reading, "dataclass": dataclass, "jnp": jnp, "__name__": "mine"}
    exec(SENSOR.format(reading=reading, measure=measure), found)
    with pytest.raises(ValueError, match=f"^sensor 's', Own: .*{said}") as caught:
        check_sensor("s", found["Own"](), *seen)
    assert "\n" not in str(caught.value)


@pytest.fixture(scope="module")
def seen():
    """What a sensor may look at in a state, and the state's shapes."""
    env, params = make_env("corridor")
    state = jax.eval_shape(lambda seed: reset_state(env, params, jax.random.key(seed)), 0)
    return lambda state: view_of(env, params, state), state


@pytest.mark.quick
@pytest.mark.parametrize(("body", "said"), [
    ("noise = 0.5", "its 'noise' has no type, so that the default 0.0 would stay"),
    ("latency = 0.5", "'latency' is never used; 'latency_s' would be"),
])
def test_a_field_of_a_sensor_that_would_be_passed_over_is_refused(body, said, seen):
    found = {"Sensor": Sensor, "Reading": Reading, "dataclass": dataclass, "jnp": jnp, "__name__": "mine"}
    exec(SENSOR.format(reading=SHAPE, measure=VALUE) + f"    {body}\n", found)
    with pytest.raises(ValueError, match=f"^sensor 's': {said}"):
        check_sensor("s", found["Own"](), *seen)


@pytest.mark.quick
def test_make_env_checks_sensors_of_others():
    found = {"Sensor": Sensor, "Reading": Reading, "dataclass": dataclass, "jnp": jnp, "__name__": "mine"}
    exec(SENSOR.format(reading=SHAPE, measure="return 1"), found)
    with pytest.raises(ValueError, match="^sensor 's', Own: "):
        make_env("corridor", observations={"s": found["Own"]()})


@pytest.mark.quick
def test_a_reward_that_is_no_number_ends_the_episode_as_diverged_and_counts_nothing():
    kind = type("Broken", (Task,), {"rewards": lambda self, moment: {"a": moment.time_s * jnp.nan}})
    env, params = make_env(dataclass(frozen=True)(kind)())
    state = jax.jit(lambda key: reset_state(env, params, key))(jax.random.key(0))
    _, outcome = jax.jit(lambda state: step_state(env, params, state, jnp.zeros(2)))(state)
    assert outcome.reward == 0 and outcome.terminated and outcome.metrics["diverged"] == 1


@pytest.mark.quick
def test_a_reading_that_is_no_number_is_shown_as_0_and_ends_the_episode_and_none_leaves_its_bounds():
    def own(reading, measure):
        found = {"Sensor": Sensor, "Reading": Reading, "dataclass": dataclass, "jnp": jnp, "__name__": "mine"}
        exec(SENSOR.format(reading=f"return {reading}", measure=f"return memory, {measure}"), found)
        return found["Own"]()

    for measure, ends in (("jnp.stack([v.time_s, 0 / (v.time_s * 0)])", 1.0), ("jnp.stack([v.time_s, v.time_s])", 0.0)):
        measure = measure.replace("v.", "view.moment.")
        sensors = {"s": own("Reading((2,))", measure), "c": own("Reading((1,), 0, 1)", "jnp.array([7.0])"),
                   "b": own("Reading((2,), 0, 255, 'uint8')", "jnp.array([300, -20])")}
        env, params = make_env("corridor", observations=sensors)
        state, first = jax.jit(lambda key, env=env, params=params: reset(env, params, key))(jax.random.key(0))
        assert np.isfinite(first.obs["s"]).all() and list(first.obs["b"]) == [255, 0] and first.obs["c"] == 1.0
        _, second = jax.jit(lambda state, env=env, params=params: step(env, params, state, jnp.zeros(2)))(state)
        assert second.metrics["diverged"] == ends and bool(second.terminated) == bool(ends)


@dataclass(frozen=True)
class Slalom(Corridor):
    """Another task's child, with neither name nor budget of its own."""

    poles: tuple[float, ...] = (1.0, 2.0)


@dataclass(frozen=True)
class Polite(Corridor):
    """Another task's child that looks at its people, with a post of its own where it is wanted."""

    post: bool = False

    def sample_world(self, key):
        world = super().sample_world(key)
        rounds = solids.stack_rounds([solids.post(1.0, 0.5, 1.0, 0.1, (0.2, 0.2, 0.2))])
        own = solids.Solids(rounds=rounds) if self.post else None
        return replace(world, scene=replace(world.scene, solids=own))

    def rewards(self, moment):
        return {**super().rewards(moment), "held": -moment.scene.people.held.sum().astype(float)}


@pytest.mark.quick
def test_rewards_may_look_at_the_people_of_a_task_that_has_some():
    env, params = make_env(Polite(people=2))
    assert reset_state(env, params, jax.random.key(0)).scene.people.speed.shape == (2,)
    with pytest.raises(ValueError, match="rewards, line .*: AttributeError"):
        make_env(Polite())


@pytest.mark.quick
def test_furnished_rooms_do_not_swallow_the_posts_of_a_task():
    with pytest.raises(ValueError, match="looks are rich, and the task has solids of its own"):
        make_env(Polite(people=2, post=True), looks="rich")


@pytest.mark.quick
def test_a_task_inherits_neither_name_nor_budget():
    task = Slalom()
    assert task.name == "slalom" and not task.budgets and Corridor.budgets
    with pytest.raises(ValueError, match="no budget for the preset 'paper'.*--steps"):
        find_preset("paper", task)
    asked = find_preset("paper", task, steps=1234)
    assert asked.total_steps == 1234 and asked.learner.vector_scale == 1.0
    assert find_preset("smoke", task).total_steps > 0


@pytest.mark.quick
def test_a_registered_task_is_known_by_its_name_until_it_is_forgotten():
    register_task(Slalom)
    try:
        assert make_env("slalom", layout="fixed")[0].task == Slalom(layout="fixed")
        with pytest.raises(ValueError, match="another name"):
            register_task(type("Slalom", (Corridor,), {"__module__": "elsewhere", "name": "slalom"})())
    finally:
        unregister_task("slalom")
    assert "slalom" not in TASKS


@pytest.mark.quick
def test_wrong_tasks_and_fields_are_refused():
    class Loose(Corridor):
        pass

    with pytest.raises(TypeError, match="frozen dataclass"):
        register_task(Loose)
    with pytest.raises(TypeError, match="no task"):
        register_task("corridor")
    with pytest.raises(ValueError, match="'point_Goal' would have the id of Gymnasium that 'point_goal' has"):
        register_task(dataclass(frozen=True)(type("Other", (Corridor,), {"name": "point_Goal"})))

    @dataclass(frozen=True)
    class Misspelt(Corridor):
        budgets: ClassVar = {"cpu": Budget(100, learner={"learning_rate": 1.0})}

    with pytest.raises(ValueError, match="task 'slalom': unhashable.*Give a tuple for an array"):
        make_env(Slalom(poles=np.ones(2)))
    with pytest.raises(ValueError, match="there is no 'learning_rate' to change"):
        find_preset("cpu", Misspelt())
    with pytest.raises(OptionError, match="no field 'wdith'"):
        read_fields(Corridor(), ["wdith=2"])
    assert read_fields(Slalom(), ["poles=1,3", "width=2"]) == {"poles": (1.0, 3.0), "width": 2.0}


@pytest.mark.quick
def test_an_ending_with_a_name_of_the_library_is_refused():
    @dataclass(frozen=True)
    class Late(Task):
        def endings(self, moment):
            return {"timeout": moment.time_s > 1.0}

    with pytest.raises(ValueError, match="ending 'timeout' is the library's own"):
        make_env(Late())


@pytest.mark.quick
@pytest.mark.parametrize("name", [name for name in TASKS if name != "map_goal"])  # it needs a map
def test_every_task_that_ships_begins_free_and_away_from_its_goal(name):
    from whill_mjx.vehicle.specs import WHILL_CR
    from whill_mjx.world.scene import clearance, footprint

    task = TASKS[name]

    def look(key):
        world = task.sample_world(key)
        start = world.start
        free = clearance(footprint(WHILL_CR, start[0], start[1], start[2]), world.scene.boxes)
        return free, jnp.linalg.norm(task.goal(world.scene) - start[:2])

    free, away = jax.jit(jax.vmap(look))(jax.random.split(jax.random.key(1), 200))
    assert float(free.min()) > 0.05 and np.isfinite(away).all()
    assert name == "follow" or float(away.min()) > task.goal_radius + 0.5  # a person is near at first, and walks away


@pytest.mark.quick
def test_threads_that_look_up_at_the_same_time_all_find_everything():
    with ThreadPoolExecutor(4) as pool:
        known = Registry("task", "whill_mjx.tasks", tasks.__file__, slowly(tasks.tasks_in), tasks._as_task, tasks.PARTS)
        counts = list(pool.map(lambda _: len(known), range(4)))
    assert {"corridor", "obstacle_course"} <= set(known) and counts == [len(known)] * 4


def slowly(found_in):
    """What is found in a module, after a moment in which other threads go on."""

    def find(module):
        time.sleep(0.01)
        return found_in(module).values()

    return find
