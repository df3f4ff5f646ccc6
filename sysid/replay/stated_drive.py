"""Which joints a robot file says are driven: by plugins of Gazebo, by ros2_control and by transmissions."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

STEERS = re.compile(r"ackermann|tricycle|steer", re.I)
SIDEWAYS = re.compile(r"mec[ac]num|planar_?move|planar-move|holonomic|omni_?drive", re.I)
ROLLERS = re.compile(r"mec[ac]num|omni|swedish", re.I)
"""Words in the names of wheels, their joints and meshes that let a robot drive sideways."""
DRIVES = re.compile(r"diff_?drive|diff-drive|skid_?steer|skid-steer|tracked|mec[ac]num", re.I)
PLACE = "(?:front|rear|back|middle|mid)?_?"
SIDE = re.compile(rf"{PLACE}(left|right)_?{PLACE}(?:wheel_?)?joint", re.I)
"""Tags of a plugin that name a driven joint: left_joint, leftJoint, leftFrontJoint, front_left_joint."""
SPEED = re.compile("VelocityJointInterface")


@dataclass(frozen=True)
class StatedDrive:
    """What a URDF says of its drive; empty for other files."""

    left: tuple[str, ...] = ()  # driven joints that a plugin names
    right: tuple[str, ...] = ()
    by_speed: tuple[str, ...] = ()  # joints that a controller drives by their speed
    steering: str = ""  # plugin that drives it as a car or a tricycle
    sideways: str = ""  # plugin that drives it sideways too
    rollers: tuple[str, ...] = ()  # links that are drawn as mecanum or omni wheels
    radius: float | None = None  # of the driven wheels, as a plugin takes it [m]
    track: float | None = None  # distance between the driven wheels, as a plugin takes it [m]


def stated_drive(top: ElementTree.Element) -> StatedDrive:
    """What the URDF says of its drive."""
    sides: dict[str, list[str]] = {"left": [], "right": []}
    steering = sideways = ""
    radius = track = None
    for plugin in top.iter("plugin"):
        name = f"{plugin.get('filename', '')} {plugin.get('name', '')}"
        if STEERS.search(re.sub(r"skid[_-]?steer", "", plugin.get("filename", ""), flags=re.I)):  # names are free
            steering = steering or _short(plugin)
            continue
        if SIDEWAYS.search(name):
            sideways = sideways or _short(plugin)
        if DRIVES.search(name):
            radius = radius or _size(plugin, "wheelradius") or _size(plugin, "wheeldiameter", 0.5)
            track = track or _size(plugin, "wheelseparation")
            for one in plugin.iter():
                if (found := SIDE.fullmatch(one.tag)) and (joint := (one.text or "").strip()):
                    sides[found[1].lower()].append(joint)
    rollers = [link.get("name", "") for link in top.iter("link")
               if any(ROLLERS.search(mesh.get("filename", "")) for mesh in link.iter("mesh"))]
    return StatedDrive(_once(sides["left"]), _once(sides["right"]), _once(_by_speed(top)), steering, sideways,
                       tuple(rollers), radius, track)


def _size(plugin: ElementTree.Element, name: str, factor: float = 1.0) -> float | None:
    """Positive number of a plugin's tag, whatever its case and underscores, times a factor; None without one."""
    for one in plugin.iter():
        try:
            value = float(one.text or "") if one.tag.replace("_", "").lower() == name else 0.0
        except ValueError:
            continue
        if 0 < value < float("inf"):
            return factor * value
    return None


def _by_speed(top: ElementTree.Element) -> Iterator[str]:
    for joint in top.iterfind("ros2_control/joint"):
        if any(one.get("name") == "velocity" for one in joint.findall("command_interface")):
            yield joint.get("name", "")
    for transmission in top.iterfind("transmission"):
        kinds = [one for owner in ("joint", "actuator") for one in transmission.iterfind(f"{owner}/hardwareInterface")]
        if kinds and SPEED.search(kinds[0].text or ""):
            yield from (joint.get("name", "") for joint in transmission.iterfind("joint"))


def _short(plugin: ElementTree.Element) -> str:
    return (plugin.get("filename") or plugin.get("name") or "").strip()


def _once(names: Iterable[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(names))
