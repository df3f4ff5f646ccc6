"""What the columns of somebody else's CSV files hold: stream, quantity and unit, by their names and by their numbers.

A role is STREAM.QUANTITY, such as command.v or ground_truth.yaw; "time" is that of all streams of a file. Names are
those of ROS exports (`pose.pose.position.x`), of plotting programs (`/odom/twist/twist/linear/x`) and of people
(`cmd_v [km/h]`). A unit comes from the name where it is there, else from the numbers: a speed must be the rate of its
pose, a measured speed must be about the commanded one.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

STREAMS = ("command", "odometry", "ground_truth", "wheels")
QUANTITIES = {
    "command": ("v", "omega", "left", "right"), "odometry": ("x", "y", "yaw", "qx", "qy", "qz", "qw", "v", "omega"),
    "ground_truth": ("x", "y", "yaw", "qx", "qy", "qz", "qw"),
    "wheels": ("left", "right", "left_angle", "right_angle"),
}
ROLES = ("time", *(f"{stream}.{one}" for stream in STREAMS for one in QUANTITIES[stream]))
UNITS = {  # kind -> unit -> SI
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "d": 86400.0},
    "length": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "ft": 0.3048, "in": 0.0254},
    "angle": {"rad": 1.0, "deg": np.pi / 180, "mrad": 1e-3, "rev": 2 * np.pi},
    "speed": {"m/s": 1.0, "km/h": 1 / 3.6, "mm/s": 1e-3, "cm/s": 1e-2, "mph": 0.44704, "ft/s": 0.3048},
    "rate": {"rad/s": 1.0, "deg/s": np.pi / 180, "mrad/s": 1e-3, "rpm": 2 * np.pi / 60},
    "none": {"-": 1.0},
}
SPELLED = {
    "sec": "s", "secs": "s", "second": "s", "seconds": "s", "msec": "ms", "millis": "ms", "milliseconds": "ms",
    "usec": "us", "micros": "us", "nsec": "ns", "nsecs": "ns", "nanosec": "ns", "nanoseconds": "ns", "nanos": "ns",
    "degree": "deg", "degrees": "deg", "radians": "rad", "radian": "rad", "mps": "m/s", "ms-1": "m/s", "kmh": "km/h",
    "kph": "km/h", "kmph": "km/h", "mmps": "mm/s", "cmps": "cm/s", "radps": "rad/s", "rads": "rad/s", "dps": "deg/s",
    "degps": "deg/s", "degs": "deg/s", "meter": "m", "meters": "m", "metre": "m", "metres": "m", "m s": "m/s",
    "mins": "min", "minute": "min", "minutes": "min", "hour": "h", "hours": "h", "hrs": "h", "day": "d", "days": "d",
    "km h": "km/h", "mm s": "mm/s", "cm s": "cm/s", "rad s": "rad/s", "deg s": "deg/s", "°": "deg", "°/s": "deg/s",
}
STREAM_WORDS = {
    "command": ("cmd", "command", "commands", "commanded", "desired", "des", "ref", "reference", "setpoint", "target",
                "input", "u", "soll", "joy", "joystick", "control", "teleop", "request", "requested", "action"),
    "odometry": ("odom", "odometry", "odo", "measured", "meas", "ist", "actual", "act", "feedback", "encoder", "enc",
                 "fb", "reported", "state"),
    "ground_truth": ("gt", "truth", "groundtruth", "mocap", "vicon", "optitrack", "qualisys", "icp", "slam", "amcl",
                     "gps", "rtk", "outside", "external", "tracker", "tracked", "marker", "lidar", "rigidbody", "tum",
                     "motive", "tracking"),
}
STREAM_LAST = {word for words in STREAM_WORDS.values() for word in words}
QUANTITY_WORDS = {
    "yaw": ("yaw", "theta", "heading", "psi", "azimuth", "th", "phi", "kurs", "gierwinkel", "rz"),
    "qx": ("qx",), "qy": ("qy",), "qz": ("qz",), "qw": ("qw",),
    "omega": ("omega", "yawrate", "w", "wz", "angular", "ang", "turnrate", "rot", "gyro", "gyroz", "angularvel",
              "angvel", "turn", "drehrate", "gierrate"),
    "v": ("v", "vx", "speed", "velocity", "linear", "lin", "vel", "forward", "linvel", "linearvel", "throttle",
          "geschwindigkeit", "geschw"),
    "x": ("x", "px", "posx", "tx", "easting", "east"), "y": ("y", "py", "posy", "ty", "northing", "north"),
}
TICKS = re.compile(r"tick|count|enc(oder)?s?([ _]|$)", re.IGNORECASE)
"""In the names of wheel angles that an encoder counts."""
PER_TURN = re.compile(r"(\d+(?:\.\d+)?)/rev")  # A unit of ticks: so many in a turn
COUNTS = re.compile(r"frame|index|sample|row|seq", re.IGNORECASE)  # in the names of columns that count rows
PER_SECOND = re.compile(r"(\d+(?:\.\d+)?) ?hz")  # A unit of rows: so many in a second
SIDES = {"left": {"left", "l", "lw", "wl", "vl", "lft", "fl", "rl", "bl", "lf", "lb", "links", "linkes"},
         "right": {"right", "r", "rw", "wr", "vr", "rgt", "fr", "rr", "br", "rf", "rb", "rechts", "rechtes"}}
CORNERS = {"fl", "rl", "bl", "lf", "lb", "fr", "rr", "br", "rf", "rb"}
"""Names of wheels that may mean other things where they stand alone."""
TIME_WORDS = ("t", "time", "zeit", "timestamp", "stamp", "clock", "epoch", "unixtime", "rostime", "date", "datetime",
              "uhrzeit", "datum")
NOT_PLANAR = {"roll", "pitch", "z", "tz", "vy", "vz", "wx", "wy", "covariance", "accel", "acceleration", "acc", "mag",
              "seq", "current", "voltage", "temperature", "battery", "torque", "effort", "error", "std", "var", "cov"}
FASTEST_STEP = 5e-4  # s; rows that follow faster are in another unit of time
SERIAL_DAYS, DAY_STEP = ((2e4, 6e4), (7.2e5, 7.6e5)), 5e-5
"""Ranges of dates that count days, as spreadsheets and MATLAB have them, and the longest step of such a recording."""
SAID = "as said"  # why a column has its role where somebody gave no unit
TOO_FAST = 50.0  # m/s; a pose that often moves faster is in millimetres
TOO_SLOW = 0.02  # m/s; a pose that never moves faster shows no unit
TURNED = 0.3  # rad; the same of a heading
ALIKE = 0.25  # relative difference from a unit's size within which numbers agree with it
NEAR = 0.02  # of any unit from 0, at which an odometry begins
GAP = 2.0  # s without samples, over which nothing is interpolated


@dataclass(frozen=True)
class Column:
    """What one column holds."""

    role: str
    file: str  # stem of the file
    name: str
    unit: str
    why: str  # how role and unit were found; empty where somebody said both
    sure: bool = True
    assumed: bool = False  # whether neither name nor numbers show the unit, so that it is the usual one
    moves: bool = True  # whether its numbers change by what a moving vehicle would have in this unit
    sign: float = 1.0  # -1 where it counts the other way round

    def __str__(self) -> str:
        return f"{self.role}={self.file}/{self.name}:{'-' if self.sign < 0 else ''}{self.unit}"

    def in_si(self, values: np.ndarray) -> np.ndarray:
        """Its numbers (T,) in SI units."""
        return np.asarray(values * (self.sign * size_of(self.role, self.unit)))


@dataclass(frozen=True)
class Table:
    """One text file of numbers; nan where a cell is empty."""

    stem: str
    columns: dict[str, np.ndarray]  # name -> (T,)
    odd: Mapping[str, str] = field(default_factory=dict)  # name of a column -> note on its cells that are no numbers
    texts: Mapping[str, str] = field(default_factory=dict)  # name of a column without numbers -> its first cell


def kind_of(role: str) -> str:
    """What a role measures: a key of UNITS."""
    quantity = role.rpartition(".")[2]
    if quantity in ("qx", "qy", "qz", "qw"):
        return "none"
    return {"time": "time", "x": "length", "y": "length", "yaw": "angle", "v": "speed", "left": "rate", "right": "rate",
            "left_angle": "angle", "right_angle": "angle"}.get(quantity, "rate")


def size_of(role: str, unit: str) -> float:
    """Size of a unit of a role in SI units; KeyError for one that is not known."""
    if kind_of(role) == "angle" and (turn := PER_TURN.fullmatch(unit)):
        return 2 * np.pi / float(turn[1])
    if role == "time" and (often := PER_SECOND.fullmatch(unit)):
        return 1 / float(often[1])
    wheel = role.rpartition(".")[2] in ("left", "right")
    return (UNITS["speed"] | UNITS["rate"] if wheel else UNITS[kind_of(role)])[unit]


def read_decision(text: str, tables: Sequence[Table]) -> Column:
    """One `ROLE=[FILE/]COLUMN[:UNIT]` as somebody wrote it; a minus before the unit, or in its place, turns the sign.

    ValueError where it is none.
    """
    role, equals, rest = text.partition("=")
    role, rest = role.strip(), rest.strip()
    if not equals or role not in ROLES:
        raise ValueError(f"--columns {text}: must be ROLE=COLUMN:UNIT, with a role of {', '.join(ROLES)}.")
    for table in tables:
        for name in sorted(table.columns, key=len, reverse=True):
            for written in (f"{table.stem}/{name}", name):
                unit = rest[len(written) :].strip()
                if rest.startswith(written) and (not unit or unit.startswith(":")):
                    unit = _unit(unit[1:].strip()) if unit else ""
                    sign = -1.0 if unit.startswith("-") and role != "time" and kind_of(role) != "none" else 1.0
                    unit = _unit(unit[1:]) if sign < 0 else unit
                    if unit and not _is_known(role, unit):
                        known = ", ".join(UNITS["speed"] | UNITS["rate"] if role.endswith(("left", "right")) else
                                          UNITS[kind_of(role)])
                        ticks = {"time": ", Nhz for N rows in a second"}.get(
                            role, ", N/rev for N ticks in a turn" if role.endswith("_angle") else "")
                        raise ValueError(f"--columns {text}: {unit!r} is no unit of {role} (known: {known}{ticks}).")
                    return Column(role, table.stem, name, unit or _split_unit(name)[1], "" if unit else SAID, sign=sign)
    known = ", ".join(f"{table.stem}/{name}" for table in tables for name in table.columns)
    raise ValueError(f"--columns {text}: no such column (found {known[:400]}). Correct its name.")


def guess(
    tables: Sequence[Table], said: Sequence[Column] = (), units: Mapping[tuple[str, str], str] | None = None
) -> list[Column]:
    """What the columns of the files of one drive hold, as far as names and numbers show it; what is `said` is kept.

    `units`: units that other drives of the source show, by role and name of the column.
    """
    found = list(said)
    taken = {(one.file, one.name) for one in said}
    settled = _settled_commands({one.role for one in said})
    for table in tables:
        roles = {one.role for one in found if one.role != "time"}
        candidates = [column for name in table.columns if (table.stem, name) not in taken
                      and (column := _by_name(table, name)) is not None and column.role not in settled]
        long_unit = {"min", "h", "d"}  # a column of hours may stand beside the time itself
        for column in sorted(candidates, key=lambda one: (not one.sure, one.role == "time" and one.unit in long_unit)):
            rival = column.role == "time" and any(one.role == "time" and one.file == table.stem for one in found)
            if not rival and column.role not in roles:
                found.append(column)
                roles.add(column.role if column.role != "time" else "")
    arrays = {(table.stem, name): values for table in tables for name, values in table.columns.items()}
    found = _origin_counts(found, arrays)
    found = [one if one.why == "" else _time_unit(one, arrays[one.file, one.name]) if one.role == "time" else one
             for one in found]
    decided = _units_by_numbers(found, arrays)
    if not units:
        return decided
    open_ones = {(one.role, one.name) for one in decided if one.assumed and (one.role, one.name) in units}
    return _units_by_numbers([replace(one, unit=units[one.role, one.name], why=f"{one.why}; as most drives show")
                              if (one.role, one.name) in open_ones else one for one in found], arrays)


def _settled_commands(said: set[str]) -> set[str]:
    """Roles of commands that are not looked for: those of the other form, where somebody said a whole command."""
    forms = [{f"command.{one}" for one in form} for form in (("v", "omega"), ("left", "right"))]
    return {role for form, other in zip(forms, reversed(forms), strict=True) if form <= said for role in other}


def shown_units(drives: Sequence[Sequence[Column]]) -> dict[tuple[str, str], str]:
    """Unit of each column, by role and name, that most moving drives show; sure ones count a little more."""
    votes: dict[tuple[str, str], Counter[str]] = {}
    for columns in drives:
        for one in columns:
            if (one.moves or not one.assumed) and one.role != "time":
                votes.setdefault((one.role, one.name), Counter())[one.unit] += 100 if one.assumed else 101
    return {key: vote.most_common(1)[0][0] for key, vote in votes.items()}


def _origin_counts(found: list[Column], arrays: Mapping[tuple[str, str], np.ndarray]) -> list[Column]:
    """Poses whose names do not say so are odometry's if they begin at the origin; elsewhere nobody can know."""
    roles = {one.role for one in found}
    words = set(STREAM_WORDS["odometry"])
    nameless = [one for one in found if one.role in ("odometry.x", "odometry.y", "odometry.yaw")
                and one.why not in ("", SAID)
                and not _stream_said(one.name, "odometry") and not set(_words(one.file)) & words]
    if not nameless or {"odometry.v", "odometry.omega"} & roles:
        return found
    starts = [arrays[one.file, one.name] for one in nameless]
    away = any(abs(known[0]) > NEAR for values in starts if len(known := values[np.isfinite(values)]))
    return [replace(one, sure=not away) if one in nameless else one for one in found]


