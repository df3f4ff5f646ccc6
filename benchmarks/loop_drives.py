"""Drives of the contact plant over ROS topics, by the bridge's own commands: one process each, and an operator."""

from __future__ import annotations

import contextlib
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.bridge_robot import Robot, environment_of
from bridge.episodes import EpisodeClient

PATIENCE = 120.0
"""Seconds that a process may take to start, and a replicate to go on."""
ARMING = 10.0
"""Seconds after which an arming counts as not heard."""
TRIES = 30
"""Times that a replicate may be stopped on its way, such as by the guard on a busy computer."""
SLEW = ("10", "20")
"""Steepest change of the commands [m/s2, rad/s2]: nobody sits on the plant, and steps show more of a vehicle."""
SPACE = ("60", "60")
"""Floor of the plant's hall [m]."""


class StageError(RuntimeError):
    """A process of a stage that went wrong, with its log."""


@dataclass(frozen=True)
class Plan:
    """One manoeuvre to drive."""

    name: str
    commands: Path
    """CSV file t, v, omega."""
    replicates: int
    start: dict[str, float] | None = None
    """x, y [m], yaw [rad] in the room; None: drawn for each trial."""
    check: tuple[str, ...] = ()
    """Further options of `bridge.manoeuvre`."""


class Station:
    """A ROS domain of this computer with the processes of one stage, which end with it."""

    def __init__(self, domain: int, logs: Path) -> None:
        self.domain, self._logs = domain, logs
        logs.mkdir(parents=True, exist_ok=True)
        self._environment = {**environment_of(domain), "ROS_LOG_DIR": str(logs)}
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def log(self, name: str) -> Path:
        """Where a process writes."""
        return self._logs / f"{name}.log"

    def start(self, name: str, module: str, *arguments: str) -> subprocess.Popen[bytes]:
        """Start `python -m module` with its output in the log of that name."""
        with open(self.log(name), "ab") as log:
            command = [sys.executable, "-m", module, *arguments]
            self._running[name] = subprocess.Popen(command, env=self._environment, stdout=log, stderr=log)
        return self._running[name]

    def end(self, name: str, wait: float = 60.0) -> int:
        """End a process in order; return its exit code."""
        process = self._running.pop(name)
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
        try:
            return process.wait(wait)
        except subprocess.TimeoutExpired:
            process.kill()
            return process.wait()

    def close(self) -> None:
        """End all that runs; each is asked first, so that none is left where this process has little time."""
        for process in self._running.values():
            if process.poll() is None:
                process.terminate()
        for name in list(self._running):
            self.end(name, 10)


@contextlib.contextmanager
def station(domain: int, logs: Path) -> Iterator[Station]:
    """A station that is closed in the end."""
    here = Station(domain, logs)
    try:
        yield here
    finally:
        here.close()


def drive_plans(here: Station, plans: Sequence[Plan], dataset: Path, plant: Sequence[str], record: Sequence[str]
                ) -> None:
    """Drive manoeuvres with `bridge.manoeuvre` on one plant, and record them; what is recorded already is left.

    Args:
        here: where the processes run.
        plans: what is driven.
        dataset: folder to record into.
        plant: options of `benchmarks.plant.robot`.
        record: options of `bridge.manoeuvre` on what dataset.toml says.

    Raises:
        StageError: a process ended early, or a replicate was stopped again and again.
    """
    missing = [(number, plan, recorded(dataset, plan)) for number, plan in enumerate(plans)]
    missing = [one for one in missing if one[2] < one[1].replicates]
    if not missing:
        return
    here.log("plant").unlink(missing_ok=True)
    process = here.start("plant", "benchmarks.plant.robot", *plant)
    client = EpisodeClient(_port(here, process))
    operator = Operator(here, client, dataset, record)
    try:
        for number, plan, done in missing:
            operator.drive(plan, done, 100 * (number + 1))
    finally:
        operator.robot.close()
        client.close()
        here.end("plant")


