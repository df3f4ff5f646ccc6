"""The page of a fit: self-contained, honest about what got worse, and written from the run folder alone."""

from __future__ import annotations

import dataclasses
import json
import re
import xml.etree.ElementTree as xml
from html.parser import HTMLParser

import jax
import numpy as np
import pytest
from conftest import TRUTH, unicycle_plant

import sysid.report as report_module
from sysid.pages import report as report_json
from sysid.pages.fit_page import autocorrelation, choose, worse
from sysid.pages.report import KIND, SCHEMA, code_hashes, error_rows, read_report, summaries, write_html, write_report
from sysid.pages.series import Channel, TrialSeries, collect, load, save
from sysid.replay.rollout import make_batch, predictions, simulate
from whill_mjx.io.html import Cell, Section, html_page, number, png, table
from whill_mjx.io.svg import Axes, Line, bar_chart, interval_bar, line_chart

pytestmark = pytest.mark.quick


class Check(HTMLParser):
    """Collects links, and checks that every element is closed in order."""

    VOID = {"meta", "img", "br"}

    def __init__(self):
        super().__init__()
        self.open, self.links, self.text = [], [], []

    def handle_starttag(self, tag, attrs):
        if tag not in self.VOID:
            self.open.append(tag)
        self.links += [value for key, value in attrs if key in ("src", "href", "data")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def check(page):
    parser = Check()
    parser.feed(page)
    assert parser.open == []
    assert all(link.startswith(("#", "data:")) for link in parser.links)
    assert "<script" not in page and "@import" not in page and "url(" not in page
    return " ".join(parser.text)


@pytest.fixture(scope="module")
def run(tmp_path_factory, unicycle_log):
    """Run folder with a report of the kinematic vehicle, before (slow) and after the fit (true)."""
    plant, trials = unicycle_plant(), (*unicycle_log.training, *unicycle_log.held_out)
    batch, _ = make_batch(trials, plant.dt)
    replay = jax.jit(lambda values: simulate(plant, values, batch))
    initial, fitted = (predictions(trials, replay(values)) for values in (np.array([0.8, 0.6, 1.1]), TRUTH))
    rows = error_rows(trials, initial, fitted)
    folder = tmp_path_factory.mktemp("run")
    report = {
        "schema": SCHEMA, "kind": KIND, "code": code_hashes(),
        "dataset": {"name": "unicycle", "path": "nowhere", "sha256": unicycle_log.sha256, "vehicle": "toy & <co>",
                    "notes": ["a note"], "training": [t.name for t in unicycle_log.training],
                    "held_out": [t.name for t in unicycle_log.held_out]},
        "settings": {"seed": 0, "physics_dt": 0.02}, "model": {"preset": "toy", "effects": ["lag"]},
        "noise": {"source": "replicates", "scale": {"odometry.v": 0.005}},
        "parameters": [{"name": "tau_v", "meaning": "lag of <v>", "unit": "s", "initial": 0.8, "value": 0.25,
                        "interval": [0.2, 0.3], "confidence": 0.9, "bounds": [0.02, 1.0], "identifiable": True,
                        "remark": ""},
                       {"name": "turn", "unit": "-", "initial": 1.1, "value": 0.9, "interval": [0.5, 1.5],
                        "confidence": 0.9, "bounds": [0.5, 1.5], "identifiable": False, "remark": "not told"}],
        "fixed": [{"name": "mass", "value": 52.0, "reason": "weigh it"}], "weak_combinations": ["+1.00 turn"],
        "spectrum": [{"information": 4.0, "combination": "+1.00 turn"},
                     {"information": 2500.0, "combination": "+1.00 tau_v"}],
        "search": {"evaluations": 10, "seconds": 1.0, "cost_initial": 9.0, "cost": 1.0, "start_costs": [1.0, 1.01, 5.0],
                   "delay_profiles": [{"name": "delay", "values": [0.0, 0.1, 0.2], "cost": [3.0, 1.0, 2.0]}]},
        **summaries(rows, trials), "errors": rows}
    write_report(folder / "report.json", report)
    save(folder, collect(trials, initial, fitted))
    return folder


def test_the_page_is_written_from_the_folder_alone_and_links_nothing_outside(run):
    page = write_html(run).read_text()
    text, header = check(page), page.partition("</header>")[0]
    for word in ("Held-out trials: predicted, never fitted", "tau_v", "not told", "weigh it", "a note", "+1.00 turn",
                 "Fisher information", "0.02000", "2 of 3", "figure_eight_1 (held out)",
                 "sysid sources SHA-256", "toy & <co>", "lag of <v>"):
        assert word in text, word
    assert '<p class="kind"><span>whill-mjx</span>Fit</p>' in header and '<p class="lead">' in header
    report = read_report(run)
    assert report["dataset"]["sha256"] in text and report["code"]["sysid sources SHA-256"] in text
    assert not list(run.glob("*.tmp"))


def test_every_chart_of_the_page_is_well_formed(run):
    page = write_html(run).read_text()
    found = re.findall(r"<svg.*?</svg>", page, re.S)
    assert len(found) > 30
    for one in found:
        xml.fromstring(one)
        assert "nan" not in one and "inf" not in one


def test_more_sections_come_first(run):
    page = write_html(run, sections=[Section("Verdict", "<p>nothing missing</p>")]).read_text()
    assert page.index("nothing missing") < page.index("Held-out trials: predicted")


def test_series_come_back_from_their_file(run, unicycle_log):
    series = load(run)
    assert {trial.name for trial in series} == {trial.name for trial in unicycle_log.trials}
    one = next(trial for trial in series if trial.name == "circle_1").channels["odometry"]
    trial = next(trial for trial in unicycle_log.trials if trial.name == "circle_1")
    np.testing.assert_allclose(one.values["measured"][:, 3], trial.odometry.v, atol=1e-6)
    assert np.square(one.error("fitted")).mean() < 0.1 * np.square(one.error("initial")).mean()


def test_a_run_without_series_names_the_dataset_that_changed(run, tmp_path, monkeypatch, unicycle_log):
    other = dataclasses.replace(unicycle_log, sha256="other")
    monkeypatch.setattr("sysid.pages.report.load_any", lambda *a, **k: other)
    with pytest.raises(ValueError, match="nowhere: has changed"):
        report_json.replay(tmp_path, read_report(run))


def test_what_got_worse_lists_every_error_above_before_and_above_ideal():
    def one(**errors):
        return {"ideal": errors["ideal"], "initial": errors["initial"], "fitted": errors["fitted"]}

    rows = [{"trial": "a_1", "held_out": True, "channel": "odometry",
             "metrics": {"yaw": one(ideal=0.3, initial=0.1, fitted=0.2), "velocity": one(ideal=1.0, initial=2.0,
                                                                                         fitted=0.5)}}]
    text = worse({"errors": rows})
    assert "Of 2 errors" in text and "1 are more than before the fit and 0 more" in text
    assert "a_1*" in text and "yaw [rad]" in text and "velocity" not in text.split("<table>")[1]
    rows[0]["metrics"].pop("yaw")
    assert "Nothing: none of 1" in worse({"errors": rows})


def test_autocorrelation_of_a_first_order_process_is_its_own():
    random, rho = np.random.default_rng(0), 0.8
    values = np.zeros(20000)
    for i in range(1, len(values)):
        values[i] = rho * values[i - 1] + random.normal()
    t = np.arange(len(values)) * 0.05
    blank = np.zeros((len(values), 3))
    fitted = np.column_stack([values, blank[:, :2]])
    lag, found, count = autocorrelation([Channel(t, {"measured": blank, "fitted": fitted})], 0, max_lag=0.5)
    np.testing.assert_allclose(found, rho ** np.arange(len(lag)), atol=0.04)
    assert count >= len(values) - 1 and lag[1] == pytest.approx(0.05)


def test_errors_are_taken_along_and_across_the_measured_heading():
    measured = np.array([[0.0, 0.0, np.pi / 2], [0.0, 1.0, np.pi]])
    replayed = measured + [[0.0, 0.2, 2 * np.pi], [0.0, 0.2, 0.1]]
    error = Channel(np.arange(2.0), {"measured": measured, "fitted": replayed}).error()
    np.testing.assert_allclose(error, [[0.2, 0.0, 0.0], [0.0, -0.2, 0.1]], atol=1e-12)


def test_held_out_trials_and_other_manoeuvres_are_drawn_first():
    series = [TrialSeries(f"{name}_{k}", name == "eight", (0, 0, 0), {})
              for name in ("circle", "eight", "turn") for k in (1, 2, 3, 4, 5, 6)]
    names = [trial.name for trial in choose(series)]
    assert len(names) == 12 and names[0] == "eight_1"
    assert names.index("turn_1") < names.index("circle_2")


def test_text_is_escaped_and_titles_that_repeat_get_their_own_anchor():
    page = html_page("a < b", [Section("Same", table(["x"], [["<i>"], [Cell(0.5, "bad")], [None]])),
                               Section("Same", "")], kind="<b>", lead="x & <script>")
    check(page)
    assert "<script>" not in page and "x &amp; &lt;script&gt;" in page and "&lt;b&gt;" in page
    assert "&lt;i&gt;" in page and 'class="n bad"' in page and page.count('id="same"') == 1


def test_a_picture_is_put_inside_the_page(tmp_path):
    (tmp_path / "x.png").write_bytes(b"\x89PNG")
    assert 'src="data:image/png;base64,iVBORw=="' in png(tmp_path / "x.png", "x")


@pytest.mark.parametrize(("value", "shown"), [(0.01, "0.01000"), (1234.5, "1234"), (0.0, "0"), (3, "3"), (None, "–"),
                                              (float("nan"), "–"), (1.5e-7, "1.500e-07"), (-0.25, "-0.2500")])
def test_numbers_have_four_digits(value, shown):
    assert number(value) == shown


def test_charts_skip_what_is_not_finite_and_say_when_nothing_is_left():
    line = Line(np.array([0.0, 1.0, 2.0, 3.0]), np.array([0.0, np.nan, 1.0, 2.0]))
    path = re.search(r'<path d="(.*?)"', line_chart([line], "x", "y")).group(1)
    assert path.count("M") == 2 and path.count("L") == 1
    assert "nothing to show" in line_chart([Line(np.zeros(0), np.zeros(0))], "x", "y", "empty")
    assert "nothing to show" in bar_chart(["a"], {"fitted": [np.nan]}, "y")
    assert interval_bar(0.5, (0.4, 0.6), (0.0, 1.0), 0.2).count("<line") == 2


def test_equal_axes_have_one_scale():
    square = Line(np.array([0.0, 1.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0, 1.0]))
    points = re.search(r'<path d="(.*?)"', line_chart([square], "x", "y", axes=Axes(equal=True))).group(1)
    numbers = np.array(re.findall(r"[-\d.]+", points), float).reshape(-1, 2)
    assert np.ptp(numbers[:, 0]) == pytest.approx(np.ptp(numbers[:, 1]), abs=0.2)


@pytest.mark.parametrize(("content", "message"), [
    (None, "report.json: missing"), ("{", "not valid JSON"), (json.dumps({"kind": "x", "schema": 1}), "kind 'x'")])
def test_a_folder_without_a_report_ends_with_one_line(tmp_path, monkeypatch, content, message):
    if content is not None:
        (tmp_path / "report.json").write_text(content)
    monkeypatch.setattr("sys.argv", ["report", str(tmp_path)])
    with pytest.raises(SystemExit, match=f"error: .*{message}"):
        report_module.cli()


@pytest.mark.quick
def test_bars_of_zeros_are_drawn():
    assert "<rect" in bar_chart(["a", "b"], {"share": [0.0, 0.0]}, "share", log_y=False)
