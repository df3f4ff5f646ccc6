"""The programs in examples/ run."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from whill_mjx.env import make_env, reset_state, step_state
from whill_mjx.tasks.options import named_task
from whill_mjx.tasks.point_goal import PointGoal

ROOT = Path(__file__).parent.parent
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
VEHICLES = sorted((ROOT / "examples").glob("*.toml"))
SMALL = {"many_chairs.py": ["--count", "8", "--steps", "2"]}


def run_example(path, cwd):
    return subprocess.run(
        [sys.executable, str(path), *SMALL.get(path.name, [])], cwd=cwd, capture_output=True, text=True
    )


@pytest.mark.quick
def test_the_examples_page_lists_every_example():
    text = (ROOT / "examples" / "README.md").read_text()
    assert [path.name for path in (*EXAMPLES, *VEHICLES) if f"`{path.name}`" not in text] == []


@pytest.mark.quick
def test_the_example_of_a_vehicle_is_the_one_of_the_page():
    page = (ROOT / "docs" / "howto" / "vehicle.md").read_text()
    assert (ROOT / "examples" / "turtlebot3_burger.toml").read_text() in page


@pytest.mark.parametrize("path", VEHICLES, ids=lambda path: path.name)
def test_an_example_of_a_vehicle_drives_as_commanded_and_carries_its_camera(path):
    env, params = make_env(PointGoal(v_min=0.0, v_max=0.2, omega_max=0.5, layout="fixed"), path)
    spec = env.model.spec
    assert abs(spec.camera.x) <= spec.body_length / 2 and spec.camera.z + spec.wheel_radius <= spec.body_height
    state = jax.jit(lambda key: reset_state(env, params, key))(jax.random.key(0))
    step = jax.jit(lambda state: step_state(env, params, state, jnp.array([1.0, 1.0])))
    for _ in range(15):
        state, outcome = step(state)
    assert outcome.metrics["v"] == pytest.approx(0.2, abs=0.03)
    assert outcome.metrics["omega"] == pytest.approx(0.5, abs=0.08)


@pytest.mark.quick
def test_the_example_of_a_task_is_a_task_and_the_same_as_in_the_tutorial():
    task = named_task(f"{ROOT / 'examples' / 'parking.py'}:Parking")
    assert task.name == "parking"
    tutorial = (ROOT / "docs" / "tutorials" / "5_my_map_my_task.md").read_text()
    methods = (
        (ROOT / "examples" / "parking.py")
        .read_text()
        .partition("    def sample_world")[2]
        .partition("    def rewards")[0]
    )
    assert methods in tutorial


@pytest.mark.quick
def test_the_example_that_reads_a_log_prints_a_line_a_trial(tmp_path):
    done = run_example(ROOT / "examples" / "read_log.py", tmp_path)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == 9 and "circle_1" in done.stdout


@pytest.mark.long
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_an_example_runs(path, tmp_path):
    done = run_example(path, tmp_path)
    assert done.returncode == 0 and done.stdout, done.stderr
