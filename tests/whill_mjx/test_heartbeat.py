"""A long command is never silent: lines while a slow stage runs, refreshed bars, and a line before each stage."""

from __future__ import annotations

import os
import pty
import re
import select
import sys
import threading
from pathlib import Path

import pytest
from tqdm import tqdm

from whill_mjx import train
from whill_mjx.io.heartbeat import Heartbeat, say

pytestmark = pytest.mark.quick


class Lines:
    """What is written, and an event after a number of writes that contain a text."""

    def __init__(self, text: str, count: int) -> None:
        self.written, self.enough = "", threading.Event()
        self._text, self._count = text, count

    def write(self, text: str) -> int:
        self.written += text
        if self.written.count(self._text) >= self._count:
            self.enough.set()
        return len(text)

    def flush(self) -> None:
        pass


def test_a_slow_stage_keeps_writing_its_name_and_its_time(monkeypatch):
    """The stage lasts until the heartbeat has written three times, whatever the machine's speed."""
    lines = Lines("compiling", 4)
    monkeypatch.setattr(sys, "stderr", lines)
    heartbeat = Heartbeat(every_s=0.05)
    heartbeat.stage("compiling, usually 60 s")  # before its thread, which would write first after a pause in between
    with heartbeat:
        assert lines.enough.wait(60), "no sign of life during the slow stage"
    first, *others = lines.written.splitlines()
    assert first == "compiling, usually 60 s"
    assert all(line.endswith(" s: compiling, usually 60 s") for line in others) and len(others) >= 3


def test_an_open_bar_is_refreshed_instead(monkeypatch):
    lines = Lines("training", 5)
    with tqdm(total=10, desc="training", file=lines, mininterval=0, ascii=True):
        with Heartbeat(every_s=0.05):
            assert lines.enough.wait(60), "the bar stood still"


def test_a_bar_is_shown_in_a_terminal_that_states_no_size():
    terminal, other_end = pty.openpty()  # of 0 rows and 0 columns, as in some containers
    with open(other_end, "w") as file, tqdm(total=10, desc="training", file=file, dynamic_ncols=True):
        with Heartbeat(every_s=0.05):
            assert select.select([terminal], [], [], 60)[0], "the bar was not drawn"
            assert b"training" in os.read(terminal, 100)
    os.close(terminal)


def test_the_heartbeat_ends_with_its_block():
    with Heartbeat(every_s=0.05):
        assert any(thread.name == "heartbeat" for thread in threading.enumerate())
    assert not any(thread.name == "heartbeat" for thread in threading.enumerate())


def test_a_line_does_not_tear_an_open_bar(capsys):
    with tqdm(total=10, desc="training", file=sys.stderr, ascii=True):
        say("two evaluations in a row")
    assert "two evaluations in a row" in re.split("[\r\n]+", capsys.readouterr().err)


def test_a_training_shows_signs_of_life_in_a_slow_stage_and_a_line_before_each(monkeypatch, tmp_path):
    """The stage, faked here, lasts until the heartbeat has written about it three times."""
    lines = Lines("compiling", 4)

    def slow(options, preset, vehicle, stage):
        stage("compiling")
        assert lines.enough.wait(60), "no sign of life during the slow stage"
        raise InterruptedError

    monkeypatch.setattr(train, "train_policy", slow)
    monkeypatch.setattr(train, "Heartbeat", lambda: Heartbeat(every_s=0.05))
    monkeypatch.setattr(sys, "stderr", lines)
    with pytest.raises(InterruptedError):
        train.main(train.TrainOptions(out=tmp_path / "run", vehicle=Path("whill_cr_ramp"), preset="smoke"))
    assert lines.written.startswith("preset smoke; devices: ")
