"""The fields of all files that people write or that come from elsewhere: unit, kind, range, and the check of a value.

One table per kind of file. A reader gets its file's content from `whill_mjx.io.reading` and puts every value through
`check_table` or `check`; classes that are made in code too (`VehicleSpec`, `Task`, `Env`) call `check_fields`. An error
names file, field, value, rule and remedy. This module imports nothing of the package.
"""

from __future__ import annotations

import dataclasses
import math
import numbers
import os
import shlex
import types
import typing
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

Made = TypeVar("Made")
LONGEST_TEXT = 400  # characters of a name or a description
SHOWN = 60  # characters of a value in an error
SPEED = 20.0  # m/s and rad/s; more is km/h, mm/s or deg/s
DAY = 86_400.0  # s that a trial may last: replays and grids take memory by the second


@dataclass(frozen=True)
class Field:
    """What a field of a file may be."""

    name: str
    unit: str = "-"
    low: float = -math.inf
    high: float = math.inf
    """Lowest and highest value of a number, both allowed."""
    kind: str = "number"
    """"number", "whole", "text", "table", "list" (of tables), "numbers", "wholes", "texts"; "any" is not looked at."""
    choices: tuple[Any, ...] = ()
    """The only values that are allowed; none allows all of the kind."""
    count: int = 0
    """How many numbers or texts; 0 for any."""
    needed: bool = True
    exceptions: tuple[float, ...] = ()
    """Numbers that are allowed outside the range, such as inf where it means "no limit"."""
    remedy: str = ""
    """What to do; by default to correct it, in SI units where it has a unit."""


def check(where: str, field: Field, value: Any, name: str | None = None) -> Any:
    """The value as a float, int, text, tuple or as it is; ValueError names where, field, value, rule and remedy.

    Args:
        where: the file, or what the value belongs to.
        field: its row of the table.
        value: as it was read.
        name: what to call the field instead of its own name.
    """
    name = field.name if name is None else name
    if field.kind in ("number", "whole"):
        return _check_number(where, field, value, name)
    if field.kind == "any":
        return value
    if field.kind in ("numbers", "wholes", "texts"):
        size = f"{field.count} " if field.count else ""
        if not isinstance(value, list | tuple) or (field.count and len(value) != field.count):
            what = "whole numbers" if field.kind == "wholes" else field.kind
            raise _error(where, name, value, f"must be a list of {size}{what}", field)
        single = replace(field, kind=field.kind[:-1])
        return tuple(check(where, single, one, f"{name}[{index}]") for index, one in enumerate(value))
    if field.kind == "table":
        right = isinstance(value, dict)
    elif field.kind == "list":
        right = isinstance(value, list) and all(isinstance(one, dict) for one in value)
    else:
        right = isinstance(value, str) and 0 < len(value) <= LONGEST_TEXT and value.isprintable()
    if not right:
        rule = {"table": "must be a table", "list": "must be a list of tables"}.get(
            field.kind, f"must be a text of 1 to {LONGEST_TEXT} printable characters")
        raise _error(where, name, value, rule, field)
    if field.choices and value not in field.choices:
        raise _error(where, name, value, f"must be one of {', '.join(map(repr, field.choices))}", field)
    return value


def check_table(
    where: str, fields: Iterable[Field], table: Any, name: str = "", remedy: str = "", others: bool = False
) -> dict[str, Any]:
    """The checked values of a table by field name; fields that are not needed and not there are left out.

    Args:
        where: the file.
        fields: rows of the table's kind.
        table: as it was read.
        name: of the table, where it is not the whole file.
        remedy: for a field of an unknown name.
        others: pass over fields of an unknown name.
    """
    known = {field.name: field for field in fields}
    prefix = f"{name} has " if name else ""
    if not isinstance(table, dict):
        raise ValueError(f"{where}: {name or 'the content'} is {shown(table)}; it must be a table. Correct it.")
    for key in table:
        if key not in known and not others:
            raise ValueError(f"{where}: {prefix}unknown field {shown(key)} (known: {', '.join(sorted(known))}). "
                             f"{remedy or 'Correct its spelling or remove it.'}")
    for field in known.values():
        if field.needed and field.name not in table:
            unit = "" if field.unit == "-" else f" [{field.unit}]"
            raise ValueError(f"{where}: {prefix}no field {field.name!r}{unit}. Add it.")
    dot = f"{name}." if name else ""
    return {key: check(where, known[key], value, dot + key) for key, value in table.items() if key in known}


