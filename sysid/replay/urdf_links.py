"""Links of a URDF as simulators take them: with a shape that touches, and a possible mass and inertia."""

from __future__ import annotations

import copy
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

CASTER = re.compile(r"cast[eo]r|\bball|_ball|skid|glider|support_?wheel", re.I)
"""Words in the names of links on which a robot stands beside its driven wheels."""
LEAST = 1e-8  # kg, kg m^2, below which MuJoCo takes nothing for a moving part
SOLID = 0.4  # of a ball's inertia over its mass and the square of its radius
USUAL = 0.05  # m, half of the size of a link whose shape has none
ENDS = 1e-6  # of the largest moment of inertia, within which rounding lies


def complete_links(path: Path, top: ElementTree.Element) -> list[str]:
    """Give links what simulators ask for and authors leave out; a note for each change.

    Where no link has a shape that touches, and on wheels and casters without one, the visible shape does. A mass of
    zero is left out, so that the shape gives it. Impossible moments of inertia become those of a ball, or are balanced.
    """
    _check_tree(path, top)
    notes = [*_held_parts(path, top), *_couplings(path, top)]
    turning = {child.get("link") for joint in top.iter("joint") if joint.get("type") == "continuous"
               and (child := joint.find("child")) is not None}
    bare = top.find("link/collision") is None
    for link in top.iter("link"):
        name, seen = link.get("name", ""), link.findall("visual")
        if seen and link.find("collision") is None and (bare or name in turning or CASTER.search(name)):
            for visual in seen:
                shape = copy.deepcopy(visual)
                shape.tag = "collision"
                link.append(shape)
            notes.append(f"{path.name}: link {name} has no collision shape: its visible one touches instead")
        notes += [f"{path.name}: {one}" for one in _inertial(link, name)]
    compiler_of(top).set("balanceinertia", "true")
    return notes


def _check_tree(path: Path, top: ElementTree.Element) -> None:
    """Raise ValueError where links and joints have one name twice, or a joint hangs on a link that is not there."""
    for kind in ("link", "joint"):
        names = [one.get("name", "") for one in top.iterfind(kind)]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"{path}: {kind} {twice[0]!r} is there twice. Give one of them another name.")
    links = {one.get("name") for one in top.iterfind("link")}
    for joint in top.iterfind("joint"):
        for end in ("parent", "child"):
            found = joint.find(end)
            name = None if found is None else found.get("link")
            if name not in links:
                raise ValueError(f"{path}: {end} of joint {joint.get('name')!r} is link {name!r}, which the file lacks."
                                 " Correct the name, or add the link.")


def _held_parts(path: Path, top: ElementTree.Element) -> list[str]:
    """Hold parts on joints that move in a plane or freely, which a robot's own parts cannot, a note for each; what
    moves the whole robot so is the free joint that it gets."""
    loose = [joint for joint in top.iter("joint") if joint.get("type") in ("planar", "floating")]
    children = {child.get("link") for joint in top.iter("joint") if (child := joint.find("child")) is not None}
    notes = []
    for joint in loose:
        above = joint.find("parent")
        parent = "" if above is None else above.get("link", "")
        if parent in children or top.find(f"link[@name='{parent}']/inertial") is not None:
            notes.append(f"{path.name}: joint {joint.get('name')} is {joint.get('type')}: its part is held at 0")
        joint.set("type", "fixed")
    return notes


def _couplings(path: Path, top: ElementTree.Element) -> list[str]:
    """Leave out mimic joints that are held, follow one that is held, or follow none; a note for those without one."""
    turning = {joint.get("name") for joint in top.iter("joint") if joint.get("type") == "continuous"}
    known = {joint.get("name") for joint in top.iterfind("joint")}
    notes = []
    for joint in top.iterfind("joint"):
        for mimic in joint.findall("mimic"):
            if joint.get("name") in turning and mimic.get("joint") in turning:
                continue
            joint.remove(mimic)
            if mimic.get("joint") not in known:
                notes.append(f"{path.name}: joint {joint.get('name')} mimics {mimic.get('joint')}, which the file "
                             "lacks: it moves by itself")
    return notes


def compiler_of(top: ElementTree.Element) -> ElementTree.Element:
    """MuJoCo's options of a URDF, made where the file has none."""
    options = top.find("mujoco")
    options = ElementTree.SubElement(top, "mujoco") if options is None else options
    compiler = options.find("compiler")
    compiler = ElementTree.SubElement(options, "compiler") if compiler is None else compiler
    return compiler


def _inertial(link: ElementTree.Element, name: str) -> list[str]:
    """Mend the mass and the inertia of a link; sentences on what was changed."""
    inertial = link.find("inertial")
    if inertial is None:
        return [] if link.find("collision") is None else [
            f"link {name} has no inertial: its shape at the density of water gives its mass"]
    weight, numbers = inertial.find("mass"), inertial.find("inertia")
    mass = 0.0 if weight is None else _number(weight, "value")
    if mass < LEAST:
        if link.find("collision") is None and link.find("visual") is None:
            return []
        link.remove(inertial)
        return [f"link {name} has a mass of {mass:g}: its shape at the density of water gives it"]
    if numbers is None:
        return []
    xx, xy, xz, yy, yz, zz = (_number(numbers, one) for one in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"))
    moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if moments[0] < LEAST * LEAST:
        ball = SOLID * mass * _reach(link) ** 2
        for one, value in (("ixx", ball), ("iyy", ball), ("izz", ball), ("ixy", 0.0), ("ixz", 0.0), ("iyz", 0.0)):
            numbers.set(one, repr(value))
        return [f"link {name} has a moment of inertia of 0 or less: that of a ball of its size stands in"]
    if moments[0] + moments[1] < (1 - ENDS) * moments[2]:
        return [f"link {name} has moments of inertia that no body has ({', '.join(f'{one:.3g}' for one in moments)} "
                "kg m^2; two together are at least the third): their mean stands in"]
    return []


def _reach(link: ElementTree.Element) -> float:
    """Half of the largest size of a link's shapes [m]."""
    sizes = []
    for shape in link.iter("geometry"):
        for one in shape:
            stated = [float(part) for part in one.get("size", "").split()]
            sizes += [max(stated) / 2] if stated else []
            sizes += [_number(one, "radius"), _number(one, "length") / 2]
    return max(sizes, default=0.0) or USUAL


def _number(element: ElementTree.Element, name: str) -> float:
    return float(element.get(name, "").strip() or 0.0)
