"""What the name of a column says: stream, quantity and unit.

Names are those of ROS exports (`pose.pose.position.x`), of plotting programs (`/odom/twist/twist/linear/x`) and of
people (`cmd_v [km/h]`).
"""

from __future__ import annotations

import re

import numpy as np

from sysid.logs.tables.columns import QUANTITIES, SPELLED, TUM, UNITS, Column, Table, unit_of

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
    "yaw": ("yaw", "theta", "heading", "psi", "azimuth", "th", "phi", "kurs", "gier", "gierwinkel", "rz"),
    "qx": ("qx",), "qy": ("qy",), "qz": ("qz",), "qw": ("qw",),
    "omega": ("omega", "yawrate", "w", "wz", "angular", "ang", "turnrate", "rot", "gyro", "gyroz", "angularvel",
              "angvel", "turn", "drehrate", "gierrate"),
    "v": ("v", "vx", "speed", "velocity", "linear", "lin", "vel", "forward", "linvel", "linearvel", "throttle",
          "geschwindigkeit", "geschw"),
    "x": ("x", "px", "posx", "tx", "easting", "east"), "y": ("y", "py", "posy", "ty", "northing", "north"),
}
TURNS, RATES = {"turn", "rot", "ang"}, {"rate", "vel", "velocity", "speed", "dot"}
"""Words for a heading or its rate, and those that say a rate beside them."""
PLURALS = {"rads", "degs"}  # units of headings too, though of rates they are rad/s and deg/s
TICKS = re.compile(r"tick|count|enc(oder)?s?([ _]|$)", re.IGNORECASE)
"""In the names of wheel angles that an encoder counts."""
COUNTS = re.compile(r"frame|index|sample|row|seq", re.IGNORECASE)  # in the names of columns that count rows
SIDES = {"left": {"left", "l", "lw", "wl", "vl", "lft", "fl", "rl", "bl", "lf", "lb", "links", "linkes"},
         "right": {"right", "r", "rw", "wr", "vr", "rgt", "fr", "rr", "br", "rf", "rb", "rechts", "rechtes"}}
CORNERS = {"fl", "rl", "bl", "lf", "lb", "fr", "rr", "br", "rf", "rb"}
"""Names of wheels that may mean other things where they stand alone."""
TIME_WORDS = ("t", "time", "zeit", "timestamp", "stamp", "clock", "epoch", "unixtime", "rostime", "date", "datetime",
              "uhrzeit", "datum")
NOT_PLANAR = {"roll", "pitch", "z", "tz", "vy", "vz", "wx", "wy", "covariance", "accel", "acceleration", "acc", "mag",
              "seq", "current", "voltage", "temperature", "battery", "torque", "effort", "error", "std", "var", "cov"}


def by_name(table: Table, name: str) -> Column | None:
    """Role and unit of a column by its name and its file's."""
    plain, unit = split_unit(name)
    words = words_of(plain)
    joined = "".join(words)
    turns = re.search(r"((angular|gyro|rate|orientation|quat\w*|rotation)|^q\w{0,4})z$", joined)
    if unit_of(name) in UNITS["time"] and unit_of(name) not in ("s", "min"):  # a column that is named after its unit
        return Column("time", table.stem, name, unit_of(name), "its name")
    if not words or NOT_PLANAR & set(words[-2:]) and not turns:
        return None
    stamp_part = words[-1] in ("secs", "sec", "nsecs", "nsec", "nanosec")
    if (set(words) & set(TIME_WORDS) and not set(words[-1:]) & {"x", "y", "z", "w"} or stamp_part
            or words == ["rosbagtimestamp"]):
        if words[-1] in ("nsecs", "nsec", "nanosec") and "+" not in name and {"header", "stamp"} & set(words):
            return None  # the rest of a second; joined with secs when read
        last = unit_of(words[-1])
        return Column("time", table.stem, name, unit or (last if last in ("min", "h", "d") else ""), "its name")
    quantity = _quantity([word for word in words if word not in STREAM_LAST] or words)
    if quantity is None:
        return None
    if quantity == "yaw" and unit in UNITS["rate"] and not PLURALS & set(words_of(name)):
        quantity = "omega"
    stream, sure = _stream_named(words, words_of(table.stem), quantity, table)
    if quantity == "omega" and stream == "ground_truth" and may_be_heading(name, unit):  # it has no rates
        quantity = "yaw"
    if stream is None or quantity not in QUANTITIES[stream]:
        return None
    if quantity in ("left", "right", "left_angle", "right_angle") and not unit and TICKS.search(name) \
            and stream == "wheels" and _counts(table.columns[name]):
        return Column(f"wheels.{quantity.removesuffix('_angle')}_angle", table.stem, name, "", "its name", False)
    of_a_body = any(words_of(split_unit(one)[0]) == ["rx"] for one in table.columns)
    doubtful = words == ["rz"] and not of_a_body or len(words) == 1 and words[0] in CORNERS
    return Column(f"{stream}.{quantity}", table.stem, name, unit, "its name", sure and not doubtful)


