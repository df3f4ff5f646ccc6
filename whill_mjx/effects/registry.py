"""All known effects by name: those of this package, of installed packages, and those that a program registers.

An installed package offers effects by entry points of the group `whill_mjx.effects`, one for each class:

    [project.entry-points."whill_mjx.effects"]
    my_effect = "my_package.my_module:MyEffect"
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable
from dataclasses import is_dataclass
from types import ModuleType
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.effects.base import PLACES, Effect, place_of
from whill_mjx.effects.card import Card
from whill_mjx.io.fields import check, parameter_field
from whill_mjx.io.registry import Registry
from whill_mjx.vehicle.types import Parameter, parameters_of

Kind = TypeVar("Kind", bound=type[Effect])


def register(kind: Kind) -> Kind:
    """Make an effect known by its name to vehicle files, fits and the closed loop. Also a decorator of its class.

    Raises:
        TypeError: it is no effect, or acts at none or several places.
        ValueError: its name, a parameter or its card is wrong, or another effect has its name.
    """
    EFFECTS.add(kind)
    return kind


def unregister(name: str) -> None:
    """Forget an effect that was registered; KeyError where there is none of this name."""
    EFFECTS.remove(name)


def effects_in(module: ModuleType) -> list[type[Effect]]:
    """The effects that a module defines itself."""
    kinds = [kind for _, kind in inspect.getmembers(module, inspect.isclass) if issubclass(kind, Effect)]
    return [kind for kind in kinds if kind.name and kind.__module__ == module.__name__]


def check_effect(kind: Any, where: str = "") -> type[Effect]:
    """The class, if it is a complete effect; TypeError or ValueError names the rule and the remedy."""
    if not (isinstance(kind, type) and issubclass(kind, Effect) and is_dataclass(kind)):
        raise TypeError(f"{kind!r} is not an effect. Derive it from whill_mjx.effects.base.Effect and decorate it with "
                        "flax.struct.dataclass.")
    place_of(kind)
    about = parameters_of(kind)
    if not kind.name.isidentifier() or kind.name == "body":
        raise ValueError(f"{kind.__qualname__}: the name {kind.name!r} must be an identifier other than 'body'.")
    if not about:
        raise ValueError(f"effect {kind.name!r} has no parameter. Declare its fields with "
                         "whill_mjx.vehicle.types.parameter.")
    named = set(kind.typical) | set(kind.card.mirrored)
    if not callable(kind.card.variants):
        named |= {axis.parameter for variant in kind.card.variants for axis in variant.axes}
    unknown = sorted(one for one in named if "." not in one and one not in about)
    if unknown:
        raise ValueError(f"effect {kind.name!r} has no parameter {unknown[0]!r} (known: {', '.join(about)}). Correct "
                         "its card or its usual values.")
    for field, one in about.items():
        _check_range(f"effect {kind.name!r}: the range of {field}", (one.low, one.high))
    for field, usual in kind.typical.items():
        _check_range(f"effect {kind.name!r}: the usual values of {field}", usual)
    return kind


def _check_range(what: str, ends: Any) -> None:
    """Raise ValueError unless these are a lower and an upper number, finite."""
    try:
        low, high = ends
        right = isinstance(low + high, (int, float)) and np.isfinite([low, high]).all() and low <= high
    except (TypeError, ValueError):
        right = False
    if not right:
        raise ValueError(f"{what} must be two finite numbers, the lower one first; got {ends!r}. Correct its class.")


def all_effects() -> Registry[type[Effect]]:
    """A registry of all effects that are installed."""
    return Registry("effect", "whill_mjx.effects", __file__, effects_in, check_effect)


EFFECTS = all_effects()
"""Every known effect by name; docs/effects.md lists those of this package."""


def make_effect(name: str, **values: float) -> Effect:
    """The effect of this name with arrays as leaves; parameters that are not given are neutral.

    Args:
        name: of a known effect.
        values: by parameter, in its unit. Numbers must lie where a vehicle file may have them; arrays of JAX are taken
            as they are.

    Raises:
        ValueError: no such effect, or no such parameter; names the known ones. Or a number out of its range.
    """
    known = known_parameters(name, values)
    for field, value in values.items():
        if not isinstance(value, jax.Array):
            about = known[field]
            allowed = parameter_field(f"{name}.{field}", about.unit, about.low, about.high, about.neutral)
            for number in np.unique(value) if isinstance(value, np.ndarray) else (value,):
                check(f"effect {name!r}", allowed, number, field)
    effect = EFFECTS[name](**values)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype=jnp.result_type(float)), effect)


def known_parameters(name: str, used: Iterable[str] = ()) -> dict[str, Parameter]:
    """The parameters of the effect of this name.

    Raises:
        ValueError: no such effect, or one of the used parameters is none of it; names the known ones.
    """
    if name not in EFFECTS:
        raise ValueError(f"unknown effect {name!r} (known: {', '.join(sorted(EFFECTS))}). Correct the name.")
    known = parameters_of(EFFECTS[name])
    for field in used:
        if field not in known:
            raise ValueError(f"effect {name!r} has no parameter {field!r} (known: {', '.join(known)}). Correct it.")
    return known


def make_effects(names: Iterable[str]) -> tuple[Effect, ...]:
    """The neutral effects of these names, each once, in the order of a vehicle: by place, then as in `EFFECTS`."""
    order = list(EFFECTS)
    effects = [make_effect(name) for name in dict.fromkeys(names)]
    return tuple(sorted(effects, key=lambda effect: (PLACES.index(place_of(effect)), order.index(effect.name))))


def equation(kind: type[Effect]) -> str:
    """The equation of an effect in one line: the first paragraph of its docstring, without the source."""
    return " ".join((kind.__doc__ or "").split("\n\n")[0].split()).partition(" Source:")[0]


def about_of(parameter: str) -> Parameter:
    """What is known of a parameter EFFECT.NAME before any data."""
    effect, _, name = parameter.partition(".")
    return parameters_of(EFFECTS[effect])[name]


def card_of(name: str) -> Card:
    """The card of an effect; a blank one for a name that is no effect."""
    return EFFECTS[name].card if name in EFFECTS else Card()
