"""Statistics with known answers, and the paper's experiment on the kinematic vehicle."""

from __future__ import annotations

import dataclasses
import itertools
import json

import jax
import numpy as np
import pytest
from conftest import TRUTH, unicycle_plant

import sysid.paper as paper_module
from sysid.intervals.statistics import EXACT_UP_TO, holm, mean_sd, sign_flip_p, smallest_p, upper_rate
from sysid.pages.paper_page import HELD_OUT, PARAMETERS, PaperConfig, caution, compare, markdown
from sysid.paper import main, select
from sysid.replay.rollout import make_batch, predictions, simulate
from sysid.search.fitting import Fit
from sysid.search.result import FitResult
from whill_mjx.logs.manoeuvres import PAPER_MANOEUVRES
from whill_mjx.vehicle.parameters import describe, set_values
from whill_mjx.vehicle.presets import preset_params
from whill_mjx.vehicle.specs import WHILL_CR
from whill_mjx.vehicle.vehicle_file import load_vehicle

pytestmark = pytest.mark.quick


@pytest.mark.parametrize(("differences", "p"), [
    ([1.0, 2.0, 3.0], 2 / 8),  # all of one sign: the two extreme patterns
    ([-1.0, -2.0, -3.0, -0.5, -0.1], 2 / 32),
    ([1.0, -1.0], 1.0),
    ([3.0, 2.0, -1.0], 4 / 8),  # |sum| 4: +++ and ++- and their negatives
    ([0.0, 0.0, 5.0], 1.0),  # every pattern has the same |sum|
    ([1.0], 1.0)])
def test_sign_flips_are_counted_exactly(differences, p):
    assert sign_flip_p(differences) == pytest.approx(p)


def test_sign_flips_agree_with_a_count_by_hand():
    values = np.random.default_rng(4).normal(0.4, 1.0, 9)
    patterns = [np.dot(signs, values) for signs in itertools.product((-1, 1), repeat=9)]
    expected = np.mean([abs(one) >= abs(values.sum()) - 1e-12 for one in patterns])
    assert sign_flip_p(values) == pytest.approx(expected)


def test_many_pairs_are_sampled_and_agree_with_the_exact_count(monkeypatch):
    values = np.random.default_rng(1).normal(0.5, 1.0, EXACT_UP_TO)
    exact = sign_flip_p(values)
    monkeypatch.setattr("sysid.intervals.statistics.EXACT_UP_TO", 4)
    assert sign_flip_p(values) == pytest.approx(exact, abs=0.01)
    assert sign_flip_p(values, seed=1) == sign_flip_p(values, seed=1)
    assert sign_flip_p(np.full(40, 1.0)) == pytest.approx(smallest_p(40))


def test_p_values_of_pure_noise_are_uniform():
    draws = np.random.default_rng(0).normal(size=(400, 8))
    p = np.array([sign_flip_p(row) for row in draws])
    assert np.mean(p <= 0.05) == pytest.approx(0.05, abs=0.025)
    assert np.mean(p <= 0.5) == pytest.approx(0.5, abs=0.07)


@pytest.mark.parametrize("bad", [[], [1.0, np.nan], [[1.0]]])
def test_pairs_that_were_not_measured_are_refused(bad):
    with pytest.raises(ValueError, match="one per pair"):
        sign_flip_p(bad)


def test_holm_has_its_textbook_values():
    np.testing.assert_allclose(holm([0.01, 0.04, 0.03, 0.005]), [0.03, 0.06, 0.06, 0.02])
    np.testing.assert_allclose(holm([0.5, 0.9]), [1.0, 1.0])
    assert len(holm([])) == 0
    with pytest.raises(ValueError, match="within 0 to 1"):
        holm([0.2, 1.2])


def test_holm_bounds_the_chance_of_any_false_finding():
    random = np.random.default_rng(2)
    assert np.mean([(holm(random.uniform(size=20)) <= 0.05).any() for _ in range(2000)]) <= 0.065


def test_mean_and_deviation_of_a_sample():
    assert mean_sd([1.0, 3.0]) == (2.0, pytest.approx(np.sqrt(2)))
    assert np.isnan(mean_sd([1.0])[1])


def test_the_thirteen_parameters_are_those_of_the_paper():
    assert len(set(PARAMETERS)) == 13
    assert set(PARAMETERS) <= set(describe(preset_params(WHILL_CR, "paper")))


def rows_of(before, after, manoeuvre="circle", metric="yaw"):
    return [{"trial": f"{manoeuvre}_{k}", "manoeuvre": manoeuvre, "channel": "odometry", "held_out": False,
             "metrics": {metric: {"ideal": 0.0, "initial": a, "fitted": b}}}
            for k, (a, b) in enumerate(zip(before, after, strict=True))]


def test_the_table_pairs_drives_and_corrects_over_all_of_it():
    rows = rows_of([1.0, 1.1, 1.2, 1.3], [0.1, 0.2, 0.2, 0.1]) + rows_of([0.5, 0.6], [0.5, 0.4], "turn")
    turn, circle = compare(rows, "odometry")
    assert (turn["manoeuvre"], circle["manoeuvre"]) == ("turn", "circle")  # in the paper's order
    assert circle["initial"] == (pytest.approx(1.15), pytest.approx(np.std([1, 1.1, 1.2, 1.3], ddof=1)))
    assert circle["drives"] == 4 and circle["p"] == pytest.approx(2 / 16)
    assert circle["p_holm"] == pytest.approx(2 * 2 / 16) and turn["p_holm"] == pytest.approx(1.0)
    (single,) = compare(rows_of([1.0], [0.5]), "odometry")
    assert single["p"] is None and single["p_holm"] is None and np.isnan(single["initial"][1])


