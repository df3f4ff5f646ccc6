"""Processes and plain ROS nodes on a domain of their own, for the tests of the nodes."""

import contextlib
import fcntl
import itertools
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

from benchmarks.bridge_robot import Robot

ROOT = Path(__file__).resolve().parents[2]


LINGER = 5.0
"""Seconds for which what a test left behind may still speak: a guard stops the vehicle of a node that was killed."""


@contextlib.contextmanager
def free_domain():
    """Hold a ROS domain that no other test of this machine uses now, and none used just before."""
    first = random.randrange(100)
    for domain in (1 + (first + i) % 100 for i in itertools.count()):
        with open(Path(tempfile.gettempdir()) / f"ros-domain-{domain}.lock", "a") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            about = os.fstat(lock.fileno())
            if about.st_size and time.time() - about.st_mtime < LINGER:
                continue
            try:
                yield domain
            finally:
                lock.truncate(0)
                lock.write("used")  # at this time
            return


WAIT = 120
"""Seconds after which a condition counts as one that never comes true; a machine that tests in parallel is slow."""
SIGNAL_AGE = ("--signal-age", "20")
"""Of nodes that drive: on a busy machine an emergency stop may be silent for longer than the usual 0.5 s."""


def commands_per_period(outcome, episode):
    """Commands per image from the first motion of an episode on: before it a standing bridge is silent."""
    within = [t for t, v, _ in outcome["commands"] if episode["began"] <= t <= episode["ended"] and v]
    return len(within) / sum(within[0] <= t <= episode["ended"] for t in outcome["image_times"])


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
        end = time.monotonic() + seconds
        while text not in self.log(name):
            assert time.monotonic() < end and self.processes[name].poll() is None, f"{name}: {self.log(name)}"
            time.sleep(0.05)

    def close(self):
        for peer in self.peers:
            peer.close()
        for process in self.processes.values():
            if process.poll() is None:
                process.kill()
                process.wait()
