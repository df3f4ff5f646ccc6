"""The vehicle file: TOML with the spec, the base parameters, the effects and where they come from.

    schema = 1
    kind = "micromobility-vehicle"
    [spec]                      # fields of VehicleSpec; [spec.camera] those of CameraMount
    [body.mass]                 # value, unit, and, where fitted, interval = [low, high]
    [[effects]]
    name = "pid_drive"          # canonical name; the order is the order in which the effects act
    [effects.parameters.kp]     # value, unit, interval
    [provenance]                # free: data hash, fit, held-out error; interval_confidence is that of all intervals
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from whill_mjx.effects import EFFECTS
from whill_mjx.vehicle.specs import CameraMount, VehicleSpec
from whill_mjx.vehicle.types import Body, VehicleParams, parameters_of

SCHEMA = 1
KIND = "micromobility-vehicle"
LATER = {"suspension.damping", "sensor_delay.speed", "torque_drive.kff", "torque_drive.period",
         "wheel_inertia.reaction"}
"""Parameters that earlier files do not have: where they are absent they are neutral."""


def save_vehicle(
    path: str | Path,
    spec: VehicleSpec,
    params: VehicleParams,
    intervals: Mapping[str, tuple[float, float]] | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> Path:
    """Write a vehicle file, whole or not at all.

    Args:
        path: file to write.
        spec, params: the vehicle; params of ONE instance.
        intervals: confidence interval of a parameter by its dotted name ("pid_drive.kp").
        provenance: what is worth knowing of the origin; strings, numbers and tables of them. Its
            `interval_confidence`, such as 0.9, belongs to the intervals.
    """
    import tomlkit  # not needed to read a file

    intervals = dict(intervals or {})
    spec_table = {key: value for key, value in dataclasses.asdict(spec).items() if value is not None}
    content = {
        "schema": SCHEMA,
        "kind": KIND,
        "spec": spec_table,
        "body": _parameter_tables("body", params.body, intervals),
        "effects": [
            {"name": effect.name, "parameters": _parameter_tables(effect.name, effect, intervals)}
            for effect in params.effects
        ],
        "provenance": dict(provenance or {}),
    }
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_text(_remark(content) + tomlkit.dumps(content))
    os.replace(temporary, path)
    return path


def _remark(content: Mapping[str, Any]) -> str:
    """Comment above a vehicle file that says what its intervals are, where it has any."""
    confidence = content["provenance"].get("interval_confidence")
    if confidence is None:
        return ""
    return (f"# Each interval [low, high] is the {confidence:.0%} confidence interval of the value above it.\n"
            "# A parameter without one was not fitted, or the log does not determine it.\n")


def load_vehicle(path: str | Path) -> tuple[VehicleSpec, VehicleParams, dict[str, Any]]:
    """Spec, parameters and provenance of a vehicle file.

    Raises:
        ValueError: names the file, the value, the rule and the remedy.
        FileNotFoundError: there is no such file.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such vehicle file. Make one with `python -m sysid.fit DATASET --out RUN`.")
    try:
        content = tomllib.loads(path.read_text())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not a TOML file ({error}). Vehicle files are written by sysid.fit.") from error
    if content.get("kind") != KIND:
        raise ValueError(f"{path}: kind is {content.get('kind')!r}, not {KIND!r}. Give a vehicle file.")
    if content.get("schema") != SCHEMA:
        raise ValueError(
            f"{path}: schema is {content.get('schema')!r}; this version reads schema {SCHEMA}. Fit the vehicle again."
        )
    try:
        spec = _read_spec(content["spec"])
        body = _read_parameters(path, "body", Body, content["body"])
        effects = tuple(_read_effect(path, table) for table in content["effects"])
    except KeyError as error:
        rule = "Every vehicle file has spec, body and effects."
        raise ValueError(f"{path}: no entry {error.args[0]!r}. {rule}") from error
    except TypeError as error:
        raise ValueError(f"{path}: {error}. Remove the entry or use a newer version of this program.") from error
    if not body.mass > 0 or not body.yaw_inertia > 0:
        raise ValueError(f"{path}: body mass {body.mass} and yaw_inertia {body.yaw_inertia} must be positive.")
    return spec, VehicleParams(body, effects), content.get("provenance", {})


def load_intervals(path: str | Path) -> dict[str, tuple[float, float]]:
    """Confidence intervals in a vehicle file by dotted parameter name."""
    content = tomllib.loads(Path(path).read_text())
    tables = {"body": content["body"], **{table["name"]: table["parameters"] for table in content["effects"]}}
    return {
        f"{holder}.{name}": (entry["interval"][0], entry["interval"][1])
        for holder, table in tables.items()
        for name, entry in table.items()
        if "interval" in entry
    }


def sha256_of(path: str | Path) -> str:
    """SHA-256 of a file, as policy files record it."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def _parameter_tables(holder: str, value: Any, intervals: dict[str, tuple[float, float]]) -> dict[str, Any]:
    tables = {}
    for name, about in parameters_of(value).items():
        table: dict[str, Any] = {"value": float(getattr(value, name)), "unit": about.unit}
        if f"{holder}.{name}" in intervals:
            low, high = intervals[f"{holder}.{name}"]
            table["interval"] = [float(low), float(high)]
        tables[name] = table
    return tables


def _read_spec(table: dict[str, Any]) -> VehicleSpec:
    table = dict(table)
    camera = CameraMount(**table.pop("camera", {}))
    return VehicleSpec(**table, camera=camera)


def _read_effect(path: Path, table: dict[str, Any]) -> Any:
    name = table["name"]
    if name not in EFFECTS:
        raise ValueError(f"{path}: unknown effect {name!r} (known: {', '.join(sorted(EFFECTS))}).")
    return _read_parameters(path, name, EFFECTS[name], table["parameters"])


def _read_parameters(path: Path, holder: str, kind: Any, table: dict[str, Any]) -> Any:
    known = parameters_of(kind)
    values = {}
    for name, entry in table.items():
        if name not in known:
            raise ValueError(f"{path}: {holder} has no parameter {name!r} (known: {', '.join(known)}).")
        value, unit = entry["value"], entry["unit"]
        if unit != known[name].unit:
            raise ValueError(f"{path}: {holder}.{name} is in {unit!r}; it must be in {known[name].unit!r}. Convert it.")
        if isinstance(value, bool) or not isinstance(value, (int, float)) or math.isnan(value):
            raise ValueError(f"{path}: {holder}.{name} is {value!r}; it must be a number.")
        values[name] = float(value)
    missing = {name for name in set(known) - set(values) if f"{holder}.{name}" not in LATER}
    if missing:
        raise ValueError(f"{path}: {holder} lacks {', '.join(sorted(missing))}. Give a value and a unit for each.")
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype=jnp.result_type(float)), kind(**values))