def check_fields(where: str, fields: Iterable[Field], holder: Any) -> None:
    """Check those attributes of an object that the table has; None passes where a field is not needed."""
    for field in fields:
        value = getattr(holder, field.name, None)
        if value is not None or (field.needed and hasattr(holder, field.name)):
            check(where, field, value)


def record(where: str, kind: type[Made], content: Any, name: str = "") -> Made:
    """A dataclass of numbers, texts, tuples, lists, dicts and such records, from a table of a JSON file.

    Args:
        where: the file.
        kind: the dataclass; its type hints are what the table is held to, and every number must be finite.
        content: as it was read.
        name: of the table, where it is not the whole file.
    """
    members = {one.name: one for one in dataclasses.fields(kind)}  # type: ignore[arg-type]
    needed = {key for key, one in members.items()
              if one.default is dataclasses.MISSING and one.default_factory is dataclasses.MISSING}
    content = check_table(where, [Field(key, kind="any", needed=key in needed) for key in members], content, name)
    hints, dot = typing.get_type_hints(kind), f"{name}." if name else ""
    return kind(**{key: _typed(where, hints[key], value, dot + key) for key, value in content.items()})


def _typed(where: str, hint: Any, value: Any, name: str) -> Any:
    """A value of a JSON file as a type hint wants it."""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin is types.UnionType and type(None) in inner:
        return None if value is None else _typed(where, inner[0], value, name)
    if dataclasses.is_dataclass(hint):
        return record(where, hint, value, name)  # type: ignore[arg-type]
    if hint in (int, float):
        return check(where, Field(name, kind="whole" if hint is int else "number"), value)
    wanted: Any
    wanted, rule = {dict: (dict, "a table"), str: (str, "a text")}.get(origin or hint, ((list, tuple), "a list"))
    if not isinstance(value, wanted):
        raise ValueError(f"{where}: {name} is {shown(value)}; it must be {rule}. Correct it.")
    if hint is str:
        return value
    if origin is dict:
        assert isinstance(value, dict)
        return {key: _typed(where, inner[1], one, f"{name}.{key}") for key, one in value.items()}
    return origin(_typed(where, inner[0], one, f"{name}[{index}]") for index, one in enumerate(value))


def counted(count: int, what: str) -> str:
    """A number of things in words: "1 row", "3 rows"."""
    return f"{count} {what}{'' if count == 1 else 's'}"


def percent(share: float) -> str:
    """A share in percent, as "75%" or "99.5%". "0%" and "100%" mean none and all: nothing is rounded to them."""
    digits = f"{100 * share:.1f}".removesuffix(".0")
    if digits == "100" and share < 1.0:
        return "over 99.9%"
    return "under 0.1%" if digits == "0" and share > 0.0 else f"{digits}%"


def in_shell(path: str | os.PathLike[str]) -> str:
    """A path as one word of a shell, so that a hint can be copied: names with spaces or brackets are quoted."""
    return shlex.quote(os.fspath(path))


