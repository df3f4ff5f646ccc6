"""A folder of a run as it is: finished, at work, stopped, or damaged. Nothing here raises for what a folder holds."""

from __future__ import annotations

import json
import math
import os
import socket
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np

from whill_mjx.io.fields import percent
from whill_mjx.io.folders import LOCK_FILE, RUN_FILE
from whill_mjx.io.reading import JSON_BYTES, read_arrays, read_bytes, read_json, read_text

KINDS = {
    "whill_mjx.train": "training", "whill_mjx.evaluate": "evaluation", "sysid.fit": "fit",
    "sysid-report": "fit", "sysid.close_loop": "missing effect", "sysid-close-loop": "missing effect",
    "sysid.inspect": "log", "sysid.paper": "the paper's experiment", "sysid.searches": "searches",
    "sysid.design": "next drive",
}  # fmt: skip
"""Words for what `run.json` or `report.json` says of its kind."""
MADE_BY = (("metrics.jsonl", "training"), ("checkpoints", "training"), ("inspect.json", "log"),
           ("evaluation.json", "evaluation"), ("report.json", "fit"), ("command.html", "next drive"))  # fmt: skip
"""Kind of a folder without a word on it, by a name in it; the first one counts."""
PAGES = ("index.html", "report.html", "inspect.html", "paper.html", "searches.html", "command.html")
RESULTS = {"training": "evaluation.json", "evaluation": "evaluation.json", "fit": "report.json",
           "missing effect": "report.json", "log": "inspect.json"}  # fmt: skip
"""The file of each kind that its end leaves."""
METRICS_BYTES = 5 * JSON_BYTES
PAGE_BYTES = 4 * JSON_BYTES
SETTINGS = ("preset", "command", "identity")
"""Tables of run.json with settings; the first ones count more where a name is in several."""
WRONG = (KeyError, IndexError, TypeError, AttributeError, ValueError, ArithmeticError, OSError, RecursionError)
"""What a file of another form lets out."""
FRESH = "the file is still being written, or the run was stopped"


@dataclass(frozen=True)
class Run:
    """What a folder holds."""

    path: Path
    name: str
    """How pages call it: the shortest end of the path that no other run has."""
    kind: str
    """"training", "fit", "missing effect", "evaluation", "log", what run.json says of another, or "unknown"."""
    state: str
    """"finished", "at work", "stopped" or "damaged"."""
    sentence: str
    """What it means so far, in one sentence."""
    problems: tuple[str, ...] = ()
    """What could not be read, and why."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Dotted name -> value."""
    lines: list[dict[str, float]] = field(default_factory=list)
    """Logged lines of a training."""
    result: dict[str, Any] = field(default_factory=dict)
    """Content of its JSON file."""
    page: Path | None = None
    """Its report."""


def find_runs(paths: Sequence[Path]) -> list[Path]:
    """The folders of runs that are named, or that lie in a folder that is named; each once.

    Raises:
        FileNotFoundError: a path is no folder, or holds no run.
    """
    found: dict[Path, Path] = {}
    for path in paths:
        if not path.is_dir():
            raise FileNotFoundError(f"RUN {path}: no such folder. Correct the path.")
        inside = [] if (path / RUN_FILE).exists() else sorted(
            one for one in path.iterdir() if one.is_dir() and is_run(one))
        inside += [path] if is_run(path) else []  # beside its runs, a folder may hold the page of a proposed drive
        if not inside:
            raise FileNotFoundError(f"RUN {path}: holds no run. Give the folder that a command wrote by --out.")
        found |= {one.resolve(): one for one in inside}
    return list(found.values())


def is_run(path: Path) -> bool:
    """Whether a folder looks like the output of a command."""
    return any((path / name).exists() for name in (RUN_FILE, *(name for name, _ in MADE_BY), *PAGES))


def read_runs(paths: Sequence[Path]) -> list[Run]:
    """All runs, under names that distinguish them."""
    return [read_run(path, name) for path, name in zip(paths, _names(paths), strict=True)]


def read_run(path: Path, name: str | None = None) -> Run:
    """What a folder holds; never raises for its content."""
    problems: list[str] = []
    about = _json(path / RUN_FILE, problems) if (path / RUN_FILE).exists() else {}
    kind = _kind(path, about, problems)
    file = path / RESULTS.get(kind, "report.json")
    result = _json(file, problems) if file.exists() else {}
    lines = read_lines(path / "metrics.jsonl", problems) if (path / "metrics.jsonl").exists() else []
    page = next((path / one for one in PAGES if (path / one).is_file() and inside(path, path / one)), None)
    owner = working(path)
    finished = bool(result) or (kind not in RESULTS and page is not None)
    state = "at work" if owner else "damaged" if problems else "finished" if finished else "stopped"
    settings = _settings(about) | _settings_of_report(result)
    sentence = (_lead(page) if page is not None and state == "finished" else "") or _sentence(
        kind, state, about, lines, result, problems)
    return Run(path, name or path.name, kind, state, sentence, tuple(problems), settings, lines, result, page)


