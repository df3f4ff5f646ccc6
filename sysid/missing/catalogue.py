"""The hypotheses of the closed loop, from the cards of the effects (`whill_mjx.effects.card`).

Every hypothesis has coordinates q: q = 0 without the effect, and |q| = 1 at a size that is small but noticeable on a
vehicle of this mass and track. That serves effects that vanish at 0, at 1 and at infinity alike.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np

from whill_mjx.effects import EFFECTS, Effect, make_effects
from whill_mjx.effects.base import place_of
from whill_mjx.effects.card import Axis, Falsifier, Scale
from whill_mjx.vehicle.parameters import describe, get_values, set_values
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.types import VehicleParams

PARAMETER = "pose_delay.delay"

OUTSIDE = "outside"  # place of the effects on a pose that is measured from outside
LEVELS = (0.5, 1.0, 2.0, 4.0, 8.0)  # sizes at which one-sided effects are tried; two-sided ones are at -1 and 1


@dataclass(frozen=True)
class Hypothesis:
    """One effect with some of its parameters freed."""

    effect: str  # canonical name
    axes: tuple[Axis, ...]
    variant: str = ""  # distinguishes the hypotheses of one effect
    kind: str = "effect"  # "parameter_shift" where the axes are base parameters of the vehicle
    constants: tuple[tuple[str, float], ...] = ()  # other parameters and the values they take
    @property
    def key(self) -> str:
        return f"{self.effect}/{self.variant}" if self.variant else self.effect

    @property
    def signed(self) -> bool:
        return all(axis.signed for axis in self.axes)

    @property
    def main(self) -> list[int]:
        """Axes that do something by themselves."""
        return [i for i, axis in enumerate(self.axes) if not axis.dependent]

    def values(self, q: np.ndarray, base: Mapping[str, float]) -> dict[str, float]:
        """Parameter values at coordinates q (k,), given the base values of all parameters."""
        found = dict(self.constants)
        for axis, size in zip(self.axes, np.asarray(q, float), strict=True):
            start = base[axis.parameter]
            if axis.form == "inverse":
                found[axis.parameter] = axis.unit / size if size > 1e-6 else float("inf")
            elif axis.form == "factor":
                found[axis.parameter] = start * float(np.exp(axis.unit * size))
            elif axis.form == "moment":
                mass = max(found[self.axes[0].parameter], 1e-3)
                found[axis.parameter] = float(np.clip(axis.unit * size / mass, -axis.reach, axis.reach))
            elif axis.form == "along":
                found[axis.parameter] = start + axis.unit * size * float(q[0])
            else:
                found[axis.parameter] = start + axis.unit * size
        return found


def hypotheses(spec: VehicleSpec, params: VehicleParams) -> tuple[Hypothesis, ...]:
    """All hypotheses for a vehicle, from the cards of the effects that act in a simulated drive. Sizes scale with the
    spec's weight, track and speed; those about parameters that the base model `params` does not have are left out."""
    have = frozenset(describe(params))
    kinds = [kind for kind in in_order() if place_of(kind) != OUTSIDE]
    return tuple(one for kind in kinds for one in of_card(kind, Scale(spec, have)))


def outside_hypotheses(spec: VehicleSpec, params: VehicleParams, fitted: Collection[str]) -> tuple[Hypothesis, ...]:
    """Hypotheses about the pose that is measured from outside; one about parameters that the base fit has freed
    (`fitted`) is two-sided around the fitted value."""
    scale = Scale(spec, frozenset(describe(params)))
    found = [one for kind in in_order() if place_of(kind) == OUTSIDE for one in of_card(kind, scale)]
    return tuple(replace(one, kind="parameter_shift", axes=tuple(replace(axis, signed=True) for axis in one.axes))
                 if {axis.parameter for axis in one.axes} <= set(fitted) else one for one in found)


def in_order() -> list[type[Effect]]:
    """All effects in the order of their hypotheses, on which the random draws of the search depend."""
    return sorted(EFFECTS.values(), key=lambda kind: kind.card.order)


def of_card(kind: type[Effect], scale: Scale) -> list[Hypothesis]:
    """The hypotheses of one effect for a vehicle, without those about parameters that its base model lacks."""
    found = []
    for variant in kind.card.variants_of(scale):
        axes = tuple(replace(axis, parameter=_dotted(kind, axis.parameter)) for axis in variant.axes)
        constants = tuple((_dotted(kind, name), value) for name, value in variant.constants)
        one = Hypothesis(kind.name, axes, variant.name, variant.kind, constants)
        if one.kind == "effect" or all(one.axes[i].parameter in scale.parameters for i in one.main):
            found.append(one)
    return found


def falsifiers() -> dict[str, tuple[Falsifier, ...]]:
    """What the law of each effect forbids, by its name, in the order of the hypotheses."""
    return {kind.name: kind.card.forbids for kind in in_order() if kind.card.forbids}


def _dotted(kind: type[Effect], parameter: str) -> str:
    """The full name of a parameter on an effect's card."""
    return parameter if "." in parameter else f"{kind.name}.{parameter}"


def with_catalogue(params: VehicleParams, found: tuple[Hypothesis, ...]) -> VehicleParams:
    """The vehicle with every effect of the hypotheses at values that do not change its motion: its neutral ones, and
    sizes in proportion to the vehicle (`Axis.start`)."""
    have = {effect.name for effect in params.effects}
    added = {axis.parameter.partition(".")[0] for one in found for axis in one.axes} - have - {"body"}
    sizes = {axis.parameter: axis.start for one in found for axis in one.axes
             if axis.start is not None and axis.parameter.partition(".")[0] in added}
    full = VehicleParams(params.body, (*params.effects, *make_effects(added)))
    return set_values(full, list(sizes), jnp.asarray(list(sizes.values()), jnp.result_type(float)))


def base_values(params: VehicleParams) -> dict[str, float]:
    """Every parameter of a vehicle by name."""
    names = list(describe(params))
    return dict(zip(names, np.asarray(get_values(params, names), float).tolist(), strict=True))
