"""Foreign corridors for MuJoCo's renderer: plain, furnished and unseen; with what the chair must not touch.

The ground plan is the paper's: a lane 2.4 m wide, a carton at 2 or 3 m, a blue square of 0.5 m at 4.5 m.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import mujoco
import numpy as np

from benchmarks.foreign import paint

VARIANTS = ("plain", "furnished", "unseen")
WIDTH, BEGIN, END = 2.4, -2.0, 6.5  # m
GOAL = (4.5, 0.0)
BODY = (0.3694, 0.277, 0.4)
"""Half sizes of the chair's outline [m]; its middle lies AHEAD of the drive axle."""
AHEAD = 0.27


@dataclass
class Room:
    """One world: MuJoCo's model of what is seen and hit, the start, and the carton."""

    model: mujoco.MjModel
    start: tuple[float, float, float]
    carton: tuple[float, float, float, float, float]
    """x, y, half sizes along and across, yaw."""
    things: list[tuple[float, float, float, float]] = field(default_factory=list)
    """x, y, half sizes of what stands along the walls."""


class _Xml:
    """Collects the parts of a model."""

    def __init__(self, random: np.random.Generator) -> None:
        self.random, self.count = random, 0
        self.assets: dict[str, bytes] = {}
        self.asset: list[str] = []
        self.world: list[str] = []

    def material(self, picture=None, colour=(1, 1, 1), repeat=(1.0, 1.0), cube=False, uniform=True, **more) -> str:
        """A material; with a picture, of so many repeats per metre (or per face with uniform False)."""
        name = f"m{self.count}"
        self.count += 1
        rgba = " ".join(f"{c:.4g}" for c in (*colour, 1))
        extra = " ".join(f'{key}="{value}"' for key, value in more.items())
        if picture is None:
            self.asset.append(f'<material name="{name}" rgba="{rgba}" {extra}/>')
            return name
        self.assets[f"{name}.png"] = paint.png(picture)
        kind = "cube" if cube else "2d"
        self.asset.append(f'<texture name="t{name}" type="{kind}" file="{name}.png"/>')
        self.asset.append(
            f'<material name="{name}" texture="t{name}" texrepeat="{repeat[0]:.4g} {repeat[1]:.4g}" '
            f'texuniform="{"true" if uniform else "false"}" rgba="{rgba}" {extra}/>'
        )
        return name

    def geom(self, kind: str, size, pos, material: str, solid: bool = False, euler=(0, 0, 0)) -> None:
        """One geom; solid ones touch the chair."""
        numbers = [" ".join(f"{value:.6g}" for value in part) for part in (size, pos, euler)]
        touch = 'contype="1" conaffinity="1"' if solid else ""
        self.world.append(
            f'<geom type="{kind}" size="{numbers[0]}" pos="{numbers[1]}" euler="{numbers[2]}" material="{material}" '
            f"{touch}/>"
        )

    def wall(self, side: int, place, half, thick: float, material: str) -> None:
        """A flat picture on a side wall, by x and z of its middle and its half width and height [m]."""
        at = (place[0], side * (WIDTH / 2 - thick), place[1])  # its own z looks into the room
        self.geom("box", (*half, thick), at, material, euler=(90, 0 if side > 0 else 180, 0))

    def compile(self, lights: str, visual: str) -> mujoco.MjModel:
        xml = f"""
<mujoco><compiler angle="degree"/>
  <visual><global offwidth="128" offheight="128"/><quality shadowsize="512" offsamples="4"/>
    <map znear="0.005" zfar="30"/>{visual}</visual>
  <asset>{"".join(self.asset)}</asset>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>{lights}{"".join(self.world)}
    <body name="chair" pos="0 0 0"><freejoint/>
      <geom name="chair" type="box" size="{BODY[0]} {BODY[1]} {BODY[2]}" pos="{AHEAD} 0 0.5" group="4" mass="1"
        contype="1" conaffinity="1"/>
      <camera name="eye" pos="0 0 0"/>
    </body>
  </worldbody>
</mujoco>"""
        return mujoco.MjModel.from_xml_string(xml, self.assets)


