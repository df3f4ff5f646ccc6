"""The five manoeuvres of the paper as commands of a log; whill_mjx/logs/manoeuvres.py describes them."""

from __future__ import annotations

from sysid.logs.log import Command
from whill_mjx.logs.manoeuvres import PAPER_MANOEUVRES as SCENARIOS
from whill_mjx.logs.manoeuvres import Scenario, command_table

__all__ = ["SCENARIOS", "Scenario", "command_sequence"]


def command_sequence(name: str, scenario: Scenario | None = None) -> Command:
    """Commands of a manoeuvre every `dt`; ValueError names the known ones."""
    return Command(*command_table(name, scenario).T)
