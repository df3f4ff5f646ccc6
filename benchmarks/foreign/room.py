"""Foreign rooms for MuJoCo's renderer: plain, furnished and unseen; with what the chair must not touch."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from benchmarks.foreign import paint
from benchmarks.foreign.plan import BEGIN, PLANS, Block, Plan

VARIANTS = ("plain", "furnished", "unseen")
BODY = (0.3694, 0.277, 0.4)
"""Half sizes of the chair's outline [m]; its middle lies AHEAD of the drive axle."""
AHEAD = 0.27
LAMPS = (1.2 / 8.5, 3.9 / 8.5, 6.4 / 8.5)
"""Where the lamps hang, as shares of the room's length."""


@dataclass(frozen=True)
class Room:
    """One world: MuJoCo's model of what is seen and hit, its plan, and what the chair must drive around."""

    model: mujoco.MjModel
    plan: Plan
    obstacles: tuple[Block, ...]
    """As they are in this variant."""
    things: tuple[Block, ...] = ()
    """What stands along the walls."""


class _Xml:
    """Collects the parts of a model."""

    def __init__(self, plan: Plan) -> None:
        self.plan, self.count = plan, 0
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
        at = (place[0], side * (self.plan.half_width - thick), place[1])  # its own z looks into the room
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


def make_room(variant: str, seed: int, task: str = "corridor") -> Room:
    """A world of a variant; the same seed gives the same start and places in all variants.

    Raises:
        ValueError: unknown variant or task.
    """
    if variant not in VARIANTS:
        raise ValueError(f"unknown variant {variant!r} (known: {', '.join(VARIANTS)}). Correct the name.")
    if task not in PLANS:
        raise ValueError(f"unknown task {task!r} (known: {', '.join(PLANS)}). Correct the name.")
    plan = PLANS[task](seed)
    random = np.random.default_rng([seed, 12, VARIANTS.index(variant)])
    build: Callable = {"plain": _plain, "furnished": _furnished, "unseen": _unseen}[variant]
    return build(_Xml(plan), random)


def _shell(xml: _Xml, wall: list[str], floor: str, height: float, ceiling: str | None) -> None:
    """Floor, four walls of materials left, right, far, near, and the ceiling."""
    end, wide = xml.plan.end, xml.plan.half_width
    middle, half = (BEGIN + end) / 2, (end - BEGIN) / 2
    xml.geom("plane", (30, 30, 1), (0, 0, 0), floor)
    for side, material in ((1, wall[0]), (-1, wall[1])):
        place = (middle, side * (wide + 0.1), height / 2)
        xml.geom("box", (half, height / 2, 0.1), place, material, True, (90, 0 if side > 0 else 180, 0))
    for x, material, turn in ((end + 0.1, wall[2], -90), (BEGIN - 0.1, wall[3], 90)):
        xml.geom("box", (height / 2, wide + 0.2, 0.1), (x, 0, height / 2), material, True, (0, turn, 0))
    if ceiling is not None:
        xml.geom("box", (half + 0.3, wide + 0.3, 0.05), (middle, 0, height + 0.05), ceiling, euler=(180, 0, 0))


def _goal(xml: _Xml, colour, stand: str | None = None) -> None:
    (x, y), (half, tall) = xml.plan.goal, xml.plan.marker
    blue = xml.material(colour=colour, specular=0, shininess=0)
    xml.geom("box", (0.02, half, half), (x, y, tall), blue)
    if stand is not None:
        pole = (tall - half + 0.02) / 2
        xml.geom("cylinder", (0.02, pole), (x + 0.03, y, pole), stand)
        xml.geom("cylinder", (0.18, 0.015), (x + 0.03, y, 0.015), stand)
        xml.geom("box", (0.008, half + 0.03, half + 0.03), (x + 0.03, y, tall), stand)


