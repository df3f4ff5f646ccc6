"""A mistake in any command of the project ends with one line and exit code 2, before any work."""

from __future__ import annotations

import dataclasses
import os
import runpy
import shlex
import shutil
import typing
import warnings
from pathlib import Path

import pytest

from bridge import chair, guard, record, simulate
from bridge import drive as bridge_drive
from bridge.nodes.exits import Exit
from sysid import close_loop, convert, design, fit, inspect, paper, report, searches
from sysid.logs.conversion import ConvertConfig
from sysid.pages.paper_page import PaperConfig
from whill_mjx import drive, evaluate, export_mjcf, export_python, look, train, view
from whill_mjx.io import command_line
from whill_mjx.io.command_line import Range

pytestmark = pytest.mark.quick
ROOT = Path(__file__).parents[1]
CHAIR = ROOT / "sysid" / "data" / "chair"
COMMANDS = {
    "fit": (fit.Arguments, fit.main), "close_loop": (close_loop.Arguments, close_loop.main),
    "design": (design.DesignConfig, design.main), "convert": (ConvertConfig, convert.main),
    "inspect": (inspect.InspectConfig, inspect.main), "paper": (PaperConfig, paper.main),
    "searches": (searches.Arguments, searches.main), "report": (report.Options, report.main),
}  # fmt: skip
OTHERS = {
    "train": train.TrainOptions, "evaluate": evaluate.EvaluateOptions, "drive": drive.DriveOptions, "look": look.Look,
    "export_mjcf": export_mjcf.Options, "export_python": export_python.Options, "view": view.ViewOptions,
}  # fmt: skip
NEEDED = {"fit": "data", "close_loop": "data", "design": "whill_cr", "convert": "data", "inspect": "data",
          "paper": "data", "searches": "data", "report": "run", "evaluate": "planner", "drive": "--out new",
          "export_mjcf": "whill_cr", "export_python": "whill_cr", "view": "run"}  # fmt: skip
"""Words that a command cannot do without."""


def refused(command, words, capsys):
    """The single line that a command ends with; its exit code is 2."""
    options, main = COMMANDS[command]
    with pytest.raises(SystemExit) as ended:
        command_line.run(options, main, None, args=shlex.split(words))
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1, lines
    assert ended.value.code == command_line.REFUSED
    return lines[0]


def files_of(folder):
    """Everything in a folder but locks."""
    return sorted(path for path in folder.rglob("*") if path.name != ".lock")


@pytest.fixture(scope="module")
def mistakes(tmp_path_factory):
    """A folder with a good dataset, a fit's file, somebody's files, and a file where a folder is needed."""
    folder = tmp_path_factory.mktemp("mistakes")
    shutil.copytree(CHAIR, folder / "data")
    (folder / "file").write_text("")
    for name in ("mine.csv", "other_2.csv", "robot.urdf"):
        (folder / name).write_text("mine")
    (folder / "folder.csv").mkdir()
    (folder / "mine").mkdir()
    (folder / "mine" / "vehicle.toml").write_text("mine")
    (folder / "notes").mkdir()
    (folder / "notes" / "diary.txt").write_text("mine")
    (folder / "empty").mkdir()
    os.mkfifo(folder / "pipe")
    (folder / "training").mkdir()
    (folder / "training" / "run.json").write_text('{"kind": "whill_mjx.train", "identity": {"seed": 0}}')
    (folder / "model.txt").write_text("")
    (folder / "other.py").write_text("x = 1\n")
    (folder / "broken.py").write_text("def model(:\n")
    (folder / "exits.py").write_text("import sys; sys.exit(3)\n")
    return folder


