"""Stages and bars of the commands are shown while they last."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from sysid import command_line


@dataclass
class Options:
    """Of a command that takes none."""


@pytest.mark.quick
def test_a_stage_is_said_where_a_command_runs_and_nowhere_else(capsys):
    command_line.stage("unasked")
    assert "unasked" not in capsys.readouterr().err
    command_line.run(Options, lambda _: command_line.stage("writing the report"), None, args=[])
    assert "writing the report" in capsys.readouterr().err


@pytest.mark.quick
def test_a_bar_of_a_search_that_ends_early_is_full_and_that_of_a_failure_is_not(capsys):
    def last(fail):
        with command_line.progress_bar(36) as advance:
            advance(20, "refits")
            if fail:
                raise ValueError

    last(fail=False)
    assert "20/20" in capsys.readouterr().err
    with pytest.raises(ValueError):
        last(fail=True)
    assert "20/36" in capsys.readouterr().err.rpartition("\r")[2]
