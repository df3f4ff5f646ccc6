"""The simulator as a robot, between processes over real DDS: rows recorded, lock-step, resets, damaged messages.

    python -m benchmarks.bridge_simulator [--parts record lock_step stale fuzz]

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
import threading
import time
from pathlib import Path

import numpy as np

from benchmarks.bridge import CLAIM, EndlessRobot, burners, cpu_model, entries, memory_mb
from benchmarks.bridge_faults import Figures
from benchmarks.bridge_robot import environment_of
from benchmarks.harness import record
from bridge.episodes import PATIENCE
from bridge.nodes.options import Parser, in_range, whole
from bridge.simulation.simulated import Frame
from whill_mjx.io.command_line import guarded

SENDER = """
import sys, time, rclpy
from nav_msgs.msg import Odometry
from bridge.nodes import ros
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


RELAY = """
import contextlib, random, time, rclpy
from rclpy.executors import ExternalShutdownException
from sensor_msgs.msg import Image
rclpy.init()
node, rng, kept = rclpy.create_node("relay"), random.Random(0), []
out = node.create_publisher(Image, "delayed/image", 20)
def relay(message):
    kept.append(message)
    for one in rng.sample(kept, min(len(kept), 2)):
        out.publish(one)
    time.sleep(rng.uniform(0, 0.002))
    out.publish(message)
    out.publish(rng.choice(kept))
    del kept[:-20]
node.create_subscription(Image, "sensing/camera/front/image_raw", relay, 20)
with contextlib.suppress(ExternalShutdownException):
    rclpy.spin(node)
"""
"""Sends each image late, with older ones before and after it."""


class NumberedRobot(EndlessRobot):
    """A point whose images show the number of their episode, beside that of their step."""

    def reset(self, seed: int) -> Frame:
        """Begin the episode of a seed."""
        self.episode = seed
        return super().reset(seed)

    def _frame(self, v: float, omega: float) -> Frame:
        frame = super()._frame(v, omega)
        frame.image[1, :2, 0] = divmod(self.episode, 256)
        return frame


def numbers_of(image: np.ndarray) -> tuple[int, int]:
    """Episode and step, one of the first 64, that an image shows."""
    high, low = (int(value) for value in image[1, :2, 0])
    return 256 * high + low, int(np.flatnonzero(image[0, :, 0] != 120)[0])


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

    def __init__(self, domain: int, folder: Path, robot: str = "benchmarks.bridge:EndlessRobot") -> None:
        log = folder / f"simulate_{domain}.log"
        with open(log, "w") as file:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "bridge.simulate", "--simulator", robot, "--port", "0", "--wait", "1000"],
                env=environment_of(domain), stdout=file, stderr=file)
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
        rates = []
        for _ in range(5):
            began = time.perf_counter()
            for _ in range(steps):
                env.step(np.array([0.3, 0.0]))
            rates.append(steps / (time.perf_counter() - began))
        took = []
        for seed in range(resets):
            began = time.perf_counter()
            env.reset(seed=seed)
            took.append(1e3 * (time.perf_counter() - began))
        env.close()
    finally:
        simulator.close()
    return {"ros_env_steps_per_s": (rates, "1/s, lock-step, 64x64, a point robot"),
            "tcp_p99_ms": ([float(np.percentile(took, 99))], f"ms of {resets} resets, image included")}


def measure_stale(domain: int, folder: Path, resets: int) -> Figures:
    """Images of another episode or step than the one asked for, where a relay delays images and sends older ones."""
    os.environ.update(environment_of(domain))
    from bridge.ros_env import RosEnv

    simulator = Simulator(domain, folder, "benchmarks.bridge_simulator:NumberedRobot")
    relay = subprocess.Popen([sys.executable, "-c", RELAY], env=environment_of(domain))
    try:
        env, wrong = RosEnv(simulator.port, image_topic="delayed/image"), 0
        for seed in range(resets):
            image, _ = env.reset(seed=seed)
            wrong += numbers_of(image) != (seed, 0)
            image, *_ = env.step(np.array([0.3, 0.0]))
            wrong += numbers_of(image) != (seed, 1)
        env.close()
    finally:
        relay.terminate()
        relay.wait(30)
        simulator.close()
    return {"ros_env_stale_images": ([float(wrong)], f"of {2 * resets} images after resets, delayed and out of order")}


SENDERS = 6
"""Threads that send damaged messages at a time; the server has eight places."""
SERVED = 15.0
"""Seconds in which a client must be served between them: slow ones hold all places for five at most."""


def message(content: bytes) -> bytes:
    """A message of some content."""
    return struct.pack(">I", len(content)) + content


HELLO = message(b'{"id":1,"call":"hello","protocol":1,"token":""}')


