"""What a fit comes to on held-out drives, as figures and as lines."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from benchmarks.harness import figure
from sysid.logs.metrics import own_floor
from sysid.logs.records import Log, Trial
from sysid.pages.report import error_rows, summaries
from sysid.search.fitting import Fit, predict

CLAIM = "How near a fit comes to the noise floor of its data"


def evaluate(fit: Fit, trials: tuple[Trial, ...]) -> dict[str, Any]:
    """Held-out summary of `sysid.report` for some trials."""
    held_out = tuple(replace(trial, held_out=True) for trial in trials)
    rows = error_rows(held_out, *predict(fit, held_out))
    return summaries(rows, held_out)


def gains(summary: dict[str, Any], prefix: str) -> dict[str, dict[str, Any]]:
    """Figures of one held-out summary: errors of the outside pose before and after, and the share removed."""
    figures = {}
    for metric in ("trajectory", "yaw"):
        one = summary["ground_truth"][metric]
        name = prefix if metric == "trajectory" else f"{prefix}_yaw"
        figures[f"gain_{name}"] = figure([1 - one["fitted"] / one["ideal"]], "share")
        for which in ("ideal", "initial", "fitted"):
            figures[f"rmse_{name}_{which}"] = figure([one[which]], one["unit"])
    return figures


def against_replicates(fit: Fit, log: Log, stem: str) -> tuple[dict[str, dict[str, Any]], dict[str, Any]]:
    """Figures of the held-out trials; mean position RMSE over the replicates' spread."""
    result = evaluate(fit, log.held_out)
    one = result["summary"]["held_out"]["ground_truth"]["trajectory"]
    floor = own_floor(log.trials, True)["ground_truth"]["trajectory"]  # of the same manoeuvres, held out or not
    assert floor is not None
    figures = gains(result["summary"]["held_out"], stem)
    figures[f"replicate_spread_{stem}"] = figure([floor], "m")
    figures[f"seconds_{stem}"] = figure([fit.seconds], "s")
    return figures, figure([one["fitted"] / floor], "-")


def show(figures: dict[str, dict[str, Any]]) -> None:
    for name, one in figures.items():
        print(f"{name:52} {one['value']:9.4f} {one['unit']}", flush=True)


def show_parameters(fit: Fit) -> None:
    print(f"  as stated: {', '.join(fit.stated) or 'nothing'}")
    for one in fit.uncertainty.estimates:
        print(f"  {one.name:32} {one.value:10.4g}  [{one.low:.4g}, {one.high:.4g}] {one.remark}", flush=True)
