"""Robot files as MuJoCo can read them: xacro expanded, meshes found beside the file, missing ones replaced by boxes."""

from __future__ import annotations

import importlib.util
import math
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from sysid.replay import xacro_text
from sysid.replay.stated_drive import StatedDrive, stated_drive
from sysid.replay.urdf_links import compiler_of, complete_links
from sysid.replay.xacro_text import around, package_folders
from whill_mjx.io.fields import shown
from whill_mjx.io.reading import LONGEST_REASON, MB, decoded, read_bytes
from whill_mjx.vehicle.vehicle_file import ROBOT_FILES

MODEL_BYTES = 20 * MB
MESHES = (".stl", ".obj", ".msh")  # what MuJoCo reads
LONGEST = 60  # s that a xacro file may take, processor time or not
BOX = 0.1  # m, of a mesh whose body says nothing of its size
NUMBERS = frozenset((
    "xyz", "rpy", "ixx", "ixy", "ixz", "iyy", "iyz", "izz", "radius", "length", "scale",
    "pos", "quat", "axisangle", "xyaxes", "zaxis", "euler", "fromto", "axis", "diaginertia", "fullinertia", "density",
    "size", "mass", "damping", "friction", "armature", "stiffness", "frictionloss", "gear", "kp", "kv", "gainprm",
    "biasprm", "gravity", "timestep"))  # fmt: skip
"""Attributes of a URDF's links and joints, and of MJCF, that are finite numbers; and the `value` of a URDF's mass."""
OTHER = "Robots are read from URDF (<robot>), xacro and MJCF (<mujoco>); export it as one of them."
XACRO = "pip install xacro"


mujoco.set_mju_user_warning(lambda text: None)
"""What is wrong in a model is raised; MuJoCo's own handler writes MUJOCO_LOG.TXT where the command was called."""


@dataclass(frozen=True)
class RobotFile:
    spec: Any  # the editable mujoco.MjSpec
    notes: list[str]  # on what was replaced or left out
    friction: dict[str, float] | None = None
    """Of links, as a URDF states it for Gazebo; None for MJCF, which has its own."""
    drive: StatedDrive = StatedDrive()  # joints that it says are driven
    included: tuple[Path, ...] = ()

    @property
    def parts(self) -> list[Path]:
        """Files that are part of the robot besides its own: included ones, meshes and height fields, each once."""
        folder = Path(self.spec.modelfiledir or "") / (self.spec.meshdir or "")
        solid = [folder / one.file for one in (*self.spec.meshes, *self.spec.hfields) if one.file]
        return sorted({one.resolve() for one in (*self.included, *solid) if one.is_file()})


def read_robot(path: Path, wheels: Sequence[str] = (), wheel_radius: float | None = None) -> RobotFile:
    """The editable model of an MJCF, URDF or xacro file; FileNotFoundError or ValueError where it is none."""
    text = decoded(path, read_bytes(path, MODEL_BYTES, "no such model. Give an MJCF, URDF or xacro file."))
    xacro = path.suffix == ".xacro" or "<xacro:" in re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    text, left_out, included = expand_xacro(path) if xacro else (text, [], [])
    try:
        top = ElementTree.fromstring(text)
    except ElementTree.ParseError:
        if path.suffix not in ROBOT_FILES:
            raise ValueError(f"{path}: {OTHER}") from None
        return RobotFile(mujoco.MjSpec.from_file(str(path)), [])  # MuJoCo says where the mistake is
    if top.tag not in ("robot", "mujoco"):
        raise ValueError(f"{path}: it begins with <{top.tag[:40]}>. {OTHER}")
    for part in top if top.tag == "robot" else [top]:
        if part.tag in ("link", "joint", "mujoco"):
            _check_numbers(path, part)
    if top.tag != "robot":
        spec = mujoco.MjSpec.from_string(text) if xacro else mujoco.MjSpec.from_file(str(path))
        included += _included(path.parent, path, top)
        return RobotFile(spec, [*left_out, *_place_meshes(path, spec)], included=tuple(included))
    drive = stated_drive(top)
    notes = [*left_out, *complete_links(path, top),
             *_place_urdf_meshes(path, top, wheels, wheel_radius, drive)]
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(top, encoding="unicode"))
    return RobotFile(spec, notes, _frictions(top), drive, tuple(included))


def _check_numbers(path: Path, top: ElementTree.Element) -> None:
    """Raise ValueError where numbers of an element or of those in it are none or not finite; MuJoCo takes some for
    0."""
    waiting = [(top, top)]  # each with what has a name, of which it is a part
    while waiting:
        element, holder = waiting.pop()
        holder = element if element.get("name") else holder
        for name, text in element.items():
            is_number = element.tag != "flag" and name in NUMBERS or (element.tag, name) == ("mass", "value")
            if is_number and not all(map(_is_finite, text.split())):
                what = name if element is holder else f"{name} of {element.tag}"
                raise ValueError(f"{path}: {what} of {holder.tag} {holder.get('name', '')!r} is {shown(text)}; it must "
                                 "be made of finite numbers. Correct it.")
        waiting += [(one, holder) for one in element]