def shown(value: Any) -> str:
    """A value as an error shows it: short, and whatever it is."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, int) and value.bit_length() > 200:
        return f"an integer of about {value.bit_length() * 3 // 10} digits"
    try:
        text = repr(value)
    except (RecursionError, ValueError):  # nested too deep, or with an integer of too many digits
        text = f"a {type(value).__name__}"
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 3]}..."


def _check_number(where: str, field: Field, value: Any, name: str) -> float:
    kind: Any = numbers.Integral if field.kind == "whole" else numbers.Real
    rule = f"lie within {field.low:g} to {field.high:g}" if field.high < math.inf else f"be at least {field.low:g}"
    if field.low > 0:
        rule = f"be positive, from {field.low:g} to {field.high:g}" if field.high < math.inf else "be positive"
    if field.low == -math.inf and field.high == math.inf:
        rule = "be finite"
    rule += "" if field.unit == "-" else f" {field.unit}"
    if field.choices:
        rule = f"be one of {', '.join(map(str, field.choices))}"
    rule += "".join(f", or {one:g}" for one in field.exceptions)
    if isinstance(value, bool | np.bool_) or not isinstance(value, kind):
        what = "whole number" if field.kind == "whole" else "number"
        raise _error(where, name, value, f"must be a {what}, and must {rule}", field)
    try:
        number = float(value)
    except OverflowError:
        number = math.inf if value > 0 else -math.inf
        raise _error(where, name, value, f"must be a number, and must {rule}", field) from None
    if math.isnan(number):
        raise _error(where, name, value, f"must be a number, and must {rule}", field)
    allowed = number in field.choices if field.choices else (
        field.low <= number <= field.high and math.isfinite(number) or number in field.exceptions)
    if not allowed:
        raise _error(where, name, value, f"must {rule}", field)
    return int(value) if field.kind == "whole" else number


def _error(where: str, name: str, value: Any, rule: str, field: Field) -> ValueError:
    remedy = field.remedy or ("Correct it." if field.unit == "-" else "Correct it, in SI units.")
    return ValueError(f"{where}: {name} is {shown(value)}; it {rule}. {remedy}")


def _optional(*fields: Field) -> tuple[Field, ...]:
    return tuple(replace(field, needed=False) for field in fields)


CAMERA = _optional(
    Field("x", "m", -10.0, 10.0),
    Field("y", "m", -10.0, 10.0),
    Field("z", "m", -10.0, 10.0),
    Field("roll", "rad", -3.2, 3.2),
    Field("pitch", "rad", -1.6, 1.6),
    Field("yaw", "rad", -3.2, 3.2),
    Field("fov_y", "rad", 0.01, 3.1),
)
"""[spec.camera] of a vehicle file."""

SIZES = (
    Field("wheel_radius", "m", 0.001, 2.0),
    Field("track", "m", 0.01, 5.0),
    Field("wheelbase", "m", 0.01, 10.0),
    Field("mass", "kg", 0.01, 1e4),
)
DRIVE = _optional(
    Field("drive", kind="text", choices=("differential", "skid"), remedy="Correct it: use 'differential' or 'skid'."),
    Field("driven_axle", kind="text", choices=("rear", "front"), remedy="Correct it: use 'rear' or 'front'."),
)

SPEC = (
    Field("name", kind="text"),
    *SIZES,
    *DRIVE,
    *_optional(
        Field("rear_axle_x", "m", -10.0, 10.0),
        Field("wheel_inertia", "kg m^2", 1e-9, 1e3),
        Field("body_length", "m", 0.01, 20.0),
        Field("body_width", "m", 0.01, 20.0),
        Field("body_height", "m", 0.01, 20.0),
        Field("v_min", "m/s", -SPEED, 0.0),
        Field("v_max", "m/s", 1e-3, SPEED),
        Field("omega_max", "rad/s", 1e-3, SPEED),
    ),
)
"""[spec] of a vehicle file, without its camera."""

VEHICLE = (
    Field("schema", kind="whole", choices=(1,)),
    Field("kind", kind="text", choices=("micromobility-vehicle",), remedy="Give a vehicle file."),
    Field("spec", kind="table"),
    Field("base", kind="text", choices=("paper", "physical"), needed=False),
    Field("body", kind="table", needed=False),
    Field("effects", kind="list", needed=False),
    Field("provenance", kind="table", needed=False),
    Field("statistics", kind="table", needed=False),
)
"""A vehicle file; without `body` and `effects` these are a base model's for the spec."""

