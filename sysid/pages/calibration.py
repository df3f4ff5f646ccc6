"""What a fit found of a vehicle's sizes and of the point that an outside pose follows, in sentences."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from sysid.intervals.uncertainty import Estimate
from sysid.logs.records import Trial
from whill_mjx.vehicle.specs import VehicleSpec

LEAST = 5e-4  # share of a size, or of a scale, that counts as nothing
SIZES = {
    "wheel radius": ("wheel_radius_difference.common", "wheels.radius"),
    "track": ("track_width.error", "wheels.track"),
}
UNKNOWN = ("Without an outside pose this log does not separate errors of wheel radius, track and odometry's scale "
           "from one another: they are taken as stated, and the odometry's path has their error.")


def calibration_notes(
    estimates: Sequence[Estimate], spec: VehicleSpec, trials: Sequence[Trial], kept: Sequence[str] = ()
) -> list[str]:
    """Sentences on radius, track, the odometry's scales and the tracked point; those that a log leaves open are
    named.

    `kept`: groups that keep their stated values (`sysid.search.stated`).
    """
    notes = _notes(estimates, spec, trials)
    if kept:
        notes.append(f"Stated values are kept for {', '.join(kept)}: free ones did not predict held-back drives "
                     "better.")
    return notes


def _notes(estimates: Sequence[Estimate], spec: VehicleSpec, trials: Sequence[Trial]) -> list[str]:
    found = {one.name: one for one in estimates}
    if not any(trial.ground_truth is not None for trial in trials):
        return [UNKNOWN]
    if not any(name in found for names in SIZES.values() for name in names) and "pose_mount.x" not in found:
        return []
    stated = {"wheel radius": spec.wheel_radius, "track": spec.track}
    notes, open_ones = [], []
    for what, names in SIZES.items():
        one = next((found[name] for name in names if name in found), None)
        if one is None:
            continue
        if not one.identifiable:
            open_ones.append(what)
            continue
        relative = one.name == names[0]  # otherwise in metres
        value, low, high = (1 + x if relative else x / stated[what] for x in (one.value, one.low, one.high))
        notes.append(_size(what, stated[what], value, low, high))
    for what, name in (("distance", "odometry_scale.linear"), ("yaw", "odometry_scale.angular")):
        one = found.get(name)
        if one is not None and one.identifiable and abs(one.value - 1) > LEAST and not one.low <= 1 <= one.high:
            notes.append(f"The odometry reports {one.value:.4f} times the {what} of wheels of the stated sizes "
                         f"({one.low:.4f} to {one.high:.4f}): it takes other sizes than the controller.")
    if "pose_mount.x" in found:
        x, y, yaw = (found[f"pose_mount.{axis}"] for axis in ("x", "y", "yaw"))
        at_zero = [one for one in (x, y, yaw) if one.identifiable and one.low <= 0 <= one.high]
        if len(at_zero) == 3:
            near = 1000 * max(-x.low, x.high, -y.low, y.high)
            angle = math.degrees(max(-yaw.low, yaw.high))
            return [*notes, f"The outside pose follows the reference point, within {near:.1f} mm and {angle:.2f} "
                            "degrees."]
        sides = [_offset(one, names) for one, names in ((x, ("ahead of", "behind")), (y, ("left of", "right of")))
                 if one.identifiable]
        if sides:
            notes.append(f"The tracked point lies {' and '.join(sides)} the reference point.")
        if yaw.identifiable:
            notes.append(f"Its heading is turned by {abs(math.degrees(yaw.value)):.2f} degrees to the "
                         f"{'left' if yaw.value >= 0 else 'right'} of the vehicle's "
                         f"({_range(yaw, 2, math.degrees)} degrees).")
        open_ones += [f"the tracked point's {axis}" for axis, one in (("x", x), ("y", y), ("heading", yaw))
                      if not one.identifiable]
    if open_ones:
        notes.append(f"This log does not determine {', '.join(open_ones)}: drive turns on the spot and straight lines.")
    return notes


def _size(what: str, stated: float, value: float, low: float, high: float) -> str:
    interval = f"{stated * low:.4g} to {stated * high:.4g} m"
    if abs(value - 1) < LEAST or low <= 1 <= high:
        return f"The {what} is as stated, {stated:.4g} m ({interval})."
    side = "larger" if value > 1 else "smaller"
    return (f"The {what} is {stated * value:.4g} m ({interval}), {abs(value - 1):.1%} {side} than the stated "
            f"{stated:.4g} m.")


def _offset(one: Estimate, sides: tuple[str, str]) -> str:
    return f"{abs(one.value):.4f} m {sides[0] if one.value >= 0 else sides[1]} ({_range(one, 4)})"


def _range(one: Estimate, digits: int, unit: Callable[[float], float] = float) -> str:
    return f"{unit(one.low):.{digits}f} to {unit(one.high):.{digits}f}"
