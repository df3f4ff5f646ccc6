"""How well vehicles are identified: planted truth, the shared plant logs, and two published measured sets.

    python -m benchmarks.fit --shared ../shared --parts planted plant chair contact few speed drive mrclam

    python -m benchmarks.fit --parts coverage --part 3/32 --work runs/fit       # one of 32 processes; the same with
    python -m benchmarks.fit --parts contact few --part 3/3 --work runs/fit     # these parts, and with
    python -m benchmarks.fit --parts starts tpe searches --part 3/40 --work runs/fit          # these parts; restart
    python -m benchmarks.fit --parts many_starts --work runs/fit                # any that was stopped. On a GPU
    python -m benchmarks.fit --parts coverage starts tpe searches many_starts --collect --work runs/fit  # the figures

On one core a synthetic log takes 150 s, one of the plant 4 min, a start 5 min, a search by features 5 min and by TPE or
CMA-ES 1 min, the 500 trials of TPE half a minute and four such searches one by one 75 s; the first process compiles
for all, 90 s and 3 GB for each kind of log.
Writes benchmarks/results/fit.json and, for drive and mrclam, measured.json. A "gain" is the share of
the held-out mean position RMSE (or yaw RMSE) of the ideal kinematic replay that the fitted vehicle removes; every
window restarts from the measured pose and wheel speeds and counts only where the measurement changed.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks import fit_coverage, fit_searches
from benchmarks.fit_jobs import (
    compile_once,
    labels_of,
    on_device,
    read_results,
    run_jobs,
    share_compilations,
    write_result,
)
from benchmarks.fit_measured import drive, mrclam
from benchmarks.fit_scores import CLAIM, against_replicates, evaluate, show, show_parameters
from benchmarks.fit_settings import Benchmark
from benchmarks.harness import device_name, figure, record
from sysid.logs.log import load_log
from sysid.logs.metrics import noise_floor
from sysid.logs.records import Log
from sysid.search.comparison import Judge
from sysid.search.fitting import Fit, fit_log, make_objective, make_problem
from sysid.search.settings import FitConfig
from whill_mjx.io.command_line import run

UNSEEN = 16
CHAIR = Path(__file__).parents[1] / "sysid" / "data" / "chair"


def plant(settings: Benchmark) -> None:
    """The plant's plain chair: held-out position error against the spread between replicates."""
    log = load_log(settings.shared / "data" / "plant" / "plain")
    for preset in settings.presets:
        fit = fit_log(log, settings.fitted(preset=preset))
        figures, ratio = against_replicates(fit, log, f"plant_{preset}{settings.tag}")
        figures[f"plant_replicate_ratio_{preset}{settings.tag}"] = ratio
        if preset == "physical":
            figures[f"plant_replicate_ratio{settings.tag}"] = ratio
        record("fit", CLAIM, figures)
        show(figures)
        show_parameters(fit)


def chair(settings: Benchmark) -> None:
    """The log that ships with the package."""
    log = load_log(CHAIR)
    fit = fit_log(log, settings.fitted())
    figures, ratio = against_replicates(fit, log, f"chair{settings.tag}")
    figures[f"chair_replicate_ratio{settings.tag}"] = ratio
    record("fit", CLAIM, figures)
    show(figures)
    show_parameters(fit)


def contact(settings: Benchmark) -> None:
    """Days of the contact plant, each fitted by itself: is the shared log an exception?"""
    days(settings, "contact")


def few(settings: Benchmark) -> None:
    """The same with as few drives as the log that ships has."""
    days(settings, "few", {path.name for path in (CHAIR / "trials").iterdir()})