def test_the_caution_says_how_many_drives_it_takes():
    content = {"dataset": {"drives": dict.fromkeys(PAPER_MANOEUVRES, 3)}, "table": {"odometry": [{}] * 20}}
    assert "Nothing can be significant; 10 drives" in caution(content)
    content["dataset"]["drives"] = dict.fromkeys(PAPER_MANOEUVRES, 10)
    assert "Nothing" not in caution(content) and "below 0.0391" in caution(content)


def test_the_figure_eight_alone_is_held_out_whatever_the_log_says(unicycle_log):
    wrong = dataclasses.replace(unicycle_log, trials=tuple(
        dataclasses.replace(trial, held_out=trial.manoeuvre == "turn") for trial in unicycle_log.trials))
    assert {trial.manoeuvre for trial in select(wrong).held_out} == {HELD_OUT}
    assert [trial.manoeuvre for trial in select(wrong).trials[::2]] == list(PAPER_MANOEUVRES)


def test_a_log_without_a_manoeuvre_or_the_channel_is_refused(unicycle_log):
    with pytest.raises(ValueError, match="no trial of turn .*name trials like circle_1"):
        select(unicycle_log.select(lambda trial: trial.manoeuvre != "turn"))
    blind = dataclasses.replace(unicycle_log, trials=tuple(
        dataclasses.replace(trial, odometry=None) for trial in unicycle_log.trials))
    with pytest.raises(ValueError, match="no position in odometry. Use --channel ground_truth"):
        select(blind)


@pytest.fixture(scope="module")
def experiment(tmp_path_factory, unicycle_log):
    """The command with a search that returns the truth, and what the search was given."""
    folder, given = tmp_path_factory.mktemp("paper"), {}
    initial = preset_params(unicycle_log.spec, "paper")

    def fit_log(log, config, progress=None):
        given.update(log=log, config=config)
        found = FitResult(np.zeros(13), 0.1, 2.0, 500, history=np.array([2.0, 0.1]))
        blank = dict.fromkeys(field.name for field in dataclasses.fields(Fit))
        fitted = set_values(initial, ("pid_drive.kp",), np.array([20.0], np.float32))
        return Fit(**{**blank, "params": fitted, "initial_params": initial, "scan": found, "initial_cost": 2.0,
                      "cost": 0.1, "seconds": 1.0, "profiles": []})

    def predict(fit, trials):
        batch, _ = make_batch(trials, 0.02)
        replay = jax.jit(lambda values: simulate(unicycle_plant(), values, batch))
        return tuple(predictions(trials, replay(values)) for values in (np.array([0.8, 0.6, 1.0]), TRUTH))

    with pytest.MonkeyPatch.context() as patch:
        for name, value in (("fit_log", fit_log), ("predict", predict), ("load_any", lambda path: unicycle_log)):
            patch.setattr(paper_module, name, value)
        content = main(PaperConfig(folder / "log", folder / "run", trials=500, seed=3))
    return folder / "run", content, given


def test_the_search_is_the_papers(experiment):
    _, _, given = experiment
    config = given["config"]
    assert (config.preset, config.method, config.trials, config.seed) == ("paper", "tpe", 500, 3)
    assert config.parameters == PARAMETERS and config.channels == "odometry"
    assert {trial.manoeuvre for trial in given["log"].training} == set(PAPER_MANOEUVRES) - {HELD_OUT}


def test_the_table_has_four_errors_of_five_manoeuvres_and_they_fell(experiment):
    folder, content, _ = experiment
    entries = content["table"]["odometry"]
    assert len(entries) == 20 and all(one["drives"] == 2 for one in entries)
    eight = next(one for one in entries if one["manoeuvre"] == HELD_OUT and one["metric"] == "trajectory")
    assert eight["held_out"] and eight["optimised"][0] < 0.2 * eight["initial"][0]
    assert markdown(content).count("| initial |") == 10  # five manoeuvres, two channels
    stored = json.loads((folder / "paper.json").read_text())
    assert stored["kind"] == "sysid-paper" and stored["search"]["J"] == 0.1
    assert "Nothing can be significant" in (folder / "paper.md").read_text()


def test_the_page_holds_table_and_figures_itself(experiment):
    folder, _, _ = experiment
    page = (folder / "paper.html").read_text()
    assert page.count("data:image/png;base64") == 2 and 'src="http' not in page and 'href="http' not in page
    assert "figure_eight (held out)" in page and "34.79" in page
    for name in ("paper_trajectories.png", "paper_yaw.png"):
        assert (folder / name).stat().st_size > 10_000
    _, params, provenance = load_vehicle(folder / "vehicle.toml")
    assert provenance["made_by"] == "sysid.paper" and float(params.effects[0].kp) == 20.0


def test_a_missing_log_ends_with_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["paper", str(tmp_path / "nowhere")])
    with pytest.raises(SystemExit, match="error: .*nowhere: no such folder"):
        paper_module.cli()


@pytest.mark.quick
def test_upper_end_of_a_rate():
    assert upper_rate(0, 60) == pytest.approx(1 - 0.05 ** (1 / 60))  # none seen: (1 - p)^n = 0.05
    assert upper_rate(4, 200) < 0.05 < upper_rate(5, 200)
    assert upper_rate(3, 3) == 1.0