@pytest.mark.parametrize("command, words, told", [
    ("fit", "data --starts 0", "--starts 0: must be at least 1"),
    ("fit", "data --starts -1", "--starts -1: must be at least 1"),
    ("fit", "data --trials 0", "--trials 0: must be at least 1"),
    ("fit", "data --iterations -5", "--iterations -5: must be at least 1"),
    ("fit", "data --seed -1", "--seed -1: must be at least 0"),
    ("fit", "data --physics-dt nan", "--physics-dt nan: must be at least 0.0001"),
    ("fit", "data --physics-dt 1e-9", "--physics-dt 1e-09: must be at least 0.0001"),
    ("fit", "data --spread 0", "--spread 0.0: must be above 0"),
    ("fit", "data --method newton", "--method"),
    ("fit", "data --train circle_1 --train turn_1", "--train: is given twice"),
    ("fit", "data --out ~/fit", "--out ~/fit: the shell has not put your home folder in place of ~"),
    ("fit", "data --trials 10", "--trials: has an effect only with --method tpe or cmaes or both"),
    ("fit", "data --study a", "--study: has an effect only with --storage"),
    ("close_loop", "data --reference-train a", "--reference-train: has an effect only with --reference"),
    ("design", "whill_cr --out mine.csv", "--out mine.csv: exists already, and is not as a command of this project"),
    ("design", "whill_cr --out other.csv --count 2", "--out other_2.csv: exists already"),
    ("inspect", "robot.urdf", "robot.urdf: MuJoCo cannot use it"),
    ("design", "whill_cr --out data/trials/circle_1/command.csv", "lies among the trials of"),
    ("convert", "data --out new --fps 10", "--fps: has an effect only with --to lerobot"),
    ("convert", "data --out new --pause 3", "--pause: has an effect only with --split standstill"),
    ("convert", "data --out new --imu-topic /imu", "--imu-topic: data is a dataset, which says this itself"),
    ("convert", "data --out new --command-timeout -1", "--command-timeout -1.0: must be at least 0.01"),
    ("fit", "data --out ''", "--out: an empty word"),
    ("fit", "data --out data", "--out data: holds dataset.toml of something else"),
    ("fit", "data --out data/trials/new", "--out data/trials/new: lies among the trials of"),
    ("fit", "''", "the command line: an empty word"),
    ("fit", "data --out=", "--out: an empty word"),
    ("fit", "data --train ' '", "--train: an empty word"),
    ("fit", "nowhere", "nowhere"),
    ("fit", "file", "file"),
    ("fit", "empty", "empty: no dataset.toml"),
    ("fit", "pipe", "pipe: a pipe or a device"),
    ("convert", "pipe --out new", "pipe"),
    ("fit", "data --parameters body.nope", "body.nope"),
    ("fit", "data --effects nope", "no effect 'nope'"),
    ("fit", "data --effects yaw_scrub yaw_scrub", "--effects yaw_scrub: is given twice"),
    ("fit", "data --parameters", "--parameters: none is given"),
    ("fit", "data --parameters --quick", "--parameters: none is given"),
    ("fit", f"data --out {'x' * 300}", "File name too long. Choose another place."),
    ("close_loop", "data --held-out circle_1", "its dataset.toml says which trials are held out"),
    ("close_loop", "data --reference empty empty", "--reference empty: is given twice"),
    ("searches", "data --seeds 1 1", "--seeds 1: is given twice"),
    ("inspect", "data --wheels left", "--wheels: data is a driving log"),
    ("design", "whill_cr --space 0.2 0.2", "a room of 0.2 x 0.2 m leaves nothing within a margin"),
    ("fit", "data --profile nope", "profile of 'nope'"),
    ("fit", "data --method tpe --profile all", "--profile with --method tpe"),
    ("fit", "data --vehicle nope.toml", "nope.toml: no such vehicle file"),
    ("fit", "data --vehicle data", "data: a dataset"),
    ("fit", "data --vehicle mine/vehicle.toml", "mine/vehicle.toml: not a TOML file"),
    ("fit", "data --model nope.xml", "nope.xml: no such model"),
    ("fit", "data --model model.txt", "model.txt: a model is .xml"),
    ("fit", "data --model other.py", "other.py: defines no 'model'"),
    ("fit", "data --model other.py:x", "x is a int"),
    ("fit", "data --model other.py --close-loop", "--close-loop asks what the simulator's vehicle lacks"),
    ("fit", "data --train nope", "selection 'nope' matches no trial"),
    ("fit", "data --format mrclam", "data"),
    ("fit", "data --storage nope --method tpe", "storage 'nope' is neither"),
    ("fit", "data --storage journal:a.log", "--storage journal:a.log: --method features has no global search"),
    ("fit", "data --close-loop --reference nowhere", "nowhere"),
    ("fit", "data --reference data", "--reference: only --close-loop asks for drives of other days"),
    ("fit", "data --wheels left right", "--wheels: only a --model has joints"),
    ("fit", "data --model exits.py", "exits.py: ends in SystemExit when it is run (3)"),
    ("fit", "data --model broken.py", "broken.py: ends in SyntaxError when it is run"),
    ("close_loop", "data --reference data", "which is among the drives in question already"),
    ("fit", "data --reference data --close-loop", "which is among the drives in question already"),
    ("convert", "data --out new --columns command.v=v", "--columns: only tables have columns to name"),
    ("fit", "data --out file", "--out file: is a file, not a folder"),
    ("fit", "data --out file/new", "file is a file, not a folder"),
    ("fit", "data --out mine", "--out mine: holds vehicle.toml of something else"),
    ("fit", "data --out training", "--out training: holds results of whill_mjx.train, not of"),
    ("close_loop", "data --seed -1", "--seed -1: must be at least 0"),
    ("close_loop", "data --iterations -1", "--iterations -1: must be at least 1"),
    ("close_loop", "data --iterations 0", "--iterations 0: must be at least 1"),
    ("close_loop", "data --refit-nulls -3", "--refit-nulls -3: must be at least 0"),
    ("close_loop", "data --without nope", "--without nope: unknown (known: "),
    ("close_loop", "data --reference nowhere", "nowhere"),
    ("close_loop", "data --vehicle nope", "unknown vehicle 'nope'"),
    ("close_loop", "data --vehicle data", "data: a dataset"),
    ("close_loop", "data --vehicle husky", "husky: wheel_radius is 0.165, but 0.1325"),
    ("close_loop", "data --decision coin", "--decision"),
    ("close_loop", "nowhere", "nowhere"),
    ("close_loop", "data --out file", "--out file: is a file, not a folder"),
    ("close_loop", "data --out file/new", "file is a file, not a folder"),
    ("close_loop", "data --out mine", "--out mine: holds vehicle.toml of something else"),
    ("design", "whill_cr --count 0", "--count 0: must be at least 1"),
    ("design", "whill_cr --seconds nan", "--seconds nan: must be at least 1"),
    ("design", "whill_cr --seconds 0", "--seconds 0.0: must be at least 1"),
    ("design", "whill_cr --space 0 4", "--space 0.0: must be at least 0.1"),
    ("design", "whill_cr --space nan 4", "--space nan: must be at least 0.1"),
    ("design", "whill_cr --space 4", "--space"),
    ("design", "whill_cr --margin -1", "--margin -1.0: must be at least 0"),
    ("design", "whill_cr --v-max 0", "--v-max 0.0: must be above 0"),
    ("design", "whill_cr --v-min 1", "--v-min 1.0: must be at most 0"),
    ("design", "whill_cr --omega-max inf", "--omega-max inf: must be above 0"),
    ("design", "whill_cr --criterion e", "--criterion"),
    ("design", "whill_cr --parameters nope", "nope"),
    ("design", "whill_cr --out empty", "--out empty: must end in .csv"),
    ("design", "whill_cr --out folder.csv", "--out folder.csv: is a folder"),
    ("design", "whill_cr --out file/a.csv", "file is a file, not a folder"),
    ("design", "nope", "unknown vehicle 'nope'"),
    ("design", "empty", "empty"),
    ("design", "data", "data: a dataset"),
    ("convert", "nowhere --out new", "nowhere: does not exist"),
    ("convert", "empty --out new", "empty"),
    ("convert", "data --out file", "--out file: is a file, not a folder"),
    ("convert", "data --out file/new", "file is a file, not a folder"),
    ("convert", "data --out notes", "--out notes: holds other files"),
    ("convert", "data --out data", "exists already"),
    ("convert", "data --out new --pause nan", "--pause nan: must be at least 0"),
    ("convert", "data --out new --pause -1", "--pause -1.0: must be at least 0"),
    ("convert", "data --out new --wheel-radius 0", "--wheel-radius 0.0: must be at least 0.001"),
    ("convert", "data --out new --track nan", "--track nan"),
    ("convert", "data --out new --mass -3", "--mass -3.0: must be at least 0.01"),
    ("convert", "data --out new --truth-ahead inf", "--truth-ahead inf"),
    ("convert", "data --out new --truth-turned nan", "--truth-turned nan"),
    ("convert", "data --out new --held-out nope", "--held-out nope"),
    ("convert", "data --out new --stamp never", "--stamp"),
    ("inspect", "nowhere", "nowhere"),
    ("inspect", "file", "file"),
    ("inspect", "data --select nope", "nope"),
    ("inspect", "data --format bag", "--format"),
    ("inspect", "data --out file", "--out file: is a file, not a folder"),
    ("inspect", "data --out file/new", "file is a file, not a folder"),
    ("inspect", "data --out training", "--out training: holds results of whill_mjx.train, not of"),
    ("paper", "data --trials 0", "--trials 0: must be at least 1"),
    ("paper", "data --seed -1", "--seed -1: must be at least 0"),
    ("paper", "data --physics-dt 0", "--physics-dt 0.0: must be at least 0.0001"),
    ("paper", "data --channel gps", "--channel"),
    ("paper", "nowhere", "nowhere"),
    ("paper", "data --out file", "--out file: is a file, not a folder"),
    ("paper", "data --out mine", "--out mine: holds vehicle.toml of something else"),
    ("searches", "data --methods newton", "--methods newton: unknown (known: features, lm"),
    ("searches", "data --methods", "--methods"),
    ("searches", "data --seeds -1", "--seeds -1: must be at least 0"),
    ("searches", "data --trials 0", "--trials 0: must be at least 1"),
    ("searches", "data --starts 0", "--starts 0: must be at least 1"),
    ("searches", "data --out file", "--out file: is a file, not a folder"),
    ("report", "nowhere", "nowhere"),
    ("report", "empty", "empty/report.json: missing"),
    ("report", "data", "data: a dataset"),
    ("report", "file", "file"),
])  # fmt: skip
def test_a_mistake_in_identification_ends_with_one_line_and_writes_nothing(
    command, words, told, mistakes, monkeypatch, capsys
):
    monkeypatch.chdir(mistakes)
    for work in ("run_folder.keep_steps", "searches.make_problem", "inspect.look", "design.propose"):
        monkeypatch.setattr(f"sysid.{work}", lambda *words: pytest.fail("begun"))
    before = files_of(mistakes)
    assert told in refused(command, words, capsys)
    assert files_of(mistakes) == before


