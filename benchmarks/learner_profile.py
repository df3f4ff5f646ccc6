"""Where an update spends the device's time: its kernels by the part of the learner that asked for them.

One block of updates is traced by the profiler. Each of its events names the instruction of the compiled program it ran,
and each instruction the part it came from, for the parts are given a name while the learner is traced. A fusion of two
parts counts for the one of its last operation; copies and loop counters count for none ("other").
"""

from __future__ import annotations

import contextlib
import re
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Any
from unittest import mock

import jax

from benchmarks import harness
from benchmarks.learner_updates import Updates
from dreamer.config import DreamerConfig
from dreamer.experience import replay
from dreamer.layers import sensors
from dreamer.model import behavior, optim, rssm, world_model

PLACES: tuple[tuple[str, Any, str], ...] = (
    ("encoder", sensors, "encode"),
    ("observe", rssm, "observe"),
    ("decoder", sensors, "representation_losses"),
    ("imagine", behavior, "imagine"),
    ("heads", world_model, "head"),
    ("optimiser", optim, "update"),
    ("replay", replay, "sample"),
    ("replay", replay, "write_back"),
)
"""Part, and the function that it is. A head within imagining is imagining."""
MARK = "part_"
INSTRUCTION = re.compile(r'^\s*(?:ROOT )?%?([\w.-]+) = .*?op_name="([^"]*)"', re.MULTILINE)


@dataclass(frozen=True)
class Event:
    """One run of one instruction."""

    op: str
    path: str
    """Whatever else the profiler says of it."""
    start_ns: float
    duration_ns: float


@contextlib.contextmanager
def named_parts() -> Iterator[None]:
    """What is traced within carries the names of `PLACES`."""
    with contextlib.ExitStack() as stack:
        for part, module, function in PLACES:
            marked = _marked(MARK + part, getattr(module, function))
            stack.enter_context(mock.patch.object(module, function, marked))
        yield


def _marked(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        with jax.named_scope(name):
            return function(*args, **kwargs)

    return call


def parts_of(text: str) -> dict[str, str]:
    """Instruction -> part, from the text of a compiled program."""
    return {instruction: part_in(path) for instruction, path in INSTRUCTION.findall(text)}


def part_in(path: str) -> str:
    """Part of a path of names; the outermost counts."""
    found = re.search(rf"{MARK}([a-z]+)", path)
    return found[1] if found else "other"


def traced(call: Callable[[], Any]) -> list[Event]:
    """Kernels that `call` runs on an accelerator, or instructions on a CPU."""
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            call()
        file = next(Path(folder).rglob("*.xplane.pb"))
        planes = list(jax.profiler.ProfileData.from_file(str(file)).planes)
    on_device = [plane for plane in planes if plane.name.startswith("/device:GPU")]
    if on_device:
        lines = [line for plane in on_device for line in plane.lines]
        return list(_events([line for line in lines if line.name.startswith("Stream")] or lines))
    return [one for one in _events(line for plane in planes for line in plane.lines) if one.op]


def _events(lines: Iterable[Any]) -> Iterator[Event]:
    for line in lines:
        for event in line.events:
            stats = {name: str(value) for name, value in event.stats}
            yield Event(stats.pop("hlo_op", ""), " ".join(stats.values()), event.start_ns, event.duration_ns)


def busy_ns(events: Iterable[Event]) -> float:
    """Time in which at least one event runs."""
    total, end = 0.0, float("-inf")
    for one in sorted(events, key=lambda one: one.start_ns):
        last = one.start_ns + one.duration_ns
        total += max(0.0, last - max(end, one.start_ns))
        end = max(end, last)
    return total


def measure(config: DreamerConfig, label: str, per_block: int) -> dict[str, dict[str, Any]]:
    """Kernels and time of an update [ms], of each part of it too, and the share of the time in which kernels run.

    Loops on a CPU are events around those of their bodies and are left out.
    """
    with named_parts():
        updates = Updates(config, per_block)
    updates.compile()
    updates.run()
    events = traced(updates.run)
    if not events:
        raise RuntimeError("the profiler gave no events: it may not be allowed to count on this machine")
    parts = parts_of(updates.program.as_text())
    events = [one for one in events if not re.match(r"(while|call|conditional)\b", one.op)]
    counts: Counter[str] = Counter()
    times: dict[str, float] = defaultdict(float)
    for one in events:
        part = parts.get(one.op) or part_in(one.path)
        counts[part] += 1
        times[part] += one.duration_ns
    whole = max(one.start_ns + one.duration_ns for one in events) - min(one.start_ns for one in events)
    figures = {
        f"kernels_per_update_{label}": harness.figure([len(events) / per_block], "kernels"),
        f"kernels_busy_share_{label}": harness.figure([busy_ns(events) / whole], "share"),
        f"kernels_ms_per_update_{label}": harness.figure([sum(times.values()) / per_block / 1e6], "ms"),
    }
    for part in sorted(times):
        figure = harness.figure([times[part] / per_block / 1e6], "ms")
        figures[f"kernels_ms_{part}_{label}"] = {**figure, "kernels_per_update": counts[part] / per_block}
    return figures