def _plain(xml: _Xml, random) -> Room:
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
    for one in xml.plan.obstacles:
        xml.geom("box", one[2:5], (one.x, one.y, one.half_z), brown, True)
    _goal(xml, (0.04, 0.16, 0.90))
    lights = (
        '<light directional="true" dir="0.48 -0.36 -0.8" diffuse="0.55 0.55 0.55" specular="0 0 0" castshadow="false"/>'
    )
    model = xml.compile(lights, '<headlight ambient="0.55 0.55 0.55" diffuse="0 0 0" specular="0 0 0"/>')
    return Room(model, xml.plan, xml.plan.obstacles)


def _lamps(xml: _Xml, random, height: float, level: tuple[float, float], warm: float) -> str:
    """Lamps on the ceiling; two of them light the room and throw shadows."""
    glow = xml.material(colour=(1, 1, 0.97), emission=1)
    lights = []
    colour = np.array([1.0, 1.0 - 0.12 * warm, 1.0 - 0.4 * warm])
    for index, share in enumerate(LAMPS):
        x = BEGIN + share * (xml.plan.end - BEGIN) + random.uniform(-0.5, 0.5)
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
        side, x = int(random.choice([-1, 1])), random.uniform(-0.5, xml.plan.end - 1.0)
        colour = random.choice([(0.5, 0.36, 0.22), (0.62, 0.62, 0.6), (0.35, 0.4, 0.45), (0.75, 0.7, 0.6)])
        leaf = xml.material(paint.door(random, colour), uniform=False)
        frame = xml.material(colour=tuple(np.asarray(colour) * 0.6))
        xml.wall(side, (x, 1.04), (0.5, 1.04), 0.012, frame)
        xml.wall(side, (x, 1.0), (0.44, 1.0), 0.02, leaf)


def _carton(xml: _Xml, random, one: Block, colour) -> None:
    skin = xml.material(paint.carton(random, colour), cube=True, uniform=False, specular=0)
    xml.geom("box", one[2:5], (one.x, one.y, one.half_z), skin, True, (0, 0, math.degrees(one.yaw)))


def _row(xml: _Xml, random, one: Block) -> None:
    """Cartons, crates or benches side by side, as wide together as the obstacle; none is longer or higher than it."""
    count = int(random.integers(1, 4))
    half_y = one.half_y / count
    for index in range(count):
        half_x, half_z = one.half_x * random.uniform(0.7, 1.0), one.half_z * random.uniform(0.7, 1.0)
        y = one.y + (2 * index + 1 - count) * half_y
        part = Block(one.x, y, half_x, half_y, half_z, 0.0)
        colour = random.uniform(0.1, 0.9, 3) * (1, 1, 0.7)
        if random.integers(3):
            _carton(xml, random, part, colour)
            continue
        picture = paint.boards(random) if random.integers(2) else paint.letters(random, colour, random.uniform(0, 1, 3))
        skin = xml.material(picture, cube=True, uniform=False)
        xml.geom("box", part[2:5], (part.x, part.y, part.half_z), skin, True)


def _furnished(xml: _Xml, random) -> Room:
    height = 2.6
    wall = np.array([0.82, 0.8, 0.75]) * random.uniform(0.85, 1.05) + random.uniform(-0.04, 0.04, 3)
    coat = xml.material(paint.plaster(random, wall), repeat=(0.7, 0.7), specular=0)
    floor = np.full(3, random.uniform(0.45, 0.7)) + random.uniform(-0.04, 0.04, 3)
    ground = xml.material(paint.tiles(random, floor), repeat=(0.6, 0.6), specular=0.3, shininess=0.4, reflectance=0.06)
    above = xml.material(paint.tiles(random, (0.85, 0.85, 0.84)), repeat=(0.8, 0.8), specular=0)
    _shell(xml, [coat] * 4, ground, height, above)
    foot = xml.material(colour=(0.3, 0.28, 0.26))
    for side in (-1, 1):
        xml.wall(side, ((BEGIN + xml.plan.end) / 2, 0.05), ((xml.plan.end - BEGIN) / 2, 0.05), 0.01, foot)
    _doors(xml, random, 3)
    for one in xml.plan.obstacles:
        _carton(xml, random, one, np.array([0.62, 0.46, 0.3]) * random.uniform(0.8, 1.1))
    grey = xml.material(colour=(0.3, 0.3, 0.32))
    _goal(xml, (0.05, 0.15, 0.75), grey)
    lights = _lamps(xml, random, height, (0.35, 0.8), random.uniform(0.0, 0.5))
    model = xml.compile(lights, '<headlight ambient="0.22 0.22 0.22" diffuse="0.05 0.05 0.05" specular="0 0 0"/>')
    return Room(model, xml.plan, xml.plan.obstacles)


