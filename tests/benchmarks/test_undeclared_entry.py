"""A method from outside the project can be entered into the bench, and is counted as it should be."""

from __future__ import annotations

import pytest

pytest.importorskip("mujoco")

from benchmarks import undeclared_methods as methods  # noqa: E402
from benchmarks.plant.effects import EFFECTS  # noqa: E402
from benchmarks.undeclared_entry import Case, Entry, counts, main  # noqa: E402
from benchmarks.undeclared_methods import Naive, Verdict, check_verdict, find_method, register_method  # noqa: E402
from whill_mjx.io.command_line import OptionError  # noqa: E402

OUTSIDE = '''
class Size:
    """Calls a log whose file of commands differs in length from the days' a delayed one."""

    def prepare(self, days):
        return [self.rows(day) for day in days]

    def judge(self, ready, log):
        assert not list(log.rglob("*truth.json"))
        return {"verdict": "none"} if self.rows(log) in ready else {"verdict": "named", "effects": [["command_delay"]]}

    def rows(self, folder):
        return sum(1 for path in sorted(folder.glob("trials/*/command.csv")) for _ in path.open())
'''


@pytest.fixture
def outside(tmp_path):
    path = tmp_path / "outside.py"
    path.write_text(OUTSIDE)
    return f"{path}:Size"


def small(work, *method):
    return Entry(method, nulls=1, effects=("command_delay",), days=1, replicates=1, manoeuvres=("straight",), work=work)


def test_a_method_from_outside_the_project_is_entered_and_goes_on_where_it_was(tmp_path, outside, capsys):
    first = main(small(tmp_path / "work", outside))
    assert set(first) == {outside} and first[outside]["nulls"] == 1 and first[outside]["at_4x"]["logs"] == 1
    assert "| named right |" in capsys.readouterr().out
    assert main(small(tmp_path / "work", outside)) == first
    assert "log_000" not in capsys.readouterr().out  # nothing is asked twice
    text = "".join(path.read_text() for path in (tmp_path / "work").glob("*/logs/*/**/*") if path.is_file())
    assert text and not [name for name in EFFECTS if name in text]


@pytest.mark.parametrize(("name", "wrong"), [
    ("nothing", "unknown \\(known: "), ("no.such.module:X", "cannot be loaded"), ("missing.py:X", "cannot be loaded"),
    ("json:JSONEncoder", "has no function")])  # fmt: skip
def test_a_method_that_cannot_be_called_is_refused_first(tmp_path, name, wrong):
    with pytest.raises(OptionError, match=wrong):
        main(small(tmp_path / "work", name))
    assert not (tmp_path / "work").exists()


@pytest.mark.parametrize(("given", "wrong"), [
    ("none", "must be a dict"), ({"verdict": "maybe"}, "must be a dict"), ({"verdict": "named"}, "needs effects"),
    ({"verdict": "none", "effects": ["slope"]}, "needs effects"), ({"verdict": "named", "effects": "slope"}, "a list"),
    ({"verdict": "named", "effects": ["gremlins"]}, "unknown"),
    ({"verdict": "named", "effects": [list(methods.VOCABULARY)]}, "1 to 8")])  # fmt: skip
def test_a_verdict_against_the_rules_is_refused(given, wrong):
    with pytest.raises(ValueError, match=wrong):
        check_verdict(given)


def test_right_wrong_and_silent_verdicts_are_counted_apart():
    rows = [({}, Verdict("none")), ({}, Verdict("unexplained")),
            ({"slope": 0.1}, Verdict("named", (("wind", "slope"),))), ({"wind": 9.0}, Verdict("named", (("slope",),))),
            ({"warm_up": 2.0}, Verdict("unexplained")), ({"track_width": 0.1}, Verdict("none"))]  # fmt: skip
    listed = [Case("log", effects, 2.0 if effects else 0.0, 0) for effects, _ in rows]
    found = counts(listed, [(said, 1.0) for _, said in rows])
    assert (found["nulls"], found["false_alarms"]) == (2, 1)
    assert found["at_2x"] == {"logs": 3, "named_right": 1, "named_wrong": 1, "unexplained": 0, "missed": 1,
                              "names_per_effect": 1.5, "beyond_the_vocabulary": 1, "said_to_be_unexplained": 1}


def test_a_method_is_registered_by_its_name_once():
    try:
        register_method("mine")(Naive)
        assert isinstance(find_method("mine"), Naive)
        with pytest.raises(ValueError, match="twice"):
            register_method("mine")(Naive)
    finally:
        methods.METHODS.pop("mine", None)


def test_the_naive_method_names_what_stands_out_of_the_days_and_nothing_else(monkeypatch):
    numbers = {"day_1": [0.1] * 7, "day_2": [0.12] * 7, "day_3": [0.11] * 7, "same": [0.105] * 7,
               "late": [9.0] + [0.1] * 6, "odd": [0.1, 0.1, 9.0] + [0.1] * 4}  # fmt: skip
    naive = Naive()
    monkeypatch.setattr(naive, "numbers", lambda folder: methods.np.array(numbers[folder]), raising=False)
    ready = naive.prepare(["day_1", "day_2", "day_3"])
    assert naive.judge(ready, "same") == {"verdict": "none"}
    assert naive.judge(ready, "late") == {"verdict": "named", "effects": ["command_delay"]}
    assert naive.judge(ready, "odd") == {"verdict": "unexplained"}
