"""What `policy.json` says of each sensor of a policy that reads more than one camera image."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from bridge.policy.fields import Fields, is_number, is_within

SHAPES = {
    "camera": "[H, W, 3]", "lidar": "[rays]", "odometry": "[5]", "imu": "[6]", "goal": "[2]", "commands": "[2 n]",
}  # fmt: skip
"""Kinds of sensors that a vehicle has and the bridge reads, with the shape of what they give."""
PACERS = ("camera", "lidar", "odometry", "imu", "goal")
"""Kinds that can pace a policy, the first one that it has."""
CAMERA_FRAMES = ("base_footprint", "chassis")
"""Frames of the camera: `chassis` in files that name none."""
CAMERA_RULES = {"x": (10.0, "m"), "y": (10.0, "m"), "z": (10.0, "m"), "roll": (math.pi, "rad"),
                "pitch": (math.pi / 2, "rad"), "yaw": (math.pi, "rad"), "fov_y": (math.pi, "rad")}
"""Largest size of each number of the camera, and its unit."""
FARTHEST = 1000.0
"""Largest reach of a scanner that is believed [m]."""


@dataclass(frozen=True)
class SensorInput:
    """One observation of a policy: which sensor gives it, and how that one was in the training."""

    name: str
    """Of the network's input."""
    kind: str
    """One of SHAPES; another one is measured by no vehicle that the bridge knows."""
    shape: tuple[int, ...]
    """Of one reading."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Of the training's sensor: of a lidar its `fov` [rad] and `reach` [m], a full turn and 10 m unless given; of any
    sensor `rate_hz` [1/s] and `latency_s`, where it had its own."""
    camera: Mapping[str, Any] = field(default_factory=dict)
    """Pose and field of view, of a camera."""

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns of a camera's image [pixels]."""
        return self.shape[0], self.shape[1]

    @property
    def age(self) -> float:
        """Seconds by which its values were old in the training at most, besides the policy's own period."""
        rate = self.settings.get("rate_hz")
        return float(self.settings.get("latency_s") or 0.0) + (1 / float(rate) if rate else 0.0)


def pacer_of(sensors: Mapping[str, SensorInput]) -> SensorInput | None:
    """Return the sensor whose messages make a policy step; None where it has none that could."""
    ranked = sorted(sensors.values(), key=lambda one: (PACERS.index(one.kind) if one.kind in PACERS else 99, one.name))
    return ranked[0] if ranked and ranked[0].kind in PACERS else None


def parse_sensors(fields: Fields, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, SensorInput]:
    """Return the sensors of an agent's observations; empty where its file, an older one, does not name them.

    Raises:
        PolicyFileError: a field breaks its rule.
    """
    if "sensors" not in fields.table:
        return {}
    names = sorted(shapes)
    table = fields.rule("sensors", lambda value: isinstance(value, Mapping) and sorted(value) == names,
                        f"must have an entry for each of {names}")
    return {name: _parse(Fields(f"{fields.name} sensors {name}", table[name]), name, shapes[name]) for name in names}


def _parse(entry: Fields, name: str, shape: tuple[int, ...]) -> SensorInput:
    kind = entry.rule("kind", lambda value: isinstance(value, str) and len(value) <= 200, "must be text")
    if kind in SHAPES and not _fits(kind, shape):
        entry.rule("kind", lambda _: False, f"must suit an observation of shape {list(shape)}; {kind} gives "
                   f"{SHAPES[kind]}")
    settings = entry.child("settings") if "settings" in entry.table else Fields(entry.name, {})
    for key, least, most in (("rate_hz", 0.01, 1e6), ("latency_s", 0.0, 100.0)):
        if settings.table.get(key) is not None:
            settings.rule(key, _within(least, most), f"must be from {least:g} to {most:g}, or null")
    if kind == "lidar":
        for key, most, unit in (("fov", 2 * math.pi + 1e-6, "rad"), ("reach", FARTHEST, "m")):
            if key in settings.table:
                settings.rule(key, _within(1e-3, most), f"must be above 0 and at most {most:g} [{unit}]")
    camera = parse_camera(entry.child("camera")) if kind == "camera" and "camera" in entry.table else {}
    return SensorInput(name, kind, shape, settings.table, camera)


def parse_camera(camera: Fields) -> dict[str, Any]:
    """Return the camera with its frame; fields of other names are free."""
    frame = "chassis" if "frame" not in camera.table else camera.rule(
        "frame", lambda value: value in CAMERA_FRAMES, f"must be one of {list(CAMERA_FRAMES)}")
    for key, (limit, unit) in CAMERA_RULES.items():
        if key in camera.table:
            camera.rule(key, is_within(limit), f"must be a number from {-limit:g} to {limit:g} [{unit}]")
    if "fov_y" in camera.table:
        camera.rule("fov_y", lambda value: value > 0, "must be above 0 rad: it is an angle of view")
    return {**camera.table, "frame": frame}


def _fits(kind: str, shape: tuple[int, ...]) -> bool:
    if kind == "camera":
        return len(shape) == 3 and shape[2] == 3
    if len(shape) != 1:
        return False
    size = {"odometry": 5, "imu": 6, "goal": 2}.get(kind, shape[0])
    return shape[0] == size and (kind != "commands" or size % 2 == 0)


def _within(low: float, high: float) -> Any:
    return lambda value: is_number(value) and low <= value <= high
