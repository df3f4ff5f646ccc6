"""Evaluations over a grid: one or two things are varied, each cell gets the same episodes.

A sweep is written `NAME=VALUES` or `NAME=VALUES NAME=VALUES`, where VALUES is `a,b,c` or `low:high:count`. Names are
those of `conditions.py`, with `latency_s` for the latency; `EFFECT.PARAMETER` and `body.PARAMETER` of the vehicle,
whose values are absolute or, written `0.5x`, relative to the vehicle's own; and `vehicle`, with files or presets.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.evaluation.conditions import NAMES, Condition, nominal
from whill_mjx.evaluation.drivers import Driver
from whill_mjx.evaluation.episodes import Course, Episodes, episode_figures
from whill_mjx.evaluation.intervals import wilson_interval
from whill_mjx.io.command_line import check_once
from whill_mjx.io.fields import CONDITION, check
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.world.randomize import check_parameter, with_parameter

CONDITIONS = tuple(name for name in NAMES if name != "latency") + ("latency_s",)
PATHS_KEPT = 40
MOST = 1000
"""Values of an axis."""


@dataclass(frozen=True)
class Axis:
    """One thing that is varied."""

    name: str
    values: tuple[Any, ...]
    relative: bool = False
    """The values are factors on the vehicle's own parameter."""

    @property
    def labels(self) -> list[str]:
        """The values as text."""
        if self.name == "vehicle":
            return [str(value).rsplit("/", 1)[-1] for value in self.values]
        return [f"{value:g}{'x' if self.relative else ''}" for value in self.values]


@dataclass(frozen=True)
class Sweep:
    """Figures of every cell; arrays have one axis per `Axis`."""

    axes: tuple[Axis, ...]
    episodes: int
    """Per cell."""
    figures: dict[str, np.ndarray]
    intervals: dict[str, np.ndarray]
    """(..., 2) Wilson intervals of the shares."""
    paths: list[tuple[np.ndarray, Any]]
    """Of each cell in row order: paths (n, T + 1, 2) and the scene of the first episode."""

    def plain(self) -> dict[str, Any]:
        """As JSON data."""
        axes = [{"name": axis.name, "relative": axis.relative, "values": list(axis.values)} for axis in self.axes]
        return {
            "axes": axes, "episodes_per_cell": self.episodes,
            **{name: _finite(value) for name, value in self.figures.items()},
            **{f"{name}_interval_95": _finite(value) for name, value in self.intervals.items()},
        }  # fmt: skip


def parse_sweep(text: str) -> tuple[Axis, ...]:
    """Axes of a sweep, one or two.

    Raises:
        ValueError: unknown name, no value, or too many axes; names the rule.
    """
    axes = tuple(_parse_axis(part) for part in text.split())
    if not 1 <= len(axes) <= 2:
        raise ValueError(f"sweep {text!r} has {len(axes)} axes; give one or two: 'light=0.5,1 latency_s=0,0.1'.")
    if len({axis.name for axis in axes}) < len(axes):
        raise ValueError(f"sweep {text!r} varies {axes[0].name} twice; name two different things.")
    return axes


def _parse_axis(text: str) -> Axis:
    name, equals, values = text.partition("=")
    if not equals or not values:
        raise ValueError(f"{text!r} is no axis of a sweep; write NAME=a,b,c or NAME=low:high:count.")
    if name == "vehicle":
        check_once(f"--sweep {text}", values.split(","))
        return Axis(name, tuple(values.split(",")))
    _check_name(name)
    parts = values.replace(":", ",").split(",")
    relative = parts[0].endswith("x")
    if relative and "." not in name:
        raise ValueError(f"{text!r}: {name} is no parameter of the vehicle, so it has no factor; leave out the x.")
    try:
        if ":" in values:
            low, high, count = values.split(":")
            if int(count) > MOST:
                raise ValueError(f"{count} values are more than {MOST}")
            numbers = np.linspace(float(low.removesuffix("x")), float(high.removesuffix("x")), int(count))
        else:
            if any(part.endswith("x") != relative for part in parts):
                raise ValueError("factors and absolute values are mixed")
            numbers = np.array([float(part.removesuffix("x")) for part in parts])
    except ValueError as error:
        raise ValueError(f"{text!r}: {error}; write NAME=a,b,c or NAME=low:high:count.") from error
    if not numbers.size:
        raise ValueError(f"{text!r}: has no value; write NAME=a,b,c or NAME=low:high:count.")
    if len(np.unique(numbers)) < len(numbers):
        raise ValueError(f"{text!r}: a value is there twice. Leave one out.")
    if not np.isfinite(numbers).all():
        raise ValueError(f"{text!r}: values must be finite.")
    ends = float(numbers.min()), float(numbers.max())
    if name in CONDITION:
        for value in ends:
            check(f"{text!r}", CONDITION[name], value)
        _check_periods(text, name, numbers)
    elif "." in name:
        check_parameter(f"axis {name!r}", name, ends, relative)
    return Axis(name, tuple(float(np.round(number, 9)) for number in numbers), relative)