def inside(folder: Path, path: Path) -> bool:
    """Whether a file lies in a folder, links followed."""
    try:
        return path.resolve().is_relative_to(folder.resolve())
    except OSError:
        return False


def working(path: Path) -> str:
    """The process of this machine that holds a folder; empty where none does."""
    try:
        owner = json.loads(read_text(path / LOCK_FILE, 10_000, "no lock"))
        if owner["host"] != socket.gethostname():
            return ""
        os.kill(int(owner["pid"]), 0)
        return f"process {int(owner['pid'])}"
    except PermissionError:
        return "a process of somebody else"
    except (*WRONG, OverflowError):
        return ""


def read_lines(path: Path, problems: list[str]) -> list[dict[str, float]]:
    """Finite numbers of the lines of a .jsonl; a last line that is half-written is left out."""
    try:
        data = read_bytes(path, METRICS_BYTES, "missing.")
    except (ValueError, OSError) as error:
        problems.append(str(error))
        return []
    texts, lines, wrong = data.decode("utf-8", "replace").split("\n"), [], 0
    for number, text in enumerate(texts, start=1):
        if not text.strip():
            continue
        try:
            given = json.loads(text)
            lines.append({name: float(value) for name, value in given.items()
                          if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)})
        except (*WRONG, OverflowError):
            if number < len(texts):  # the last line has no end yet
                wrong += 1
    if wrong:
        problems.append(f"{path}: {wrong} of {len(lines) + wrong} lines are no JSON objects and are left out.")
    return lines


