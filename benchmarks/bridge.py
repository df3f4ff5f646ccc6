"""Latency and reaction times of the bridge: separate processes over real DDS on this machine.

    python -m benchmarks.bridge --seconds 60

The policy is a stand-in of 10 million random parameters with the shape of a trained one (recurrent, 64x64 RGB), unless
--policy names another. A trained policy cannot be made to fail on purpose, so `stop_action_ms` always uses the
stand-in. All times are of the system's one steady clock. Figures named `_realtime` are taken with both nodes under
SCHED_FIFO, where that is permitted. Faults are injected by a plain ROS node (benchmarks.bridge_robot); a reaction is
the time from the injection to the first zero that this node hears.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import os
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bridge_robot import Robot, Switch, message_type
from bridge.options import Parser, in_range, whole
from bridge.simulated import Frame
from whill_mjx.io.command_line import guarded

CLAIM = "Frame to command, delivery, pacing and every stop of the bridge, measured between processes"
HIDDEN = 2048


class EndlessRobot:
    """A point that never arrives; each image differs from the last."""

    period = 0.1
    steps_per_episode = 1 << 30
    white_at = -1

    def __init__(self, task: str = "", vehicle: str | None = None) -> None:
        self.steps = 0

    def reset(self, seed: int) -> Frame:
        self.steps = 0
        return self._frame(0.0, 0.0)

    def step(self, v: float, omega: float) -> Frame:
        self.steps += 1
        return self._frame(v, omega)

    def _frame(self, v: float, omega: float) -> Frame:
        image = np.full((64, 64, 3), 120, np.uint8)
        image[0, self.steps % 64] = self.steps % 100
        if self.steps == self.white_at:
            image[:] = 255
        return Frame(image, 0.0, 0.0, 0.0, v, omega, done=self.steps >= self.steps_per_episode)


class ShortRobot(EndlessRobot):
    """Episodes of one second."""

    steps_per_episode = 10


class WhiteRobot(EndlessRobot):
    """Episodes of six seconds with one white image, at which the stand-in policy's action is not a number."""

    steps_per_episode = 60
    white_at = 20


