"""The ROS node that drives a manoeuvre: its player's commands, a recording of each replicate, Enter to arm."""

import argparse
import os
import select
import sys
import time
from pathlib import Path
from typing import Any

from bridge.driving.command_table import PERIOD
from bridge.driving.player import Player
from bridge.driving.vehicle_node import VehicleNode
from bridge.driving.vehicle_time import VehicleTime
from bridge.nodes import ros
from bridge.recording.record_node import RecordNode
from bridge.recording.trial_writer import TrialWriter, left_out


class ManoeuvreNode(VehicleNode):
    """Connects a player to the ROS graph, and records each replicate."""

    def __init__(self, node: Any, player: Player, options: argparse.Namespace) -> None:
        simulated = VehicleTime() if ros.uses_simulated_time(node) else None
        super().__init__(node, player, options, simulated or time.monotonic)
        self.player = player
        self._recorder = RecordNode(node, None, options) if options.dataset else None
        self.trials: list[Path] = []
        """Folders of the replicates that were driven to their end."""
        self._over_since = time.monotonic()
        self._driven_before = 0
        self.failure = ""
        """Why the drive ended early, such as a full disk."""
        self._simulated = 0.0
        if simulated is not None:
            player.clock = lambda _: self._simulated
            ros.subscribe_clock(node, lambda seconds: self._on_clock(simulated, seconds))
        ros.steady_timer(node, PERIOD / 2, self._on_progress)
        self.start()

    def finished(self) -> bool:
        """Return whether all is driven and the vehicle has stood for a moment."""
        over = self.player.finished and self._recording is None
        if not over:
            self._over_since = time.monotonic()
        return bool(self.failure) or time.monotonic() - self._over_since > 1.0

    def _on_clock(self, vehicle_time: VehicleTime, seconds: float) -> None:
        """Take the simulated time, and send the row that is due."""
        vehicle_time.on_clock()
        self._simulated = seconds
        self._on_input(self.now())
        self._on_progress()

    def details(self) -> dict[str, Any]:
        """Return the progress of the manoeuvre."""
        player = self.player
        return {"manoeuvre": {"replicate": min(player.driven + 1, player.repeat), "of": player.repeat,
                              "elapsed": player.elapsed, "seconds": player.table.seconds,
                              "driven": player.driven, "aborted": player.aborted}}

    @property
    def _recording(self) -> TrialWriter | None:
        return self._recorder.writer if self._recorder else None

    def _on_progress(self) -> None:
        """Open a recording when a replicate begins, close it when it ends; heed Enter in the terminal."""
        player, recorder = self.player, self._recorder
        if _enter_was_pressed():
            self._on_rearm(None)
        if recorder is None:
            return
        if recorder.failure:
            self.supervisor.latch("the recording failed")
            self.failure = str(recorder.failure)
        elif player.elapsed is not None and recorder.writer is None:
            self._driven_before = player.driven
            try:
                recorder.writer = TrialWriter(self.options.dataset, self._trial_name())
                recorder.writer.begin(recorder.now() - player.since_start(self.now()))
            except (OSError, ValueError) as error:
                self.supervisor.latch("the recording failed")
                self.failure = str(error)
        elif recorder.writer is not None and player.elapsed is None:
            self._end_recording(recorder)

    def _end_recording(self, recorder: RecordNode) -> None:
        """Make a trial of a replicate that was driven to its end, and put any other one aside."""
        writer, recorder.writer = recorder.writer, None
        try:
            if self.player.driven > self._driven_before:
                self.trials.append(writer.close())
                self.node.get_logger().info(f"{self.trials[-1]}: rows {writer.rows}")
                for line in left_out(writer.left_out):
                    self.node.get_logger().warning(line)
            else:
                aside = writer.put_aside()
                self.node.get_logger().warning(f"stopped on the way; what was recorded is in {aside}")
        except OSError as error:
            self.supervisor.latch("the recording failed")
            self.failure = self.failure or str(error)

    def close(self) -> None:
        """End the node, and the recording of a replicate that is on its way."""
        with ros.undisturbed():
            super().close()
            if self._recorder is not None and self._recorder.writer is not None:
                self._end_recording(self._recorder)

    def _trial_name(self) -> str:
        return f"{self.options.trial}_{self.options.first + self.player.driven}"


def _enter_was_pressed() -> bool:
    """Return whether the operator pressed Enter in the terminal; False where there is no terminal."""
    if not sys.stdin or not sys.stdin.isatty():
        return False
    try:
        in_front = os.getpgrp() == os.tcgetpgrp(sys.stdin.fileno())
    except OSError:  # not the terminal of this session, as after setsid
        return False
    ready, _, _ = select.select([sys.stdin], [], [], 0) if in_front else ([], [], [])
    line = sys.stdin.readline() if ready else ""
    return line.endswith("\n") and not line.strip()  # the end of the input, Ctrl-D, is no Enter
