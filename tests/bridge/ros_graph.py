"""Processes and plain ROS nodes on a domain of their own, for the tests of the nodes."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from benchmarks.bridge_robot import Robot

ROOT = Path(__file__).resolve().parents[2]

WAIT = 120
"""Seconds after which a condition counts as one that never comes true; a machine that tests in parallel is slow."""
SIGNAL_AGE = ("--signal-age", "20")
"""Of nodes that drive: on a busy machine an emergency stop may be silent for longer than the usual 0.5 s."""


def check_pace(outcome, episode):
    """While an episode was driven, about one command came per image.

    The usual gaps are compared: pauses of a busy machine, in which the vehicle stands, lengthen some of them.
    """
    driven = [t for t, v, _ in outcome["commands"] if episode["began"] <= t <= episode["ended"] and v]
    usual = np.median(np.diff([t for t in outcome["image_times"] if driven[0] <= t <= driven[-1]]))
    gaps = np.diff(driven)
    assert np.median(gaps) >= usual / 2.3 and np.quantile(gaps, 0.25) <= usual / 0.3


def taken_for_others(robot):
    """Statuses by which a node of the bridge was taken for another commander.

    Not those of a node whose name is not known yet: on a busy machine it may take long, and then it holds the vehicle.
    """
    nameless = "has other publishers: a node without a name;"
    return [one for one in robot.statuses if "another node dr" in one["reason"]
            or ("another node" in one["reason"] and nameless not in str(one["causes"]))]


def wait_until(condition, told=lambda: "", seconds=WAIT):
    """Wait for a condition and return its value; `told` says what there is where it does not come true."""
    end = time.monotonic() + seconds
    while not (value := condition()):
        assert time.monotonic() < end, told()
        time.sleep(0.05)
    return value


def send_until_disarmed(robot, publisher, make):
    """Send a single command of another node. It is lost where the bridge has not found its sender yet: once more."""
    for _ in range(40):
        publisher.publish(make())
        try:
            return robot.wait_for_status(seconds=3, state="disarmed", reason="another node drove")
        except AssertionError:
            continue
    pytest.fail(f"it did not yield: {robot.statuses[-3:]}")


class Graph:
    """Processes of one ROS domain that end with the test."""

    def __init__(self, folder, domain):
        self.folder, self.domain, self.processes, self.peers = folder, domain, {}, []
        python_path = os.pathsep.join([str(ROOT), str(ROOT / "tests" / "bridge")])
        self.environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "PYTHONPATH": python_path,
                            "ROS_LOG_DIR": str(folder / "log")}

    def start(self, name, *arguments, key=None):
        key = key or name
        if name in ("drive", "manoeuvre") and "--signal-age" not in arguments:
            at = arguments.index("--ros-args") if "--ros-args" in arguments else len(arguments)
            arguments = (*arguments[:at], *SIGNAL_AGE, *arguments[at:])
        log = open(self.folder / f"{key}.log", "w")
        command = [sys.executable, "-m", f"bridge.{name}", *map(str, arguments)]
        self.processes[key] = subprocess.Popen(command, cwd=self.folder, env=self.environment, stdout=log, stderr=log)
        log.close()

    def peer(self, name="peer"):
        """A plain ROS node within this process."""
        peer = Robot(self.domain, name)
        self.peers.append(peer)
        return peer

    def log(self, name):
        return (self.folder / f"{name}.log").read_text()

    def end(self, name, number=signal.SIGTERM):
        """Send a signal and return the exit code."""
        self.processes[name].send_signal(number)
        return self.wait(name)

    def wait(self, name, seconds=WAIT):
        try:
            return self.processes[name].wait(seconds)
        except subprocess.TimeoutExpired:
            pytest.fail(f"{name} did not end in {seconds} s: {self.log(name)}")

    def wait_for(self, name, text, seconds=WAIT):
        """Wait until a process has said something."""
        def said():
            ended = self.processes[name].poll() is not None  # asked before the log is read: its last words count
            there = text in self.log(name)
            assert there or not ended, f"{name}: {self.log(name)}"
            return there

        wait_until(said, lambda: f"{name}: {self.log(name)}", seconds)

    def close(self):
        for peer in self.peers:
            peer.close()
        for process in self.processes.values():
            if process.poll() is None:
                process.kill()
                process.wait()
        for pid in self.left():  # guards that outlive their node: they would speak to the next test on this domain
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def left(self):
        """Processes that those of this test have started and left: they have its folder in their environment."""
        mark = f"ROS_LOG_DIR={self.environment['ROS_LOG_DIR']}\0".encode()
        for path in Path("/proc").glob("[0-9]*/environ"):
            with contextlib.suppress(OSError):
                if mark in path.read_bytes() + b"\0" and int(path.parent.name) != os.getpid():
                    yield int(path.parent.name)
