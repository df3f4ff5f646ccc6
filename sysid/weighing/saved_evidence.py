"""Everything the verdict needs of one log, in one file that needs no simulator.

A file is a plain .npz of arrays with a JSON header, compressed by xz, and written whole or not at all. White columns
and residuals are stored in steps of `STEP` standard deviations of the reference noise. Drives with the same commands
share one copy of every column in which they agree.
"""

from __future__ import annotations

import io
import json
import lzma
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from whill_mjx.io.folders import write_whole

SCHEMA = 1
STEP = 0.06
"""Resolution of stored white values, in standard deviations of the reference noise; columns whose coordinates may be
large are stored finer."""
FINER = 4.0
MOTION = ("inside", "v", "omega", "command_v", "command_omega", "left_angle", "right_angle", "x", "y", "yaw")
"""Quantities of the motion in each bin; the last three are nan without an outside pose."""


@dataclass(frozen=True)
class Axis:
    """One coordinate of an effect: q = 0 is its absence, |q| = 1 a small size."""

    parameter: str
    signed: bool
    limit: float
    dependent: bool
    """It does nothing by itself, but changes what the other axes do."""


@dataclass(frozen=True)
class Effect:
    """One hypothesis of the catalogue and the columns of its simulated sizes."""

    key: str
    name: str
    kind: str
    axes: tuple[Axis, ...]
    levels: tuple[float, ...]
    """Sizes that were simulated, rising."""
    columns: tuple[tuple[int, ...], ...]
    """Of each size, the column of each axis: the change by that size, so that a coordinate of 1 is q = size."""


@dataclass(frozen=True)
class Point:
    """The drives linearised again, at a nonlinear refit of a set of effects."""

    keys: tuple[str, ...]
    q: np.ndarray  # (k,) coordinates of all effects there
    residual: np.ndarray  # (B, K, C) with the base and the set put back: J du + X q + what is left
    columns: np.ndarray  # (B, K, C, k) by q
    responses: np.ndarray  # (B, K, C, number of effects): what each of them changes there


@dataclass(frozen=True)
class Evidence:
    """White residual and columns of B trials, K bins, C channels."""

    trials: tuple[str, ...]
    manoeuvre: np.ndarray  # (B,) number of the manoeuvre
    course: np.ndarray  # (B,) trials with equal numbers were given the same commands
    channels: tuple[str, ...]
    scales: np.ndarray  # (C,) noise of the reference in units of the channel
    width: float
    """Of a bin [s]."""
    mask: np.ndarray  # (B, K, C) 1 where measured
    residual: np.ndarray  # (B, K, C) at the refitted base, with its move from the reference put back
    base_names: tuple[str, ...]
    base: np.ndarray  # (B, K, C, P) by the base parameters, in standard deviations from day to day
    spread: np.ndarray  # (P, P) their correlation from day to day
    effects: tuple[Effect, ...]
    columns: np.ndarray  # (B, K, C, S)
    wander: np.ndarray  # (S, S) day-to-day covariance of each effect's apparent size, 0 between effects
    motion: np.ndarray  # (B, K, len(MOTION))
    pool: np.ndarray  # (J, K, C) white noise of reference drives
    pool_manoeuvre: np.ndarray  # (J,)
    pool_day: np.ndarray  # (J,)
    pool_course: np.ndarray  # (J,)
    track: float
    points: tuple[Point, ...] = ()
    about: Mapping[str, Any] = field(default_factory=dict)
    """What made it: versions, names of the log and of the reference days."""

    def effect(self, key: str) -> Effect:
        """The hypothesis of a key."""
        return next(one for one in self.effects if one.key == key)

    def without(self, names: frozenset[str]) -> Evidence:
        """The same for a catalogue that lacks some effects."""
        kept = {one.key for one in self.effects if one.name not in names}
        return replace(self, effects=tuple(one for one in self.effects if one.key in kept),
                       points=tuple(one for one in self.points if set(one.keys) <= kept))