def _by_name(table: Table, name: str) -> Column | None:
    """Role and unit of a column by its name and its file's."""
    plain, unit = _split_unit(name)
    words = _words(plain)
    joined = "".join(words)
    turns = re.search(r"((angular|gyro|rate|orientation|quat\w*|rotation)|^q\w{0,4})z$", joined)
    if _unit(name) in UNITS["time"] and _unit(name) not in ("s", "min"):  # a column that is named after its unit
        return Column("time", table.stem, name, _unit(name), "its name")
    if not words or NOT_PLANAR & set(words[-2:]) and not turns:
        return None
    stamp_part = words[-1] in ("secs", "sec", "nsecs", "nsec", "nanosec")
    if (set(words) & set(TIME_WORDS) and not set(words[-1:]) & {"x", "y", "z", "w"} or stamp_part
            or words == ["rosbagtimestamp"]):
        if words[-1] in ("nsecs", "nsec", "nanosec") and "+" not in name and {"header", "stamp"} & set(words):
            return None  # the rest of a second; joined with secs when read
        last = _unit(words[-1])
        return Column("time", table.stem, name, unit or (last if last in ("min", "h", "d") else ""), "its name")
    stream_words = {one for known in STREAM_WORDS.values() for one in known}
    quantity = _quantity([word for word in words if word not in stream_words] or words)
    if quantity is None:
        return None
    stream, sure = _stream(words, _words(table.stem), quantity, table)
    if stream is None or quantity not in QUANTITIES[stream]:
        return None
    if quantity in ("left", "right", "left_angle", "right_angle") and not unit and TICKS.search(name) \
            and stream == "wheels" and _counts(table.columns[name]):
        return Column(f"wheels.{quantity.removesuffix('_angle')}_angle", table.stem, name, "", "its name", False)
    of_a_body = any(_words(_split_unit(one)[0]) == ["rx"] for one in table.columns)
    doubtful = words == ["rz"] and not of_a_body or len(words) == 1 and words[0] in CORNERS
    return Column(f"{stream}.{quantity}", table.stem, name, unit, "its name", sure and not doubtful)