def make_room(variant: str, seed: int) -> Room:
    """A world of a variant; the same seed gives the same start and carton place in all variants."""
    if variant not in VARIANTS:
        raise ValueError(f"unknown variant {variant!r} (known: {', '.join(VARIANTS)}). Correct the name.")
    plan = np.random.default_rng([seed, 11])
    start = (plan.uniform(-0.3, 0.3), plan.uniform(-0.3, 0.3), math.radians(plan.uniform(-15, 15)))
    carton_at = (2.0 + seed % 2, plan.uniform(-0.5, 0.5))
    random = np.random.default_rng([seed, 12, VARIANTS.index(variant)])
    build: Callable = {"plain": _plain, "furnished": _furnished, "unseen": _unseen}[variant]
    return build(_Xml(random), random, start, carton_at)


def _shell(xml: _Xml, wall: list[str], floor: str, height: float, ceiling: str | None) -> None:
    """Floor, four walls of materials left, right, far, near, and the ceiling."""
    middle, half = (BEGIN + END) / 2, (END - BEGIN) / 2
    xml.geom("plane", (30, 30, 1), (0, 0, 0), floor)
    for side, material in ((1, wall[0]), (-1, wall[1])):
        place = (middle, side * (WIDTH / 2 + 0.1), height / 2)
        xml.geom("box", (half, height / 2, 0.1), place, material, True, (90, 0 if side > 0 else 180, 0))
    for x, material, turn in ((END + 0.1, wall[2], -90), (BEGIN - 0.1, wall[3], 90)):
        xml.geom("box", (height / 2, WIDTH / 2 + 0.2, 0.1), (x, 0, height / 2), material, True, (0, turn, 0))
    if ceiling is not None:
        xml.geom("box", (half + 0.3, WIDTH / 2 + 0.3, 0.05), (middle, 0, height + 0.05), ceiling, euler=(180, 0, 0))


def _goal(xml: _Xml, colour, stand: str | None = None) -> None:
    blue = xml.material(colour=colour, specular=0, shininess=0)
    xml.geom("box", (0.02, 0.25, 0.25), (GOAL[0], GOAL[1], 0.55), blue)
    if stand is not None:
        xml.geom("cylinder", (0.02, 0.16), (GOAL[0] + 0.03, 0, 0.16), stand)
        xml.geom("cylinder", (0.18, 0.015), (GOAL[0] + 0.03, 0, 0.015), stand)
        xml.geom("box", (0.008, 0.28, 0.28), (GOAL[0] + 0.03, 0, 0.55), stand)


def _plain(xml: _Xml, random, start, carton_at) -> Room:
    pale = xml.material(colour=(0.78, 0.76, 0.72), specular=0)
    dark = xml.material(colour=(0.66, 0.65, 0.61), specular=0)
    xml.asset.append(
        '<texture name="sky" type="skybox" builtin="gradient" rgb1="0.62 0.74 0.88" rgb2="0.80 0.86 0.92" '
        'width="64" height="384"/>'
        '<texture name="check" type="2d" builtin="checker" rgb1="0.50 0.50 0.48" rgb2="0.42 0.42 0.41" '
        'width="64" height="64"/>'
        '<material name="floor" texture="check" texrepeat="1 1" texuniform="true" specular="0"/>'
    )  # fmt: skip
    _shell(xml, [pale, pale, dark, dark], "floor", 2.0, None)
    brown = xml.material(colour=(0.62, 0.44, 0.26), specular=0)
    half = 0.2
    xml.geom("box", (half, half, 0.225), (*carton_at, 0.225), brown, True)
    _goal(xml, (0.04, 0.16, 0.90))
    lights = (
        '<light directional="true" dir="0.48 -0.36 -0.8" diffuse="0.55 0.55 0.55" specular="0 0 0" castshadow="false"/>'
    )
    model = xml.compile(lights, '<headlight ambient="0.55 0.55 0.55" diffuse="0 0 0" specular="0 0 0"/>')
    return Room(model, start, (*carton_at, half, half, 0.0))


def _lamps(xml: _Xml, random, height: float, level: tuple[float, float], warm: float) -> str:
    """Lamps on the ceiling; two of them light the room and throw shadows."""
    glow = xml.material(colour=(1, 1, 0.97), emission=1)
    lights = []
    colour = np.array([1.0, 1.0 - 0.12 * warm, 1.0 - 0.4 * warm])
    for index, x in enumerate((-0.8, 1.9, 4.4)):
        x += random.uniform(-0.5, 0.5)
        y = random.uniform(-0.4, 0.4)
        xml.geom("box", (0.3, 0.08, 0.02), (x, y, height - 0.02), glow)
        strength = random.uniform(*level)
        diffuse = " ".join(f"{c:.3g}" for c in strength * colour)
        shadow = "true" if index else "false"
        lights.append(
            f'<light pos="{x:.3g} {y:.3g} {height - 0.15:.3g}" dir="0 0 -1" cutoff="85" exponent="1" '
            f'attenuation="0.6 0.15 0.06" diffuse="{diffuse}" specular="0.1 0.1 0.1" castshadow="{shadow}"/>'
        )
    return "".join(lights)