STATISTICS = (
    Field("schema", kind="whole", choices=(1,), remedy="Fit the vehicle again, or use the version that wrote it."),
    Field("drives", kind="whole", low=1),
    Field("bin", "s", 0.01, 60.0),
    Field("channels", kind="texts"),
    Field("shared", low=0.0, high=1.0),
    Field("scale", low=0.0, kind="numbers"),
    *(Field(name, kind="numbers") for name in ("memory", "inverse")),
    Field("factors", low=1.0, kind="numbers"),
    Field("parameters", kind="texts"),
    Field("standard_error", low=0.0, kind="numbers"),
    Field("correlation", low=-1.0, high=1.0, kind="numbers"),
)
"""[statistics] of a vehicle file: what its fit knows beside the values. Matrices are written row by row."""

EFFECT = (Field("name", kind="text"), Field("parameters", kind="table"))
"""One of [[effects]] of a vehicle file."""

VALUE = (
    Field("value", kind="any"),
    Field("unit", kind="text"),
    Field("interval", kind="any", needed=False),
)
"""A parameter in a vehicle file; its value goes by `parameter_field`, its interval by `INTERVAL`."""

INTERVAL = Field("interval", kind="numbers", count=2, exceptions=(-math.inf, math.inf))

SIZE = {field.name: field for field in SIZES}
CHAIR = (52.0, 0.1325)
"""Mass [kg] and wheel radius [m] of the vehicle for which the ranges of parameters are stated."""
GROWTH = {
    "kg": (1, 0), "N": (1, 0), "N s/m": (1, 0), "N s^2/m^2": (1, 0), "N m": (1, 1), "N m s/rad": (1, 2),
    "N m/rad": (1, 2), "kg m^2": (1, 2), "1/W": (-1, 0), "s/kg": (-1, 0),
}  # fmt: skip
"""Powers of mass and of length with which parameters of a unit grow with the vehicle. Gains of a drive act on a mass at
the radius of its wheels."""

RANGES: dict[str, tuple[float, float]] = {
    "body.mass": (SIZE["mass"].low, SIZE["mass"].high),
    "body.yaw_inertia": (1e-6, 1e5),  # of the chair
    **dict.fromkeys(("body.com_x", "body.com_y", "body.com_z", "payload_shift.x", "payload_shift.y", "payload_shift.z"),
                    (-20.0, 20.0)),
    "caster_kick.trail": (1e-4, 20.0),
    **dict.fromkeys(
        ("actuator_lag.cascade", "axle_pivot.freedom", "command_expiry.loss", "middle_wheels.share",
         "rolling_contact.grip", "unnamed.with_motion", "wheel_inertia.reaction"), (0.0, 1.0)),
    **dict.fromkeys(("backlash.rotor", "command_dead_zone.release"), (0.001, 1.0)),
    **dict.fromkeys(("incline.along_x", "incline.along_y", "slope.along_x", "slope.along_y"), (-1.5, 1.5)),
    "drive_gain_difference.difference": (-2.0, 2.0),
    "gyro_bias.scale": (-10.0, 10.0),
    "track_width.error": (-0.9, 5.0),
    "unnamed.quantity": (1.0, 11.0),
    **dict.fromkeys(("wheel_radius_difference.difference", "wheel_radius_difference.common"), (-0.6, 0.6)),
}
"""Widest sensible range of a parameter of a vehicle file, where it is not the usual one of `parameter_field`."""


def growth(unit: str, mass: float, wheel_radius: float) -> float:
    """How many times larger than the chair's a parameter of a unit is on a vehicle that is built alike; 1 for the
    chair."""
    powers = GROWTH.get(unit, (0, 0))
    return float((mass / CHAIR[0]) ** powers[0] * (wheel_radius / CHAIR[1]) ** powers[1])


