"""Processes and plain ROS nodes on a domain of their own, for the tests of the nodes."""

import array
import contextlib
import fcntl
import itertools
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@contextlib.contextmanager
def free_domain():
    """Hold a ROS domain that no other test of this machine uses now, and none used just before."""
    first = random.randrange(100)
    for domain in (1 + (first + i) % 100 for i in itertools.count()):
        with open(Path(tempfile.gettempdir()) / f"ros-domain-{domain}.lock", "w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            yield domain
            return


class Graph:
    """Processes of one ROS domain that end with the test."""

    def __init__(self, folder, domain):
        self.folder, self.domain, self.processes, self.peers = folder, domain, {}, []
        python_path = os.pathsep.join([str(ROOT), str(ROOT / "tests" / "bridge")])
        self.environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
                            "PYTHONPATH": python_path, "ROS_LOG_DIR": str(folder / "log")}

    def start(self, name, *arguments, key=None):
        key = key or name
        log = open(self.folder / f"{key}.log", "w")
        command = [sys.executable, "-m", f"bridge.{name}", *map(str, arguments)]
        self.processes[key] = subprocess.Popen(command, cwd=self.folder, env=self.environment, stdout=log, stderr=log)
        log.close()

    def peer(self, name="peer"):
        """A plain ROS node within this process."""
        peer = Peer(self.domain, name)
        self.peers.append(peer)
        return peer

    def log(self, name):
        return (self.folder / f"{name}.log").read_text()

    def end(self, name, number=signal.SIGTERM):
        """Send a signal and return the exit code."""
        self.processes[name].send_signal(number)
        return self.wait(name)

    def wait(self, name, seconds=60):
        try:
            return self.processes[name].wait(seconds)
        except subprocess.TimeoutExpired:
            pytest.fail(f"{name} did not end in {seconds} s: {self.log(name)}")

    def wait_for(self, name, text, seconds=60):
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


class Peer:
    """A camera, a base, an emergency stop or a joystick: whatever a test asks for, served by a thread."""

    def __init__(self, domain, name):
        import rclpy
        from rclpy.executors import SingleThreadedExecutor

        self.context = rclpy.Context()
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
            rclpy.init(context=self.context, domain_id=domain)
        self.node = rclpy.create_node(name, context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.commands, self.statuses, self.frames = [], [], 0
        self.clock_offset, self.encoding = 0.0, "rgb8"  # of the camera
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self):
        from rclpy.executors import ExternalShutdownException

        with contextlib.suppress(ExternalShutdownException):
            self.executor.spin()

    def close(self):
        self.context.try_shutdown()
        self._thread.join(5)
        self.executor.shutdown(timeout_sec=1)

    def publisher(self, kind, topic, profile=1):
        """A publisher of a message type such as std_msgs/Bool."""
        return self.node.create_publisher(message_type(kind), topic, profile)

    def repeat(self, publisher, period, make):
        """Publish `make()` again and again, at once too."""
        publisher.publish(make())
        return self.node.create_timer(period, lambda: publisher.publish(make()))

    def base(self, topic="whill/controller/cmd_vel", kind="geometry_msgs/Twist"):
        """Listen to commands: (steady time, v, omega) in `commands`."""
        def heard(message):
            planar = getattr(message, "twist", message)
            self.commands.append((time.monotonic(), planar.linear.x, planar.angular.z))

        self.node.create_subscription(message_type(kind), topic, heard, 10)

    def watch(self, topic="bridge/status"):
        """Collect the statuses of a bridge."""
        self.node.create_subscription(message_type("std_msgs/String"), topic,
                                      lambda message: self.statuses.append(json.loads(message.data)), 10)

    def e_stop(self, topic="e_stop", pulled=False):
        """Beat as an emergency stop; set `.value` of the result to pull it."""
        bell = self.publisher("std_msgs/Bool", topic)
        state = type("State", (), {"value": pulled})()
        state.timer = self.repeat(bell, 0.05, lambda: message_type("std_msgs/Bool")(data=state.value))
        return state

    def camera(self, topic="sensing/camera/front/image_raw", rate=10, size=(64, 64), frozen=False):
        """Publish white images, each different from the last unless `frozen`."""
        from bridge import ros

        image = message_type("sensor_msgs/Image")
        publisher = self.node.create_publisher(image, topic, ros.best_effort())
        pixels = bytearray(b"\xff" * (size[0] * size[1] * 3))

        def make():
            self.frames += 1
            pixels[0] = 5 if frozen else self.frames % 250
            message = image(height=size[0], width=size[1], encoding=self.encoding, step=3 * size[1])
            message.data = array.array("B", pixels)
            stamp = time.time() + self.clock_offset
            message.header.stamp.sec, message.header.stamp.nanosec = int(stamp), int(stamp % 1 * 1e9)
            return message

        return self.repeat(publisher, 1 / rate, make)

    def robot(self):
        """A whole vehicle: base, camera and emergency stop; returns the latter."""
        self.base()
        self.watch()
        self.camera()
        return self.e_stop()

    def wait_until(self, condition, seconds=60):
        """Wait for a condition of this peer; return its value."""
        end = time.monotonic() + seconds
        while not (value := condition(self)):
            assert time.monotonic() < end, f"commands {self.commands[-5:]}, statuses {self.statuses[-3:]}"
            time.sleep(0.01)
        return value

    def wait_for_status(self, seconds=60, **fields):
        """Wait until the newest status has these values; of texts and lists a part is enough."""
        def fits(peer):
            status = peer.statuses[-1] if peer.statuses else {}
            return all(want == status.get(name) if isinstance(want, bool) else want in str(status.get(name, ""))
                       for name, want in fields.items())

        self.wait_until(fits, seconds)
        return self.statuses[-1]

    def moving(self, since=0.0):
        """The commands after a time that are not zero."""
        return [command for command in self.commands if command[0] > since and (command[1] or command[2])]


def message_type(name):
    """The class of a message such as std_msgs/Bool."""
    import importlib

    package, _, kind = name.partition("/")
    return getattr(importlib.import_module(f"{package}.msg"), kind)
