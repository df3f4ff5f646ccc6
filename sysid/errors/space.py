"""Which parameters are searched, between which bounds and on which scale, and how much large residuals count.

The search runs in unit coordinates u in [0, 1]: linear, or logarithmic where the range spans more than a factor of 10.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from sysid.replay.arrays import namespace
from whill_mjx.io.fields import growth, parameter_field
from whill_mjx.vehicle.specs import WHILL_CR, VehicleSpec
from whill_mjx.vehicle.types import Parameter

STEP = 0.01  # half the distance between the two ends of a difference, as a share of the parameter's range

LOG_SPAN = 10.0
# Parameters that no driving log determines, or that only act through another one; they keep their value unless named.
FIXED = {
    "air_drag.area": "acts only as a product with air_drag.c_d",
    "pid_drive.integral_limit": "never reached in ordinary driving",
    "rolling_contact.grip": "part of the model, not of the vehicle",
    "body.mass": "acts only as a ratio to forces that are fitted; weigh the vehicle",
    "body.com_z": "has next to no effect on level ground",
    "middle_wheels.share": "follows from the places of the axles",
}
NUISANCE = {
    "torque_drive.period": "this log cannot determine it; it is free so that it does not bias the others",
}  # searched, but never reported as determined: what its curvature at one point says holds nowhere else
BENT = ("body.com_z",)  # a log determines them better or worse by their own value: driving shifts load by the height
LOADED = "slip_traction.mu"  # with it, wheels skid by their load, and brakes and turns show how high the mass lies


RATIO, YAW, ALONG = "wheel_inertia.ratio", "body.yaw_inertia", "body.com_x"
TERMS = {RATIO: "drives fix the inertia that motors turn, of which that of the wheels is one of two terms"}
"""Searched by their logarithm, but reported as they are: intervals reach as far down as up."""
PER_INERTIA = ("torque_drive.kp", "torque_drive.ki", "torque_drive.limit", "torque_drive.kff", "wheel_damping.damping",
               "rolling_resistance.mu_r", "yaw_scrub.torque", "lateral_damping.c_front")
"""Torques and forces that drives fix per inertia that they speed up, wheels included."""


@dataclass(frozen=True)
class Turned:
    """What one side's motor turns, from the nominal vehicle."""

    mass: float  # inertia of half of the vehicle, at the wheel [kg m^2]
    wheel: float  # nominal spin inertia of the wheels of one side [kg m^2]
    yaw: float  # by how many times a wheel's spin inertia the vehicle is harder to turn about its vertical axis [-]
    driven: float
    """Where the driven wheels are in the chassis frame [m]: centrifugal force shows how far before them the mass is."""

    @classmethod
    def of(cls, spec: VehicleSpec) -> Turned:
        """That of a vehicle."""
        yaw = spec.track**2 / 2 / spec.wheel_radius**2
        return cls(spec.mass / 2 * spec.wheel_radius**2, spec.wheel_inertia, yaw, spec.reference_x)

    @property
    def besides(self) -> dict[str, tuple[float, float]]:
        """Fixed per inertia, as a constant and a share of the wheel's inertia that count besides its value."""
        return {**dict.fromkeys(PER_INERTIA, (0.0, 0.0)), YAW: (0.0, self.yaw), ALONG: (-self.driven, 0.0)}