class Operator:
    """Brings the vehicle back to each start, and arms."""

    def __init__(self, here: Station, client: EpisodeClient, dataset: Path, record: Sequence[str]) -> None:
        self.robot = Robot(here.domain, "operator")
        self.robot.watch()
        self._here, self._client, self._dataset, self._record = here, client, dataset, record

    def drive(self, plan: Plan, done: int, index: int) -> None:
        """Drive the replicates of a manoeuvre that are missing; `index` numbers its trials for the plant."""
        here, robot = self._here, self.robot
        robot.statuses.clear()
        left = plan.replicates - done
        name = f"manoeuvre_{plan.name}"
        process = here.start(name, "bridge.manoeuvre", str(plan.commands), "--trial", plan.name, "--dataset",
                             str(self._dataset), "--first", str(done + 1), "--repeat", str(left), "--space", *SPACE,
                             "--slew", *SLEW, "--base", "generic", "--time", "stamp", *plan.check, *self._record,
                             "--ros-args", "-p", "use_sim_time:=true")
        refused = 0
        try:
            while self._progress[0] < left and process.poll() is None:
                robot.wait_until(lambda _: self._is_ready(process), PATIENCE)
                before = self._progress
                if before[1] + refused > TRIES:
                    raise StageError(f"{plan.name} was stopped {before[1]} times; see {here.log(name)}")
                if process.poll() is None:
                    self._client.call("reset", seed=index + done + before[0], **(plan.start or {}))
                    robot.arm()
                    if not self._moves(process, before):
                        refused += 1
                        continue
                    robot.wait_until(self._has_ended(process, before), PATIENCE)
        except AssertionError as error:
            raise StageError(f"bridge.manoeuvre of {plan.name} does not go on ({error}); see "
                             f"{here.log(name)}") from None
        code = process.wait(PATIENCE)
        if code:
            raise StageError(f"bridge.manoeuvre of {plan.name} ended with {code}: {last_line(here.log(name))}; see "
                             f"{here.log(name)}")

    def _has_ended(self, process: subprocess.Popen[bytes], before: tuple[int, int]) -> Callable[[Robot], bool]:
        """Return what says whether the replicate is driven or stopped."""
        return lambda _: self._progress != before or process.poll() is not None

    @property
    def _progress(self) -> tuple[int, int]:
        """Replicates that were driven, and stopped."""
        state: dict[str, Any] = self.robot.statuses[-1]["manoeuvre"] if self.robot.statuses else {}
        return int(state.get("driven", 0)), int(state.get("aborted", 0))

    def _is_ready(self, process: subprocess.Popen[bytes]) -> bool:
        """Whether the next replicate may be armed, or none comes any more."""
        last = self.robot.statuses[-1] if self.robot.statuses else {"state": ""}
        return process.poll() is not None or last["state"] == "disarmed" and not last["holds"]

    def _moves(self, process: subprocess.Popen[bytes], before: tuple[int, int]) -> bool:
        """Whether the arming was heard: a hold that comes back in between refuses it."""
        def heard(robot: Robot) -> bool:
            return self._progress != before or process.poll() is not None or robot.statuses[-1]["state"] == "driving"

        try:
            return bool(self.robot.wait_until(heard, ARMING))
        except AssertionError:
            return False


def recorded(dataset: Path, plan: Plan) -> int:
    """Replicates of a plan that are recorded."""
    count = 0
    while (dataset / "trials" / f"{plan.name}_{count + 1}").is_dir():
        count += 1
    return count


def _port(here: Station, process: subprocess.Popen[bytes]) -> int:
    """The port that a plant prints at its start."""
    end, log = time.monotonic() + PATIENCE, here.log("plant")
    while not (found := re.search(r"\bport (\d+)\b", log.read_text())):
        if process.poll() is not None or time.monotonic() > end:
            raise StageError(f"the plant did not start: {last_line(log)}; see {log}")
        time.sleep(0.05)
    return int(found[1])


def last_line(log: Path) -> str:
    """The last line of a log that is not empty."""
    lines = [line.strip() for line in log.read_text(errors="replace").replace("\r", "\n").splitlines() if line.strip()]
    return lines[-1] if lines else "nothing was printed"
