"""Enter a method into the bench of undeclared effects: drive the logs, ask for verdicts, count.

    python -m benchmarks.undeclared_entry --method path/to/file.py:MyMethod
    python -m benchmarks.undeclared_entry --method naive ours --scales 2 4 --nulls 40

A method sees folders of logs and never what is in them. docs/bench.md says how to write one
(`benchmarks/undeclared_methods.py` has two). Logs and verdicts are kept in `--work`; a run that was stopped goes on
where it was. The same `--seed` gives the same logs to everybody; another one keeps them from being tuned for.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from benchmarks.plant.effects import EFFECTS
from benchmarks.plant.make import Experiment, make_log
from benchmarks.undeclared_methods import Method, Verdict, check_verdict, find_method
from benchmarks.undeclared_plant import RECORDED, capped
from sysid.intervals.statistics import upper_rate
from whill_mjx.io.command_line import COUNT, NOT_NEGATIVE, SEED, Range, check_known, refusing, run
from whill_mjx.io.folders import check_place, write_whole

FIRST_SEED = 500_000
"""Apart from the seeds with which the project's own method was made (below 100,000)."""


@dataclass(frozen=True)
class Entry:
    """Options of the command."""

    method: tuple[str, ...] = ("naive",)
    """Names of methods, package.module:NAME or path/to/file.py:NAME."""
    nulls: Annotated[int, NOT_NEGATIVE] = 20
    """Logs with nothing in them."""
    scales: tuple[Annotated[float, Range(0, above=True)], ...] = (4.0,)
    """Sizes of effects, as multiples of the one that our method notices with 80 % power."""
    effects: tuple[str, ...] = ()
    """Effects of the plant; none takes all."""
    days: Annotated[int, COUNT] = 6
    """Reference days with nothing in them."""
    replicates: Annotated[int, COUNT] = 3
    """Drives of each manoeuvre."""
    manoeuvres: tuple[str, ...] = ()
    """Of the nine; none takes all."""
    seed: Annotated[int, SEED] = 0
    """Another one gives other logs of the same effects."""
    work: Path = Path("runs/undeclared_entry")
    """Folder for logs, verdicts and entries."""


@dataclass(frozen=True)
class Case:
    """A log of the bench."""

    label: str
    effects: Mapping[str, float]
    scale: float
    """Of its effect; 0 where there is nothing."""
    seed: int


def cases(options: Entry) -> list[Case]:
    """All logs, mixed, so that the order says nothing."""
    sizes = json.loads(RECORDED.read_text())["sizes"]
    found = [Case("", {}, 0.0, FIRST_SEED + options.seed * 1000 + n) for n in range(options.nulls)]
    for number, name in enumerate(sorted(options.effects or sizes)):
        size = sizes[name]["value"] if name in sizes else EFFECTS[name].base
        for k, scale in enumerate(options.scales):
            seed = FIRST_SEED + options.seed * 1000 + 200 + 10 * number + k
            found.append(Case("", {name: capped(name, scale * size)}, scale, seed))
    order = np.random.default_rng(options.seed).permutation(len(found))
    return [Case(f"log_{n:03d}", found[k].effects, found[k].scale, found[k].seed) for n, k in enumerate(order)]


def main(options: Entry) -> dict[str, dict[str, Any]]:
    """Judge all logs with all methods; returns the counts by method."""
    with refusing():
        for name in options.effects:
            check_known("--effects", name, EFFECTS)
        methods = {name: find_method(name) for name in options.method}
        check_place("--work", options.work)
    folder = options.work / _settings(options)
    listed = cases(options)
    days = [_driven(folder / "days" / f"day_{n + 1}", {}, FIRST_SEED - 1000 + options.seed * 10 + n, options)
            for n in range(options.days)]
    found = {}
    for name, method in methods.items():
        verdicts = judged(name, method, days, listed, folder, options)
        found[name] = counts(listed, verdicts)
        path = folder / "entries" / f"{_file(name)}.json"
        write_whole(path, json.dumps({"method": name, "counts": found[name]}, indent=1) + "\n")
        print(f"wrote {path}")
    print(table(found))
    return found