def parameter_field(
    name: str, unit: str, low: float, high: float, neutral: float, sizes: tuple[float, float] | None = None
) -> Field:
    """The field of a parameter of a vehicle: ten times beyond the range that a fit may search, and the neutral value.

    What grows with the vehicle may be a hundred times beyond what it is on the chair and on the vehicle itself.

    Args:
        name: dotted, such as "pid_drive.kp".
        unit, low, high, neutral: of its `Parameter`.
        sizes: mass [kg] and wheel radius [m] of the vehicle; None, where it is not known, allows what the smallest
            and the largest one (`SIZES`) may have.
    """
    mass, radius = SIZE["mass"], SIZE["wheel_radius"]
    ends = [(mass.low, radius.low), (mass.high, radius.high)] if sizes is None else [CHAIR, sizes]
    smaller, larger = sorted(growth(unit, *end) for end in ends)
    beyond = 100.0 if unit in GROWTH else 10.0  # a fit searches these around where it starts, which may be anywhere
    reach = beyond * larger * max(abs(low), abs(high))
    lowest, highest = (-reach if low < 0 else low * smaller / beyond), (reach if high > 0 else 0.0)
    lowest, highest = RANGES.get(name, (lowest, highest))
    if name == "body.yaw_inertia":
        lowest, highest = lowest * smaller, highest * larger
    neutral_too = not (name.startswith("body.") or lowest <= neutral <= highest)
    return Field(name, unit, lowest, highest, exceptions=(neutral,) if neutral_too else ())


DATASET = (
    Field("schema", kind="whole", choices=(1,), remedy="Write schema = 1 and follow docs/log_format.md."),
    Field("vehicle", kind="text", remedy="Give the name of a built-in vehicle or a short description."),
    *DRIVE,
    *_optional(*SIZES),
    Field("command_limits", "m/s, rad/s", 1e-3, SPEED, kind="numbers", count=2, needed=False,
          remedy="Write [v, omega], both positive."),
    Field("command_timeout", "s", 0.01, 60.0, needed=False,
          remedy="It is how long the base drives on where no command comes; leave it out where it never stops."),
    Field("reference_point", kind="text", choices=("drive axle centre", "vehicle centre"), needed=False,
          remedy="Move the measured poses to one of them before writing the log."),
    Field("odometry", kind="text", needed=False),
    Field("ground_truth", kind="text", needed=False),
    Field("held_out", kind="texts", needed=False),
    Field("input", kind="text", choices=("commands", "wheels"), needed=False,
          remedy="Write \"wheels\" where command.csv holds measured wheel speeds, else leave it out."),
    Field("columns", kind="texts", needed=False),
)
"""dataset.toml of a driving log."""

COLUMNS = {field.name: field for field in (
    Field("t", "s", -DAY, DAY, remedy="It counts in seconds from the trial's start: subtract the first time stamp, and "
                                      "divide milli-, micro- or nanoseconds."),
    Field("x", "m", -1e7, 1e7, remedy="Convert it to metres."),  # of a national grid, too
    Field("y", "m", -1e7, 1e7, remedy="Convert it to metres."),
    Field("yaw", "rad", -1e5, 1e5, remedy="Convert it to radians."),
    Field("v", "m/s", -SPEED, SPEED, remedy="Convert it to m/s: is it in km/h or mm/s?"),
    Field("omega", "rad/s", -SPEED, SPEED, remedy="Convert it to rad/s: is it in deg/s?"),
    Field("gyro", "rad/s", -SPEED, SPEED, remedy="Convert it to rad/s: is it in deg/s?"),
)}  # fmt: skip
"""Columns of the CSV files of a driving log."""

