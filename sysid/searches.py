"""Compare the searches of a fit: error against simulator evaluations and against time.

    python -m sysid.searches DATASET --methods features lm both tpe cmaes --seeds 0 1 2 --out RUN

writes RUN/searches.json, RUN/searches.png and the page RUN/searches.html. All searches minimise the same weighted least
squares of the training trials (`features` begins with motion in short bins). Every replay that a search asks for is
recorded with the parameter sets in it and the time until its answer; a derivative counts as one evaluation per
parameter and one for the point. Compilation is done before the clock starts, and what the record itself costs is not
counted. The error is that of the best point so far: its cost on the training trials, and its position error on the
held-out ones, replayed when the search is over.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

from whill_mjx.io.command_line import SEED, Range, check_known, listen, refusing, starts

if starts(__name__):
    listen()

import jax

from sysid import command_line
from sysid.logs.loaders import load_any
from sysid.logs.records import Log
from sysid.pages.plots import write_search_plot
from sysid.pages.report import code_hashes, write_report
from sysid.search.comparison import METHODS, NEAR, Effort, Judge, arrivals, trace
from sysid.search.fitting import Problem, check_settings, make_problem, subject
from sysid.search.result import Trace
from sysid.search.settings import FitConfig
from whill_mjx.io.folders import claim_folder
from whill_mjx.io.html import Section, html_page, paragraph, png, table
from whill_mjx.logs.dataset import write_text

KIND = "sysid-searches"
OUTPUTS = ("searches.json", "searches.png", "searches.html")


@dataclass(frozen=True, kw_only=True)
class Arguments(command_line.OwnModels, FitConfig):
    """Command line of `python -m sysid.searches`; what is fitted is set as for `sysid.fit`."""

    dataset: Path
    """Folder with the driving log."""
    out: Path = Path("runs/searches")
    """Folder for searches.json, .png and .html."""
    methods: tuple[str, ...] = METHODS
    """Searches to compare: features, lm, both (TPE, then lm), tpe, cmaes."""
    seeds: Annotated[tuple[int, ...], SEED] = (0,)
    """One run of each search for each."""
    trials: Annotated[int, Range(1, 1_000_000)] = 256
    """Parameter sets that the global searches try."""
    iterations: Annotated[int, Range(1, 10_000)] = 20
    """Iterations of the gradient searches."""
    starts: Annotated[int, Range(1, 10_000)] = 4
    """Starts of the gradient searches: the initial values, and random ones."""


def main(arguments: Arguments) -> list[Trace]:
    """Run all searches with all seeds and write the comparison."""
    with refusing():
        for method in arguments.methods:
            check_known("--methods", method, METHODS)
        if not arguments.methods or not arguments.seeds:
            raise ValueError("--methods and --seeds: each needs one at least. Leave the option out for the default.")
        log = load_any(arguments.dataset)
        config = FitConfig(**{name: getattr(arguments, name) for name in FitConfig.__dataclass_fields__})
        log, model = subject(log, config, check_settings(log, config))
    with claim_folder(arguments.out, "sysid.searches", OUTPUTS) as claim:
        claim.settle({})  # timings are made anew
        return compare(arguments, log, make_problem(log, config, model=model))


def compare(arguments: Arguments, log: Log, problem: Problem) -> list[Trace]:
    """Run, write and print in a folder that is held."""
    judge = Judge(problem, log)
    effort = Effort(arguments.trials, arguments.iterations, arguments.starts)
    traces = []
    with command_line.progress_bar(len(arguments.methods) * len(arguments.seeds), "searches") as progress:
        for method in arguments.methods:
            for seed in arguments.seeds:
                traces.append(trace(problem, judge, method, seed, effort))
                progress(1, f"{method}: cost {traces[-1].cost[-1]:.4g}")
    write(arguments.out, log, traces, problem.space.names)
    for row in arrivals(traces):
        print("  ".join(f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}"
                        for key, value in row.items()))
    print(f"wrote {arguments.out / 'searches.html'}, searches.json and searches.png")
    return traces


def write(out: Path, log: Log, traces: Sequence[Trace], names: Sequence[str]) -> None:
    """Write searches.json, searches.png and searches.html."""
    out.mkdir(parents=True, exist_ok=True)
    device = jax.devices()[0]
    rows = arrivals(traces)
    write_report(out / "searches.json", {
        "schema": 1, "kind": KIND, "dataset": {"name": log.name, "sha256": log.sha256}, "parameters": list(names),
        "device": f"{device.platform} {device.device_kind}", "code": code_hashes(), "near": NEAR, "table": rows,
        "traces": [asdict(one) for one in traces]})
    picture = write_search_plot(out / "searches.png", traces)
    header = ["search", "runs", f"within {NEAR:.0%} of the best", "evaluations until then", "seconds until then",
              "final cost", "held-out position RMSE [m]", "evaluations", "seconds"]
    body = [[row[key] for key in ("method", "runs", "arrived", "evaluations", "seconds", "cost", "held_out",
                                  "all_evaluations", "all_seconds")] for row in rows]
    page = html_page(f"Searches on {log.name}", [
        Section("Error against effort", png(picture, "Best point so far; thin: each run, thick: their median.")),
        Section("Arrival", table(header, body) + paragraph(
            "Medians over runs. Times are without compilation; a derivative counts one evaluation per parameter.",
            "dim"))],
        f"{device.device_kind}, {len(names)} parameters", kind="Searches", lead=_headline(rows))
    write_text(out / "searches.html", page)


def _headline(rows: Sequence[dict[str, Any]]) -> str:
    """One sentence: which search came nearest, and how long it took."""
    best = min(rows, key=lambda row: row["cost"])
    return (f"The lowest cost, {best['cost']:.4g}, is that of the search {best['method']}, in "
            f"{best['all_seconds']:.3g} s.")


def cli() -> None:
    command_line.run(Arguments, main, __doc__)


if __name__ == "__main__":
    cli()
