"""Commands keep what is compiled for later runs; a folder that is bad, full or the user's own costs nothing else."""

from __future__ import annotations

import os
import subprocess
import sys
import zlib
from dataclasses import dataclass
from pathlib import Path

import jax
import pytest

from whill_mjx.io import command_line, compiled

FOLDER, LEAST = compiled.FOLDER, compiled.LEAST_S
ROOT = Path(__file__).parents[2]
PROGRAM = """
import jax, jax.numpy as jnp
from whill_mjx.io import compiled
compiled.KEPT_S = 0.0
compiled.keep_compiled()
hits = []
jax.monitoring.register_event_listener(lambda name, **about: name.endswith("cache_hits") and hits.append(name))
print(jax.jit(lambda x: x @ x + {add})(jnp.eye(3))[0, 0], len(hits))
"""

pytestmark = pytest.mark.quick


@dataclass
class Options:
    """Of a command that takes none."""


@pytest.fixture
def untold(monkeypatch):
    """JAX without a folder of compiled programs."""
    before = {name: jax.config.values[name] for name in (FOLDER, LEAST)}
    for name in before:
        monkeypatch.delenv(name.upper(), raising=False)
    jax.config.update(FOLDER, None)
    yield
    for name, value in before.items():
        jax.config.update(name, value)
        os.environ.pop(name.upper(), None)  # the fixture monkeypatch puts the old one back


def test_a_command_keeps_programs_in_a_folder_of_the_processors_own_and_tells_its_children(
    untold, tmp_path, monkeypatch
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    command_line.run(Options, lambda _: None, None, args=[])
    (folder,) = (tmp_path / "whill_mjx").iterdir()
    assert jax.config.values[FOLDER] == os.environ[FOLDER.upper()] == str(folder)
    jax.config.update(FOLDER, None)
    del os.environ[FOLDER.upper()]
    monkeypatch.setattr(compiled, "_processor", lambda: "other")
    compiled.keep_compiled()
    assert jax.config.values[FOLDER] == str(tmp_path / "whill_mjx" / "compiled-other")


@pytest.mark.parametrize("by", ["environment", "python"])
def test_a_folder_that_the_user_named_stays(untold, tmp_path, monkeypatch, by):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    if by == "python":
        jax.config.update(FOLDER, str(tmp_path / "mine"))
    else:
        monkeypatch.setenv(FOLDER.upper(), str(tmp_path / "mine"))
    before = jax.config.values[FOLDER]
    compiled.keep_compiled()
    assert jax.config.values[FOLDER] == before and not (tmp_path / "whill_mjx").exists()


def test_a_cache_that_cannot_be_written_is_done_without(untold, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    compiled.keep_compiled()
    assert jax.config.values[FOLDER] is None and FOLDER.upper() not in os.environ


def test_the_longest_unused_programs_make_room(tmp_path):
    for age, name in enumerate(("new", "used", "old", "older")):
        (tmp_path / name).write_bytes(b"y" * 100)
        os.utime(tmp_path / name, (1000.0 - age, 1000.0 - age))
    os.utime(tmp_path / "older", (2000.0, 0.0))  # read just now
    compiled.tidy(tmp_path, most=250)
    assert {path.name for path in tmp_path.iterdir()} == {"new", "older", compiled.CHECKED}
    compiled.tidy(tmp_path, most=0)
    assert {path.name for path in tmp_path.iterdir()} == {compiled.CHECKED}


def test_a_program_that_was_cut_off_is_removed(tmp_path):
    whole = zlib.compress(os.urandom(1000))
    contents = {"whole": whole, "cut": whole[:500], "empty": b"", "other": b"\x28" + whole}
    for name, data in contents.items():
        (tmp_path / name).write_bytes(data)
    compiled.tidy(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"whole", "other", compiled.CHECKED}


def test_a_damaged_or_full_folder_costs_a_compilation_and_no_word(tmp_path):
    def run(add, limit=None):
        words = [sys.executable, "-c", PROGRAM.format(add=add)]
        words = words if limit is None else ["bash", "-c", f'ulimit -f {limit}; exec "$0" "$@"', *words]
        environment = {name: value for name, value in os.environ.items() if name not in (FOLDER.upper(), LEAST.upper())}
        environment |= {"XDG_CACHE_HOME": str(tmp_path)}
        ended = subprocess.run(words, capture_output=True, text=True, env=environment, check=True)
        assert ended.stderr == ""
        return ended.stdout.split()

    assert run(1.0, limit=0) == ["2.0", "0"]  # nothing can be written
    first, again = run(1.0), run(1.0)
    assert first[0] == again[0] == "2.0" and int(again[1]) > int(first[1])
    (folder,) = (tmp_path / "whill_mjx").iterdir()
    for path in folder.glob("*-cache"):
        path.write_bytes(path.read_bytes()[:-20])
    assert run(1.0) == ["2.0", "0"]