def _counts(values: np.ndarray) -> bool:
    """Whether values (T,) are whole numbers, as an encoder's."""
    known = values[np.isfinite(values)]
    return bool((known == np.round(known)).all())


def _is_known(role: str, unit: str) -> bool:
    try:
        return size_of(role, unit) > 0
    except (KeyError, ZeroDivisionError):
        return False


def _quantity(words: list[str]) -> str | None:
    text = " ".join(words)
    if match := re.fullmatch(r"(p|pos|position|q|quat|quaternion|orientation) (?:\w{1,2} )*([wxyz])", text):
        return f"q{match[2]}" if match[1][0] in "qo" else match[2] if match[2] in "xy" else None
    side = next((one for one, known in SIDES.items() if known & set(words)), "")
    if side and re.search(r"^\w+$|wheel|motor|joint|rad|\bw\b|vel|speed|rpm|enc|angle|pos|\blw\b|\brw\b|omega|cmd|tick|"
                          "count", text):
        angle = re.search(r"angle|pos|position|enc(oder)?$|tick|count", text) and not re.search(r"vel|speed|rpm", text)
        return f"{side}_angle" if angle else side
    last = words[-1]
    if match := re.search(r"\b(x|y|z|theta|yaw|heading|psi) (vel|velocity|speed|rate|dot)$", text):
        return {"x": "v", "y": None, "z": None}.get(match[1], "omega")
    if "angular" not in words and (
            match := re.search(r"\b(?:vel|velocity|speed|rate|v) (x|y|theta|yaw|heading|psi)$", text)):
        return {"x": "v", "y": None}.get(match[1], "omega")
    if match := re.fullmatch(r"(?:\w+ )?(x|y|theta|yaw|heading) (?:pos|position)", text):
        return match[1] if match[1] in "xy" else "yaw"
    if re.search(r"(orientation|quat\w*|rotation|^q) [wxyz]$", text):
        return f"q{last}"
    if last in "xyz" and re.search(r"angular|gyro|rate|^w |omega", text):
        return "omega" if last == "z" else None
    if last in "xyz" and re.search(r"linear|vel|speed|twist", text):
        return "v" if last == "x" else None
    joined = "".join(words)
    for quantity, known in QUANTITY_WORDS.items():
        if last in known or joined in known or any(joined.endswith(one) for one in known if len(one) > 4):
            rate = quantity in ("yaw", "v") and re.search(r"yaw ?rate|yaw (vel|speed|rate)|ang", text)
            return "omega" if rate else quantity
    for quantity, known in QUANTITY_WORDS.items():
        if set(words) & {one for one in known if len(one) > 1}:
            return quantity
    if last in ("vel", "rate") and "yaw" in words:
        return "omega"
    return None