def curve(lines: Sequence[dict[str, float]], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Environment steps (T,) and values (T,) of a quantity."""
    found = [(line["env_steps"], line[name]) for line in lines if name in line and "env_steps" in line]
    return np.array([x for x, _ in found], float), np.array([y for _, y in found], float)


@dataclass(frozen=True)
class Drives:
    """Paths from above."""

    paths: list[np.ndarray]
    """Each (T, 2) x, y [m]."""
    endings: list[str]
    """"success", "collision", "timeout", "diverged" or ""."""


def read_drives(path: Path, most: int = 24) -> Drives:
    """The first drives of a training's drives.npz; ValueError where it is another file."""
    arrays = read_arrays(path, "missing.", "Evaluate the policy again.")
    try:
        names = [str(one) for one in arrays["channels"]]
        trace, length = np.asarray(arrays["trace"], float), np.asarray(arrays["length"], int)
        columns = [names.index("x"), names.index("y")]
        paths, endings = [], []
        for index in range(min(len(trace), most)):
            paths.append(trace[index, : max(int(length[index]), 0) + 1][:, columns])
            endings.append(next((one for one in ("success", "collision", "timeout", "diverged")
                                 if one in arrays and float(arrays[one][index]) > 0.5), ""))
    except WRONG as error:
        raise ValueError(f"{path}: is not of this form ({_short(error)}). Evaluate the policy again.") from None
    return Drives(paths, endings)


@dataclass(frozen=True)
class Replay:
    """A trial of a fit."""

    name: str
    held_out: bool
    paths: dict[str, np.ndarray]
    """"measured", "ideal", "initial", "fitted" -> (T, 2) x, y [m]."""


def read_replays(path: Path, most: int = 8) -> list[Replay]:
    """Paths of a fit's series.npz, held-out trials first; ValueError where it is another file."""
    arrays = read_arrays(path, "missing.", "Fit the log again.")
    try:
        about = json.loads(str(arrays["about"]))
        replays = []
        for index in sorted(range(len(about)), key=lambda k: not about[k]["held_out"])[:most]:
            channels = about[index]["channels"]
            channel = "ground_truth" if "ground_truth" in channels else "odometry"
            paths = {name: np.asarray(arrays[f"{index}.{channel}.{name}"], float)[:, :2]
                     for name in ("measured", "ideal", "initial", "fitted")}
            replays.append(Replay(str(about[index]["name"]), bool(about[index]["held_out"]), paths))
    except WRONG as error:
        raise ValueError(f"{path}: is not of this form ({_short(error)}). Fit the log again.") from None
    return replays


def differing(runs: Sequence[Run]) -> tuple[list[str], list[str]]:
    """Names of settings that differ between runs, and of those that are equal in all; a missing one differs."""
    names = dict.fromkeys(name for run in runs for name in run.settings)
    differs = [name for name in names if len({_text(run.settings.get(name, "")) for run in runs}) > 1]
    return differs, [name for name in names if name not in set(differs)]


def guarded(build: Callable[[], Any], problems: list[str], where: str) -> Any:
    """What `build` gives; None, with a line in `problems`, where a file is of another form."""
    try:
        return build()
    except WRONG as error:
        text = str(error)
        problems.append(text if isinstance(error, ValueError | OSError) and where in text
                        else f"{where}: is not of this form ({_short(error)}).")
        return None


def _names(paths: Sequence[Path]) -> list[str]:
    """The shortest ends of the paths that differ."""
    parts = [one.resolve().parts for one in paths]
    for count in range(1, max(map(len, parts), default=1) + 1):
        names = ["/".join(one[-count:]) for one in parts]
        if len(set(names)) == len(names):
            return names
    return [str(one) for one in paths]


def _json(path: Path, problems: list[str]) -> dict[str, Any]:
    try:
        return read_json(path, "missing.", f"Either {FRESH}.")
    except (ValueError, OSError) as error:
        problems.append(str(error))
        return {}


def _kind(path: Path, about: dict[str, Any], problems: list[str]) -> str:
    said = about.get("kind")
    if said is None and (path / "report.json").exists():
        said = _json(path / "report.json", []).get("kind")
    if isinstance(said, str):
        return KINDS.get(said, said[:60])
    if said is not None:
        problems.append(f"{path / RUN_FILE}: kind is {str(said)[:60]}; it must be a text.")
    return next((kind for name, kind in MADE_BY if (path / name).exists()), "unknown")


def _settings(about: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for part in SETTINGS:
        for name, value in _flat(about.get(part)):
            found.setdefault(name, value)
    return found


def _settings_of_report(result: dict[str, Any]) -> dict[str, Any]:
    """Settings that a report keeps: of a fit or loop, or the options of an evaluation."""
    manifest = result.get("manifest")
    tables = [result.get("settings"), result.get("options")]
    tables += [manifest.get("settings"), manifest.get("thresholds")] if isinstance(manifest, dict) else []
    return dict(pair for one in tables for pair in _flat(one))


def _flat(value: Any, prefix: str = "", depth: int = 0) -> Iterator[tuple[str, Any]]:
    if not isinstance(value, dict) or depth > 6:
        return
    for name, one in value.items():
        if isinstance(one, dict) and one:
            yield from _flat(one, f"{prefix}{name}.", depth + 1)
        else:
            yield f"{prefix}{name}", one


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, default=str)


def _sentence(
    kind: str, state: str, about: dict[str, Any], lines: Sequence[dict[str, float]], result: dict[str, Any],
    problems: Sequence[str]
) -> str:  # fmt: skip
    """What a run without a page means."""
    try:
        if state == "damaged":
            return f"It cannot be read as a whole: {problems[0]}"
        if kind == "training" and result:
            policy = result["policy"]
            return f"The policy succeeds in {percent(policy['success'])} of {policy['episodes']} unseen episodes."
        if kind == "training":
            return _progress(state, about, lines)
        if kind == "evaluation" and result:
            name, first = next(iter(result["drivers"].items()))
            return f"{name.capitalize()} succeeds in {percent(first['success'])} of {first['episodes']} episodes."
        if kind == "missing effect" and result:
            return f"{result['verdict'].capitalize()}: {result['reason']}."
        if result:
            return "It is finished; it has no page."
    except WRONG:
        pass
    return "It is at work; nothing is finished yet." if state == "at work" else "It was stopped before its end."


def _progress(state: str, about: dict[str, Any], lines: Sequence[dict[str, float]]) -> str:
    """How far a training is."""
    how = "It trains" if state == "at work" else "It was stopped"
    if not lines:
        return f"{how}; no line is logged yet." if state == "at work" else f"{how} before its first line."
    preset = about.get("preset")
    total = preset.get("total_steps") if isinstance(preset, dict) else None
    done = int(lines[-1].get("env_steps", 0))
    text = f"{how} at step {done:,}" + (f" of {int(total):,}" if isinstance(total, int | float) else "")
    shown = [line["eval/success"] for line in lines if "eval/success" in line]
    return f"{text}; its last evaluation succeeds in {percent(shown[-1])} of the episodes." if shown else (
        f"{text}; nothing is evaluated yet.")


class _Lead(HTMLParser):
    """Text of the first paragraph of class "lead"."""

    def __init__(self) -> None:
        super().__init__()
        self.text, self._within, self.done = "", False, False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "p" and ("class", "lead") in attrs and not self.done:
            self._within = True

    def handle_endtag(self, tag: str) -> None:
        if tag == "p" and self._within:
            self._within, self.done = False, True

    def handle_data(self, data: str) -> None:
        if self._within:
            self.text += data


def _lead(page: Path) -> str:
    """The sentence with which a report begins."""
    try:
        parser = _Lead()
        parser.feed(read_text(page, PAGE_BYTES, "missing.")[:200_000])
        return " ".join(parser.text.split())[:600]
    except WRONG:
        return ""


def _short(error: BaseException) -> str:
    return f"{type(error).__name__}: {str(error)[:120]}"
