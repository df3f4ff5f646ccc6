"""Fields of `policy.json`, each read together with its rule."""

import math
from collections.abc import Callable, Mapping
from typing import Any

from bridge.policy.parts import EXPORT_AGAIN, PolicyFileError, show


class Fields:
    """A JSON object whose fields are read together with their rule."""

    def __init__(self, name: str, table: Any) -> None:
        self.name, self.table = name, table
        if not isinstance(table, Mapping):
            raise PolicyFileError(f"{name}: is {show(table)}; it must be a JSON object. {EXPORT_AGAIN}.")

    def child(self, key: str) -> "Fields":
        """Return the object in a field."""
        return Fields(f"{self.name} {key}", self.table.get(key))

    def rule(self, key: str, holds: Callable[[Any], bool], text: str) -> Any:
        """Return the value of a field that keeps its rule.

        Raises:
            PolicyFileError: it does not; names the file, the field, the value, the rule and the remedy.
        """
        value = self.table.get(key)
        if not holds(value):
            raise PolicyFileError(f"{self.name}: {key} = {show(value)}, but it {text}. {EXPORT_AGAIN}.")
        return value


def is_integer(value: Any) -> bool:
    """Return whether a value is an integer and no truth value."""
    return isinstance(value, int) and not isinstance(value, bool)


def is_number(value: Any) -> bool:
    """Return whether a value is a finite number; an integer too long for a float is none."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:
        return False


def is_within(limit: float) -> Callable[[Any], bool]:
    return lambda value: is_number(value) and abs(value) <= limit