def _check_periods(text: str, name: str, values: np.ndarray) -> None:
    """Refuse latencies that are no whole number of control periods: what was driven would be another one."""
    period = VehicleConfig().control_dt
    if name == "latency_s" and not np.allclose(values / period, np.round(values / period), atol=1e-6):
        raise ValueError(f"{text!r}: images are late by whole control periods of {period:g} s. Give multiples of it.")


def _check_name(name: str) -> None:
    if "." not in name and name not in CONDITIONS:
        raise ValueError(f"unknown axis {name!r} (known: {', '.join(CONDITIONS)}, vehicle, EFFECT.PARAMETER and "
                         "body.PARAMETER).")


def run_sweep(
    axes: tuple[Axis, ...],
    keys: jax.Array,
    course: Callable[[str | None], Course],
    driver: Callable[[Course], Driver],
) -> Sweep:
    """Drive the same episodes in every cell of a grid.

    Args:
        axes: what is varied.
        keys: (E,) of the episodes.
        course: vehicle file or name -> course with that vehicle; None gives the evaluation's own.
        driver: course -> who drives it.
    """
    cells = list(itertools.product(*(axis.values for axis in axes)))
    by_vehicle: dict[str | None, list[int]] = {}
    names = [axis.name for axis in axes]
    for index, cell in enumerate(cells):
        vehicle = cell[names.index("vehicle")] if "vehicle" in names else None
        by_vehicle.setdefault(vehicle, []).append(index)
    found: dict[int, Episodes] = {}
    for vehicle, indices in by_vehicle.items():
        here = course(vehicle)
        episodes = _drive_cells(here, driver(here), axes, [cells[index] for index in indices], keys)
        for place, index in enumerate(indices):
            found[index] = episodes.some(np.arange(place * len(keys), (place + 1) * len(keys)))
    shape = tuple(len(axis.values) for axis in axes)
    rows = [_cell(found[index]) for index in range(len(cells))]
    figures = {name: np.array([row[0][name] for row in rows]).reshape(shape) for name in rows[0][0]}
    intervals = {name: np.array([row[1][name] for row in rows]).reshape(*shape, 2) for name in rows[0][1]}
    return Sweep(axes, len(keys), figures, intervals, [row[2] for row in rows])


def _drive_cells(
    course: Course, driver: Driver, axes: tuple[Axis, ...], cells: list[tuple], keys: jax.Array
) -> Episodes:
    """Episodes of all cells, those of a cell one after the other."""
    each = len(keys)
    values = {axis.name: np.repeat([cell[i] for cell in cells], each) for i, axis in enumerate(axes)}
    condition = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(cells) * each,)), nominal())
    condition = _condition(condition, values, course.env.model.config.control_dt)
    repeated = jax.tree.map(lambda leaf: jnp.tile(leaf, (len(cells), *[1] * (leaf.ndim - 1))), course.vehicles(keys))
    for axis in axes:
        if "." in axis.name:
            change = jax.vmap(lambda p, value, axis=axis: with_parameter(p, axis.name, value, axis.relative))
            repeated = change(repeated, jnp.asarray(values[axis.name], jnp.result_type(float)))
    return course.drive(driver, jnp.tile(keys, len(cells)), condition, repeated)


def _condition(condition: Condition, values: dict[str, np.ndarray], control_dt: float) -> Condition:
    changes = {name: jnp.asarray(value, jnp.result_type(float)) for name, value in values.items() if name in NAMES}
    if "latency_s" in values:
        changes["latency"] = jnp.asarray(values["latency_s"] / control_dt, jnp.result_type(float))
    return dataclasses.replace(condition, **changes)


def _cell(episodes: Episodes) -> tuple[dict[str, float], dict[str, tuple[float, float]], tuple[np.ndarray, Any]]:
    figures = episode_figures(episodes)
    means = {name: float(value[np.isfinite(value)].mean()) if np.isfinite(value).any() else np.nan
             for name, value in figures.items()}
    shares = {name: wilson_interval(int((figures[name] > 0.5).sum()), episodes.count)
              for name in ("success", "collision", "timeout")}
    paths = np.stack([episodes.channel("x"), episodes.channel("y")], -1)[:PATHS_KEPT]
    return means, shares, (paths, jax.tree.map(lambda leaf: leaf[0], episodes.scene))


def _finite(values: np.ndarray) -> Any:
    """Nested lists with None for what is not a number, since JSON has no NaN."""
    plain = values.astype(object)
    plain[~np.isfinite(values)] = None
    return plain.tolist()
