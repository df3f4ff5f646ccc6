"""Python looks for garbage less often in commands, and not at all while JAX traces."""

from __future__ import annotations

import gc
from dataclasses import dataclass

import jax
import pytest

from whill_mjx.io import command_line
from whill_mjx.io.garbage import undisturbed

pytestmark = pytest.mark.quick


@dataclass
class Options:
    """Of a command that takes none."""


@pytest.fixture
def usual():
    before = gc.get_threshold()
    gc.set_threshold(700, 10, 10)
    yield
    gc.set_threshold(*before)


def test_a_command_searches_for_garbage_less_often_than_python_does_by_default(usual):
    seen = []
    command_line.run(Options, lambda _: seen.append(gc.get_threshold()), None, args=[])
    assert seen[0][0] > 10_000 and seen[0][1:] == (10, 10)


def test_a_process_that_never_searches_is_left_so(usual):
    gc.set_threshold(0)
    command_line.run(Options, lambda _: None, None, args=[])
    assert gc.get_threshold()[0] == 0


def test_nothing_is_searched_while_a_function_is_traced_and_all_is_as_before_afterwards():
    seen = []

    def function(x):
        seen.append(gc.isenabled())
        if len(seen) == 2:
            raise ValueError("of the function")
        return x + 1

    program = jax.jit(undisturbed(function))
    assert program(1) == 2 and program(2) == 3
    assert seen == [False] and gc.isenabled()
    with pytest.raises(ValueError, match="of the function"):
        program(1.0)
    assert gc.isenabled()
    gc.disable()
    try:
        program(True)
        assert not gc.isenabled()
    finally:
        gc.enable()
