"""The simulator as a robot, between processes over real DDS: rows recorded, lock-step, resets, damaged messages.

    python -m benchmarks.bridge_simulator [--parts record lock_step fuzz]

The vehicle is a point, so the figures are of the bridge and not of the physics. The recorder hears numbered odometry of
another process at 100 Hz while two busy processes take the cores. Figures go to bridge.json.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import os
import random
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.bridge import CLAIM, Figures, cpu_model
from benchmarks.harness import figure, record
from bridge.options import Parser, in_range, whole
from whill_mjx.io.command_line import guarded

SENDER = """
import sys, time, rclpy
from nav_msgs.msg import Odometry
from bridge import ros
rclpy.init()
node = rclpy.create_node("sender")
publisher = node.create_publisher(Odometry, "whill/odom", getattr(ros, sys.argv[1])(500))
while not publisher.get_subscription_count():
    time.sleep(0.01)
time.sleep(0.5)
message, began = Odometry(), time.monotonic()
message.pose.pose.orientation.w = 1.0
for i in range(int(sys.argv[2])):
    message.header.stamp.sec, message.header.stamp.nanosec = 1 + i // 100, i % 100 * 10_000_000
    publisher.publish(message)
    time.sleep(max(0.0, began + (i + 1) * 0.01 - time.monotonic()))
