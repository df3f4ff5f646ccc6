"""What is compiled is kept for later runs, unless the user or the machine will not have it."""

from __future__ import annotations

import jax
import pytest

from sysid import command_line

FOLDER, LEAST = "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"


@pytest.fixture
def untold():
    """JAX without a folder of compiled programs."""
    before = {name: jax.config.values[name] for name in (FOLDER, LEAST)}
    jax.config.update(FOLDER, None)
    yield
    for name, value in before.items():
        jax.config.update(name, value)


@pytest.mark.quick
def test_compiled_programs_go_to_the_users_cache_in_a_folder_of_the_processors_own(untold, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    command_line.keep_compiled()
    (folder,) = (tmp_path / "whill_mjx").iterdir()
    assert jax.config.values[FOLDER] == str(folder)
    jax.config.update(FOLDER, None)
    command_line.keep_compiled()
    assert jax.config.values[FOLDER] == str(folder)
    jax.config.update(FOLDER, None)
    monkeypatch.setattr(command_line, "_processor", lambda: "other")
    command_line.keep_compiled()
    assert jax.config.values[FOLDER] == str(tmp_path / "whill_mjx" / "compiled-other")


@pytest.mark.quick
def test_a_folder_that_the_user_named_stays(untold, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    jax.config.update(FOLDER, str(tmp_path / "mine"))
    command_line.keep_compiled()
    assert jax.config.values[FOLDER] == str(tmp_path / "mine") and not (tmp_path / "whill_mjx").exists()


@pytest.mark.quick
def test_a_cache_that_cannot_be_written_is_done_without(untold, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    command_line.keep_compiled()
    assert jax.config.values[FOLDER] is None