def judged(
    name: str, method: Method, days: Sequence[Path], listed: Sequence[Case], folder: Path, options: Entry
) -> list[tuple[Verdict, float]]:
    """Verdict and seconds of every log; those that are there are not asked for again."""
    ready: list[Any] = []
    found = []
    for case in listed:
        path = folder / "verdicts" / _file(name) / f"{case.label}.json"
        if not path.exists():
            log = _driven(folder / "logs" / case.label, case.effects, case.seed, options)
            if not ready:
                ready.append(method.prepare(list(days)))
            began = time.perf_counter()
            try:
                verdict = check_verdict(method.judge(ready[0], log))
            except ValueError as error:
                raise ValueError(f"method {name}, {case.label}: {error}") from error
            kept = {"verdict": verdict.verdict, "effects": verdict.effects, "seconds": time.perf_counter() - began}
            write_whole(path, json.dumps(kept) + "\n")
            print(f"{name}: {case.label} {verdict.verdict} {' '.join('/'.join(one) for one in verdict.effects)}",
                  flush=True)
        one = json.loads(path.read_text())
        found.append((check_verdict(one), float(one["seconds"])))
    return found


def counts(listed: Sequence[Case], verdicts: Sequence[tuple[Verdict, float]]) -> dict[str, Any]:
    """How often a method was right, wrong and silent.

    An effect with a name in `VOCABULARY` is named right where one effect of the verdict may have its name, and wrong
    where none may. Of any other effect "unexplained" is right.
    """
    rows = list(zip(listed, verdicts, strict=True))
    nulls = [verdict for case, (verdict, _) in rows if not case.effects]
    alarms = sum(verdict.verdict != "none" for verdict in nulls)
    found: dict[str, Any] = {
        "nulls": len(nulls), "false_alarms": alarms, "false_alarms_at_most": upper_rate(alarms, len(nulls)) if nulls
        else None, "seconds_per_log": float(np.median([seconds for _, (_, seconds) in rows])) if rows else None}
    for scale in sorted({case.scale for case in listed if case.effects}):
        mine = [(next(iter(case.effects)), verdict) for case, (verdict, _) in rows if case.scale == scale]
        known = [(EFFECTS[name].covered or name, verdict) for name, verdict in mine if EFFECTS[name].can_be_named]
        beyond = [verdict for name, verdict in mine if not EFFECTS[name].can_be_named]
        right = [any(name in names for names in verdict.effects) for name, verdict in known]
        sizes = [len(names) for _, verdict in known for names in verdict.effects]
        found[f"at_{scale:g}x"] = {
            "logs": len(known), "named_right": sum(right),
            "named_wrong": sum(verdict.verdict == "named" and not ok
                               for (_, verdict), ok in zip(known, right, strict=True)),
            "unexplained": sum(verdict.verdict == "unexplained" for _, verdict in known),
            "missed": sum(verdict.verdict == "none" for _, verdict in known),
            "names_per_effect": float(np.mean(sizes)) if sizes else None,
            "beyond_the_vocabulary": len(beyond),
            "said_to_be_unexplained": sum(verdict.verdict == "unexplained" for verdict in beyond)}
    return found


def table(found: Mapping[str, Mapping[str, Any]]) -> str:
    """The counts as a table in Markdown."""
    lines = ["| method | size | named right | named wrong | unexplained | missed | names per effect | unknown effects "
             "left unexplained | false alarms | s per log |", "|---|" + "---|" * 9]
    for name, one in found.items():
        for key, at in one.items():
            if key.startswith("at_"):
                names = "-" if at["names_per_effect"] is None else f"{at['names_per_effect']:.1f}"
                size = key.removeprefix("at_")
                lines.append(
                    f"| {name} | {size} | {at['named_right']} of {at['logs']} | {at['named_wrong']} | "
                    f"{at['unexplained']} | {at['missed']} | {names} | {at['said_to_be_unexplained']} of "
                    f"{at['beyond_the_vocabulary']} | {one['false_alarms']} of {one['nulls']} | "
                    f"{one['seconds_per_log']:.2g} |")
    return "\n".join(lines)


def _driven(folder: Path, effects: Mapping[str, float], seed: int, options: Entry) -> Path:
    """The log of these effects; what was in it is nowhere in the folder."""
    if not folder.exists():
        make_log(folder, Experiment(effects=effects, seed=seed, manoeuvres=options.manoeuvres or None,
                 replicates=options.replicates))
    return folder


def _settings(options: Entry) -> str:
    """A folder for logs of the same settings."""
    chosen = {name: value for name, value in asdict(options).items() if name not in ("method", "work")}
    return f"seed_{options.seed}_{hashlib.sha256(json.dumps(chosen, sort_keys=True).encode()).hexdigest()[:8]}"


def _file(name: str) -> str:
    return "".join(letter if letter.isalnum() else "_" for letter in name)


if __name__ == "__main__":
    run(Entry, main, __doc__, positional=False)
