"""Coordinate systems of map files, and their places in metres.

The EPSG codes are those of the EPSG data set 11.022. All of them are not needed: a file in degrees whose system is not
known is recognised by its numbers and refused.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from whill_mjx.io.reading import LONGEST_REASON

EARTH = 6_378_137.0, 6.694_379_990_14e-3
"""Equatorial radius [m] and squared eccentricity of WGS84."""
FOOT = 0.3048
"""International foot [m]; the foot of the US survey is longer by 2e-6 of it, 2 mm in a kilometre."""
DEGREES = """3823-3824 4148-4152 4167 4171 4173 4202-4203 4214 4230-4231 4258 4265 4267 4269 4272 4275 4277 4283-4284
4289 4301 4312-4314 4326 4480 4490 4610 4612 4617 4619 4674 4737 4759 4893 4927 4933 4937 4939 4941 4943 4947 4955
4957 4959 4965 4977 4979 4989 5498 5500 6318-6319 6349 6667-6668 6697 6705-6706 7409 7423 7843-7844 8360 9422 9518
9705 9707"""
"""The usual EPSG codes of latitude and longitude, in this order; of some, a height follows."""
FEET = """2136 2155 2159-2160 2194 2204 2222-2289 2314 2867-2930 2964-2968 2992-2994/2 3080 3089-3091/2 3102 3359-3365/2
3404 3407 3417-3438 3441-3446 3451-3459 3479-3487/2 3490-3512/2 3515-3553/2 3560-3570 3582-3590/2 3593 3598-3600/2
3605 3608-3636/2 3640-3664/2 3668-3676/2 3677-3679/2 3680-3682/2 3683 3686-3692/2 3696-3700/2 3728-3739 3753-3760
3991-3992 4217 4399-4413 4418-4433 4438-4439 4455-4457 5588-5589 5623-5625 5646 5654-5655 6128-6129 6141 6200-6202
6391 6405-6413/2 6416-6438/2 6441-6479/2 6484-6496/2 6499-6507/2 6510 6515-6565/2 6568-6578/2 6582-6590/2
6593-6609/2 6612-6618/2 6625-6627 6633 6785-6863/2 6868 6880 6885-6887/2 6923-6925/2 6966 6997 7057-7070 7119-7128
7132 7258-7370/2 7407 7587-7645 8035-8036 8065-8068 8091-8093/2 8096-8182/2 8177 8185 8189 8193-8197/2 8200-8210/2
8213 8216 8220 8224-8226/2 8312-8348/2 8380-8384/2 8387 8518-8540 8700-8800 9748-9749 10481 10516 10622 20050
23301-23333 24100 26729-26813 26847-26870 29872 32001-32058 32064-32077 32099 32164-32167 32664-32667"""
"""All EPSG codes of projected systems in feet: most zones of the United States. "/2": every second code."""
EPSG = re.compile(r"(?:EPSG(?:\.xml#|:[\d.]*:|/[\d.]*/|\D?)|^)(\d+)", re.IGNORECASE)
LONGITUDE_FIRST = re.compile(r"CRS:?(?:84h?|83|27)$", re.IGNORECASE)


def _codes(text: str) -> frozenset[int]:
    found: set[int] = set()
    for word in text.split():
        run, _, step = word.partition("/")
        first, _, last = run.partition("-")
        found.update(range(int(first), int(last or first) + 1, int(step or 1)))
    return frozenset(found)


IN_DEGREES, IN_FEET = _codes(DEGREES), _codes(FEET)


@dataclass(frozen=True)
class System:
    """What the two numbers of a place mean."""

    unit: float | None = 1.0
    """Metres per unit; None for degrees."""
    longitude_first: bool = False

    def beside(self, place: np.ndarray, east_north: np.ndarray) -> np.ndarray:
        """Places (n, 2) of this system that lie `east_north` (n, 2) from `place` (2,); [m] where it is in degrees."""
        if self.unit is not None:
            return place + east_north
        latitude = place[1] if self.longitude_first else place[0]
        off = np.rad2deg(east_north / _radii(math.radians(latitude)))
        return place + (off if self.longitude_first else off[:, ::-1])


LATITUDE_LONGITUDE = System(None)


@lru_cache(64)
def system_of(name: str) -> System:
    """Coordinate system of a srsName; of a compound one, its first part. An unknown one is projected, in metres."""
    if LONGITUDE_FIRST.search(name.strip().rstrip("/")):
        return System(None, longitude_first=True)
    code = EPSG.search(name)
    number = int(code[1][:9]) if code else 0
    return LATITUDE_LONGITUDE if number in IN_DEGREES else System(FOOT if number in IN_FEET else 1.0)


def read_numbers(text: str | None) -> list[float]:
    """Numbers of a text with blanks between them."""
    try:
        return [float(word) for word in (text or "").split()]
    except ValueError as error:
        raise unreadable(str(error)) from None


def unreadable(reason: str) -> ValueError:
    """The error of a coordinate that is no number, or of too few."""
    return ValueError(f"has a coordinate that cannot be read ({reason[:LONGEST_REASON]}). Export it again.")


class World(NamedTuple):
    """Places around the zero of the world."""

    places: np.ndarray
    """(n, 2) east and north [m]."""
    shift: tuple[float, float]
    """Whole metres that were taken off; 0 of degrees."""
    notes: list[str]
    """How the numbers were understood."""


def to_world(places: np.ndarray, system: System, name: str, scale: float = 1.0) -> World:
    """World coordinates of places (n, 2) of a system, from their middle; of a projected one, from a whole metre there.

    Args:
        places: all corners of a map.
        system: from `system_of`.
        name: of the system, for notes and errors.
        scale: metres per unit of a projected system; 1 for the unit that the system is known to have.

    Raises:
        ValueError: a number is not finite, no latitude where one should be, or a degree where metres should be.
    """
    if not np.isfinite(places).all():
        raise ValueError("has a coordinate that is no finite number. Export it again.")
    if system.unit is None:
        degrees = places[:, ::-1] if system.longitude_first else places
        far = np.abs(degrees[:, 0]).max()
        if far > 90.0:
            raise ValueError(f"has a latitude of {far:g} degrees, over 90, in {name}. Correct it, or the srsName: "
                             "urn:ogc:def:crs:OGC:1.3:CRS84 has the longitude first.")  # fmt: skip
        if scale != 1.0:
            raise ValueError(f"is in degrees ({name}), where --scale {scale:g} has no meaning. Leave it out.")
        middle = (degrees.min(0) + degrees.max(0)) / 2
        note = f"x 0, y 0: latitude {middle[0]:.8f}, longitude {middle[1]:.8f}"
        return World(_east_north(degrees, middle), (0.0, 0.0), [note])
    unit = system.unit if scale == 1.0 else scale
    low, high, span = places.min(0), places.max(0), np.ptp(places, axis=0)
    beyond = np.sort(np.abs(places).max(0)) > [90.0, 180.0]
    if not beyond.any() and (span * unit < 1.0).all():
        where = f"from {low[0]:.6g}, {low[1]:.6g} to {high[0]:.6g}, {high[1]:.6g}"
        raise ValueError(f"has coordinates {where} in {name}, less than 1 m in all. They look like degrees; reproject "
                         "it to metres, or correct its srsName.")  # fmt: skip
    middle = np.rint((low + high) / 2 * unit)
    notes = [] if unit == 1.0 else [f"unit of {name}: {unit:g} m"]
    return World(places * unit - middle, (float(middle[0]), float(middle[1])), notes)


def _east_north(degrees: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """East and north (n, 2) [m] of latitude and longitude (n, 2) [degrees], on the plane that touches `middle`."""
    return np.deg2rad(degrees - middle)[:, ::-1] * _radii(math.radians(middle[0]))


def _radii(latitude: float) -> np.ndarray:
    """Metres per radian of longitude and of latitude at a latitude [rad]."""
    radius, squared = EARTH
    curved = 1.0 - squared * math.sin(latitude) ** 2
    return np.array([radius / math.sqrt(curved) * math.cos(latitude), radius * (1.0 - squared) / curved**1.5])
