"""One page opens all results of a training, by relative paths, and the last lines name them."""

from __future__ import annotations

import json
import re
import shlex

import pytest

from whill_mjx.evaluation.output.pictures import reward_curve
from whill_mjx.io.fields import percent
from whill_mjx.io.html import STYLE
from whill_mjx.learning.index_page import list_results, write_index

pytestmark = pytest.mark.quick
FIGURES = {"success": 0.75, "success_interval_95": [0.5, 0.9], "collision": 0.25, "timeout": 0.0, "episodes": 8,
           "time_to_goal_s": 6.5, "return": 12.0}  # fmt: skip


@pytest.fixture
def run(tmp_path):
    for name in ("drives.png", "failures.mp4", "fit/report.html", "fit/trajectories.png", "policy/policy.json"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    evaluation = {"env_steps": 400, "policy": FIGURES, "random": FIGURES}
    return tmp_path, write_index(tmp_path, evaluation, "obstacle_course")


def test_the_page_shows_what_is_there_and_every_link_leads_to_a_file(run):
    out, page = run
    text = page.read_text()
    assert STYLE in text and "succeeds in 75% of 8 unseen episodes" in text
    links = {link for link in re.findall(r'(?:src|href)="([^"#]+)"', text)}
    assert links >= {"drives.png", "failures.mp4", "fit/report.html", "policy/policy.json"}
    assert all((out / link).is_file() for link in links)
    assert re.search(r"<video [^>]*failures.mp4", text) and re.search(r"<img [^>]*drives.png", text)
    assert "reward_curve.png" not in text  # it was not drawn


def test_a_share_is_not_rounded_to_all_or_none_of_the_episodes(tmp_path):
    nearly = {**FIGURES, "success": 0.995, "collision": 0.005, "success_interval_95": [0.988, 0.9996], "episodes": 1000}
    text = write_index(tmp_path, {"env_steps": 400, "policy": nearly}, "obstacle_course").read_text()
    assert "succeeds in 99.5% of 1000" in text and "98.8% to over 99.9%" in text and "<td>0.5%" in text
    shown = [percent(share) for share in (0.0, 1e-4, 0.25, 0.9996, 1.0)]
    assert shown == ["0%", "under 0.1%", "25%", "over 99.9%", "100%"]


def test_endings_of_the_tasks_own_and_divergence_are_shown(tmp_path):
    ends = {name: value for one, share in (("diverged", 0.5), ("astray", 0.25), ("parked", 0.0))
            for name, value in ((one, share), (f"{one}_interval_95", [0.0, 1.0]))}  # fmt: skip
    text = write_index(tmp_path, {"env_steps": 400, "policy": FIGURES | ends}, "obstacle_course").read_text()
    assert "diverged 50%, astray 25%<" in text


def test_the_next_command_can_be_copied_where_the_folder_has_a_space(tmp_path):
    out = tmp_path / "my runs" / "first"
    (out / "policy").mkdir(parents=True)
    hint = next(line for line in list_results(out) if line.startswith("next: "))
    assert shlex.split(hint)[4] == str(out / "policy")


def test_the_last_lines_name_the_page_the_reports_and_the_pictures(run):
    out, page = run
    text = "\n".join(list_results(out))
    assert str(page) in text and str(out / "fit" / "report.html") in text
    assert "drives.png, failures.mp4" in text and f"whill_mjx.evaluate {out / 'policy'}" in text


def test_the_reward_curve_counts_the_steps_of_the_progress_bar(tmp_path, monkeypatch):
    lines = [{"env_steps": steps, "eval/return": steps / 10, "eval/success": 0.5} for steps in (200, 400)]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    drawn = []
    monkeypatch.setattr("whill_mjx.evaluation.output.pictures.save_figure", lambda figure, out: drawn.append(figure))
    reward_curve(tmp_path / "metrics.jsonl", tmp_path / "curve.png", action_repeat=5)
    for axes in drawn[0].axes:
        assert [list(line.get_xdata()) for line in axes.get_lines()] == [[200, 400]]
    assert drawn[0].axes[1].get_xlabel().startswith("environment steps (each 5 control periods)")