def _counts(values: np.ndarray) -> bool:
    """Whether values (T,) are whole numbers, as an encoder's."""
    known = values[np.isfinite(values)]
    return bool((known == np.round(known)).all())


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


def _stream_named(words: list[str], file: list[str], quantity: str, table: Table) -> tuple[str | None, bool]:
    """Stream of a quantity, and whether its name or its file's says so."""
    wheel = quantity in QUANTITIES["wheels"]
    if len(words) == 1 and words[0] in TUM and set(TUM[1:]) <= set(table.columns):  # a trajectory is of one stream
        odometry = set(file) & set(STREAM_WORDS["odometry"]) and not set(file) & set(STREAM_WORDS["ground_truth"])
        return "odometry" if odometry else "ground_truth", True
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
    return "odometry", any(says_stream(name, "command") for name in table.columns)


def says_stream(name: str, stream: str) -> bool:
    return bool(set(words_of(split_unit(name)[0])) & set(STREAM_WORDS[stream]))


def says_any_stream(name: str) -> bool:
    """Whether a name by itself says of which stream it is."""
    text = " ".join(words_of(split_unit(name)[0]))
    return bool(set(text.split()) & STREAM_LAST) or "twist twist" in text or "pose pose" in text or "cmd" in text


def words_of(name: str) -> list[str]:
    name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", name)
    return [word for word in re.split(r"[^a-z0-9]+", name.lower()) if word and word not in ("field", "data", "msg")]


def split_unit(name: str) -> tuple[str, str]:
    """Name without its unit, and the unit; empty where none is written."""
    if match := re.search(r"[\[(<]\s*([^\])>]*)\s*[\])>]\s*$", name):
        return name[: match.start()], unit_of(match[1])
    rest, gap, last = re.match(r"(.*?)([_ .]?)([^_ .]*)$", name, re.DOTALL).groups()  # type: ignore[union-attr]
    if gap and last.lower() in STREAM_LAST and (split := split_unit(rest))[1]:  # left_rpm_cmd
        return f"{split[0]}{gap}{last}", split[1]
    if match := re.search(r"[_ .]((?:k?m|mm|cm|rad|deg)[_ ]?(?:p|per|/)[_ ]?(?:s|h|sec)|kmh|kph|mps|mmps|rpm|degrees|"
                          r"radians|degs|dps|rads|deg|rad|mm|cm|ms|us|ns|msec|usec|nanos|millis|secs|sec|seconds)$",
                          name, re.IGNORECASE):
        unit = re.sub(r"[_ ]?(p|per|/)[_ ]?", "/", match[1].lower()) if re.search(r"p|/", match[1].lower()) and \
            match[1].lower() not in SPELLED and match[1].lower() != "rpm" else match[1]
        return name[: match.start()], unit_of(unit.replace("/sec", "/s"))
    return name, ""


def may_be_heading(name: str, unit: str) -> bool:
    """Whether a yaw rate by its name is a heading by its unit, and not a rate as `yaw_rate_deg`, without the second."""
    words = set(words_of(name))
    return unit in UNITS["angle"] and bool(words & TURNS) and not words & RATES


def with_unit(name: str, unit: str) -> str:
    """The name of a column with a unit that stands below it; its own unit counts where it has one."""
    return f"{name} [{unit.strip('[]()')}]" if unit and not split_unit(name)[1] else name
