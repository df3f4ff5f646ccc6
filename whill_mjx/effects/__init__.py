"""The effects: one physical effect per file, with its card. `EFFECTS` finds one by name; docs/effects.md lists all."""

from whill_mjx.effects.base import Effect
from whill_mjx.effects.registry import (
    EFFECTS,
    about_of,
    card_of,
    equation,
    make_effect,
    make_effects,
    register,
    unregister,
)

__all__ = ["EFFECTS", "Effect", "about_of", "card_of", "equation", "make_effect", "make_effects", "register",
           "unregister"]