def days(settings: Benchmark, name: str, trials: set[str] | None = None) -> None:
    """Error of fits to days of the contact plant on UNSEEN further drives of the held-out manoeuvre, over the spread of
    these; of these trials only, if they are given. The spread of two drives is known to a third, which is too little.
    """
    from benchmarks.plant.make import Experiment, make_log

    def job(seed: str) -> dict[str, Any]:
        with tempfile.TemporaryDirectory() as folder:
            make_log(Path(folder) / "log", Experiment(seed=int(seed)))
            log = load_log(Path(folder) / "log").select(lambda one: trials is None or one.name in trials)
            held_out = tuple({one.manoeuvre for one in log.held_out})
            make_log(Path(folder) / "more", Experiment(seed=int(seed), replicates=UNSEEN, manoeuvres=held_out))
            more = load_log(Path(folder) / "more").trials
        fit = fit_log(log, settings.fitted())
        error = evaluate(fit, more)["summary"]["held_out"]["ground_truth"]["trajectory"]["fitted"]
        floor = noise_floor(more)
        assert floor is not None and floor["ground_truth"]["trajectory"] is not None
        return {"ratio": error / floor["ground_truth"]["trajectory"], "seconds": fit.seconds,
                "of_two": against_replicates(fit, log, name)[1]["value"], "as_stated": list(fit.stated)}

    folder = settings.work / f"{name}{settings.tag}"
    if not settings.collect:
        run_jobs(folder, labels_of(settings.part, [str(seed) for seed in settings.seeds]), job)
    results = [one for one in read_results(folder) if int(one["label"]) in settings.seeds]
    for one in results:
        print(f"day {one['label']}: {one['ratio']:.3f} ({one['of_two']:.3f} by its own two); as stated: "
              f"{', '.join(one['as_stated']) or 'nothing'}")
    if len(results) == len(settings.seeds):
        ratios, seconds = ([one[of] for one in results] for of in ("ratio", "seconds"))
        figures = on_device({f"{name}_replicate_ratio{settings.tag}": figure(ratios, "-"),
                             f"seconds_{name}{settings.tag}": figure(seconds, "s")}, results)
        record("fit", CLAIM, figures)
        show(figures)


def planted(settings: Benchmark) -> None:
    """Planted truth of the same model: held-out error against the sensor noise, and starts that agree."""
    from benchmarks.planted_logs import Schedule, fitted_plant, write_dataset
    from sysid.errors.space import make_space
    from whill_mjx.vehicle.parameters import get_values, set_values
    from whill_mjx.vehicle.presets import preset_params
    from whill_mjx.vehicle.specs import WHILL_CR

    start = preset_params(WHILL_CR, "paper")
    space = make_space(start, WHILL_CR)
    # What the fit takes as known (such as the height of the centre of mass) is as it takes it.
    truth = set_values(start, space.names, get_values(preset_params(WHILL_CR, "paper_optimised"), space.names))
    with tempfile.TemporaryDirectory() as folder:
        log = load_log(write_dataset(Path(folder) / "log", WHILL_CR, truth, Schedule(replicates=2),
                                     plant=fitted_plant(WHILL_CR)))
    fit = fit_log(log, FitConfig(preset="paper", iterations=settings.iterations))
    one = evaluate(fit, log.held_out)["summary"]["held_out"]["ground_truth"]["trajectory"]
    inside = [estimate.low <= value <= estimate.high for estimate, value in zip(
        fit.uncertainty.estimates, np.asarray(get_values(truth, space.names)), strict=True) if estimate.identifiable]
    figures = {"noise_floor_ratio": figure([one["fitted"] / one["noise_floor"]], "-"),
               "planted_identifiable": figure([float(len(inside))], "count"),
               "planted_inside_interval": figure([float(np.mean(inside))], "share")}
    record("fit", CLAIM, figures)
    show(figures)
    show_parameters(fit)


def speed(settings: Benchmark) -> None:
    """Seconds of one start to convergence, features and poses, on 18 trials of 22 s, and of the whole fit, which also
    looks elsewhere; compilation included. Of one start also where a fit before it has compiled all, and of the whole
    fit the processor time, also without compiling.
    """
    log = load_log(settings.shared / "data" / "plant" / "plain")
    kept = {trial.name for trial in log.training[:18]}
    log = log.select(lambda trial: trial.name in kept)
    one, whole, process, compiling = [], [], [], []
    for _ in range(settings.repeats):
        one.append(fit_log(log, FitConfig(iterations=settings.iterations, elsewhere=False)).seconds)
        began = time.process_time()
        fit = fit_log(log, FitConfig(iterations=settings.iterations))
        process.append(time.process_time() - began)
        whole.append(fit.seconds)
        compiling.append(compile_seconds(fit, log))
    share_compilations(settings.work / "compiled")
    again = [fit_log(log, FitConfig(iterations=settings.iterations, elsewhere=False)).seconds
             for _ in range(1 + settings.repeats)][1:]
    # On a machine that others use as well, processor time is what the fit itself takes.
    figures = {"cpu_seconds": figure(one, "s"), "cpu_seconds_compiled": figure(again, "s"),
               "cpu_seconds_whole": figure(whole, "s"),
               "cpu_seconds_process": figure(process, "s"),
               "cpu_seconds_process_search": figure([a - b for a, b in zip(process, compiling, strict=True)], "s")}
    record("fit", CLAIM, figures)
    show(figures)


