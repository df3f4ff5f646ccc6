"""Whether faults of time and frames in driving logs are named, and how long a log of an hour takes.

    python -m benchmarks.logs               # 200 faulty and 200 healthy logs, and an hour of driving
    python -m benchmarks.logs --parts faults --count 60 --seed 7

Writes benchmarks/results/logs.json.
"""

from __future__ import annotations

import argparse
import re
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.harness import figure, record
from benchmarks.log_faults import FAULTS, Drive, Fault, Robot, healthy

CLAIM = "Faults of time and frames in driving logs are named, healthy logs are not, and an hour of driving is read fast"
WRONG = re.compile("sign is reversed|check its unit")
"""What no fault here is."""


@dataclass(frozen=True)
class Case:
    """One log with a fault, and what was said of it."""

    fault: Fault
    size: int
    """0 is the largest."""
    said: tuple[str, ...]

    @property
    def named(self) -> bool:
        """Whether the fault is named, and nothing else is said that is not so."""
        return any(re.search(self.fault.says, one) for one in self.said) and not any(map(WRONG.search, self.said))


def write_log(folder: Path, robot: Robot, drives: list[Drive]) -> None:
    """Write drives of a robot as a dataset."""
    from whill_mjx.logs.dataset import COMMAND_HEADER, ODOMETRY_HEADER, POSE_HEADER, write_csv, write_text

    headers = {"command": COMMAND_HEADER, "odometry": ODOMETRY_HEADER, "ground_truth": POSE_HEADER}
    write_text(folder / "dataset.toml", 'schema = 1\nvehicle = "a robot"\nwheel_radius = 0.1\n'
                                        f'track = {robot.track:.3f}\ndrive = "{robot.drive}"\n')
    for number, drive in enumerate(drives):
        for name, table in drive.items():
            write_csv(folder / f"trials/drive_{chr(97 + number)}/{name}.csv", headers[name], table)


def said_of_log(robot: Robot, drives: list[Drive]) -> tuple[str, ...]:
    """What `sysid.inspect` says of a dataset with these drives."""
    from sysid.logs.coverage import sanity
    from sysid.logs.log import load_log

    with TemporaryDirectory() as folder:
        write_log(Path(folder), robot, drives)
        try:
            return tuple(sanity(load_log(folder)))
        except ValueError as error:
            return (str(error),)


def said_of_bag(sent: list[Drive], got: list[Drive]) -> tuple[str, ...]:
    """What `sysid.convert` says of recordings with the times `sent` in the headers, received at the times `got`."""
    from sysid.logs.rosbag import Bag, BagStream, clock_notes, in_order, stream_times

    said: list[str] = []
    for one, other in zip(sent, got, strict=True):
        streams = {}
        for name, table in one.items():
            received = other[name][:, 0] + 1.7e9
            stamped = np.full(len(table), np.nan) if name == "command" else table[:, 0] + 1.7e9 - 0.01
            order = np.argsort(received, kind="stable")  # as readers return messages
            streams[name] = BagStream(f"/{name}", "", received[order], stamped[order], table[order, 1:])
        bag = Bag(Path("bag"), streams)
        try:
            bag = in_order(bag, "receive")
            stream_times(bag, "receive")
            said += clock_notes(bag, "receive")
        except ValueError as error:
            said.append(str(error))
    return tuple(said)


def run_case(fault: Fault, size: int, seed: int) -> Case:
    """Make a log with the fault, and ask what is wrong with it."""
    random = np.random.default_rng(seed)
    robot = healthy(random, fault.turning, whole=True)
    faulty = fault.apply(robot.drives, fault.sizes[size], random)
    return Case(fault, size, said_of_bag(robot.drives, faulty) if fault.receipt else said_of_log(robot, faulty))


def fault_figures(count: int, seed: int, verbose: bool) -> dict[str, Any]:
    """Shares of faults named and of healthy logs that something is said of."""
    cases = []
    for number in range(count):
        fault, size = FAULTS[number % len(FAULTS)], number // len(FAULTS) % 3
        cases.append(run_case(fault, size, 1000 * seed + number))
        progress(f"faulty log {number + 1} of {count}")
        if verbose and (size < 2) != cases[-1].named:
            print(f"\n{number} {fault.name} at {fault.sizes[size]:g} {fault.unit}: {' | '.join(cases[-1].said)}")
    false = []
    for number in range(count):
        random = np.random.default_rng(1000 * seed + 500 + number + 10**6)
        robot = healthy(random)
        drives = robot.drives
        said = said_of_log(robot, drives)
        if all("odometry" in drive for drive in drives):
            said += said_of_bag(drives, [{name: table + np.eye(1, table.shape[1]) * 0.02 for name, table in one.items()}
                                         for one in drives])
        false.append(float(bool(said)))
        progress(f"healthy log {number + 1} of {count}")
        if verbose and said:
            print(f"\nhealthy {number}: {' | '.join(said)}")
    found = {"time_faults_named": figure([float(one.named) for one in cases if one.size < 2], "share"),
             "time_faults_false": figure(false, "share")}
    for entry in found.values():
        entry["value"] = float(np.mean(entry["repeats"]))
    for fault in FAULTS:
        for size, value in enumerate(fault.sizes):
            named = [float(one.named) for one in cases if one.fault is fault and one.size == size]
            if named:
                entry = figure(named, "share")
                found[f"named_{re.sub('[^a-z]+', '_', fault.name)}_{size + 1}"] = {
                    **entry, "value": float(np.mean(named)), "size": f"{value:g} {fault.unit}"}
    return found


def progress(text: str) -> None:
    """Show how far the work is, on a terminal."""
    if sys.stderr.isatty():
        print(f"\r{text}", end="", file=sys.stderr, flush=True)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.logs", description=__doc__.split("\n\n")[0])
    parser.add_argument("--parts", nargs="+", default=["faults"], choices=["faults"])
    parser.add_argument("--count", type=int, default=200, help="faulty logs, and healthy ones")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--dry", action="store_true", help="print what goes wrong, record nothing")
    options = parser.parse_args()
    figures: dict[str, Any] = {}
    if "faults" in options.parts:
        figures |= fault_figures(options.count, options.seed, options.dry)
    for name, one in figures.items():
        print(f"{name}: {one['value']:.3g} {one['unit']} {one.get('size', '')}")
    if not options.dry:
        print(record("logs", CLAIM, figures))


if __name__ == "__main__":
    main()