MAP = (
    Field("image", kind="text"),
    Field("resolution", "m", 1e-4, 100.0),
    Field("origin", "m, m, rad", -1e6, 1e6, kind="numbers", count=3, remedy="It must be [x, y, yaw]."),
    Field("occupied_thresh", "-", 0.0, 1.0),
    Field("free_thresh", "-", 0.0, 1.0),
    Field("negate", kind="whole", choices=(0, 1), remedy="Write 0, 1, false or true."),
    Field("mode", kind="text", choices=("trinary", "scale", "raw"), needed=False),
)
"""YAML file of a map, as map_server reads it."""

REPEATS = 100
"""Control periods that a decision holds at most, as a policy file has it."""
TASK = (
    Field("v_min", "m/s", -SPEED, SPEED),
    Field("v_max", "m/s", -SPEED, SPEED),
    Field("omega_max", "rad/s", 0.0, SPEED),
    Field("max_steps", kind="whole", low=1, high=10**7),
    Field("action_repeat", kind="whole", low=1, high=REPEATS),
    Field("goal_radius", "m", 0.0, 1e3),
    Field("goal_reward", "-", -1e9, 1e9),
    Field("collision_reward", "-", -1e9, 1e9),
    Field("progress_gain", "1/m", -1e9, 1e9),
    Field("step_reward", "-", -1e9, 1e9),
    Field("smoothness_gain", "s/rad", -1e9, 1e9),
    Field("layout", kind="text"),
    Field("people", kind="whole", low=0, high=200, needed=False),
    Field("people_within", "m", 0.5, 1e3, needed=False),
    Field("yielding", "-", 0.0, 1.0, needed=False),
    Field("gates", kind="whole", low=0, high=2),
    Field("goal_x", "m", -1e3, 1e3),
    Field("gate_x", "m", -1e3, 1e3, kind="numbers", count=2),
    Field("box_x", "m", -1e3, 1e3),
    Field("width", "m", 0.01, 1e3),
)
"""A task, in code and in run.json."""

BUDGET = (
    Field("steps", kind="whole", low=1, high=10**12),
    *(Field(name, kind="whole", low=1, high=high, needed=False)
      for name, high in (("eval_every", 10**12), ("eval_episodes", 10**6), ("instances", 10**7))),
    *(Field(name, low=0.0, high=1.0, needed=False) for name in ("exploring_starts", "second_tries", "stop_success")),
)  # fmt: skip
"""How long a task is trained (`whill_mjx.tasks.base.Budget`)."""

RUN = (Field("preset", kind="table"),)
PRESET = (Field("task", kind="table"),)
"""run.json of a training, and its `preset`: what other commands read of them."""

ENV = (
    Field("height", "pixels", 1, 4096, kind="whole"),
    Field("width", "pixels", 1, 4096, kind="whole"),
    Field("exploring_starts", "-", 0.0, 1.0, remedy="It is a share of episodes; use 0 to 1."),
)
BATCH = (
    Field("count", kind="whole", low=1, high=10**7),
    Field("spread", "-", 0.0, 2.0, remedy="It is a relative standard deviation; use for example 0.1."),
)
CONDITION = {field.name: field for field in (
    *(Field(name, "m", -1e4, 1e4) for name in ("obstacle_x", "obstacle_y", "obstacle_shift_y", "start_x", "start_y")),
    Field("start_yaw_deg", "deg", -360.0, 360.0),
    Field("light", "-", 0.0, 100.0, remedy="It is a factor; 1 changes nothing."),
    *(Field(f"camera_{axis}", "m", -10.0, 10.0) for axis in "xyz"),
    *(Field(f"camera_{angle}_deg", "deg", -180.0, 180.0) for angle in ("pitch", "yaw")),
    Field("latency_s", "s", 0.0, 10.0),
)}  # fmt: skip
"""What a sweep and `reset(options=...)` change of an episode."""
TIMES = (Field("control_dt", "s", 1e-6, 10.0), Field("physics_dt", "s", 1e-6, 10.0))
"""Arguments of `make_env`, of `make_batch`, and the time steps of `VehicleConfig`."""
