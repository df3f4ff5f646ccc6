"""A mistake in a command ends with one line that names it, before any work, and nothing is written."""

from __future__ import annotations

import dataclasses
import shlex
from typing import Annotated

import marker_seeker
import pytest

from whill_mjx import drive, evaluate, export_mjcf, export_python, look, maps, view
from whill_mjx.io import command_line
from whill_mjx.io.command_line import Range
from whill_mjx.logs import paths

pytestmark = pytest.mark.quick
COMMANDS = {
    "look": (look.Look, look.main, True),
    "drive": (drive.DriveOptions, drive.drive_and_say, False),
    "export_mjcf": (export_mjcf.Options, export_mjcf.main, True),
    "export_python": (export_python.Options, export_python.main, True),
    "view": (view.ViewOptions, view.main, False),
    "maps": (maps.Import, maps.main, True),
    "paths": (paths.PathOptions, paths.main, True),
    "evaluate": (evaluate.EvaluateOptions, evaluate.main, False),
}


def mistaken(command, words, capsys):
    """Exit code and the single line that a command ends with."""
    options, main, positional = COMMANDS[command]
    with pytest.raises(SystemExit) as ended:
        command_line.run(options, main, None, positional=positional, args=shlex.split(words))
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1, lines
    return ended.value.code, lines[0]


