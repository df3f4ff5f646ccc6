"""Names in a class of a user's own that would be passed over without a word."""

from __future__ import annotations

import dataclasses
import difflib
import dis
import inspect
import sys
from collections.abc import Iterable, Iterator
from types import CodeType
from typing import Any

ALIKE = 0.85
"""Similarity (`difflib`) from which a name that nothing reads is taken for a misspelling of the library's."""
LIBRARY = "whill_mjx."
READ = ("LOAD_ATTR", "LOAD_METHOD", "LOAD_NAME", "LOAD_GLOBAL")
"""Instructions of Python that read a name."""
GENERATED = ("__init__", "__repr__", "__eq__", "__hash__", "__setattr__", "__delattr__", "__replace__")
"""Methods that dataclasses write; they read every field."""


def check_own_class(what: str, kind: type, base: type) -> None:
    """Raise ValueError for a name in a class derived from `base` that the library would not see.

    Args:
        what: the class in words, such as "task 'parking'".
        kind: its class; what this package defines is passed over.
        base: the class whose names the library reads.
    """
    own = [one for one in kind.__mro__ if one is not object and not f"{one.__module__}.".startswith(LIBRARY)]
    _check_defaults(what, kind)
    known = [name for name in (*vars(base), *_annotated(base)) if not name.startswith("_")]
    read = _names_read(own)
    for name in dict.fromkeys(name for one in own for name in (*vars(one), *_annotated(one))):
        if name.startswith("_") or name in known or name in read:
            continue
        meant = difflib.get_close_matches(name, known, 1, ALIKE)
        if meant:
            raise ValueError(f"{what}: {name!r} is never used; {meant[0]!r} would be. Call it so, or _{name} if it is "
                             "another.")


def check_fixed(what: str, value: Any) -> None:
    """Raise ValueError for a record with a list or an array in it: compiled programs are found by its hash."""
    try:
        hash(value)
    except TypeError as error:
        raise ValueError(f"{what}: {error}; its fields must be numbers, texts or tuples of them. Give a tuple for an "
                         "array or a list.") from error


def _check_defaults(what: str, kind: type) -> None:
    """Refuse a default without a type: a dataclass would go on with the one of the class above."""
    for field in dataclasses.fields(kind):
        there = getattr(kind, field.name, dataclasses.MISSING)
        if field.default is dataclasses.MISSING or there is field.default:
            continue
        typed = getattr(field.type, "__name__", field.type)
        raise ValueError(f"{what}: its {field.name!r} has no type, so that the default {field.default!r} would stay. "
                         f"Write {field.name}: {typed} = ... in a class with @dataclass(frozen=True).")


def _annotated(kind: type) -> Iterable[str]:
    return inspect.get_annotations(kind)


def _names_read(kinds: list[type]) -> set[str]:
    """Names that functions of the classes and of their modules read."""
    holders = [*kinds, *(sys.modules[one.__module__] for one in kinds if one.__module__ in sys.modules)]
    values = [value for holder in holders for name, value in vars(holder).items() if name not in GENERATED]
    steps = (step for value in values for code in _codes(value) for step in dis.get_instructions(code))
    return {step.argval for step in steps if step.opname in READ}


def _codes(value: Any) -> Iterator[CodeType]:
    """Code of a function, method or property, and of the functions within it."""
    for part in ("__func__", "fget", "func"):
        value = getattr(value, part, value)
    code = value if isinstance(value, CodeType) else getattr(value, "__code__", None)
    if isinstance(code, CodeType):
        yield code
        for constant in code.co_consts:
            if isinstance(constant, CodeType):
                yield from _codes(constant)