def save(path: Path, evidence: Evidence) -> None:
    """Write a file whole or not at all."""
    first, copy = np.unique(evidence.course, return_index=True, return_inverse=True)[1:]
    finer = np.ones(evidence.columns.shape[-1])
    for effect in evidence.effects:
        if len(effect.levels) == 1:
            finer[list(effect.columns[0])] = FINER
    header: dict[str, Any] = {"schema": SCHEMA}
    arrays: dict[str, np.ndarray] = {}
    for name, value in vars(evidence).items():
        if name in ("residual", "base", "columns", "pool"):
            _pack(arrays, name, value, first, copy, finer if name == "columns" else np.ones(1))
        elif name == "points":
            header["points"] = [list(point.keys) for point in value]
            for number, point in enumerate(value):
                arrays[f"point_{number}_q"] = point.q
                for part in ("residual", "columns", "responses"):
                    step = np.maximum(np.abs(point.q), 1.0) if part == "columns" else np.ones(1)
                    _pack(arrays, f"point_{number}_{part}", getattr(point, part), first, copy, step)
        elif isinstance(value, np.ndarray):
            arrays[name] = value.astype(np.float16) if name == "motion" else value
        else:
            header[name] = [asdict(one) for one in value] if name == "effects" else value
    arrays["mask"] = evidence.mask.astype(np.int8)
    arrays["wander"] = evidence.wander.astype(np.float32)
    buffer = io.BytesIO()
    np.savez(buffer, header=np.frombuffer(json.dumps(header).encode(), np.uint8), **arrays)  # type: ignore[arg-type]
    write_whole(path, lzma.compress(buffer.getvalue()))


def load(path: Path) -> Evidence:
    """Read a file.

    Raises:
        ValueError: if it is of another schema.
    """
    with np.load(io.BytesIO(lzma.decompress(path.read_bytes())), allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    header = json.loads(arrays.pop("header").tobytes())
    if header.pop("schema", None) != SCHEMA:
        raise ValueError(f"{path}: evidence of another version than {SCHEMA}. Make it again from its log.")
    copy = np.unique(arrays["course"], return_inverse=True)[1]
    effects = tuple(
        Effect(one["key"], one["name"], one["kind"], tuple(Axis(**axis) for axis in one["axes"]), tuple(one["levels"]),
               tuple(map(tuple, one["columns"]))) for one in header.pop("effects"))
    points = tuple(
        Point(tuple(keys), arrays[f"point_{number}_q"],
              *(_unpack(arrays, f"point_{number}_{part}", copy) for part in ("residual", "columns", "responses")))
        for number, keys in enumerate(header.pop("points")))
    packed = {name: _unpack(arrays, name, copy) for name in ("residual", "base", "columns", "pool")}
    plain = {name: value for name, value in arrays.items() if name in Evidence.__annotations__}
    plain["motion"], plain["wander"] = plain["motion"].astype(float), plain["wander"].astype(float)
    for name in ("trials", "channels", "base_names"):
        header[name] = tuple(header[name])
    return Evidence(**{**header, **plain, **packed, "effects": effects, "points": points,
                       "mask": plain["mask"].astype(float)})


def _pack(arrays: dict[str, np.ndarray], name: str, values: np.ndarray, first: np.ndarray, copy: np.ndarray,
          finer: np.ndarray) -> None:
    """Store values (B, K, C, ...) as whole steps, columns last axis first; columns that courses share once."""
    flat = values.reshape(*values.shape[:3], -1)
    top = np.maximum(np.abs(flat).max((0, 1, 2)), 1e-30)
    step = np.maximum(STEP / finer, top / 32000.0)
    whole = np.moveaxis(np.round(flat / step).astype(np.int16), -1, 0)  # (S, B, K, C)
    shared = np.zeros(len(whole), bool)
    if len(values) == len(copy):
        shared = (whole == whole[:, first][:, copy]).all((1, 2, 3))
    whole = np.moveaxis(whole, 2, -1)  # time last: neighbours are alike
    arrays[f"{name}_shared"], arrays[f"{name}_own"] = whole[shared][:, first], whole[~shared]
    arrays[f"{name}_is_shared"], arrays[f"{name}_step"] = shared, step.astype(np.float32)
    arrays[f"{name}_shape"] = np.array(values.shape)


def _unpack(arrays: Mapping[str, np.ndarray], name: str, copy: np.ndarray) -> np.ndarray:
    shape, shared = tuple(arrays[f"{name}_shape"]), arrays[f"{name}_is_shared"]
    out = np.empty((len(shared), shape[0], shape[2], shape[1]), np.float32)
    if shared.any():
        out[shared] = arrays[f"{name}_shared"][:, copy]
    out[~shared] = arrays[f"{name}_own"]
    out *= arrays[f"{name}_step"][:, None, None, None]
    return np.ascontiguousarray(np.moveaxis(out, (0, 2), (-1, -2))).reshape(shape).astype(np.float64)