def _doors(xml: _Xml, random, count: int) -> None:
    for _ in range(count):
        side, x = int(random.choice([-1, 1])), random.uniform(-0.5, 5.5)
        colour = random.choice([(0.5, 0.36, 0.22), (0.62, 0.62, 0.6), (0.35, 0.4, 0.45), (0.75, 0.7, 0.6)])
        leaf = xml.material(paint.door(random, colour), uniform=False)
        frame = xml.material(colour=tuple(np.asarray(colour) * 0.6))
        xml.wall(side, (x, 1.04), (0.5, 1.04), 0.012, frame)
        xml.wall(side, (x, 1.0), (0.44, 1.0), 0.02, leaf)


def _carton(xml: _Xml, random, at, half, yaw: float, colour) -> None:
    skin = xml.material(paint.carton(random, colour), cube=True, uniform=False, specular=0)
    xml.geom("box", half, (*at, half[2]), skin, True, (0, 0, math.degrees(yaw)))


def _furnished(xml: _Xml, random, start, carton_at) -> Room:
    height = 2.6
    wall = np.array([0.82, 0.8, 0.75]) * random.uniform(0.85, 1.05) + random.uniform(-0.04, 0.04, 3)
    coat = xml.material(paint.plaster(random, wall), repeat=(0.7, 0.7), specular=0)
    floor = np.full(3, random.uniform(0.45, 0.7)) + random.uniform(-0.04, 0.04, 3)
    ground = xml.material(paint.tiles(random, floor), repeat=(0.6, 0.6), specular=0.3, shininess=0.4, reflectance=0.06)
    above = xml.material(paint.tiles(random, (0.85, 0.85, 0.84)), repeat=(0.8, 0.8), specular=0)
    _shell(xml, [coat] * 4, ground, height, above)
    foot = xml.material(colour=(0.3, 0.28, 0.26))
    for side in (-1, 1):
        xml.wall(side, (2.25, 0.05), (4.25, 0.05), 0.01, foot)
    _doors(xml, random, 3)
    half = (0.2, 0.2, 0.225)
    _carton(xml, random, carton_at, half, 0.0, np.array([0.62, 0.46, 0.3]) * random.uniform(0.8, 1.1))
    grey = xml.material(colour=(0.3, 0.3, 0.32))
    _goal(xml, (0.05, 0.15, 0.75), grey)
    lights = _lamps(xml, random, height, (0.35, 0.8), random.uniform(0.0, 0.5))
    model = xml.compile(lights, '<headlight ambient="0.22 0.22 0.22" diffuse="0.05 0.05 0.05" specular="0 0 0"/>')
    return Room(model, start, (*carton_at, half[0], half[1], 0.0))