def _is_finite(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def _included(folder: Path, path: Path, top: ElementTree.Element) -> list[Path]:
    """Files that an MJCF file in a folder includes or attaches, and those that they include."""
    found: list[Path] = []
    waiting = [(path, top)]
    while waiting:
        path, top = waiting.pop()
        for element in (one for one in top.iter() if one.tag in ("include", "model") and one.get("file")):
            places = [place / element.get("file", "") for place in (path.parent, folder)]
            one = next((place for place in places if place.is_file() and place not in found), None)
            if one is None:
                continue
            found.append(one)
            try:
                root = ElementTree.parse(one).getroot()
            except ElementTree.ParseError:
                continue  # MuJoCo is less strict
            _check_numbers(one, root)
            waiting.append((one, root))
    return found


def _frictions(top: ElementTree.Element) -> dict[str, float]:
    """Coefficients along the first direction that a URDF states for Gazebo, by link."""
    found = {}
    for element in top.findall("gazebo"):
        stated = [one.get("value") or one.text or "" for one in element.iter() if one.tag in ("mu1", "mu")]
        try:
            found[element.get("reference", "")] = float(stated[0])
        except (IndexError, ValueError):
            continue
    return found


def expand_xacro(path: Path) -> tuple[str, list[str], list[Path]]:
    """Text of a xacro file with all macros expanded, by a process that may be stopped; notes on missing files, and the
    files that it includes."""
    if importlib.util.find_spec("xacro") is None:
        raise ValueError(f"{path}: xacro files need the package xacro. Install it: {XACRO}; or expand the file where "
                         "you have ROS: xacro FILE > robot.urdf.")
    try:
        done = subprocess.run(
            [sys.executable, xacro_text.__file__, str(path), str(xacro_text.SECONDS)], capture_output=True,
            timeout=LONGEST, env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        )  # fmt: skip
        said = done.stdout.decode("utf-8", errors="replace")
        if done.returncode == 0:
            lines = done.stderr.decode("utf-8", errors="replace").splitlines()
            missing, included = ([one.removeprefix(kind) for one in lines if one.startswith(kind)]
                                 for kind in (xacro_text.LEFT_OUT, xacro_text.INCLUDED))
            return said, [f"{path.name}: {one}" for one in missing], [Path(one) for one in included]
        limit = f"it takes more than {xacro_text.SECONDS} s of processor time"
        reason = said[:LONGEST_REASON] if done.returncode == 1 else limit
    except subprocess.TimeoutExpired:
        reason = f"it is not done after {LONGEST} s"
    raise ValueError(f"{path}: xacro cannot expand it: {reason}. Correct the file, or expand it where you have ROS: "
                     "xacro FILE ARGUMENT:=VALUE > robot.urdf.")


def find_mesh(folder: Path, name: str) -> Path | None:
    """The file beside a robot file's folder of a mesh that MuJoCo can read, or None.

    `name`: package://PACKAGE/PATH, model://..., file://PATH, an absolute or a relative path.
    """
    scheme, _, rest = name.partition("://") if "://" in name else ("", "", name)
    rest = rest.replace("\\", "/")
    places = [Path(rest), folder / rest] if scheme in ("", "file") else []
    if scheme in ("package", "model"):
        package, _, inside = rest.partition("/")
        places += [place / inside for place in (*package_folders(folder, package), *around(folder))]
    else:
        places += [place / rest.lstrip("/") for place in around(folder)]
    file = Path(rest).name
    places += [folder / file, *sorted((folder / "meshes").rglob(file)), *sorted((folder.parent / "meshes").rglob(file))]
    for place in places:  # a mesh for pictures often lies beside one that MuJoCo can read
        for one in (place, *(place.with_suffix(suffix) for suffix in MESHES)):
            if one.suffix.lower() in MESHES and one.is_file() and _is_readable(one):
                return one.resolve()
    return None


def _is_readable(path: Path) -> bool:
    """Whether MuJoCo can make a solid of a mesh: it does not know the text form of STL, for example."""
    spec = mujoco.MjSpec()
    spec.add_mesh(name="mesh", file=str(path.resolve()), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh")
    try:
        spec.compile()
    except (ValueError, mujoco.FatalError):
        return False
    return True


def _place_urdf_meshes(
    path: Path, top: ElementTree.Element, wheels: Sequence[str], wheel_radius: float | None, drive: StatedDrive,
) -> list[str]:  # fmt: skip
    """Give meshes their whole paths; those that are not found become boxes, and cylinders on wheels. The radius that a
    plugin states is that of the wheels which it drives."""
    notes: list[str] = []
    driven = {*drive.left, *drive.right, *drive.by_speed, *wheels}
    axles = {child.get("link"): joint for joint in top.iter("joint") if joint.get("type") == "continuous"
             and (child := joint.find("child")) is not None
             and (joint.get("name") in wheels or re.search("wheel", f"{joint.get('name')} {child.get('link')}", re.I))}
    for link in top.iter("link"):
        for kind in ("visual", "collision"):
            for element in link.findall(kind):
                geometry = element.find("geometry")
                mesh = None if geometry is None else geometry.find("mesh")
                if geometry is None or mesh is None:
                    continue
                name = mesh.get("filename", "")
                found = find_mesh(path.resolve().parent, name)
                if found is not None:
                    mesh.set("filename", str(found))
                elif kind == "visual":
                    link.remove(element)  # it does nothing
                else:
                    geometry.remove(mesh)
                    axle = axles.get(link.get("name"))
                    stated = drive.radius if axle is not None and axle.get("name") in driven else None
                    shape = _stand_in(link, element, geometry, axle, wheel_radius or stated)
                    notes.append(f"{path.name}: mesh {name} of link {link.get('name')} is not found, or MuJoCo cannot "
                                 f"read it; {shape} stands in for it")
    compiler_of(top).set("strippath", "false")
    return notes


def _stand_in(
    link: ElementTree.Element, element: ElementTree.Element, geometry: ElementTree.Element,
    axle: ElementTree.Element | None, wheel_radius: float | None,
) -> str:  # fmt: skip
    """Put a box of the link's inertia, or a wheel's cylinder, into a collision element; its name and size."""
    inertial = link.find("inertial")
    mass, inertia = 0.0, np.zeros(3)
    if inertial is not None:
        numbers, weight = inertial.find("inertia"), inertial.find("mass")
        mass = float(weight.get("value", 0)) if weight is not None else 0.0
        if numbers is not None:
            inertia = np.array([float(numbers.get(name, 0)) for name in ("ixx", "iyy", "izz")])
    for origin in element.findall("origin"):
        element.remove(origin)
    if axle is not None:
        direction = axle.find("axis")
        axis = np.array((direction.get("xyz", "1 0 0") if direction is not None else "1 0 0").split(), float)
        axis = axis / (np.linalg.norm(axis) or 1.0)
        about = float(axis**2 @ inertia)
        radius = wheel_radius or (math.sqrt(2 * about / mass) if mass > 0 and about > 0 else BOX / 2)
        pitch, yaw = math.atan2(math.hypot(axis[0], axis[1]), axis[2]), math.atan2(axis[1], axis[0])
        ElementTree.SubElement(element, "origin", xyz="0 0 0", rpy=f"0 {pitch!r} {yaw!r}")
        ElementTree.SubElement(geometry, "cylinder", radius=repr(float(radius)), length=repr(float(radius / 2)))
        return f"a cylinder of {radius:.3g} m radius"
    size = _box(mass, inertia)
    place = None if inertial is None else inertial.find("origin")
    if place is not None:
        ElementTree.SubElement(element, "origin", place.attrib)
    ElementTree.SubElement(geometry, "box", size=" ".join(repr(float(one)) for one in size))
    return f"a box of {' x '.join(f'{one:.3g}' for one in size)} m"


def _box(mass: float, inertia: np.ndarray) -> np.ndarray:
    """Sides (3,) of the even box with this mass and these moments of inertia (3,), at least a millimetre each."""
    if mass <= 0 or not (inertia > 0).any():
        return np.full(3, BOX)
    return np.sqrt(np.maximum(6 / mass * (inertia.sum() - 2 * inertia), 1e-6))


def _place_meshes(path: Path, spec: Any) -> list[str]:
    """Give meshes of an MJCF model their whole paths; those that are not found become boxes."""
    folder = Path(spec.modelfiledir or path.parent)
    notes: list[str] = []
    for mesh in list(spec.meshes):
        if not mesh.file:
            continue
        name, place = mesh.name or Path(mesh.file).stem, folder / (spec.meshdir or "") / mesh.file
        found = place if place.is_file() and _is_readable(place) else find_mesh(folder.resolve(), mesh.file)
        if found is not None:
            mesh.file = str(found.resolve())
            continue
        for geom in [one for one in spec.geoms if one.meshname == name]:
            if not geom.contype and not geom.conaffinity:
                spec.delete(geom)  # it does nothing
                continue
            body = geom.parent
            size = _box(float(body.mass), np.array(body.inertia)) if body.explicitinertial else np.full(3, BOX)
            geom.type, geom.size, geom.meshname = mujoco.mjtGeom.mjGEOM_BOX, size / 2, ""
            if body.explicitinertial:
                geom.pos = body.ipos
            notes.append(f"{path.name}: mesh {mesh.file} of body {body.name} is not found, or MuJoCo cannot "
                         f"read it; a box of {' x '.join(f'{one:.3g}' for one in size)} m stands in for it")
        spec.delete(mesh)
    return notes