def compile_seconds(fit: Fit, log: Log) -> float:
    """By how much more processor time the first replay and Jacobian of a fresh objective take than the second."""
    objective = make_objective(fit.plant, fit.initial_params, fit.space, log.training, fit.noise)
    spent = []
    for _ in range(2):
        began = time.process_time()
        objective.jacobian(fit.u[None])
        objective.residuals(np.tile(fit.u, (4, 1)))
        spent.append(time.process_time() - began)
    return spent[0] - spent[1]


def many_starts(settings: Benchmark) -> None:
    """Seconds of 32 starts at once, compilation apart: gpu_seconds on a GPU."""
    stem = f"many_starts_{Path(settings.search_log).name}"
    if settings.collect:
        for platform in ("cpu", "gpu"):
            results = read_results(settings.work / f"{stem}_{platform}")
            if results:
                figures = on_device(fit_searches.summarise_many(results, platform), results)
                record("fit", CLAIM, figures, replacing=fit_searches.many_stem(platform))
                show(figures)
        return
    log = fit_searches.find_log(settings.search_log, settings.shared, settings.search_trials)
    problem = make_problem(log, FitConfig(physics_dt=settings.physics_dt))

    def search() -> dict[str, Any]:
        return fit_searches.many_starts(problem, log.spec.track, settings.many, settings.iterations,
                                        settings.whole)

    first = search()["seconds"]
    print(f"first of {settings.repeats + 1} searches: {first:.1f} s", flush=True)
    platform = "cpu" if jax.default_backend() == "cpu" else "gpu"
    run_jobs(settings.work / f"{stem}_{platform}", [f"repeat_{n}" for n in range(settings.repeats)],
             lambda label: {**search(), "first": first})


def coverage(settings: Benchmark) -> None:
    """Coverage of the 90 % intervals on logs with known values."""
    folder = settings.work / "coverage"
    again = settings.work / "told_again"
    counts = {"synthetic": settings.logs, "plant": settings.plant_logs}
    labels = [f"{kind}_{n:03d}" for kind in fit_coverage.KINDS for n in range(counts.get(kind, settings.other_logs))]
    if not settings.collect:
        share_compilations(settings.work / "compiled")
        if settings.told_again:
            kept = {one["label"]: one for one in read_results(folder)}
            labels = [label for label in labels if label in kept]
            run_jobs(again, labels_of(settings.part, labels), lambda label: fit_coverage.told_again(
                kept[label], settings.work / "compiled"))
            return
        run_jobs(folder, labels_of(settings.part, labels), lambda label: fit_coverage.job(
            label, settings.iterations, folder, settings.work / "compiled"))
        return
    for kind in fit_coverage.KINDS:
        prefix = "" if kind == "synthetic" else f"{kind}_"
        results = ([fit_coverage.judged_again(one, folder) for one in read_results(folder, f"{kind}_*")]
                   if not settings.told_again else read_results(again, f"{kind}_*"))
        if results:
            figures = on_device(fit_coverage.summarise(results, prefix), results)
            record("fit", CLAIM, figures, replacing=tuple(f"{prefix}{stem}" for stem in fit_coverage.PER_PARAMETER))
            show(figures)


def starts(settings: Benchmark) -> None:
    """How many of 32 starts of the default search end at the same optimum."""
    name = Path(settings.search_log).name
    folder = settings.work / f"starts_{name}"
    if settings.collect:
        results = read_results(folder)
        if results:
            log = fit_searches.find_log(settings.search_log, settings.shared, settings.search_trials)
            ends = np.array([one["u"] for one in results])
            costs = fit_searches.common_costs(make_problem(log, FitConfig()), log.spec.track, ends)
            results = [{**one, "cost": float(cost)} for one, cost in zip(results, costs, strict=True)]
            figures = on_device(fit_searches.summarise_starts(results, "" if name == "plant" else f"{name}_"), results)
            record("fit", CLAIM, figures)
            show(figures)
        return
    share_compilations(settings.work / "compiled")
    log = fit_searches.find_log(settings.search_log, settings.shared, settings.search_trials)
    problem = make_problem(log, FitConfig())
    compile_once(settings.work / "compiled", log.name, lambda: fit_searches.compile_replay(problem.objective))
    labels = [f"start_{n:02d}" for n in range(fit_searches.STARTS)]
    run_jobs(folder, labels_of(settings.part, labels), lambda label: fit_searches.start_job(
        problem, log.spec.track, int(label[-2:]), settings.iterations, folder / "stages"))