@pytest.mark.parametrize("command, words, told", [
    ("look", "--scene nope", "unknown scene 'nope' (known: among_people, corridor, "),
    ("look", "--scene task.py", "--scene task.py: a task in a file is named too. Give task.py:CLASS."),
    ("look", "--layout nope", "--layout nope: unknown (known: randomised, fixed)"),
    ("look", "--worlds 0", "--worlds 0: must be at least 1"),
    ("look", "--steps 0", "--steps 0: must be at least 1"),
    ("look", "--scale -3", "--scale -3: must be at least 1"),
    ("look", "--seed -1", "--seed -1: must be at least 0"),
    ("look", "--out a.jpg", "--out a.jpg: must end in .png"),
    ("look", "--out folder.png", "--out folder.png: is a folder"),
    ("look", "--out file/a.png", "file is a file, not a folder"),
    ("drive", "--out new --noise --noise-levels.position nan", "--noise-levels.position nan: must be at least 0"),
    ("drive", "--out new --noise-levels.v -1", "--noise-levels.v -1.0: must be at least 0"),
    ("drive", "--out new --scenario.dt 0", "--scenario.dt 0.0: must be at least 0.001"),
    ("drive", "--out new --scenario.dt nan", "--scenario.dt nan"),
    ("drive", "--out new --scenario.length inf", "--scenario.length inf"),
    ("drive", "--out new --scenario.omega 0", "--scenario.omega 0.0: a figure-eight needs"),
    ("drive", "--out new --sensors.imu-rate nan", "imu_rate is nan Hz"),
    ("drive", "--out new --manoeuvre", "--manoeuvre: none is given"),
    ("drive", "--out new --replicates 0", "--replicates 0: must be at least 1"),
    ("drive", "--out new --seed -1", "--seed -1: must be at least 0"),
    ("drive", "--out new --vehicle nope", "unknown vehicle 'nope'"),
    ("drive", "--out new --vehicle nope.toml", "nope.toml: no such vehicle file"),
    ("drive", "--out new --manoeuvre nope", "unknown manoeuvre 'nope'"),
    ("drive", "--out new --effects nope", "unknown effect 'nope'"),
    ("drive", "--out new --effects yaw_scrub:torque=1,torque=2", "torque is given twice"),
    ("drive", "--out file", "--out file: exists already"),
    ("drive", "--out file/new", "file is a file, not a folder"),
    ("export_mjcf", "whill_cr --physics-dt nan", "--physics-dt nan: must be at least 0.0001"),
    ("export_mjcf", "whill_cr --physics-dt 0", "--physics-dt 0.0: must be at least 0.0001"),
    ("export_mjcf", "nope", "unknown vehicle 'nope'"),
    ("export_mjcf", "nope.toml", "nope.toml: no such vehicle file"),
    ("export_mjcf", "whill_cr --out file", "--out file: exists already"),
    ("export_mjcf", "whill_cr --out file/new", "file is a file, not a folder"),
    ("export_python", "whill_cr --physics-dt nan", "--physics-dt nan: must be at least 0.0001"),
    ("export_python", "nope", "unknown vehicle 'nope'"),
    ("export_python", "whill_cr --out vehicle.txt", "--out vehicle.txt: must be a file that ends in .py"),
    ("export_python", "whill_cr --out folder.py", "--out folder.py: is a folder"),
    ("export_python", "whill_cr --out file/new.py", "file is a file, not a folder"),
    ("view", "", "RUN: none is given"),
    ("view", "nowhere", "RUN nowhere: no such folder"),
    ("view", "file", "RUN file: no such folder"),
    ("view", "empty", "RUN empty: holds no run"),
    ("view", "training --out file", "--out file: must be a file that ends in .html"),
    ("view", "training --out file/new.html", "file is a file, not a folder"),
    ("look", "--out mine.png", "--out mine.png: exists already, and is not as a command of this project wrote it"),
    ("look", "--scene all --out the.png", "the_corridor.png: exists already"),
    ("export_python", "whill_cr --out mine.py", "--out mine.py: exists already"),
    ("view", "training --out mine.html", "--out mine.html: exists already"),
    ("maps", "map.yaml --out mine", "--out mine.png: exists already"),
    ("paths", "command.csv whill_cr --out mine.csv", "--out mine.csv: exists already"),
    ("view", "training --embed-mb -1", "--embed-mb -1.0: must be at least 0"),
    ("view", "training --serve --port 70000", "--port 70000: must be at least 0 and at most 65535"),
    ("evaluate", "nowhere", "nowhere"),
    ("evaluate", "planner --task nope", "--task nope: unknown (known: among_people, corridor, "),
    ("evaluate", "planner --episodes 0", "--episodes 0: must be at least 1"),
    ("evaluate", "planner --batch -2", "--batch -2: must be at least 1"),
    ("evaluate", "planner --sweep-episodes 0", "--sweep-episodes 0: must be at least 1"),
    ("evaluate", "planner --spread nan", "--spread nan: must be at least 0 and below 1"),
    ("evaluate", "planner --near -1", "--near -1.0: must be at least 0"),
    ("evaluate", "planner --seed -1", "--seed -1: must be at least 0"),
    ("evaluate", "planner --videos -1", "--videos -1: must be at least 0"),
    ("evaluate", "planner --set gates", "'gates' is not NAME=VALUE"),
    ("evaluate", "planner --set gate=1", "no field 'gate'"),
    ("evaluate", "planner --set goal_x=1 goal_x=2", "--set goal_x=2: goal_x is given twice"),
    ("evaluate", "planner --set goal_x=nan", "--set goal_x=nan: must be finite"),
    ("evaluate", "planner --set gate_x=1", "--set gate_x=1: 1 numbers where 2 are needed"),
    ("evaluate", "planner --set max_steps=0", "max_steps is 0; it must be positive"),
    ("evaluate", "planner --sweep nope=1", "unknown axis 'nope'"),
    ("evaluate", "planner --sweep nope", "'nope' is no axis of a sweep"),
    ("evaluate", "planner --sweep light=1:2", "light=1:2"),
    ("evaluate", "planner --sweep light=0:1:0", "light=0:1:0"),
    ("evaluate", "planner --sweep light=0:1:-4", "light=0:1:-4"),
    ("evaluate", "planner --sweep light=nan", "light=nan"),
    ("evaluate", "planner --sweep light=0:1:1000000000", "1000000000 values are more than 1000"),
    ("evaluate", "planner --sweep start_x=1e300", "start_x is 1e+300"),
    ("evaluate", "planner --task task.py", "--task task.py: a task in a file is named too. Give task.py:CLASS."),
    ("evaluate", "planner --sweep yaw_scrub.nope=1", "no parameter 'nope'"),
    ("evaluate", "planner --sweep body.mass=50,-5", "body.mass is -5"),
    ("look", "--set layout=fixed", "--set layout=fixed: the layout has an option of its own"),
    ("look", "--scene corridor --scene docking", "--scene: is given twice"),
    ("look", "--out data/trials/drive/a.png", "lies among the trials of"),
    ("drive", "--out data/trials/drive", "lies among the trials of"),
    ("drive", "--out new --noise-levels.position 1", "--noise-levels: has an effect only with --noise"),
    ("drive", "--out new --effects yaw_scrub:", "no parameter follows the colon"),
    ("drive", "--out new --effects yaw_scrub:torque=1e300", "torque is 1e+300 N m"),
    ("view", "training --port 1", "--port: has an effect only with --serve"),
    ("evaluate", "planner --task map_goal", "map is '': a name is missing"),
    ("evaluate", "planner --task map_goal --set map=a.yaml", "a.yaml: does not exist"),
    ("evaluate", "planner --task point_goal --set boxes=9999999999", "boxes is 9999999999; it must lie within 0"),
    ("evaluate", "planner --task point_goal --set nearest=5", "nearest and farthest: 5, 3.5; the lower number"),
    ("evaluate", "planner --task doorway --set door=1,0.5", "door: 1, 0.5; the lower number"),
    ("evaluate", "planner --sweep-episodes 5", "--sweep-episodes: has an effect only with --sweep"),
    ("evaluate", "planner --baselines planner", "--baselines planner: is given twice"),
    ("evaluate", "planner --baselines ../x=random", "a name is letters, digits"),
    ("evaluate", "planner --blind blank", "planner does not look at images"),
    ("evaluate", "planner --sweep vehicle=husky,husky", "husky: is given twice"),
    ("evaluate", "planner --sweep light=1,1", "a value is there twice"),
    ("evaluate", "planner --baselines a=planner a=random", "--baselines a: is given twice"),
    ("drive", "--out new --effects yaw_scrub:torque=1 yaw_scrub:torque=2", "--effects yaw_scrub: is given twice"),
    ("evaluate", "planner --sweep body.mass=0x,1x", "factor is 0"),
    ("evaluate", "planner --sweep vehicle=whill_cr,nope", "unknown vehicle 'nope'"),
    ("evaluate", "planner --baselines nope", "'nope' is not NAME=VALUE"),
    ("evaluate", "planner --vehicle nope", "unknown vehicle 'nope'"),
    ("evaluate", "planner --out file", "--out file: is a file, not a folder"),
    ("evaluate", "planner --out file/new", "file is a file, not a folder"),
    ("evaluate", "planner --out mine", "--out mine: holds report.html of something else"),
    ("evaluate", "planner --out training", "--out training: holds results of whill_mjx.train, not of"),
])  # fmt: skip
def test_a_mistake_ends_with_one_line_and_code_2(command, words, told, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    for name in ("mine.png", "the_corridor.png", "mine.py", "mine.html", "mine.npz", "mine.csv"):
        (tmp_path / name).write_text("somebody's")
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "folder.py").mkdir()
    (tmp_path / "empty").mkdir()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "report.html").write_text("mine")
    (tmp_path / "training").mkdir()
    (tmp_path / "training" / "run.json").write_text('{"kind": "whill_mjx.train", "identity": {"seed": 0}}')
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "dataset.toml").write_text("")
    before = sorted(tmp_path.rglob("*"))
    code, line = mistaken(command, words, capsys)
    assert told in line and code == command_line.REFUSED
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(("text", "said"), [
    ("{", "not valid JSON"), ("[]", "is []; it must be a JSON object"),
    ('{"preset": {"task": 3}}', "preset.task is 3; it must be a table"), ("\ufeff{}", "no field 'preset'"),
])  # fmt: skip
def test_a_damaged_note_beside_a_policy_is_named(text, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    marker_seeker.write(tmp_path / "run" / "policy")
    (tmp_path / "run" / "run.json").write_text(text, encoding="utf-8")
    code, line = mistaken("evaluate", "run/policy --out new", capsys)
    assert code == command_line.REFUSED and f"run.json: {said}" in line
    assert not (tmp_path / "new").exists()


@dataclasses.dataclass(frozen=True)
class TwoLines:
    """Options of a test."""

    first: Annotated[int, Range(1, 5)] = 1
    """A sentence that begins in one line of its docstring
    and ends in the next."""


def test_help_wraps_a_sentence_of_two_lines_as_one(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    for _ in range(2):
        with pytest.raises(SystemExit):
            command_line.run(TwoLines, lambda options: None, None, args=["--help"])
        assert "one line of its docstring and ends in the next." in capsys.readouterr().out
    with pytest.raises(SystemExit):  # its range still counts
        command_line.run(TwoLines, lambda options: None, None, args=["--first", "9"])
    assert "--first 9: must be at least 1 and at most 5" in capsys.readouterr().err