def _stream(words: list[str], file: list[str], quantity: str, table: Table) -> tuple[str | None, bool]:
    """Stream of a quantity, and whether its name or its file's says so."""
    wheel = quantity in QUANTITIES["wheels"]
    for place in (words, file):
        for stream, known in STREAM_WORDS.items():
            if set(place) & set(known):
                if wheel:
                    return ("command" if stream == "command" and not quantity.endswith("angle") else "wheels"), True
                return stream, True
        text = " ".join(place)
        if "twist twist" in text or "pose pose" in text:
            return "odometry", True
        if "cmd" in "".join(place):
            return "command", True
    if wheel:
        return "wheels", True
    if quantity in ("qx", "qy", "qz", "qw") or quantity in ("x", "y", "yaw") and {"pose", "position"} & set(words):
        return "ground_truth", False
    if {"observation", "observed", "obs"} & set(words):
        return "odometry", True
    if {"linear", "angular"} & set(words):
        return "command", False  # a Twist by itself
    return "odometry", any(_stream_said(name, "command") for name in table.columns)


def _stream_said(name: str, stream: str) -> bool:
    return bool(set(_words(_split_unit(name)[0])) & set(STREAM_WORDS[stream]))


def _words(name: str) -> list[str]:
    name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", name)
    return [word for word in re.split(r"[^a-z0-9]+", name.lower()) if word and word not in ("field", "data", "msg")]


