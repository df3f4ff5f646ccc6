"""The vehicle file: TOML with the spec, the base parameters, the effects and where they come from.

    schema = 1
    kind = "micromobility-vehicle"
    [spec]                      # fields of VehicleSpec; [spec.camera] those of CameraMount
    [body.mass]                 # value, unit, and, where fitted, interval = [low, high]
    [[effects]]                 # without body and effects: those of the base model `base` ("physical") for the spec
    name = "pid_drive"          # canonical name; the order is the order in which the effects act
    [effects.parameters.kp]     # value, unit, interval
    [provenance]                # free: data hash, fit, held-out error; interval_confidence is that of all intervals
    [statistics]                # optional, by sysid.fit: errors of the parameters, and what the model leaves of drives
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax

from whill_mjx.effects import EFFECTS
from whill_mjx.io import fields
from whill_mjx.io.formats import upgraded
from whill_mjx.io.reading import read_toml
from whill_mjx.vehicle.presets import in_short, preset
from whill_mjx.vehicle.specs import WHILL_CR, VehicleSpec, in_proportion
from whill_mjx.vehicle.types import Body, VehicleParams, as_number, parameters_of

SCHEMA = 1
KIND = "micromobility-vehicle"
ROBOT_FILES = (".xml", ".mjcf", ".urdf", ".xacro")
"""Ends of the names of robot files, which people give in place of vehicle files."""
LATER = {"suspension.damping", "sensor_delay.speed", "torque_drive.kff", "torque_drive.period",
         "wheel_inertia.reaction", "rolling_resistance_speed.growth"}
"""Parameters that earlier files do not have: where they are absent they are neutral."""
NEWER = "Remove the entry or use a newer version of this program."


def save_vehicle(
    path: str | Path,
    spec: VehicleSpec,
    params: VehicleParams,
    intervals: Mapping[str, tuple[float, float]] | None = None,
    provenance: Mapping[str, Any] | None = None,
    statistics: Mapping[str, Any] | None = None,
) -> Path:
    """Write a vehicle file, whole or not at all.

    Args:
        path: file to write.
        spec, params: the vehicle; params of ONE instance.
        intervals: confidence interval of a parameter by its dotted name ("pid_drive.kp").
        provenance: what is worth knowing of the origin; strings, numbers and tables of them. Its
            `interval_confidence`, such as 0.9, belongs to the intervals.
        statistics: what a fit knows beside the values (`whill_mjx.io.fields.STATISTICS`).
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
    if statistics is not None:
        content["statistics"] = dict(statistics)
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


def load_vehicle(name_or_path: str | Path) -> tuple[VehicleSpec, VehicleParams, dict[str, Any]]:
    """Spec, parameters and provenance of a built-in vehicle or a vehicle file.

    Raises:
        ValueError: neither a name (the error lists all of them) nor a valid file.
        FileNotFoundError: as of `read_vehicle`.
    """
    path = Path(name_or_path)
    if path.suffix == ".toml" or path.is_file():
        return read_vehicle(path)
    return *preset(str(name_or_path)), {"preset": str(name_or_path)}


def read_vehicle(path: str | Path) -> tuple[VehicleSpec, VehicleParams, dict[str, Any]]:
    """Spec, parameters and provenance of a vehicle file.

    Raises:
        ValueError: names the file, the value, the rule and the remedy.
        FileNotFoundError: there is no such file.
    """
    path = Path(path)
    content = _read(path)
    spec = _read_spec(path, content["spec"])
    if "body" not in content and "effects" not in content:
        _check_sizes(path, spec)
        return spec, in_short(spec, content.get("base", "physical")), content.get("provenance", {})
    sizes = spec.mass, spec.wheel_radius
    body = _read_parameters(path, "body", Body, content["body"], sizes)
    effects: dict[str, Any] = {}
    for name, table in _effect_tables(path, content):
        if name in effects:
            raise ValueError(f"{path}: effect {name!r} is there twice; each acts once. Remove one of them.")
        effects[name] = _read_parameters(path, name, EFFECTS[name], table, sizes)
    return spec, VehicleParams(body, tuple(effects.values())), content.get("provenance", {})


def load_intervals(path: str | Path) -> dict[str, tuple[float, float]]:
    """Confidence intervals in a vehicle file by dotted parameter name; errors as of `load_vehicle`."""
    path = Path(path)
    content = _read(path)
    found = {}
    for holder, table in [("body", content.get("body", {})), *_effect_tables(path, content)]:
        for name, entry in table.items():
            whole = fields.check_table(str(path), fields.VALUE, entry, f"{holder}.{name}")
            if "interval" in whole:
                where = f"{holder}.{name}.interval"
                low, high = fields.check(str(path), fields.INTERVAL, whole["interval"], where)
                if low > high:
                    raise ValueError(f"{path}: {where} is [{low:g}, {high:g}]; the lower end comes first. Swap them.")
                found[f"{holder}.{name}"] = (low, high)
    return found


def load_statistics(path: str | Path) -> dict[str, Any] | None:
    """The checked section `statistics` of a vehicle file, None where it has none; errors as of `load_vehicle`."""
    path = Path(path)
    table = _read(path).get("statistics")
    return None if table is None else fields.check_table(str(path), fields.STATISTICS, table, "statistics", NEWER)


def _parameter_tables(holder: str, value: Any, intervals: dict[str, tuple[float, float]]) -> dict[str, Any]:
    tables = {}
    for name, about in parameters_of(value).items():
        table: dict[str, Any] = {"value": float(getattr(value, name)), "unit": about.unit}
        if f"{holder}.{name}" in intervals:
            low, high = intervals[f"{holder}.{name}"]
            table["interval"] = [float(low), float(high)]
        tables[name] = table
    return tables