def out_of_range(kind, marks):
    """Words for one number that an option must refuse."""
    allowed = next((mark for mark in marks if isinstance(mark, Range)), Range())
    yield "many"
    if kind is float:
        yield from ("nan", "inf")
    for end, beyond in ((allowed.low, -1), (allowed.high, 1)):
        if abs(end) < 1e18:
            yield repr(kind(end + beyond * max(1, abs(end))))


def numbers(options, prefix=""):
    """Every option that takes a number, with words that it must refuse."""
    hints = typing.get_type_hints(options, include_extras=True)
    for field in dataclasses.fields(options):
        name, hint = prefix + field.name.replace("_", "-"), hints[field.name]
        marks = getattr(hint, "__metadata__", ())
        plain = hint.__origin__ if marks else hint
        if dataclasses.is_dataclass(plain):
            yield from numbers(plain, f"{name}.")
            continue
        kinds = [kind for kind in (plain, *typing.get_args(plain)) if kind in (int, float)]
        several = len(kinds) if typing.get_origin(plain) is tuple and Ellipsis not in typing.get_args(plain) else 1
        for kind in kinds[:1]:
            for word in out_of_range(kind, marks):
                yield f"--{name}", " ".join([word] * several)


ALL = {**{name: options for name, (options, _) in COMMANDS.items()}, **OTHERS}