def _split_unit(name: str) -> tuple[str, str]:
    """Name without its unit, and the unit; empty where none is written."""
    if match := re.search(r"[\[(<]\s*([^\])>]*)\s*[\])>]\s*$", name):
        return name[: match.start()], _unit(match[1])
    rest, gap, last = re.match(r"(.*?)([_ .]?)([^_ .]*)$", name, re.DOTALL).groups()  # type: ignore[union-attr]
    if gap and last.lower() in STREAM_LAST and (split := _split_unit(rest))[1]:  # left_rpm_cmd
        return f"{split[0]}{gap}{last}", split[1]
    if match := re.search(r"[_ .]((?:k?m|mm|cm|rad|deg)[_ ]?(?:p|per|/)[_ ]?(?:s|h|sec)|kmh|kph|mps|mmps|rpm|degrees|"
                          r"radians|degs|dps|rads|deg|rad|mm|cm|ms|us|ns|msec|usec|nanos|millis|secs|sec|seconds)$",
                          name, re.IGNORECASE):
        unit = re.sub(r"[_ ]?(p|per|/)[_ ]?", "/", match[1].lower()) if re.search(r"p|/", match[1].lower()) and \
            match[1].lower() not in SPELLED and match[1].lower() != "rpm" else match[1]
        return name[: match.start()], _unit(unit.replace("/sec", "/s"))
    return name, ""