time.sleep(1.0)
"""


@contextlib.contextmanager
def burners(count: int):
    """Processes that take a core each."""
    running = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for one in running:
            one.kill()
            one.wait()


def environment_of(domain: int) -> dict[str, str]:
    """The environment of processes on a domain of this computer."""
    return {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}


def rows_kept(kind: str, domain: int, seconds: float, folder: Path) -> float:
    """Share of 100 Hz odometry that a recorder keeps under two burners."""
    count, environment = int(100 * seconds), environment_of(domain)
    recorder = subprocess.Popen([sys.executable, "-m", "bridge.record", str(folder / "logs"), f"{kind}_1"],
                                env=environment, stderr=subprocess.DEVNULL)
    time.sleep(2)
    with burners(2):
        subprocess.run([sys.executable, "-c", SENDER, kind, str(count)], env=environment, check=True)
    recorder.terminate()
    recorder.wait(30)
    with open(folder / "logs" / "trials" / f"{kind}_1" / "odometry.csv", newline="") as file:
        stamps = [row["stamp"] for row in csv.DictReader(file)]
    assert len(set(stamps)) == len(stamps), "a message was recorded twice"
    return len(stamps) / count


class Simulator:
    """A point robot behind topics, with episode control."""

    def __init__(self, domain: int, folder: Path) -> None:
        log = folder / f"simulate_{domain}.log"
        with open(log, "w") as file:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "bridge.simulate", "--simulator", "benchmarks.bridge:EndlessRobot", "--port",
                 "0", "--wait", "1000"], env=environment_of(domain), stdout=file, stderr=file)
        end = time.monotonic() + 60
        while "port " not in log.read_text():
            if time.monotonic() > end or self.process.poll() is not None:
                raise RuntimeError(log.read_text())
            time.sleep(0.05)
        self.port = int(log.read_text().split("port ")[1].split()[0])

    def close(self) -> None:
        """End it."""
        self.process.terminate()
        self.process.wait(30)


def measure_lock_step(domain: int, folder: Path, steps: int, resets: int) -> Figures:
    """Steps a second of the environment, time of a reset, and images of another step than the one asked for."""
    os.environ.update(environment_of(domain))
    from bridge.ros_env import RosEnv

    simulator = Simulator(domain, folder)
    try:
        env = RosEnv(simulator.port)
        env.reset(seed=0)
        rates, wrong = [], 0
        for _ in range(5):
            began = time.perf_counter()
            for _ in range(steps):
                env.step(np.array([0.3, 0.0]))
            rates.append(steps / (time.perf_counter() - began))
        took = []
        for seed in range(resets):
            began = time.perf_counter()
            image, _ = env.reset(seed=seed)
            took.append(1e3 * (time.perf_counter() - began))
            wrong += int(image[0, 0, 0] != 0)  # the first step of an episode is drawn at column 0
            image, *_ = env.step(np.array([0.3, 0.0]))
            wrong += int(image[0, 1, 0] != 1)
        env.close()
    finally:
        simulator.close()
    return {"ros_env_steps_per_second": (rates, "1/s, lock-step, 64x64, a point robot"),
            "ros_env_reset_p99_ms": ([float(np.percentile(took, 99))], f"ms of {resets} resets, image included"),
            "ros_env_stale_images": ([float(wrong)], f"of {2 * resets} images after resets")}


def damaged(rng: random.Random) -> bytes:
    """Bytes that are no message: noise, cut off, huge, or JSON that is no call."""
    kind = rng.randrange(4)
    if kind == 0:
        return rng.randbytes(rng.randrange(200))
    if kind == 1:
        return struct.pack(">I", rng.randrange(1, 5000)) + rng.randbytes(rng.randrange(20))
    if kind == 2:
        return struct.pack(">I", rng.randrange(65537, 1 << 32))
    content = rng.choice([b"[]", b"{}", b'{"id":1}', b'{"id":1,"call":"reset"}', b"nan", b'{"call":[]}', b"\xff"])
    return struct.pack(">I", len(content)) + content


def measure_fuzz(domain: int, folder: Path, count: int) -> Figures:
    """Damaged messages after which the server was dead, and its growth of memory."""
    from benchmarks.bridge import memory_mb
    from bridge.episodes import EpisodeClient

    rng, simulator = random.Random(0), Simulator(domain, folder)
    try:
        before, failed = memory_mb(simulator.process.pid), 0
        for number in range(count):
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", simulator.port), 5) as connection:
                connection.sendall(damaged(rng))
            if number % 200 == 199:
                try:
                    EpisodeClient(simulator.port, wait=10).close()
                except (OSError, ValueError):
                    failed += 1
        growth = memory_mb(simulator.process.pid) - before
    finally:
        simulator.close()
    return {"tcp_fuzz_failures": ([float(failed)], f"of {count // 200} calls between {count} damaged messages"),
            "tcp_fuzz_growth_mb": ([growth], f"MB of memory over {count} damaged messages")}


def main() -> None:
    """Measure and record."""
    parser = Parser(prog="python -m benchmarks.bridge_simulator", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = ("record", "lock_step", "fuzz")
    parser.add_argument("--parts", nargs="+", choices=parts, default=parts)
    parser.add_argument("--seconds", type=in_range(0), default=60.0, help="of each recording")
    parser.add_argument("--steps", type=whole(), default=500, help="of each of five rounds in lock-step")
    parser.add_argument("--resets", type=whole(), default=1000)
    parser.add_argument("--messages", type=whole(), default=100_000, help="damaged ones")
    options = parser.parse_args()
    domain, figures = 61 + os.getpid() % 30, {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if "record" in options.parts:
            for number, kind in enumerate(("reliable", "best_effort")):
                figures[f"recorded_{kind}"] = ([rows_kept(kind, domain + number, options.seconds, folder)],
                                               "share of rows at 100 Hz, two burners")
        if "lock_step" in options.parts:
            figures |= measure_lock_step(domain + 2, folder, options.steps, options.resets)
        if "fuzz" in options.parts:
            figures |= measure_fuzz(domain + 3, folder, options.messages)
    figures["simulator_load_average"] = ([os.getloadavg()[0]], "processes wanting a core, after the runs above")
    cpu = f"cpu, {len(os.sched_getaffinity(0))} cores, {cpu_model()}"
    path = record("bridge", CLAIM, {one: figure(repeats, unit, cpu) for one, (repeats, unit) in figures.items()})
    for one, (repeats, unit) in figures.items():
        print(f"{one:28s} {statistics.median(repeats):10.3f} {unit}")
    print(path)


if __name__ == "__main__":
    with guarded():
        main()