@pytest.mark.parametrize("command, option, word", [
    (command, option, word) for command, options in ALL.items() for option, word in numbers(options)])  # fmt: skip
def test_no_option_takes_a_number_that_makes_no_sense(command, option, word, capsys):
    words = [*shlex.split(NEEDED.get(command, "")), option, *word.split()]
    with pytest.raises(SystemExit) as ended:
        command_line.run(ALL[command], lambda options: pytest.fail("begun"), None, args=words,
                         positional=command not in ("drive", "train") and command != "evaluate")
    line = capsys.readouterr().err
    named = option in line or option.rpartition(".")[2].replace("-", "_") in line
    assert ended.value.code == command_line.REFUSED and line.count("\n") == 1 and named


BRIDGE = {"drive": bridge_drive.main, "record": record.main, "simulate": simulate.main, "chair": chair.main,
          "guard": guard.main}  # fmt: skip


DAMAGED = {("drive", "nowhere"), ("drive", "file"), ("drive", "empty"), ("record", "file t"), ("simulate", "nowhere")}
"""Where a file is at fault, and not the command."""


@pytest.mark.parametrize("command, words, told", [
    ("drive", "", "policy"), ("drive", "nowhere", "nowhere"), ("drive", "file", "file"), ("drive", "empty", "empty"),
    ("drive", "nowhere --v-limits nan 1", "--v-limits"), ("drive", "nowhere --slew -1 1", "--slew"),
    ("drive", "nowhere --crop 0 0 many 3", "--crop"), ("drive", "nowhere --stamp-age nan", "--stamp-age"),
    ("drive", "nowhere --frame-age -1", "--frame-age"), ("drive", "nowhere --realtime 200", "--realtime"),
    ("drive", "nowhere --signal-age nan", "--signal-age"), ("drive", "nowhere --dead-man-button -7", "--dead-man"),
    ("drive", "nowhere --base tank", "--base"), ("drive", "nowhere --results empty", "--results"),
    ("drive", "nowhere --results no/where.json", "--results"), ("drive", "nowhere --nope", "nope"),
    ("drive", "nowhere --slew 1 1 --slew 2 2", "--slew: is given twice"), ("drive", "~/policy", "put your home folder"),
    ("drive", "''", "an empty word"), ("drive", "nowhere --results ''", "--results: an empty word"),
    ("record", "", "dataset"), ("record", "new", "trial"), ("record", "new t --seconds -1", "--seconds"),
    ("record", "new t --seconds nan", "--seconds"), ("record", "new t --wheel-radius 0", "--wheel-radius"),
    ("record", "new t --track inf", "--track"), ("record", "new t --wheelbase nan", "--wheelbase"),
    ("record", "new t --mass -1", "--mass"), ("record", "new t --v-limit nan", "--v-limit"),
    ("record", "new t --omega-limit 0", "--omega-limit"), ("record", "file t", "file"),
    ("record", "mine t", "mine: holds vehicle.toml and no dataset.toml"),
    ("record", "new ../t", "t"), ("record", "data circle_1", "circle_1"),
    ("simulate", "--task nope", "nope"), ("simulate", "--set gates", "gates"), ("simulate", "--set gate=1", "gate"),
    ("simulate", "--episodes -1", "--episodes"), ("simulate", "--seed -1", "--seed"),
    ("simulate", "--wait nan", "--wait"), ("simulate", "--linger -1", "--linger"),
    ("simulate", "--image-size 0 0", "--image-size"), ("simulate", "--realtime 1.5", "--realtime"),
    ("simulate", "--vehicle nope", "nope"), ("simulate", "--simulator nope", "nope"),
    ("simulate", "--simulator os:nope", "nope"), ("simulate", "nowhere", "nowhere"),
    ("simulate", "--results empty", "--results"), ("drive", "nowhere --results file", "file: exists already"),
    ("simulate", "--results training/run.json", "training/run.json: exists already, and is no earlier result"),
    ("chair", "--wheel-radius nan", "--wheel-radius"), ("chair", "--tread 0", "--tread"), ("chair", "x", "x"),
    ("guard", "--command-topic ///", "--command-topic"), ("drive", "nowhere --image-topic 1a", "--image-topic"),
    ("record", "new t --imu-topic 'a b'", "--imu-topic"), ("chair", "--state-topic a/", "--state-topic"),
    ("record", "file t", "file/trials: Not a directory"), ("guard", "--realtime -1", "--realtime"),
    ("guard", "--command-type Tw", "--command-type"),
])  # fmt: skip
def test_a_mistake_in_the_bridge_ends_with_one_line(command, words, told, mistakes, monkeypatch, capsys):
    monkeypatch.chdir(mistakes)
    before = files_of(mistakes)
    try:
        code = BRIDGE[command](shlex.split(words))
    except SystemExit as ended:
        code = ended.code
    lines = capsys.readouterr().err.splitlines()
    wanted = Exit.FAULT if (command, words) in DAMAGED else Exit.REFUSED
    assert code == wanted and len(lines) == 1 and told in lines[0], (code, lines)
    assert files_of(mistakes) == before


BENCHMARKS = sorted(path for path in (ROOT / "benchmarks").rglob("*.py") if "__main__\":" in path.read_text())


@pytest.mark.parametrize("path", BENCHMARKS, ids=lambda path: path.stem)
@pytest.mark.parametrize("word", ["--help", "--no-such-option"])
def test_a_benchmark_says_what_it_takes_and_writes_nothing(word, path, monkeypatch, capsys):
    name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__main__")
    monkeypatch.setattr("sys.argv", [name, word])
    pages = {page: page.stat().st_mtime_ns for page in [*ROOT.glob("*.md"), *ROOT.glob("benchmarks/**/*.md")]}
    with pytest.raises(SystemExit) as ended, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of modules that other tests have imported
        runpy.run_module(name, run_name="__main__", alter_sys=True)
    said = capsys.readouterr()
    if word == "--help":
        assert ended.value.code in (0, None) and "--help" in said.out
    else:
        assert ended.value.code == 2 and said.err.count("\n") == 1
        assert "no-such-option" in said.err or "required" in said.err
    assert {page: page.stat().st_mtime_ns for page in pages} == pages