def _unit(text: str) -> str:
    text = re.sub(r"/ ?sec(onds?)?$", "/s", text.strip().lower().replace("²", "2"))
    return SPELLED.get(text, text)


def unit_named(text: str) -> bool:
    """Whether a text is the name of a unit."""
    return any(_unit(text.strip("[]()")) in units for units in UNITS.values())


def with_unit(name: str, unit: str) -> str:
    """The name of a column with a unit that stands below it; its own unit counts where it has one."""
    return f"{name} [{unit.strip('[]()')}]" if unit and not _split_unit(name)[1] else name


def _time_unit(column: Column, values: np.ndarray) -> Column:
    if column.unit in UNITS["time"] and not (column.unit == "s" and np.nanmedian(np.abs(values)) > 1e11):
        return column
    known = values[np.isfinite(values)]
    steps = np.diff(np.unique(known))
    step = float(np.median(steps)) if len(steps) else 1.0
    first = float(np.abs(known[0])) if len(known) else 0.0
    for unit, least in (("ns", 1e17), ("us", 1e14), ("ms", 1e11)):  # since 1970
        if first > least:
            return replace(column, unit=unit, why="it counts since 1970")
    if step < DAY_STEP and any(low < first < high for low, high in SERIAL_DAYS):
        return replace(column, unit="d", why="it counts days")
    for unit, longest in (("s", 4.0), ("ms", 4e3), ("us", 4e6)):
        if step < longest:
            return replace(column, unit=unit, why=f"it steps by {step:.3g}", sure=column.sure and step > FASTEST_STEP)
    return replace(column, unit="ns", why=f"it steps by {step:.3g}")


def _units_by_numbers(found: list[Column], arrays: Mapping[tuple[str, str], np.ndarray]) -> list[Column]:
    """Columns with the units that their numbers agree with, in the order in which one shows the next."""
    drive = _Known({one.role: one for one in found if one.role != "time"},
                   {one.file: one for one in found if one.role == "time"}, arrays)  # fmt: skip
    streams = ("ground_truth", "odometry")
    for stream in streams:
        drive.settle_pose(stream)
    ways = {stream: _way(drive.signal(f"{stream}.x"), drive.signal(f"{stream}.y")) for stream in streams}
    turns = {stream: _rate(*heading) if (heading := drive.heading(stream)) else None for stream in streams}
    drive.settle("odometry.v", _first(ways["odometry"], ways["ground_truth"]), "as the pose moves")
    drive.settle("odometry.omega", _first(turns["odometry"], turns["ground_truth"]), "as the pose turns")
    for role, rates, why in (("v", ways, "as the vehicle moves"), ("omega", turns, "as the vehicle turns")):
        measured = _first(drive.signal(f"odometry.{role}"), rates["odometry"], rates["ground_truth"])
        drive.settle(f"command.{role}", measured, why, 0.5)
    drive.settle_wheels(_first(drive.signal("command.v"), drive.signal("odometry.v"), *ways.values(),
                               drive.raw("command.v")))
    return [one if one.role == "time" else _with_some_unit(drive.columns[one.role], arrays[one.file, one.name])
            for one in found]