def tpe500(settings: Benchmark) -> None:
    """TPE in batches, timed, and its J against that of TPE asked one by one (on the processor: one at a time)."""
    platform = "cpu" if jax.default_backend() == "cpu" else "gpu"
    folder = settings.work / f"tpe_{Path(settings.search_log).name}"
    if settings.collect:
        sequential = read_results(folder, "sequential_*")
        for platform in ("cpu", "gpu"):
            batched = read_results(folder, f"{platform}_*")
            if not batched:
                continue
            figures = on_device(fit_searches.summarise_tpe(batched, sequential, platform), batched)
            record("fit", CLAIM, figures)
            show(figures)
        return
    share_compilations(settings.work / "compiled")
    log = fit_searches.find_log(settings.search_log, settings.shared, settings.search_trials)
    problem = make_problem(log, FitConfig(physics_dt=settings.physics_dt))
    compile_once(settings.work / "compiled", log.name, lambda: fit_searches.compile_replay(problem.objective))
    seeds = range(settings.search_seeds)
    groups = [list(seeds)[i : i + fit_searches.LOCKSTEP] for i in range(0, len(seeds), fit_searches.LOCKSTEP)]
    labels = [f"{platform}_{seed:02d}" for seed in seeds]
    # On an accelerator only what it is to be timed with is run: one by one, the processor is no slower.
    labels += [f"group_{k}" for k in range(len(groups))] if platform == "cpu" else []

    def job(label: str) -> dict[str, Any]:
        if label.startswith(platform):
            return fit_searches.tpe_batched(problem, settings.tpe_trials, int(label[-2:]),
                                            folder / "costs" / f"{label}.jsonl")
        group = groups[int(label.removeprefix("group_"))]
        found = fit_searches.tpe_sequential(problem, settings.tpe_trials, group, folder / "costs" / f"{label}.jsonl")
        for seed, one in zip(group, found, strict=True):
            write_result(folder / f"sequential_{seed:02d}.json", {**one, "device": device_name()})
        return {"seeds": group}

    run_jobs(folder, labels_of(settings.part, labels), job)


def searches(settings: Benchmark) -> None:
    """Error against simulator evaluations and seconds of each search, and their picture."""
    folder = settings.work / f"searches_{Path(settings.search_log).name}"
    log = fit_searches.find_log(settings.search_log, settings.shared, settings.search_trials)
    if settings.collect:
        results = read_results(folder / "jobs")
        if results:
            figures = on_device(fit_searches.write_curves(folder, log, results), results)
            record("fit", CLAIM, figures)
            show(figures)
            print(f"wrote {folder / 'searches.png'}")
        return
    share_compilations(settings.work / "compiled")
    problem = make_problem(log, FitConfig())
    judge = Judge(problem, log)
    compile_once(settings.work / "compiled", log.name, lambda: fit_searches.compile_replay(problem.objective))
    effort = fit_searches.Effort(settings.tpe_trials, settings.iterations, settings.search_starts)
    labels = [f"{method}_{seed:02d}" for seed in range(settings.search_seeds) for method in settings.methods]

    def job(label: str) -> dict[str, Any]:
        method, _, seed = label.partition("_")
        return fit_searches.curve_job(problem, judge, method, int(seed), effort)

    run_jobs(folder / "jobs", labels_of(settings.part, labels), job)


def main(settings: Benchmark) -> None:
    """Measure the parts whose data is at hand."""
    parts = {"planted": planted, "plant": plant, "chair": chair, "contact": contact, "few": few, "speed": speed,
             "many_starts": many_starts, "starts": starts, "coverage": coverage, "tpe": tpe500, "searches": searches,
             "drive": drive, "mrclam": mrclam}
    for name in settings.parts:
        searched = ("many_starts", "starts", "tpe", "searches") if settings.search_log == "plant" else ()
        needs = {**dict.fromkeys(("plant", "speed", *searched), "plant"),
                 "drive": "measured/drive_norlab", "mrclam": "measured/mrclam"}
        folder = settings.shared / "data" / needs.get(name, "")
        if name in needs and not folder.is_dir():
            print(f"{name}: {folder} is not there, left out")
            continue
        parts[name](settings)


if __name__ == "__main__":
    run(Benchmark, main, __doc__, positional=False)
