"""Whether faults of time and frames in driving logs are named, and how long a log of an hour takes.

    python -m benchmarks.logs               # 200 faulty and 200 healthy logs, fits to some, and an hour of driving
    python -m benchmarks.logs --parts faults --count 60 --seed 7

Writes benchmarks/results/logs.json.
"""

from __future__ import annotations

import re
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.harness import figure, record
from benchmarks.log_faults import FAULTS, ROOT, Drive, Fault, Robot, healthy
from bridge.nodes.options import Parser, whole
from whill_mjx.io.command_line import guarded

CLAIM = "Strangers' logs and robots: faults that are named, calibration, robot files that load."
FITTED = ("clock set forward", "clock fast", "commands pause", "outside pose late", "tracked body turned",
          "odometry reset")
"""Faults whose harm to a fit is measured, at all three sizes."""
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
    from sysid.logs.bags.clocks import clock_notes, in_order, stream_times
    from sysid.logs.bags.recording import Bag, BagStream

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


def slow_unicycle() -> Any:
    """A small model whose fit takes seconds: a unicycle that follows its commands late, scaled and with a lag."""
    import jax.numpy as jnp

    from sysid import function_model

    dt = 0.02

    def step(p: dict[str, Any], state: Any, command: Any) -> Any:
        share = dt / (dt + p["lag"])
        v = state[3] + share * (p["distance"] * command[0] - state[3])
        omega = state[4] + share * (p["turn"] * command[1] - state[4])
        middle = state[2] + omega * dt / 2
        return jnp.stack([state[0] + dt * v * jnp.cos(middle), state[1] + dt * v * jnp.sin(middle),
                          state[2] + dt * omega, v, omega])

    return function_model(step, {"distance": (1.0, 0.5, 1.5), "turn": (1.0, 0.5, 1.5), "lag": (0.15, 0.0, 1.0, "s")},
                          dt=dt, name="slow unicycle", effects=("command_delay", "pose_delay"))


def fitted_error(robot: Robot, drives: list[Drive]) -> float:
    """Position error [m] on healthy drives of a robot of the model fitted to some drives, as `sysid.fit` reads them;
    nan where these are refused."""
    from sysid.logs.loaders import load_any
    from sysid.logs.metrics import score
    from sysid.search.fitting import fit_log, predict
    from sysid.search.settings import FitConfig

    with TemporaryDirectory() as folder:
        faulty, whole = Path(folder) / "faulty", Path(folder) / "whole"
        write_log(faulty, robot, drives)
        write_log(whole, robot, robot.drives)
        try:
            fit = fit_log(load_any(faulty), FitConfig(method="lm", starts=1, quick=True, physics_dt=0.02),
                          model=slow_unicycle())
        except ValueError:
            return float("nan")
        trials = load_any(whole).trials
        _, replayed = predict(fit, trials)
        errors = [score(trial, one)["ground_truth"]["trajectory"] for trial, one in zip(trials, replayed, strict=True)]
    return float(np.mean([error for error in errors if error is not None]))


def harm_figures(repeats: int, seed: int) -> Iterator[dict[str, Any]]:
    """How many times the error of a fit to a healthy log that of a fit to the same log with a fault is, by size; after
    each robot those of all so far."""
    found: dict[str, list[float]] = {}
    sizes = {f"fit_error_{re.sub('[^a-z]+', '_', fault.name)}_{k + 1}": f"{value:g} {fault.unit}"
             for fault in FAULTS for k, value in enumerate(fault.sizes)}
    for number in range(repeats):
        random = np.random.default_rng(1000 * seed + number)
        robot = healthy(random, turning=1.0, whole=True)
        usual = fitted_error(robot, robot.drives)
        for fault in (one for one in FAULTS if one.name in FITTED):
            for size, value in enumerate(fault.sizes):
                drives = fault.apply(robot.drives, value, np.random.default_rng(number))
                times = fitted_error(robot, drives) / usual
                progress(f"robot {number + 1} of {repeats}, {fault.name} at {value:g} {fault.unit}: {times:.2f} times")
                found.setdefault(f"fit_error_{re.sub('[^a-z]+', '_', fault.name)}_{size + 1}", []).append(times)
        fits = {name: [one for one in values if np.isfinite(one)] for name, values in found.items()}
        yield {name: {**figure(values, "times the error of a fit to the healthy log"), "size": sizes[name]}
               for name, values in fits.items() if values} | {
            name.replace("error", "refused"): {**figure([1.0 - np.isfinite(one) for one in values], "share"),
                                               "size": sizes[name]}
            for name, values in found.items() if len(fits[name]) < len(values)}


