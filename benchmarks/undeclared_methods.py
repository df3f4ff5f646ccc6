"""Methods that judge logs with undeclared effects: what one must offer, and the two that come with the bench.

A method is an object or a class without arguments with

    prepare(days)          days: folders of logs with nothing in them -> whatever `judge` needs
    judge(ready, log)      log: folder of the log in question -> a verdict

A verdict is a dict: "verdict" is "none", "named" or "unexplained"; "named" comes with "effects", a list of effects.
Each effect is a name of `VOCABULARY`, or a list of names that the method cannot separate. Folders hold driving-log
datasets (docs/log_format.md): TOML and CSV, which a method may read as it likes.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from benchmarks.plant.effects import EFFECTS

VERDICTS = ("none", "named", "unexplained")
VOCABULARY = tuple(sorted({entry.covered or name for name, entry in EFFECTS.items() if entry.can_be_named}))
"""Names that a verdict may use. Effects beyond them exist in the bench; "unexplained" is then right."""
MOST_ALIKE = 8
"""Names that one effect of a verdict may have."""


class Method(Protocol):
    """What the bench calls."""

    def prepare(self, days: Sequence[Path]) -> Any:
        """What is known of the vehicle from days with nothing undeclared in them."""

    def judge(self, ready: Any, log: Path) -> Mapping[str, Any]:
        """The verdict on one log."""


@dataclass(frozen=True)
class Verdict:
    """A checked verdict."""

    verdict: str
    effects: tuple[tuple[str, ...], ...] = ()
    """Names that each effect may have."""


METHODS: dict[str, Callable[[], Method]] = {}
"""Methods by name; `register_method` adds one."""


def register_method(name: str) -> Callable[[Callable[[], Method]], Callable[[], Method]]:
    """Decorator: make a class known to `--method NAME`; ValueError where the name is taken."""

    def added(kind: Callable[[], Method]) -> Callable[[], Method]:
        if name in METHODS:
            raise ValueError(f"method {name!r} is registered twice. Choose another name.")
        METHODS[name] = kind
        return kind

    return added


def find_method(name: str) -> Method:
    """A method by its name, or of `package.module:NAME` or `path/to/file.py:NAME`.

    Raises:
        ValueError: there is none, or it lacks `prepare` or `judge`.
    """
    place, colon, attribute = name.rpartition(":")
    if not colon:
        if name not in METHODS:
            raise ValueError(f"--method {name}: unknown (known: {', '.join(METHODS)}). Correct the name, or give "
                             "package.module:NAME or path/to/file.py:NAME.")
        kind: Any = METHODS[name]
    else:
        kind = _attribute(name, place, attribute)
    method = kind() if isinstance(kind, type) or name in METHODS else kind
    for wanted in ("prepare", "judge"):
        if not callable(getattr(method, wanted, None)):
            raise ValueError(f"--method {name}: has no function {wanted}. Write prepare(days) and judge(ready, log).")
    return method


def _attribute(name: str, place: str, attribute: str) -> Any:
    try:
        if place.endswith(".py"):
            about = importlib.util.spec_from_file_location(Path(place).stem, place)
            if about is None or about.loader is None:
                raise ImportError("it is no Python file")
            module = importlib.util.module_from_spec(about)
            about.loader.exec_module(module)
        else:
            module = importlib.import_module(place)
        return getattr(module, attribute)
    except (ImportError, AttributeError, OSError, SyntaxError) as error:
        raise ValueError(f"--method {name}: cannot be loaded ({error}). Correct the file or the name.") from error


def check_verdict(given: Any) -> Verdict:
    """A verdict as a method gave it; ValueError names the rule that it breaks."""
    if not isinstance(given, Mapping) or given.get("verdict") not in VERDICTS:
        raise ValueError(f"the verdict {str(given)[:80]!r}: must be a dict whose \"verdict\" is one of {VERDICTS}.")
    effects = given.get("effects", ())
    if isinstance(effects, str) or not isinstance(effects, Sequence):
        raise ValueError(f"effects {str(effects)[:80]!r}: must be a list of names, or of lists of names.")
    named = tuple((one,) if isinstance(one, str) else tuple(one) for one in effects)
    for names in named:
        for name in names:
            if name not in VOCABULARY:
                raise ValueError(f"effect {name!r}: unknown (known: {', '.join(VOCABULARY)}). Say \"unexplained\" of "
                                 "what has no name there.")
        if not 1 <= len(names) <= MOST_ALIKE:
            raise ValueError(f"an effect with {len(names)} names: give 1 to {MOST_ALIKE}.")
    if (given["verdict"] == "named") != bool(named):
        raise ValueError('"named" needs effects, and other verdicts have none.')
    return Verdict(given["verdict"], named)


@register_method("ours")
class Ours:
    """`sysid.find_missing` with its usual settings."""

    def prepare(self, days: Sequence[Path]) -> Any:
        """The reference, and the compiled search."""
        from benchmarks.undeclared_reference import reference_of
        from sysid.logs.log import load_log
        from sysid.verdict.preparation import prepare
        from sysid.verdict.result import LoopConfig

        logs, config = [load_log(day) for day in days], LoopConfig()
        return prepare(reference_of(logs, config), logs[0].spec, config)

    def judge(self, ready: Any, log: Path) -> dict[str, Any]:
        """Its verdict; an effect comes with those that look alike in these drives."""
        from sysid.logs.log import load_log
        from sysid.pages.loop_report import effects
        from sysid.verdict.pipeline import find_missing
        from sysid.verdict.result import LoopConfig

        result = find_missing(load_log(log), (), LoopConfig(), reference=ready)
        if result.search.verdict != "named":
            return {"verdict": result.search.verdict}
        alike = [[name for name in dict.fromkeys([one["name"], *one["class"]]) if name in VOCABULARY][:MOST_ALIKE]
                 for one in effects(result)]
        known = [names for names in alike if names]
        return {"verdict": "named", "effects": known} if known else {"verdict": "unexplained"}


@register_method("naive")
class Naive:
    """Seven numbers of a log beside those of the reference days; the one that is farthest off gives the name.

    It simulates nothing. Each number is one that people look at first: delay, gains, ratios of odometry and outside
    pose. A number that no effect moves alone has none to its name.
    """

    ALPHA = 0.005
    NAMES = {"delay": "command_delay", "gain_v": "command_scale", "gain_omega": None, "distance": "odometry_scale",
             "turn": "track_width", "drift": "wheel_radius_difference", "pull": "side_force"}  # fmt: skip

    def prepare(self, days: Sequence[Path]) -> Any:
        """Mean and standard deviation (7,) over the days, and their number."""
        if len(days) < 2:
            raise ValueError(f"the method naive needs 2 reference days at least, not {len(days)}. Give more --days.")
        table = np.array([self.numbers(day) for day in days])
        return np.nanmean(table, axis=0), np.nanstd(table, axis=0, ddof=1), len(days)

    def judge(self, ready: Any, log: Path) -> dict[str, Any]:
        """Student's t of every number, corrected for having seven of them."""
        from scipy import stats

        mean, deviation, count = ready
        t = np.nan_to_num((self.numbers(log) - mean) / (deviation * np.sqrt(1 + 1 / count)))
        p = 2 * stats.t.sf(np.abs(t), count - 1) * len(t)
        if p.min() > self.ALPHA:
            return {"verdict": "none"}
        name = list(self.NAMES.values())[int(p.argmin())]
        return {"verdict": "named", "effects": [name]} if name else {"verdict": "unexplained"}

    def numbers(self, log: Path) -> np.ndarray:
        """The seven numbers of a log: medians over its trials; nan where no trial shows one."""
        from sysid.logs.log import load_log
        from sysid.logs.records import command_in_force
        from sysid.logs.stream_quality import response_shift

        rows = []
        for trial in load_log(log).training:
            row = dict.fromkeys(self.NAMES, np.nan)
            shift = response_shift(trial, "odometry")
            if shift:
                row["delay"] = float(np.mean([one.delay for one in shift.values()]))
            row |= {f"gain_{name}": one.gain for name, one in shift.items()}
            own, true = trial.odometry, trial.ground_truth
            if own is not None and true is not None:
                poses = [one.values[:, :3] for one in (own, true)]  # each (T, 3) x, y [m], yaw [rad]
                paths = [float(np.linalg.norm(np.diff(one[::10, :2], axis=0), axis=1).sum()) for one in poses]
                turns = [float(one[-1, 2] - one[0, 2]) for one in poses]
                if paths[1] > 1.0:
                    row["distance"] = paths[0] / paths[1]
                    row["drift"] = (turns[1] - turns[0]) / paths[1] if abs(turns[0]) < 0.5 else np.nan
                if abs(turns[1]) > 2.0:
                    row["turn"] = turns[0] / turns[1]
            if own is not None:
                held = np.maximum(command_in_force(trial.command, own.t), 0)
                row["pull"] = float(np.mean(own.omega - trial.command.omega[held]))
            rows.append(list(row.values()))
        table = np.array(rows, float)
        return np.array([np.median(one[np.isfinite(one)]) if np.isfinite(one).any() else np.nan for one in table.T])