def _unseen(xml: _Xml, random) -> Room:
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
        ranges = ((-0.5, xml.plan.end - 0.5), (0.2, 0.45), (0.9, 1.7), (0.15, 0.5))
        x, tall, z, wide = (random.uniform(*ends) for ends in ranges)
        xml.wall(side, (x, z), (wide, tall), 0.008, poster)
    obstacles = xml.plan.obstacles
    if xml.plan.lone:
        size = (random.uniform(0.12, 0.3), random.uniform(0.12, 0.3), random.uniform(0.12, 0.4))
        yaw = random.uniform(-math.pi / 2, math.pi / 2)
        obstacles = (Block(*obstacles[0][:2], *size, yaw),)
        _carton(xml, random, obstacles[0], random.uniform(0.1, 0.9, 3) * (1, 1, 0.7))
    else:
        for one in obstacles:
            _row(xml, random, one)
    things = _things(xml, random, obstacles)
    stand = xml.material(colour=tuple(random.uniform(0.05, 0.8, 3)))
    _goal(xml, (random.uniform(0.02, 0.1), random.uniform(0.08, 0.25), random.uniform(0.6, 0.9)), stand)
    lights = _lamps(xml, random, height, (0.15, 1.0), random.uniform(-0.2, 1.0))
    ambient = " ".join([f"{random.uniform(0.1, 0.3):.3g}"] * 3)
    model = xml.compile(lights, f'<headlight ambient="{ambient}" diffuse="0.03 0.03 0.03" specular="0 0 0"/>')
    return Room(model, xml.plan, obstacles, things)


def _wall_colour(random) -> np.ndarray:
    """Any paint that somebody might put on a wall: pale or dark, more or less colourful."""
    return np.clip(random.uniform(0.3, 0.9) + random.uniform(-0.2, 0.2, 3), 0.05, 1.0)


def _things(xml: _Xml, random, obstacles: tuple[Block, ...]) -> tuple[Block, ...]:
    """Chairs, bins, balls, plants and crates at the walls, where the plan takes them."""
    placed: list[Block] = []
    wide = xml.plan.half_width
    for _ in range(int(random.integers(1, 6))):
        side, deep, long = int(random.choice([-1, 1])), random.uniform(0.05, 0.17), random.uniform(0.06, 0.3)
        x = random.uniform(0.9, xml.plan.end - 0.3)
        y = side * (wide - deep - 0.01)
        taken = any(abs(x - other.x) < long + other.half_x + 0.05 for other in placed)
        if taken or not xml.plan.takes(Block(x, y, long, deep, 0.0, 0.0), obstacles):
            continue
        skin = xml.material(colour=tuple(random.uniform(0.03, 0.85, 3) * (1, 1, 0.8)))
        kind, tall = random.integers(4), random.uniform(0.15, 0.7)
        if kind == 0:  # a chair: a seat on legs, with a back
            xml.geom("box", (long, deep, 0.03), (x, y, 0.42), skin, True)
            xml.geom("box", (long, 0.02, 0.25), (x, side * (wide - 0.03), 0.68), skin, True)
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
        placed.append(Block(x, y, long, deep, tall / 2, 0.0))
    return tuple(placed)