def write_hour(path: Path, seconds: float = 3600.0) -> None:
    """Write a bag: odometry at 50 Hz and commands at 10 Hz, of drives of 20 s with 5 s of standstill between them."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds = {name: store.types[f"{name.split('/')[0]}/msg/{name.split('/')[1]}"] for name in (
        "std_msgs/Header", "builtin_interfaces/Time", "geometry_msgs/Vector3", "geometry_msgs/Twist",
        "geometry_msgs/Point", "geometry_msgs/Quaternion", "geometry_msgs/Pose", "geometry_msgs/PoseWithCovariance",
        "geometry_msgs/TwistWithCovariance", "nav_msgs/Odometry")}
    blank = np.zeros(36)

    def twist(v: float, omega: float) -> Any:
        return kinds["geometry_msgs/Twist"](linear=kinds["geometry_msgs/Vector3"](x=v, y=0.0, z=0.0),
                                            angular=kinds["geometry_msgs/Vector3"](x=0.0, y=0.0, z=omega))

    t = np.arange(0.0, seconds, 0.02)
    going = t % 25.0 > 5.0
    v, omega = 0.6 * going * np.sin(0.4 * t) ** 2, 0.5 * going * np.sin(0.7 * t)
    late_v, late_omega = (np.interp(t - 0.2, t, one) for one in (v, omega))
    yaw = np.cumsum(late_omega) * 0.02
    x, y = np.cumsum(late_v * np.cos(yaw)) * 0.02, np.cumsum(late_v * np.sin(yaw)) * 0.02
    with Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        commands = writer.add_connection("/cmd_vel", "geometry_msgs/msg/Twist", typestore=store)
        odometry = writer.add_connection("/odom", "nav_msgs/msg/Odometry", typestore=store)
        for k, now in enumerate(t):
            stamp = int((1.7e9 + now) * 1e9)
            if k % 5 == 0:
                writer.write(commands, stamp, store.serialize_cdr(twist(v[k], omega[k]), "geometry_msgs/msg/Twist"))
            time_of = kinds["builtin_interfaces/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
            pose = kinds["geometry_msgs/Pose"](
                position=kinds["geometry_msgs/Point"](x=x[k], y=y[k], z=0.0),
                orientation=kinds["geometry_msgs/Quaternion"](x=0.0, y=0.0, z=np.sin(yaw[k] / 2), w=np.cos(yaw[k] / 2)))
            message = kinds["nav_msgs/Odometry"](
                header=kinds["std_msgs/Header"](stamp=time_of, frame_id="odom"), child_frame_id="base_link",
                pose=kinds["geometry_msgs/PoseWithCovariance"](pose=pose, covariance=blank),
                twist=kinds["geometry_msgs/TwistWithCovariance"](twist=twist(late_v[k], late_omega[k]),
                                                                 covariance=blank))
            writer.write(odometry, stamp, store.serialize_cdr(message, "nav_msgs/msg/Odometry"))


def hour_figures(repeats: int) -> dict[str, Any]:
    """Seconds from a bag of an hour to an inspected dataset: both commands, started as a user does."""
    seconds, cpu = [], []
    with TemporaryDirectory() as folder:
        bag = Path(folder) / "hour"
        write_hour(bag)
        for number in range(repeats):
            dataset = Path(folder) / f"dataset_{number}"
            began, used = time.perf_counter(), _used()
            for command in (["sysid.convert", str(bag), "--out", str(dataset), "--split", "standstill"],
                            ["sysid.inspect", str(dataset)]):
                subprocess.run([sys.executable, "-m", *command], check=True, capture_output=True, cwd=ROOT)
            seconds.append(time.perf_counter() - began)
            cpu.append(_used() - used)
            progress(f"an hour of driving, repeat {number + 1} of {repeats}: {seconds[-1]:.1f} s")
    return {"bag_hour_s": figure(seconds, "s, convert and inspect"),
            "bag_hour_cpu_s": figure(cpu, "s of processor time, convert and inspect")}


def _used() -> float:
    """Processor time of the processes that were started and have ended [s]."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def progress(text: str) -> None:
    """Show how far the work is, on a terminal."""
    if sys.stderr.isatty():
        print(f"\r{text}", end="", file=sys.stderr, flush=True)


def main() -> None:
    """Command line."""
    parser = Parser(prog="python -m benchmarks.logs", description=__doc__.split("\n\n")[0])
    parser.add_argument("--parts", nargs="+", default=["faults", "fits", "hour"],
                        choices=["faults", "fits", "hour"])
    parser.add_argument("--count", type=whole(), default=200, help="faulty logs, and healthy ones")
    parser.add_argument("--seed", type=whole(0), default=0)
    parser.add_argument("--repeats", type=whole(), default=3, help="of the hour, and robots of the fits")
    parser.add_argument("--dry", action="store_true", help="print what goes wrong, record nothing")
    options = parser.parse_args()
    figures: dict[str, Any] = {}
    if "faults" in options.parts:
        figures |= fault_figures(options.count, options.seed, options.dry)
    if "fits" in options.parts:
        for so_far in harm_figures(options.repeats, options.seed):
            figures |= so_far
            if not options.dry:
                record("logs", CLAIM, figures)
    if "hour" in options.parts:
        figures |= hour_figures(options.repeats)
    for name, one in figures.items():
        print(f"{name}: {one['value']:.3g} {one['unit']} {one.get('size', '')}")
    if not options.dry:
        print(record("logs", CLAIM, figures))


if __name__ == "__main__":
    with guarded():
        main()
