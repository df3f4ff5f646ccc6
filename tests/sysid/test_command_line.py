"""What is compiled is kept for later runs, unless the user or the machine will not have it."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import pytest

from sysid import command_line


@dataclass
class Options:
    """Of a command that takes none."""


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


@pytest.mark.quick
def test_a_stage_is_said_where_a_command_runs_and_nowhere_else(monkeypatch, capsys):
    command_line.stage("unasked")
    assert "unasked" not in capsys.readouterr().err
    monkeypatch.setattr(command_line, "keep_compiled", lambda: None)
    command_line.run(Options, lambda _: command_line.stage("writing the report"), None, args=[])
    assert "writing the report" in capsys.readouterr().err


@pytest.mark.quick
def test_a_bar_of_a_search_that_ends_early_is_full_and_that_of_a_failure_is_not(capsys):
    def last(fail):
        advance, close = command_line.progress_bar(36)
        try:
            advance(20, "refits")
            if fail:
                raise ValueError
        finally:
            close()

    last(fail=False)
    assert "20/20" in capsys.readouterr().err
    with pytest.raises(ValueError):
        last(fail=True)
    assert "20/36" in capsys.readouterr().err.rpartition("\r")[2]
