"""Effects as somebody writes them: NAME, or NAME:PARAMETER=VALUE,..."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from whill_mjx.effects import EFFECTS, make_effect
from whill_mjx.effects.registry import known_parameters
from whill_mjx.vehicle.types import VehicleParams


def with_effects(params: VehicleParams, texts: Sequence[str]) -> VehicleParams:
    """The vehicle with effects given as NAME or NAME:PARAMETER=VALUE,...

    An effect that the vehicle has keeps its place and the values that are not given; others are appended, so that
    those of place `actuation` act behind the drive.
    """
    effects = list(params.effects)
    for text in texts:
        name, values = parse_effect(text)
        if not (values or EFFECTS[name].typical):
            raise ValueError(f"effect {text!r}: {name} has no usual values, so it would do nothing. Give some, as "
                             f"{name}:{next(iter(known_parameters(name)))}=VALUE.")
        new = make_effect(name, **(values or {key: high for key, (_, high) in EFFECTS[name].typical.items()}))
        index = next((i for i, effect in enumerate(effects) if effect.name == name), None)
        if index is None:
            effects.append(new)
        else:
            effects[index] = replace(effects[index], **{key: getattr(new, key) for key in values})
    return replace(params, effects=tuple(effects))


def parse_effect(text: str) -> tuple[str, dict[str, float]]:
    """Name and values of "NAME:PARAMETER=VALUE,..."; ValueError names what is wrong and what is known."""
    name, colon, rest = text.partition(":")
    if colon and not rest:
        raise ValueError(f"effect {text!r}: no parameter follows the colon. Write it like command_delay:delay=0.2.")
    values: dict[str, float] = {}
    for pair in filter(None, rest.split(",")):
        key, equals, number = pair.partition("=")
        if key in values:
            raise ValueError(f"effect {text!r}: {key} is given twice. Leave one out.")
        try:
            values[key] = float(number)
        except ValueError:
            raise ValueError(
                f"effect {text!r}: {pair!r} is not PARAMETER=NUMBER{'' if equals else ' (no =)'}. "
                "Write it like command_delay:delay=0.2."
            ) from None
    known = known_parameters(name, values)
    for key, value in values.items():
        about = known[key]
        if not (about.low <= value <= about.high or value == about.neutral):
            raise ValueError(
                f"effect {text!r}: {key} is {value:g} {about.unit}; it must lie within {about.low:g} to "
                f"{about.high:g}, or be {about.neutral:g} for no effect. Check the unit."
            )
    return name, values