def export_stand_in(folder: Path) -> Path:
    """Write a recurrent policy of random parameters; a white image makes its action NaN."""
    import jax
    import jax.numpy as jnp

    from dreamer.export import PolicyContract, export_policy

    keys = jax.random.split(jax.random.key(0), 4)
    weights = {"patch": jax.random.normal(keys[0], (192, 32)) / 14,
               "embed": jax.random.normal(keys[1], (2048, 512)) / 45,
               "gru": jax.random.normal(keys[2], (8, 512 + HIDDEN // 8, 3 * HIDDEN // 8)) / 28,
               "out": jax.random.normal(keys[3], (HIDDEN, 2048)) / 45}

    def step(carry: dict[str, jax.Array], image: jax.Array) -> tuple[dict[str, jax.Array], jax.Array]:
        x = image.astype(jnp.float32) / 255
        patches = x.reshape(8, 8, 8, 8, 3).transpose(0, 2, 1, 3, 4).reshape(64, 192) @ weights["patch"]
        embed = jax.nn.silu(patches.reshape(-1) @ weights["embed"])
        blocks = carry["deter"].reshape(8, -1)
        gates = jnp.einsum("gi,gio->go", jnp.concatenate([jnp.tile(embed, (8, 1)), blocks], -1), weights["gru"])
        reset, candidate, update = jnp.split(gates, 3, -1)
        update = jax.nn.sigmoid(update - 1)
        deter = (update * jnp.tanh(jax.nn.sigmoid(reset) * candidate) + (1 - update) * blocks).reshape(-1)
        action = 0.5 + 0.4 * jnp.tanh(deter @ weights["out"])[:2]
        return {"deter": deter}, jnp.where(x.mean() > 0.99, jnp.nan, action)

    contract = PolicyContract(action_low=(-0.5, -0.6), action_high=(1.0, 0.6), task="stand-in")
    return export_policy(folder, step, {"deter": np.zeros(HIDDEN, np.float32)}, weights, contract,
                         check_steps=1000)


class Run:
    """One simulator and one policy node, and what they report."""

    def __init__(self, folder: Path, policy: Path, robot: str, domain: int, *options: str, realtime: bool = False
                 ) -> None:
        self.results, self.drive_results = folder / "simulate.json", folder / "drive.json"
        for path in (self.results, self.drive_results):
            path.unlink(missing_ok=True)
        self._environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        scheduling = ("--realtime", "20") if realtime else ()
        self.drive = self._start("bridge.drive", str(policy), "--results", str(self.drive_results), *scheduling)
        self.simulate = self._start("bridge.simulate", "--simulator", f"benchmarks.bridge:{robot}", "--results",
                                    str(self.results), *scheduling, *options)

    def _start(self, module: str, *arguments: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen([sys.executable, "-m", module, *arguments], env=self._environment,
                                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def finish(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """End the processes, the policy node first, and return the results of simulator and policy node."""
        for process in (self.drive, self.simulate):
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
            process.wait(60)
        drive = json.loads(self.drive_results.read_text()) if self.drive_results.exists() else {}
        return json.loads(self.results.read_text()), drive


def settled(results: dict[str, Any], after: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    """Return the delays [ms] and command intervals [ms] of the steady part of a run, without its last second."""
    begin = results["episodes"][0]["began"] + after
    commands = [t for t, v, omega in results["commands"] if v or omega]
    end = commands[-1] - 1.0
    delays = [1e3 * delay for t, delay in results["frame_to_command"] if begin <= t <= end]
    times = [t for t in commands if begin <= t <= end]
    return np.array(delays), 1e3 * np.diff(times)


def first_zero(results: dict[str, Any], after: float) -> float:
    """Return the seconds from `after` to the first zero command."""
    return min(t for t, v, omega in results["commands"] if t >= after and v == 0 and omega == 0) - after


def stops(drive: dict[str, Any]) -> int:
    """Return how often a bridge stopped."""
    return sum(count for name, count in drive["counts"].items() if name.startswith("stop: "))


def processor_seconds(pid: int) -> float:
    """Return the processor time [s] that a process has taken."""
    with open(f"/proc/{pid}/stat") as file:
        fields = file.read().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def memory_mb(pid: int) -> float:
    """Return the resident memory of a process [MB]."""
    with open(f"/proc/{pid}/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


class Bridge:
    """A policy node that drives a robot of plain ROS."""

    def __init__(self, policy: Path, domain: int, *options: str) -> None:
        self.robot = Robot(domain)
        self.e_stop = self.robot.whole(shade=120)  # at white the stand-in fails
        self.enable = Switch(self.robot, "enable", True)
        self.collision = self.robot.publisher("std_msgs/Bool", "collision_sensor")
        self.robot.joystick()
        if SIMULATED[-1] in options:
            self.robot.clock()
        self.other: Any = None
        environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        self.process = subprocess.Popen([sys.executable, "-m", "bridge.drive", str(policy), *options], env=environment,
                                        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def collide(self, value: bool) -> None:
        """Publish one value of the collision sensor."""
        self.collision.publish(message_type("std_msgs/Bool")(data=value))

    def join(self) -> None:
        """Let another node publish on the command topic; it sends nothing."""
        self.other = self.robot.publisher("geometry_msgs/Twist", "whill/controller/cmd_vel")

    def leave(self) -> None:
        """Take that publisher away."""
        self.robot.node.destroy_publisher(self.other)

    def guard(self) -> int:
        """Return the process of its guard."""
        with open(f"/proc/{self.process.pid}/task/{self.process.pid}/children") as file:
            return int(file.read().split()[0])

    def close(self) -> None:
        """End it, and the robot."""
        self.process.send_signal(signal.SIGCONT)
        self.process.terminate()
        self.process.wait(60)
        self.robot.close()


SIMULATED = ("--ros-args", "-p", "use_sim_time:=true")
FAULTS: dict[str, tuple[tuple[str, ...], Any, Any]] = {
    "e_stop": ((), lambda bridge: bridge.e_stop.turn(True), lambda bridge: bridge.e_stop.turn(False)),
    "e_stop_silent": ((), lambda bridge: bridge.e_stop.timer.cancel(), lambda bridge: bridge.e_stop.timer.reset()),
    "collision": ((), lambda bridge: bridge.collide(True), lambda bridge: bridge.collide(False)),
    "enable": (("--enable", "require"), lambda bridge: bridge.enable.turn(False),
               lambda bridge: bridge.enable.turn(True)),
    "frozen_camera": ((), lambda bridge: setattr(bridge.robot, "frozen", True),
                      lambda bridge: setattr(bridge.robot, "frozen", False)),
    "late_stamps": ((), lambda bridge: setattr(bridge.robot, "clock_offset", -5.0),
                    lambda bridge: setattr(bridge.robot, "clock_offset", 0.0)),
    "wrong_encoding": ((), lambda bridge: setattr(bridge.robot, "encoding", "bayer_rggb8"),
                       lambda bridge: setattr(bridge.robot, "encoding", "rgb8")),
    "repeated_stamp": ((), lambda bridge: setattr(bridge.robot, "repeats_stamp", True),
                       lambda bridge: setattr(bridge.robot, "repeats_stamp", False)),
    "dark_camera": (("--blind", "stop"), lambda bridge: setattr(bridge.robot, "dark", True),
                    lambda bridge: setattr(bridge.robot, "dark", False)),
    "dead_man": (("--dead-man-button", "0"), lambda bridge: setattr(bridge.robot, "held", False),
                 lambda bridge: setattr(bridge.robot, "held", True)),
    "second_commander": ((), lambda bridge: bridge.join(), lambda bridge: bridge.leave()),
    "clock_stops": (SIMULATED, lambda bridge: setattr(bridge.robot, "ticking", False),
                    lambda bridge: setattr(bridge.robot, "ticking", True)),
    "clock_jumps": (SIMULATED, lambda bridge: setattr(bridge.robot, "clock_offset", 90.0),
                    lambda bridge: setattr(bridge.robot, "clock_offset", 0.0)),
    "guard_killed": ((), lambda bridge: os.kill(bridge.guard(), signal.SIGKILL), lambda bridge: None),
    "node_stopped": (("--signal-age", "5"), lambda bridge: bridge.process.send_signal(signal.SIGSTOP),
                    lambda bridge: bridge.process.send_signal(signal.SIGCONT)),
    "node_ends": ((), lambda bridge: bridge.process.terminate(), None),
    "killed": ((), lambda bridge: bridge.process.kill(), None),
    "killed_first": ((), lambda bridge: bridge.process.kill(), None),
}
"""Options, injection and its end by the name of a fault; without an end each repeat takes a new node."""


def measure_faults(policy: Path, domain: int, repeats: int, names: Sequence[str]) -> Figures:
    """Return the reaction times to the faults of these names."""
    found: Figures = {}
    for number, (name, (options, inject, end)) in enumerate((name, FAULTS[name]) for name in names):
        reactions: list[float] = []
        while len(reactions) < repeats:
            bridge = Bridge(policy, domain + number, *options)
            try:
                reactions.extend(reaction_times(bridge, name, inject, end, repeats if end else 1, len(reactions)))
            finally:
                bridge.close()
        title = "e_stop_ms" if name == "e_stop" else f"stop_{name}_ms"
        found[title] = (reactions, "ms from the fault to the first zero")
    return found


def reaction_times(bridge: Bridge, name: str, inject: Any, end: Any, repeats: int, phase: int) -> list[float]:
    """Return the times [ms] from a fault to the first zero, each at another phase of the control period."""
    robot, found = bridge.robot, []
    for i in range(repeats):
        robot.wait_until(moving_after(time.monotonic()))
        if name != "killed_first":
            time.sleep(0.7 + 0.037 * (i + phase))
            robot.wait_until(moving_after(time.monotonic()))  # a busy machine may have stopped it meanwhile
        at = time.monotonic()
        inject(bridge)
        found.append(1e3 * robot.first_zero(at))
        if end is None:
            break
        end(bridge)
        with contextlib.suppress(AssertionError):  # resumed by itself
            robot.wait_for_status(2.0, state="disarmed", holds="[]")
            robot.arm()
    return found


def moving_after(since: float) -> Callable[[Robot], Any]:
    """Return the condition that a motion is commanded after a time."""
    return lambda robot: robot.moving(since)


def fuzz(count: int) -> int:
    """Return how many commands of a supervisor left the limits, of so many outputs of any bits."""
    from bridge.safety import SafetyConfig, Supervisor

    config = SafetyConfig((-0.5, -1.0), (1.0, 1.0))
    supervisor, rng, now, wrong = Supervisor(config), np.random.default_rng(0), 0.0, 0
    for number, bits in enumerate(rng.integers(0, 2**64, (count, 2), np.uint64)):
        now += 0.1
        supervisor.frame(now, now, number)
        command = supervisor.action(now, bits.view(np.float64))
        wrong += not (-0.5 <= command.v <= 1.0 and -1.0 <= command.omega <= 1.0)
        supervisor.arm()
    return wrong


def policy_times(policy_path: Path, steps: int) -> np.ndarray:
    """Return the durations and the processor times (steps, 2) [ms] of policy steps paced at 10 Hz.

    A step that waits for a core, because others are busy, lasts longer but takes no more processor time.
    """
    from bridge.policy import Policy

    policy = Policy.load(policy_path)
    image = np.full((policy.contract.height, policy.contract.width, 3), 90, np.uint8)
    times = []
    for _ in range(steps):
        start = time.perf_counter(), time.thread_time()
        policy.step(image)
        times.append((time.perf_counter() - start[0], time.thread_time() - start[1]))
        time.sleep(0.1)
    return 1e3 * np.array(times)


def cold_start(policy_path: Path) -> float:
    """Return the seconds from starting a process to its first command."""
    code = ("import sys, numpy as np; from bridge.policy import Policy; p = Policy.load(sys.argv[1]); "
            "c = p.contract; assert np.isfinite(p.step(np.zeros((c.height, c.width, 3), np.uint8))).all()")
    start = time.perf_counter()
    subprocess.run([sys.executable, "-c", code, str(policy_path)], check=True)
    return time.perf_counter() - start


Figures = dict[str, tuple[list[float], str]]
"""Repeats and unit of each figure by its name."""


def measure_steady(policy: Path, folder: Path, domain: int, seconds: float) -> Figures:
    """Return latency, pacing, delivery, spurious stops and memory of undisturbed drives."""
    figures: Figures = {}
    healthy_stops, missed, growth, memory = 0, 0, [], []
    for number, suffix in enumerate(("", "_realtime")):
        run = Run(folder, policy, "EndlessRobot", domain + 2 * number, realtime=bool(suffix))
        time.sleep(5)
        before, taken = memory_mb(run.drive.pid), processor_seconds(run.drive.pid)
        time.sleep(seconds)
        taken = processor_seconds(run.drive.pid) - taken
        memory.append(memory_mb(run.drive.pid))
        growth.append(memory[-1] - before)
        results, drive = run.finish()
        healthy_stops += stops(drive)
        delays, intervals = settled(results)
        missed += int((intervals > 150).sum())
        figures[f"drive_processor{suffix}_share"] = ([taken / seconds], "of a core, by the policy node")
        figures[f"frame_to_command_p50{suffix}_ms"] = ([float(np.percentile(delays, 50))], "ms")
        figures[f"frame_to_command_p99{suffix}_ms"] = ([float(np.percentile(delays, 99))], "ms")
        figures[f"frame_to_command_max{suffix}_ms"] = ([float(delays.max())], "ms")
        figures[f"tick_error_p99{suffix}_ms"] = ([float(np.percentile(np.abs(intervals - 100), 99))], "ms")
        run = Run(folder, policy, "EndlessRobot", domain + 2 * number + 1, "--image-size", "720", "1280",
                  realtime=bool(suffix))
        time.sleep(seconds + 5)
        results, drive = run.finish()
        healthy_stops += stops(drive)
        delays, intervals = settled(results)
        missed += int((intervals > 150).sum())
        figures[f"frame_720p_p99{suffix}_ms"] = ([float(np.percentile(delays, 99))], "ms")
        end = results["commands"][-results["stops_at_end"]][0]  # the policy node's farewell
        shown = sum(t < end - 0.01 for t in results["image_times"])
        figures[f"frames_720p_delivered{suffix}"] = ([min(1.0, drive["counts"]["frames"] / shown)], "share")
    figures["load_average"] = ([os.getloadavg()[0]], "processes wanting a core, during the runs above")
    figures["healthy_stops"] = ([float(healthy_stops)], f"stops in {4 * (seconds + 5):.0f} healthy seconds")
    figures["missed_ticks"] = ([float(missed)], f"commands 50 ms late in {4 * seconds:.0f} healthy seconds")
    figures["drive_memory_mb"] = (memory, "MB of the policy node, resident, after a drive")
    figures["memory_growth_mb"] = (growth, f"MB in {seconds:.0f} s, after the first 5 s")
    return figures


def measure_episodes(policy: Path, stand_in: Path, folder: Path, domain: int, resets: int) -> Figures:
    """Return the reactions to a camera that falls silent, at resets, and to an action that is not a number."""
    run = Run(folder, policy, "ShortRobot", domain, "--episodes", str(resets))
    run.simulate.wait(30 + 4 * resets)
    results, _ = run.finish()
    moved = [t for t, v, omega in results["commands"] if v or omega]
    # the first episodes may be over before the nodes have found each other: nothing moves, and nothing needs a zero
    episodes = [episode for episode in results["episodes"] if any(0 <= episode["ended"] - t < 0.2 for t in moved)]
    stale = sum(1 for begin in (episode["began"] for episode in episodes[1:])
                for t, v, omega in results["commands"] if begin - 0.15 < t < begin + 0.1 and (v or omega))
    run = Run(folder, stand_in, "WhiteRobot", domain + 1, "--episodes", "4")
    run.simulate.wait(90)
    white_results, _ = run.finish()
    whites = [episode["began"] + 0.1 * WhiteRobot.white_at for episode in white_results["episodes"]]
    return {
        "stop_input_ms": ([1e3 * first_zero(results, episode["ended"]) for episode in episodes], "ms"),
        "stale_after_reset": ([float(stale)], f"commands before the third frame, {resets - 1} resets"),
        "stop_action_ms": ([1e3 * first_zero(white_results, white - 0.03) - 30 for white in whites], "ms"),
    }


def measure_policy(policy: Path, seconds: float) -> Figures:
    """Return duration, cold start and parity of the policy, and the size of what it needs."""
    parity = json.loads((policy / "policy.json").read_text())["parity"]
    wall, processor = np.percentile(policy_times(policy, int(10 * seconds)), 99, axis=0).tolist()
    return {
        "policy_parity": ([parity["max_abs_action_drift"]],
                          f"of the action, ONNX and JAX, {parity['steps']} recurrent steps"),
        "policy_p99_ms": ([wall], "ms"),
        "policy_processor_p99_ms": ([processor], "ms of processor time"),
        "cold_start_s": ([cold_start(policy) for _ in range(3)], "s"),
        "installed_mb": ([installed_mb("numpy", "onnxruntime")], "MB of numpy, onnxruntime and what they require"),
    }


def installed_mb(*names: str) -> float:
    """Return the size [MB] of installed distributions and all that they require."""
    found: dict[str, float] = {}
    waiting = list(names)
    while waiting:
        name = waiting.pop()
        if name in found:
            continue
        try:
            distribution = importlib.metadata.distribution(name)
        except importlib.metadata.PackageNotFoundError:
            continue
        files = [Path(str(distribution.locate_file(file))) for file in distribution.files or ()]
        found[name] = sum(file.stat().st_size for file in files if file.is_file()) / 1e6
        required = [line for line in distribution.requires or () if "extra ==" not in line]
        waiting.extend(re.split(r"[^A-Za-z0-9._-]", line, maxsplit=1)[0] for line in required)
    return sum(found.values())


def main() -> None:
    parts = ("steady", "episodes", "faults", "fuzz", "policy")
    parser = Parser(prog="python -m benchmarks.bridge", description="Measure the bridge.")
    parser.add_argument("--seconds", type=in_range(0), default=60.0, help="length of each steady run")
    parser.add_argument("--resets", type=whole(0), default=20)
    parser.add_argument("--repeats", type=whole(), default=5, help="of each fault")
    parser.add_argument("--faults", nargs="+", choices=tuple(FAULTS), default=tuple(FAULTS))
    parser.add_argument("--policy", type=Path, help="policy file to measure; default: a stand-in of 10 M parameters")
    parser.add_argument("--parts", nargs="+", choices=parts, default=parts)
    options = parser.parse_args()
    figures: Figures = {}
    domain = 1 + os.getpid() % 60
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        stand_in = export_stand_in(folder / "stand_in")
        policy = options.policy or stand_in
        if "steady" in options.parts:
            figures |= measure_steady(policy, folder, domain, options.seconds)
        if "episodes" in options.parts:
            figures |= measure_episodes(policy, stand_in, folder, domain + 4, options.resets)
        if "faults" in options.parts:
            figures |= measure_faults(policy, domain + 6, options.repeats, options.faults)
            figures["faults_load_average"] = ([os.getloadavg()[0]], "processes wanting a core, during the faults")
        if "fuzz" in options.parts:
            figures["fuzz_outside_limits"] = ([float(fuzz(1_000_000))], "of 1,000,000 outputs of any 64 bits")
        if "policy" in options.parts:
            figures |= measure_policy(policy, options.seconds)

    from benchmarks.harness import figure, record

    cpu = f"cpu, {len(os.sched_getaffinity(0))} cores, {cpu_model()}"
    path = record("bridge", CLAIM, {name: figure(repeats, unit, cpu) for name, (repeats, unit) in figures.items()})
    for name, (repeats, unit) in figures.items():
        print(f"{name:28s} {statistics.median(repeats):10.3f} {unit}")
    print(path)


def cpu_model() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "unknown")


if __name__ == "__main__":
    with guarded():
        main()