def _with_some_unit(one: Column, values: np.ndarray) -> Column:
    """The column, in SI where nothing shows its unit, if that is at all possible."""
    wheel = one.role.rpartition(".")[2] in ("left", "right")
    if _is_known(one.role, one.unit):
        return one
    usual = float(np.nanpercentile(np.abs(values), 95)) if np.isfinite(values).any() else 0.0
    largest = 40.0 if wheel else {"speed": 4.0, "rate": 4.0}.get(kind_of(one.role), np.inf)
    return replace(one, unit=next(iter(UNITS[kind_of(one.role)])), why=f"{one.why}; SI assumed",
                   sure=one.sure and usual < largest, assumed=True, moves=usual > 0.05)


@dataclass
class _Known:
    """What is known of the columns of a drive while their units are found."""

    columns: dict[str, Column]  # by role
    clocks: dict[str, Column]  # by file
    arrays: Mapping[tuple[str, str], np.ndarray]

    def signal(self, role: str, unit: str = "") -> tuple[np.ndarray, np.ndarray] | None:
        """Times [s] and values of a role in SI units; None where there are few, or its unit is not known."""
        one = self.columns.get(role)
        clock = self.clocks.get(one.file) if one is not None else None
        if one is None or clock is None or (unit or one.unit) not in UNITS[kind_of(role)]:
            return None
        t = self.arrays[clock.file, clock.name] * size_of("time", clock.unit)
        values = self.arrays[one.file, one.name] * (one.sign * UNITS[kind_of(role)][unit or one.unit])
        good = np.isfinite(t) & np.isfinite(values)
        return (t[good], values[good]) if good.sum() > 20 else None

    def raw(self, role: str) -> tuple[np.ndarray, np.ndarray] | None:
        """The same as if it were in SI units already."""
        return self.signal(role, next(iter(UNITS[kind_of(role)])))

    def settle(self, role: str, reference: tuple[np.ndarray, np.ndarray] | None, why: str, loose: float = ALIKE
               ) -> None:  # fmt: skip
        """Find the unit in which a signal is as large as a reference."""
        one, mine = self.columns.get(role), self.raw(role)
        if one is None or one.unit in UNITS[kind_of(role)] or mine is None:
            return
        unit = _size_of(mine, reference, UNITS[kind_of(role)], loose)
        if unit is not None:
            self.columns[role] = replace(one, unit=unit, why=f"{one.why}; {why}")

    def settle_wheels(self, reference: tuple[np.ndarray, np.ndarray] | None) -> None:
        """Find whether wheel speeds are those of their rims: no wheel has a radius of a metre, or of a millimetre."""
        for stream in ("wheels", "command"):
            sides = [self.raw(f"{stream}.{side}") for side in ("left", "right")]
            if sides[0] is None or sides[1] is None or len(sides[0][0]) != len(sides[1][0]):
                continue
            mean = sides[0][0], (sides[0][1] + sides[1][1]) / 2
            unit = _size_of(mean, reference, {one: UNITS["speed"][one] for one in ("m/s", "mm/s")}, ALIKE)
            for side in ("left", "right") if unit is not None else ():
                one = self.columns[f"{stream}.{side}"]
                if not _is_known(one.role, one.unit):
                    self.columns[one.role] = replace(one, unit=str(unit), why=f"{one.why}; as the vehicle moves")

    def settle_pose(self, stream: str) -> None:
        """Find the units of a pose: of its heading by the range, of its place by how fast it moves."""
        role = f"{stream}.yaw"
        if (one := self.columns.get(role)) and one.unit not in UNITS["angle"] and (mine := self.raw(role)):
            degrees = bool(np.ptp(mine[1]) > 30)
            self.columns[role] = replace(one, unit="deg" if degrees else "rad", why=f"{one.why}; its range",
                                         assumed=not degrees, moves=bool(np.ptp(mine[1]) > TURNED))
        axes = [self.raw(f"{stream}.{axis}") for axis in ("x", "y")]
        rate = max((float(np.percentile(np.abs(_rate(*one)[1]), 90)) for one in axes if one is not None), default=0.0)
        for role in (f"{stream}.x", f"{stream}.y"):
            if (one := self.columns.get(role)) and one.unit not in UNITS["length"] and self.raw(role):
                self.columns[role] = replace(one, unit="mm" if rate > TOO_FAST else "m", why=f"{one.why}; its rate",
                                             assumed=rate <= TOO_FAST, moves=rate >= TOO_SLOW)
        for role in (f"{stream}.{one}" for one in ("qx", "qy", "qz", "qw")):
            if one := self.columns.get(role):
                self.columns[role] = replace(one, unit="-")

    def heading(self, stream: str) -> tuple[np.ndarray, np.ndarray] | None:
        """Times [s] and heading [rad] of a pose, without jumps."""
        parts = {one: part for one in ("qw", "qx", "qy", "qz") if (part := self.signal(f"{stream}.{one}"))}
        if {"qw", "qz"} <= set(parts) and len({len(part[0]) for part in parts.values()}) == 1:
            t, w = parts["qw"]
            x, y, z = (parts[one][1] if one in parts else np.zeros(len(t)) for one in ("qx", "qy", "qz"))
            return t, np.unwrap(np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z))
        yaw = self.signal(f"{stream}.yaw")
        return (yaw[0], np.unwrap(yaw[1])) if yaw else None


