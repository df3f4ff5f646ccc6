"""Every public name says what it is; where it takes or gives arrays, it says their shapes and units."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import inspect
import re
import textwrap

import pytest

PACKAGES = ("whill_mjx", "sysid", "dreamer", "bridge", "bridge.policy")
ARRAY = re.compile(r"\b(Array|ndarray)\b")
SHAPE = re.compile(r"\((?:\.\.\.|[\w+* ]*)(?:, ?(?:\.\.\.|[\w+* ]+))*,?\)")
"""Such as (), (2,), (T, 5) or (H, W, C)."""
WORDS = "m|s|m/s|rad|rad/s|kg|Hz|SI|uint8|int32|bool|pixels|normalised|units?|share|nat"
UNIT = re.compile(rf"\[[^\]]+\]|(?<!')\b({WORDS})\b")
"""A unit, or a word for what has none; no possessive s, and no N, which counts instances."""

pytestmark = pytest.mark.quick


def public():
    """(label, object) of every public name."""
    for package in PACKAGES:
        module = importlib.import_module(package)
        for name in (*getattr(module, "__all__", ()), *getattr(module, "_EXTENDING", ())):
            yield f"{package}.{name}", getattr(module, name)


def callables():
    """(label, function, what it says) of every public function, method and property."""
    for label, thing in public():
        if inspect.isclass(thing):
            for name, member in vars(thing).items():
                function = getattr(member, "__func__", getattr(member, "fget", member))
                field = name in getattr(thing, "__dataclass_fields__", {})  # a function as its default
                if not name.startswith("_") and not field and inspect.isfunction(function):
                    yield f"{label}.{name}", function, inspect.getdoc(member) or ""
        elif inspect.isfunction(thing):
            yield label, thing, inspect.getdoc(thing) or ""


def documented_fields(kind):
    """Name -> (annotation, what stands below or beside it) of the fields that a dataclass defines itself."""
    lines = textwrap.dedent(inspect.getsource(kind)).splitlines()
    body = ast.parse("\n".join(lines)).body[0].body
    found = {}
    for number, node in enumerate(body):
        if not isinstance(node, ast.AnnAssign) or node.target.id.startswith("_"):
            continue
        below = body[number + 1] if number + 1 < len(body) else None
        said = below.value.value if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant) else ""
        beside = " ".join(line.partition("#")[2] for line in lines[node.lineno - 1 : node.end_lineno])
        above = lines[node.lineno - 2].strip().partition("#")[2]
        called = ast.unparse(node.value) if isinstance(node.value, ast.Call) else ""  # parameter("kg", ...)
        found[node.target.id] = ast.unparse(node.annotation), " ".join([said, beside, above, called]).strip()
    inherited = [documented_fields(base) for base in kind.__mro__[1:] if dataclasses.is_dataclass(base)]
    return {name: (annotation, said or next((one[name][1] for one in inherited if name in one), ""))
            for name, (annotation, said) in found.items()}


def records():
    return [(label, thing) for label, thing in public() if inspect.isclass(thing) and dataclasses.is_dataclass(thing)]


def test_every_public_name_says_what_it_is():
    silent = [label for label, thing in public() if not isinstance(thing, str | int | tuple)
              and not (inspect.getdoc(thing if callable(thing) else type(thing)) or "").strip()]
    silent += [label for label, _, said in callables() if not said.strip()]
    assert not silent


def test_functions_say_the_shapes_and_units_of_their_arrays():
    vague = []
    for label, function, said in callables():
        hints = {name: str(hint) for name, hint in getattr(function, "__annotations__", {}).items()}
        arrays = [name for name, hint in hints.items()
                  if ARRAY.search(hint) and "Callable" not in hint and not name.endswith("key")]  # random keys
        if arrays and not (SHAPE.search(said) and UNIT.search(said)):
            vague.append((label, arrays))
    assert not vague


def test_fields_of_records_are_explained_and_arrays_among_them_have_a_shape():
    vague = []
    for label, kind in records():
        said_above = inspect.getdoc(kind) or ""
        for name, (annotation, said) in documented_fields(kind).items():
            named = re.search(rf"\b{name}\b", said_above)
            if not said and not named:
                vague.append(f"{label}.{name}: no word")
            elif re.fullmatch(r"(jax\.Array|np\.ndarray)", annotation) and not SHAPE.search(said + said_above):
                vague.append(f"{label}.{name}: no shape")
    assert not vague