def _unseen(xml: _Xml, random, start, carton_at) -> Room:
    height = random.uniform(2.3, 3.0)
    makers = [
        lambda: xml.material(paint.bricks(random), repeat=(0.9, 0.9), specular=0),
        lambda: xml.material(paint.boards(random), repeat=(0.6, 0.6), specular=0.1),
        lambda: xml.material(paint.plaster(random, _wall_colour(random)), repeat=(0.7, 0.7), specular=0),
        lambda: xml.material(paint.tiles(random, _wall_colour(random), 8), repeat=(0.7, 0.7)),
    ]
    sides = [makers[random.integers(4)]() for _ in range(2)]
    floors = [
        lambda: xml.material(paint.carpet(random), repeat=(0.6, 0.6), specular=0),
        lambda: xml.material(paint.boards(random), repeat=(0.7, 0.7), specular=0.2, reflectance=0.08),
        lambda: xml.material(paint.terrazzo(random), repeat=(0.8, 0.8), specular=0.4, reflectance=0.1),
        lambda: xml.material(paint.bricks(random), repeat=(0.8, 0.8), specular=0),
    ]
    far = makers[random.integers(4)]()
    white = xml.material(paint.plaster(random, np.full(3, random.uniform(0.4, 0.95))), repeat=(0.7, 0.7), specular=0)
    _shell(xml, [sides[0], sides[random.integers(2)], far, sides[0]], floors[random.integers(4)](), height, white)
    _doors(xml, random, int(random.integers(0, 4)))
    for _ in range(int(random.integers(2, 7))):
        poster = xml.material(paint.letters(random, random.uniform(0, 1, 3), random.uniform(0, 1, 3)), uniform=False)
        side = int(random.choice([-1, 1]))
        x, tall, z, wide = (random.uniform(*ends) for ends in ((-0.5, 6), (0.2, 0.45), (0.9, 1.7), (0.15, 0.5)))
        xml.wall(side, (x, z), (wide, tall), 0.008, poster)
    size = (random.uniform(0.12, 0.3), random.uniform(0.12, 0.3), random.uniform(0.12, 0.4))
    yaw = random.uniform(-math.pi / 2, math.pi / 2)
    across = size[0] * abs(math.sin(yaw)) + size[1] * abs(math.cos(yaw))
    _carton(xml, random, carton_at, size, yaw, random.uniform(0.1, 0.9, 3) * (1, 1, 0.7))
    things = _things(xml, random, carton_at, across, max(size[0], size[1]))
    stand = xml.material(colour=tuple(random.uniform(0.05, 0.8, 3)))
    _goal(xml, (random.uniform(0.02, 0.1), random.uniform(0.08, 0.25), random.uniform(0.6, 0.9)), stand)
    lights = _lamps(xml, random, height, (0.15, 1.0), random.uniform(-0.2, 1.0))
    ambient = " ".join([f"{random.uniform(0.1, 0.3):.3g}"] * 3)
    model = xml.compile(lights, f'<headlight ambient="{ambient}" diffuse="0.03 0.03 0.03" specular="0 0 0"/>')
    return Room(model, start, (*carton_at, size[0], size[1], yaw), things)


def _wall_colour(random) -> np.ndarray:
    """Any paint that somebody might put on a wall: pale or dark, more or less colourful."""
    return np.clip(random.uniform(0.3, 0.9) + random.uniform(-0.2, 0.2, 3), 0.05, 1.0)


def _things(xml: _Xml, random, carton_at, across: float, along: float) -> list[tuple[float, float, float, float]]:
    """Chairs, bins, balls, plants and crates at the walls; the wider way past the carton stays 1.05 m wide."""
    placed: list[tuple[float, float, float, float]] = []
    wider = -1 if carton_at[1] > 0 else 1
    for _ in range(int(random.integers(1, 6))):
        side, deep, long = int(random.choice([-1, 1])), random.uniform(0.05, 0.17), random.uniform(0.06, 0.3)
        x = random.uniform(0.9, 6.2)
        beside = abs(x - carton_at[0]) < along + long + 1.0
        free = WIDTH / 2 + abs(carton_at[1]) - across - 2 * deep
        taken = any(abs(x - other[0]) < long + other[2] + 0.05 for other in placed)
        if taken or (beside and side == wider and free < 1.05):
            continue
        y = side * (WIDTH / 2 - deep - 0.01)
        skin = xml.material(colour=tuple(random.uniform(0.03, 0.85, 3) * (1, 1, 0.8)))
        kind, tall = random.integers(4), random.uniform(0.15, 0.7)
        if kind == 0:  # a chair: a seat on legs, with a back
            xml.geom("box", (long, deep, 0.03), (x, y, 0.42), skin, True)
            xml.geom("box", (long, 0.02, 0.25), (x, side * (WIDTH / 2 - 0.03), 0.68), skin, True)
            for dx in (-long + 0.02, long - 0.02):
                for dy in (-deep + 0.02, deep - 0.02):
                    xml.geom("cylinder", (0.015, 0.2), (x + dx, y + dy, 0.2), skin, True)
        elif kind == 1:  # a bin
            long = deep
            xml.geom("cylinder", (deep, tall / 2), (x, y, tall / 2), skin, True)
        elif kind == 2:  # a plant in a pot
            long = deep
            xml.geom("cylinder", (deep * 0.7, 0.15), (x, y, 0.15), skin, True)
            green = xml.material(colour=(random.uniform(0.05, 0.2), random.uniform(0.25, 0.5), 0.08))
            xml.geom("ellipsoid", (deep, deep, tall / 2), (x, y, 0.3 + tall / 2), green, True)
        else:  # a crate with a picture
            print_ = paint.letters(random, random.uniform(0, 1, 3), random.uniform(0, 1, 3))
            crate = xml.material(print_, cube=True, uniform=False)
            xml.geom("box", (long, deep, tall / 2), (x, y, tall / 2), crate, True)
        placed.append((x, y, long, deep))
    return placed