@dataclass(frozen=True)
class Space:
    """P searched parameters."""

    names: tuple[str, ...]
    low: np.ndarray  # (P,)
    high: np.ndarray  # (P,)
    initial: np.ndarray  # (P,)
    log: np.ndarray  # (P,) bool
    fixed: tuple[tuple[str, str], ...] = ()  # names that keep their value, each with the reason
    turned: Turned | None = None  # of the vehicle, where it is one

    def __post_init__(self) -> None:
        for name, low, high, value in zip(self.names, self.low, self.high, self.initial, strict=True):
            if not low < high:
                raise ValueError(f"{name}: bounds {low:g} to {high:g}; low must be below high.")
            if not low <= value <= high:
                raise ValueError(f"{name}: initial value {value:g} is outside {low:g} to {high:g}. Widen the bounds.")
            if not np.isfinite([low, high, value]).all():
                raise ValueError(f"{name}: bounds {low:g} to {high:g} and value {value:g} must be finite.")

    @property
    def size(self) -> int:
        return len(self.names)

    @property
    def _ends(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds (P,) of what is searched by its logarithm; of the others numbers whose logarithm is finite."""
        return np.where(self.log, self.low, 1.0), np.where(self.log, self.high, 2.0)

    def to_values(self, u: Any) -> Any:
        """Values (..., P) of unit coordinates (..., P), which are clipped to [0, 1]."""
        xp = namespace(u)
        u = xp.clip(u, 0.0, 1.0)
        low, high = self._ends
        return xp.where(self.log, low * (high / low) ** u, self.low + u * (self.high - self.low))

    def to_unit(self, values: np.ndarray) -> np.ndarray:
        """Unit coordinates (..., P) of values (..., P)."""
        return self._unit(np.clip(values, self.low, self.high))

    def _unit(self, values: np.ndarray) -> np.ndarray:
        """Those of values (..., P) that may lie outside the range."""
        low, high = self._ends
        logarithm = np.log(np.maximum(np.where(self.log, values, 1.0) / low, 1e-300)) / np.log(high / low)
        return np.where(self.log, logarithm, (values - self.low) / (self.high - self.low))

    def slope(self, u: np.ndarray) -> np.ndarray:
        """d value / d u (..., P)."""
        low, high = self._ends
        return np.where(self.log, self.to_values(u) * np.log(high / low), self.high - self.low)

    def moved(self, u: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Unit coordinates (N, P) a step (N, P) from u (N, P), along the valley of what drives fix per inertia only.

        Heavier wheels with as much larger torques drive alike. The wheels' inertia is one of two terms of what torques
        turn, so that valley is curved. The first order is that of a straight step.
        """
        end = u + step
        if self.turned is None or RATIO not in self.names:
            return end
        at, moves, ratio = self.to_values(u), self.slope(u) * step, self.names.index(RATIO)
        wheel, later = (self.turned.wheel * self.to_values(x)[:, ratio] for x in (u, end))
        heavier = self.turned.wheel * moves[:, ratio]
        inertia, grown = self.turned.mass + wheel, self.turned.mass + later
        besides, values = self.turned.besides, at.copy()
        for i, name in enumerate(self.names):
            if name in besides:
                constant, share = besides[name]
                grown_value = (at[:, i] + constant + share * wheel) / inertia
                move = (moves[:, i] + share * heavier - grown_value * heavier) / inertia
                grown_value = grown_value * np.exp(move / grown_value) if self.log[i] else grown_value + move
                values[:, i] = grown_value * grown - constant - share * later
        return np.where([name in besides for name in self.names], self._unit(values), end)

    def without(self, name: str, reason: str) -> Space:
        """The space in which one parameter keeps its value."""
        kept = [i for i, one in enumerate(self.names) if one != name]
        return replace(self, names=tuple(self.names[i] for i in kept), low=self.low[kept], high=self.high[kept],
                       initial=self.initial[kept], log=self.log[kept], fixed=(*self.fixed, (name, reason)))


# Factors on the starting value, for what a preset scales with the vehicle, from 3 kg to 300 kg.
FACTORS = {"body.yaw_inertia": (1 / 4, 4.0), "torque_drive.kp": (1 / 30, 30.0), "torque_drive.ki": (0.0, 20.0),
           "torque_drive.limit": (1 / 10, 30.0)}
ROUNDING = 1e-6  # share by which single precision may round a bound out of what a file may hold
LENGTHS = {"caster_kick.trail": "wheelbase", "payload_shift.x": "wheelbase", "payload_shift.y": "track",
           "payload_shift.z": "body_height"}
"""Lengths on the vehicle, and the size of the vehicle with which they grow."""
LOSS = 1.5  # 1/s by which bearings may brake a vehicle that rolls, or a feed-forward make up for it


def vehicle_bounds(names: Sequence[str], initial: np.ndarray, spec: VehicleSpec) -> dict[str, tuple[float, float]]:
    """Bounds that follow the vehicle: its torques, scrub up to its whole weight sliding at a quarter of the track,
    and a centre of mass between the axles, above the floor and below where a turn at a third of g would tip it."""
    scaled = {name: (FACTORS[name][0] * value, FACTORS[name][1] * value)
              for name, value in zip(names, initial, strict=True) if name in FACTORS and value > 0}
    load = spec.mass / 2 * spec.wheel_radius**2 + spec.wheel_inertia  # [kg m^2] that one side's motor turns
    middle, length, width = (spec.rear_x + spec.front_x) / 2, 0.45 * spec.wheelbase, 0.2 * spec.track
    return {**scaled, "torque_drive.kff": (0.0, LOSS * load), "wheel_damping.damping": (0.0, LOSS * load),
            "yaw_scrub.torque": (0.0, 9.81 * spec.mass * spec.track / 4),
            "body.com_x": (middle - length, middle + length), "body.com_y": (-width, width),
            "body.com_z": (-spec.wheel_radius, 1.5 * spec.track - spec.wheel_radius)}


def searched(params: Any, asked: Sequence[str] = ()) -> list[str]:
    """What a fit searches by default: all but `FIXED`, and the height of the mass where wheels may skid. Lateral
    damping of driven wheels, which slip besides, is searched only where it is `asked` for."""
    from whill_mjx.vehicle.parameters import describe

    about = describe(params)
    left_out = set(FIXED)
    if LOADED in about:
        left_out.discard("body.com_z")
        if "lateral_damping" not in asked:
            left_out.add("lateral_damping.c_rear")
    return [name for name in about if name not in left_out]


def make_space(params: Any, spec: VehicleSpec, names: Sequence[str] | None = None) -> Space:
    """Space of a vehicle's parameters, from their values in `params`, with `vehicle_bounds` or their described bounds
    in proportion to the vehicle. `names`: what to search; by default everything but `FIXED` and limits that are not
    there."""
    from whill_mjx.vehicle.parameters import describe, get_values

    about = describe(params)
    if names is None:
        names = [name for name in about if name not in FIXED]
        names = [name for name, value in zip(names, get_values(params, names), strict=True) if np.isfinite(value)]
    unknown = sorted(set(names) - set(about))
    if unknown:
        raise ValueError(f"no parameter {unknown[0]!r} (known: {', '.join(about)}).")
    initial = np.asarray(get_values(params, names), float)
    bounds = vehicle_bounds(names, initial, spec)
    found = [bounds.get(name) or _in_proportion(name, about[name], spec) for name in names]
    low, high = (np.array([one[end] for one in found], float) for end in (0, 1))
    low, high = np.minimum(low, initial), np.maximum(high, initial)  # a preset may lie outside the usual range
    log = (low > 0) & (high > LOG_SPAN * np.maximum(low, 1e-30))
    kept = [(name, FIXED.get(name, "not selected")) for name in about if name not in names]
    return Space(tuple(names), low, high, initial, log, tuple(kept), Turned.of(spec))


def _in_proportion(name: str, about: Parameter, spec: VehicleSpec) -> tuple[float, float]:
    """Described bounds of a parameter, times as much as it grows with the vehicle, within what a file may hold."""
    times = growth(about.unit, spec.mass, spec.wheel_radius)
    if name in LENGTHS:
        times = getattr(spec, LENGTHS[name]) / getattr(WHILL_CR, LENGTHS[name])
    if times == 1.0:
        return about.low, about.high
    file = parameter_field(name, about.unit, about.low, about.high, about.neutral, (spec.mass, spec.wheel_radius))
    low, high = file.low + ROUNDING * abs(file.low), file.high - ROUNDING * abs(file.high)
    return max(times * about.low, low), min(times * about.high, high)


class Residuals(Protocol):
    """Residuals (N, B, K) of unit coordinates (N, P), and derivatives (N, B, K, P), or what `equations` sum up."""

    @property
    def space(self) -> Space: ...

    @property
    def counted(self) -> int: ...

    def residuals(self, u: np.ndarray) -> np.ndarray: ...

    def jacobian(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]: ...


HUBER = 4.0  # noise scales beyond which a robust fit counts a residual linearly


def huber_weight(residual: Any) -> Any:
    """Weight of the squares whose minimum is that of the Huber loss."""
    xp = namespace(residual)
    return xp.minimum(1.0, HUBER / xp.maximum(xp.abs(residual), 1e-12))


def robust_cost(residual: Any, robust: Any) -> Any:
    """Sum (N,) of squares, or of the Huber loss, over residuals (N, B, K). `robust` may be traced."""
    return robust_loss(residual, robust).sum((-1, -2))


def robust_loss(residual: Any, robust: Any) -> Any:
    """Squares of residuals, or their Huber losses; `robust` as of `robust_cost`."""
    xp = namespace(residual)
    if robust is False:
        return xp.square(residual)
    size = xp.abs(residual)
    return xp.where((size > HUBER) & robust, 2 * HUBER * size - HUBER**2, size**2)