def _first(*signals: tuple[np.ndarray, np.ndarray] | None) -> tuple[np.ndarray, np.ndarray] | None:
    return next((one for one in signals if one is not None), None)


def _size_of(
    mine: tuple[np.ndarray, np.ndarray], reference: tuple[np.ndarray, np.ndarray] | None, units: Mapping[str, float],
    loose: float,
) -> str | None:
    """The unit in which a signal is as large as a reference; None where they are not alike or no unit fits."""
    if reference is None:
        return None
    t = _grid(mine[0], max(mine[0][0], reference[0][0]), min(mine[0][-1], reference[0][-1]))
    if len(t) < 40:
        return None
    ours, theirs = (np.abs(np.interp(t, *one)) for one in (mine, reference))
    if max(ours.max(), theirs.max()) < 1e-6 or ours.max() < 1e-9 or theirs.max() < 1e-3:
        return None
    ratio = float(np.percentile(theirs, 90) / max(np.percentile(ours, 90), 1e-12))
    apart: dict[str, float] = {}  # ft/s, for example, is too near to km/h for numbers to separate them
    for one, size in units.items():
        if all(abs(np.log(size / other)) > np.log(1 + ALIKE) for other in apart.values()):
            apart[one] = size
    if ratio <= 0:
        return None
    unit = min(apart, key=lambda one: abs(np.log(ratio / apart[one])))
    return unit if abs(np.log(ratio / apart[unit])) < np.log(1 + loose) + 0.05 else None


def _rate(t: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rate of a signal (T,) over 0.2 s, at 20 Hz."""
    grid = _grid(t, t[0] + 0.1, t[-1] - 0.1)
    if len(grid) < 2:
        return t[:1], np.zeros(1)
    return grid, (np.interp(grid + 0.1, t, values) - np.interp(grid - 0.1, t, values)) / 0.2


def _grid(t: np.ndarray, begin: float, end: float) -> np.ndarray:
    """Times at 20 Hz from `begin` to `end`, but for gaps of more than GAP in the samples' times (T,)."""
    inside = np.unique(np.concatenate([[begin], t[(t > begin) & (t < end)], [end]])) if end > begin else np.zeros(0)
    pieces = [np.arange(one[0], one[-1], 0.05) for one in np.split(inside, np.flatnonzero(np.diff(inside) > GAP) + 1)
              if len(one)]  # fmt: skip
    return np.concatenate([*pieces, np.zeros(0)])


def _way(x: tuple[np.ndarray, np.ndarray] | None, y: tuple[np.ndarray, np.ndarray] | None
         ) -> tuple[np.ndarray, np.ndarray] | None:
    if x is None or y is None or len(x[0]) != len(y[0]):
        return None
    (t, vx), (_, vy) = _rate(*x), _rate(*y)
    return t, np.hypot(vx, vy)
