"""The comparison of searches: what is counted, and that each gets somewhere."""

from __future__ import annotations

import json
import time

import numpy as np
import pytest
from cart import cart

from sysid import searches
from sysid.search import least_squares
from sysid.search.comparison import METHODS, Effort, Judge, Recorder, arrivals, trace
from sysid.search.fitting import make_problem
from sysid.search.result import Trace
from sysid.search.settings import FitConfig
from sysid.search.studies import BATCH
from sysid.searches import Arguments

LAG = "(0.1, 0.02, 1.0)"
MODEL = cart("tau_v", "tau_omega", f'{{"tau_v": {LAG}, "tau_omega": {LAG}, "turn": (1.0, 0.5, 1.5)}}')


@pytest.fixture(scope="module")
def problem(unicycle_log):
    names: dict = {}
    exec(MODEL, names)
    return make_problem(unicycle_log, FitConfig(), model=names["model"])


@pytest.fixture(scope="module")
def compared(unicycle_log, problem):
    """One run of each search."""
    judge = Judge(problem, unicycle_log)
    return [trace(problem, judge, method, 0, Effort(64, 14, 2))
            for method in METHODS]


def test_each_search_is_followed_to_its_end(compared, problem):
    for one in compared:
        assert (np.diff(one.evaluations) >= 0).all() and (np.diff(one.seconds) >= 0).all()
        assert (np.diff(one.cost) <= 0).all() and len(one.cost) == len(one.u) == len(one.held_out) > 2
        assert one.cost[-1] < 0.2 * one.cost[0]
        assert one.cost[-1] == pytest.approx(problem.objective.weighted_cost(one.u[-1:])[0], rel=1e-6)
    by = {one.method: one for one in compared}
    asked = {method: batch * (1 + -(-63 // batch)) for method, batch in BATCH.items()}
    assert {name: by[name].evaluations[-1] for name in asked} == asked  # whole batches, the initial values' own first
    assert by["lm"].cost[-1] == pytest.approx(min(one.cost[-1] for one in compared), rel=0.01)
    assert by["lm"].held_out[-1] < 0.1 * by["lm"].held_out[0]


def test_arrival_is_counted_from_the_best_of_all(compared):
    rows = {row["method"]: row for row in arrivals(compared)}
    assert rows["lm"]["arrived"] == 1 and rows["lm"]["evaluations"] <= rows["lm"]["all_evaluations"]
    late = Trace("slow", 0, np.array([5, 9]), np.array([1.0, 2.0]), np.array([50.0, 40.0]), np.zeros((2, 3)),
                 np.array([1.0, 1.0]))
    row = arrivals([*compared, late])[-1]
    assert row["arrived"] == 0 and row["evaluations"] is None and row["cost"] == 40.0


def test_a_derivative_counts_its_directions_and_recording_takes_no_time(problem):
    class Slow:
        def simulate(self, values):
            time.sleep(0.2)
            return problem.objective.replay.simulate(values)

    recorder = Recorder(Slow(), problem.objective)
    recorder.simulate(problem.space.to_values(np.full((3, 3), 0.5)))
    assert recorder.evaluations == 3 and recorder.seconds > 0.2
    recorder = Recorder(problem.objective.replay, problem.objective)
    recorder.jacobian(problem.space.to_values(np.full((2, 3), 0.5)))
    assert recorder.evaluations == 2 * (1 + 2 * 3)  # both ends of each difference are replayed
    spent = recorder._spent
    assert spent > 0 and len(recorder.best) == 1


def test_a_recorded_search_is_the_search_itself(problem, compared):
    points = least_squares.random_starts(problem.space, 2, 0)
    alone = least_squares.fit(problem.objective, starts=points, stop=least_squares.Stopping(14))
    lm = next(one for one in compared if one.method == "lm")
    assert lm.cost[-1] == pytest.approx(alone.cost, rel=1e-3)


def test_without_held_out_trials_there_is_no_held_out_error(problem, unicycle_log):
    log = unicycle_log.select(lambda trial: not trial.held_out)
    assert np.isnan(Judge(problem, log).error(np.full((2, 3), 0.5))).all()


def test_the_command_writes_page_picture_and_figures(tmp_path, unicycle_log, monkeypatch):
    (tmp_path / "cart.py").write_text(MODEL)
    monkeypatch.setattr(searches, "load_any", lambda path: unicycle_log)
    searches.main(Arguments(dataset=tmp_path, out=tmp_path / "run", model=str(tmp_path / "cart.py"), trials=16,
                            iterations=2, starts=1, methods=("lm", "tpe"), seeds=(0, 1)))
    content = json.loads((tmp_path / "run" / "searches.json").read_text())
    assert [(one["method"], one["seed"]) for one in content["traces"]] == [("lm", 0), ("lm", 1), ("tpe", 0), ("tpe", 1)]
    assert content["kind"] == "sysid-searches" and content["parameters"] == ["tau_v", "tau_omega", "turn"]
    page = (tmp_path / "run" / "searches.html").read_text()
    assert "data:image/png" in page and 'src="http' not in page and page.count("<tr>") == 3
    assert (tmp_path / "run" / "searches.png").stat().st_size > 20_000
    assert not list((tmp_path / "run").glob("*.tmp"))


@pytest.mark.quick
def test_an_unknown_search_is_refused(problem, unicycle_log):
    with pytest.raises(ValueError, match="no search 'annealing' .known: features"):
        trace(problem, Judge(problem, unicycle_log), "annealing", 0, Effort())