def damaged(rng: random.Random) -> bytes:
    """Bytes that are no message: noise, cut off, huge, or JSON that is no call; some of them after a greeting."""
    kind, greeting = rng.randrange(4), HELLO if rng.random() < 0.3 else b""
    if kind == 0:
        return greeting + rng.randbytes(rng.randrange(200))
    if kind == 1:
        return greeting + struct.pack(">I", rng.randrange(1, 5000)) + rng.randbytes(rng.randrange(20))
    if kind == 2:
        return greeting + struct.pack(">I", rng.randrange(65537, 1 << 32)) + rng.randbytes(rng.randrange(1000))
    content = rng.choice([b"[]", b"{}", b'{"id":1}', b'{"id":1,"call":"reset"}', b"nan", b'{"call":[]}', b"\xff",
                          b'{"id":1,"call":"step","v":1e999,"omega":0}', b"[" * 5000, b'{"id":1e400,"call":"state"}'])
    return greeting + message(content)


def attack(port: int, count: int, seed: int) -> None:
    """Send damaged messages, each on a connection of its own; one of 500 slowly, one of 2000 stalls."""
    rng = random.Random(seed)
    for _ in range(count):
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 20) as connection:
            content = damaged(rng)
            if rng.random() < 0.002:
                for at in range(0, min(len(content), 60), 3):
                    connection.sendall(content[at:at + 3])
                    time.sleep(0.02)
            elif rng.random() < 0.0005:
                connection.sendall(content[:2])
                time.sleep(6)
            else:
                connection.sendall(content)


def open_files(pid: int) -> int:
    """Files and sockets that a process holds."""
    return len(os.listdir(f"/proc/{pid}/fd"))


def serves(port: int) -> bool:
    """Whether a client gets its state in time, whoever else is there."""
    from bridge.episodes import EpisodeClient

    end = time.monotonic() + SERVED
    while time.monotonic() < end:
        try:
            client = EpisodeClient(port, wait=SERVED)
        except (OSError, ValueError):  # all places are taken
            time.sleep(0.05)
            continue
        try:
            return "episode" in client.call("state")
        finally:
            client.close()
    return False


def measure_fuzz(domain: int, folder: Path, count: int) -> Figures:
    """Calls that were not served between damaged messages of many clients, and what the server kept of them."""
    simulator = Simulator(domain, folder)
    pid = simulator.process.pid
    try:
        serves(simulator.port)
        memory, files = memory_mb(pid), open_files(pid)
        senders = [threading.Thread(target=attack, args=(simulator.port, count // SENDERS, seed), daemon=True)
                   for seed in range(SENDERS)]
        for sender in senders:
            sender.start()
        calls = failed = 0
        while any(sender.is_alive() for sender in senders):
            time.sleep(0.2)
            calls += 1
            failed += not serves(simulator.port)
        time.sleep(PATIENCE + 1)  # what stalls is left alone by then
        failed += simulator.process.poll() is not None
        kept = open_files(pid) - files
        growth = memory_mb(pid) - memory
    finally:
        simulator.close()
    sent = SENDERS * (count // SENDERS)
    return {"tcp_fuzz_failures": ([float(failed)], f"of {calls} calls between {sent} damaged messages of {SENDERS} "
                                                   "clients at a time, slow and stalled ones among them"),
            "tcp_fuzz_growth_mb": ([growth], f"MB of memory over {sent} damaged messages"),
            "tcp_fuzz_open_files": ([float(kept)], f"more open files after {sent} damaged messages")}


FORMER = ("recorded_", "ros_env_steps_per_second", "ros_env_reset_p99_ms")
"""Names that figures had before."""


def main() -> None:
    """Measure and record."""
    parser = Parser(prog="python -m benchmarks.bridge_simulator", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = ("record", "lock_step", "stale", "fuzz")
    parser.add_argument("--parts", nargs="+", choices=parts, default=parts)
    parser.add_argument("--seconds", type=in_range(0), default=60.0, help="of each recording")
    parser.add_argument("--steps", type=whole(), default=500, help="of each of five rounds in lock-step")
    parser.add_argument("--resets", type=whole(), default=10_000)
    parser.add_argument("--messages", type=whole(), default=100_000, help="damaged ones")
    parser.add_argument("--domain", type=whole(1, 97), help="first of five ROS domains; none takes one by the process")
    options = parser.parse_args()
    figures: Figures = {}
    domain = options.domain or 61 + os.getpid() % 30
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if "record" in options.parts:
            kept = [rows_kept(kind, domain + number, options.seconds, folder)
                    for number, kind in enumerate(("reliable", "best_effort"))]
            figures["record_rows_kept"] = (kept, f"share of rows at 100 Hz in {options.seconds:.0f} s, two burners; "
                                                 "reliable, best effort")
        if "lock_step" in options.parts:
            figures |= measure_lock_step(domain + 2, folder, options.steps, options.resets)
        if "stale" in options.parts:
            figures |= measure_stale(domain + 4, folder, options.resets)
        if "fuzz" in options.parts:
            figures |= measure_fuzz(domain + 3, folder, options.messages)
    figures["simulator_load_average"] = ([os.getloadavg()[0]], "processes wanting a core, after the runs above")
    cpu = f"cpu, {len(os.sched_getaffinity(0))} cores, {cpu_model()}"
    path = record("bridge", CLAIM, entries(figures, cpu), replacing=FORMER)
    for one, (repeats, unit, *_) in figures.items():
        print(f"{one:28s} {statistics.median(repeats):10.3f} {unit}")
    print(path)


if __name__ == "__main__":
    with guarded():
        main()