def _read(path: Path) -> dict[str, Any]:
    """Content of a vehicle file, of the right kind and schema."""
    if path.suffix in ROBOT_FILES and path.is_file():
        raise ValueError(f"{path}: a robot file; needed here is a vehicle file. Fit it to a driving log: python -m "
                         f"sysid.fit DATASET --model {fields.in_shell(path)} --out RUN writes RUN/vehicle.toml "
                         "where a vehicle of the simulator drives alike.")
    content = read_toml(path, "no such vehicle file. Make one with `python -m sysid.fit DATASET --out RUN`.",
                        "Correct the line.")
    content = upgraded(KIND, content)
    if content.get("kind") == KIND and content.get("schema") != SCHEMA:
        raise ValueError(f"{path}: {_wrong_schema(content.get('schema'))}")
    if content.get("kind") != KIND:
        raise ValueError(f"{path}: kind is {fields.shown(content.get('kind'))}, not {KIND!r}. Give a vehicle file.")
    table = fields.check_table(str(path), fields.VEHICLE, content, remedy=NEWER)
    parts = [name for name in ("body", "effects") if name in table]
    if len(parts) == 1 or (parts and "base" in table):
        raise ValueError(f"{path}: has {' and '.join(parts)}; it must have both body and effects and no base, or "
                         "neither of the two. Correct it.")
    return table


def _wrong_schema(schema: Any) -> str:
    """What is wrong with the number of a vehicle file's format, and the remedy."""
    if schema is None:
        return f"has no schema, the number of the file's format. Add schema = {SCHEMA} at its top."
    found = f"schema is {fields.shown(schema)}; this version reads schema {SCHEMA}."
    if isinstance(schema, int) and schema > SCHEMA:
        return f"{found} A newer version wrote the file. Use that version; by hand, write schema = {SCHEMA}."
    return f"{found} Write schema = {SCHEMA}."


def _read_spec(path: Path, table: dict[str, Any]) -> VehicleSpec:
    """The spec; where the file leaves out sizes of the body, the wheels' inertia or the camera's place, they are in
    proportion to the chair's."""
    table = dict(table)
    camera = fields.check_table(str(path), fields.CAMERA, table.pop("camera", {}), "spec.camera", NEWER)
    checked = fields.check_table(str(path), fields.SPEC, table, "spec", NEWER)
    try:
        usual = in_proportion(WHILL_CR, checked["name"], checked["wheel_radius"], checked["track"],
                              checked["wheelbase"], checked["mass"])
        known = {name: getattr(usual, name) for name in ("wheel_inertia", "body_length", "body_width", "body_height")}
        return VehicleSpec(**(known | checked), camera=dataclasses.replace(usual.camera, **camera))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _check_sizes(path: Path, spec: VehicleSpec) -> None:
    """Refuse a body that does not reach to its wheels, or is lower than they are."""
    farthest = max(abs(spec.rear_x), abs(spec.front_x))
    if farthest > spec.body_length / 2 + spec.wheel_radius:
        raise ValueError(f"{path}: spec.wheelbase {spec.wheelbase:g} m and the rear axle at {spec.rear_x:g} m put an "
                         f"axle {farthest:g} m from the middle of the body, which is {spec.body_length:g} m long. "
                         "Correct wheelbase, rear_axle_x or body_length.")
    if spec.track > spec.body_width:
        raise ValueError(f"{path}: spec.track is {spec.track:g} m and spec.body_width {spec.body_width:g} m; the body "
                         "is as wide as its wheels at least. Correct one.")
    if 2 * spec.wheel_radius > spec.body_height:
        raise ValueError(f"{path}: spec.wheel_radius is {spec.wheel_radius:g} m and spec.body_height "
                         f"{spec.body_height:g} m; the body is as high as its wheels at least, twice their radius. "
                         "Correct wheel_radius, or body_height, the overall height.")


def _effect_tables(path: Path, content: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """Name and parameters of each effect of a file."""
    found = []
    for index, table in enumerate(content.get("effects", [])):
        checked = fields.check_table(str(path), fields.EFFECT, table, f"effects[{index}]", NEWER)
        if checked["name"] not in EFFECTS:
            raise ValueError(f"{path}: unknown effect {fields.shown(checked['name'])} (known: "
                             f"{', '.join(sorted(EFFECTS))}). Install or register the package that defines it, or "
                             "remove the effect.")
        found.append((checked["name"], checked["parameters"]))
    return found


def _read_parameters(path: Path, holder: str, kind: Any, table: dict[str, Any], sizes: tuple[float, float]) -> Any:
    known = parameters_of(kind)
    values = {}
    for name, entry in table.items():
        if name not in known:
            raise ValueError(f"{path}: {holder} has no parameter {fields.shown(name)} (known: {', '.join(known)}). "
                             "Remove it or use a newer version of this program.")
        about, dotted = known[name], f"{holder}.{name}"
        whole = fields.check_table(str(path), fields.VALUE, entry, dotted)
        if whole["unit"] != about.unit:
            raise ValueError(f"{path}: {dotted} is in {whole['unit']!r}; it must be in {about.unit!r}. Convert it.")
        field = fields.parameter_field(dotted, about.unit, about.low, about.high, about.neutral, sizes)
        values[name] = fields.check(str(path), field, whole["value"])
    missing = {name for name in set(known) - set(values) if f"{holder}.{name}" not in LATER}
    if missing:
        raise ValueError(f"{path}: {holder} lacks {', '.join(sorted(missing))}. Give a value and a unit for each.")
    return jax.tree.map(as_number, kind(**values))
