"""Latency and reaction times of the bridge: separate processes over real DDS on this machine.

    python -m benchmarks.bridge --seconds 60

The policy is a stand-in of 10 million random parameters with the shape of a trained one (recurrent, 64x64 RGB), unless
--policy names another. A trained policy cannot be made to fail on purpose, so `stop_action_ms` always uses the
stand-in. All times are of the system's one steady clock. Figures named `_realtime` are taken with both nodes under
SCHED_FIFO, where that is permitted.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from bridge.simulate import Frame

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
    return export_policy(folder, step, {"deter": np.zeros(HIDDEN, np.float32)}, weights, contract, check_steps=20)


class Run:
    """One simulator and one policy node, and what they report."""

    def __init__(self, folder: Path, policy: Path, robot: str, domain: int, *options: str, guard: bool = False,
                 realtime: bool = False) -> None:
        self.results, self.drive_results = folder / "simulate.json", folder / "drive.json"
        for path in (self.results, self.drive_results):
            path.unlink(missing_ok=True)
        self._environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        self.guard = self._start("bridge.guard") if guard else None
        scheduling = ("--realtime", "20") if realtime else ()
        self.drive = self._start("bridge.drive", str(policy), "--results", str(self.drive_results), *scheduling)
        self.simulate = self._start("bridge.simulate", "--simulator", f"benchmarks.bridge:{robot}", "--results",
                                    str(self.results), *scheduling, *options)

    def _start(self, module: str, *arguments: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen([sys.executable, "-m", module, *arguments], env=self._environment,
                                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def finish(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """End the processes, the policy node first, and return the results of simulator and policy node."""
        for process in (self.drive, self.simulate, self.guard):
            if process is not None:
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


def policy_times(policy_path: Path, steps: int) -> list[float]:
    """Return the durations [ms] of policy steps paced at 10 Hz."""
    from bridge.policy import Policy

    policy = Policy.load(policy_path)
    image = np.full((policy.contract.height, policy.contract.width, 3), 90, np.uint8)
    times = []
    for _ in range(steps):
        start = time.perf_counter()
        policy.step(image)
        times.append(1e3 * (time.perf_counter() - start))
        time.sleep(0.1)
    return times


def cold_start(policy_path: Path) -> float:
    """Return the seconds from starting a process to its first command."""
    code = ("import sys, numpy as np; from bridge.policy import Policy; p = Policy.load(sys.argv[1]); "
            "c = p.contract; assert np.isfinite(p.step(np.zeros((c.height, c.width, 3), np.uint8))).all()")
    start = time.perf_counter()
    subprocess.run([sys.executable, "-c", code, str(policy_path)], check=True)
    return time.perf_counter() - start


def measure(seconds: float, resets: int, kills: int, policy_path: Path | None) -> dict[str, tuple[list[float], str]]:
    """Return every figure as its repeats and unit."""
    figures: dict[str, tuple[list[float], str]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        stand_in = export_stand_in(folder / "stand_in")
        policy = policy_path or stand_in
        domain = 1 + os.getpid() % 80

        for suffix in ("", "_realtime"):
            run = Run(folder, policy, "EndlessRobot", domain, realtime=bool(suffix))
            domain += 1
            time.sleep(seconds + 5)
            delays, intervals = settled(run.finish()[0])
            figures[f"frame_to_command_p50{suffix}_ms"] = ([float(np.percentile(delays, 50))], "ms")
            figures[f"frame_to_command_p99{suffix}_ms"] = ([float(np.percentile(delays, 99))], "ms")
            figures[f"frame_to_command_max{suffix}_ms"] = ([float(delays.max())], "ms")
            figures[f"tick_error_p99{suffix}_ms"] = ([float(np.percentile(np.abs(intervals - 100), 99))], "ms")
            run = Run(folder, policy, "EndlessRobot", domain, "--image-size", "720", "1280", realtime=bool(suffix))
            domain += 1
            time.sleep(seconds + 5)
            results, drive = run.finish()
            figures[f"frame_720p_p99{suffix}_ms"] = ([float(np.percentile(settled(results)[0], 99))], "ms")
            end = results["commands"][-results["stops_at_end"]][0]  # the policy node's farewell
            shown = sum(t < end - 0.01 for t in results["image_times"])
            figures[f"frames_720p_delivered{suffix}"] = ([min(1.0, drive["counts"]["frames"] / shown)], "share")
        figures["load_average"] = ([os.getloadavg()[0]], "processes wanting a core, during the runs above")

        run = Run(folder, policy, "ShortRobot", domain, "--episodes", str(resets))
        run.simulate.wait(30 + 4 * resets)
        results, _ = run.finish()
        episodes = results["episodes"]
        figures["stop_input_ms"] = ([1e3 * first_zero(results, episode["ended"]) for episode in episodes], "ms")
        stale = sum(1 for begin in (episode["began"] for episode in episodes[1:])
                    for t, v, omega in results["commands"] if begin - 0.15 < t < begin + 0.1 and (v or omega))
        figures["stale_after_reset"] = ([float(stale)], f"commands before the third frame, {resets - 1} resets")

        run = Run(folder, stand_in, "WhiteRobot", domain + 1, "--episodes", "4")
        run.simulate.wait(90)
        results, _ = run.finish()
        whites = [episode["began"] + 0.1 * WhiteRobot.white_at for episode in results["episodes"]]
        figures["stop_action_ms"] = ([1e3 * first_zero(results, white - 0.03) - 30 for white in whites], "ms")

        killed = []
        for i in range(kills):
            run = Run(folder, policy, "EndlessRobot", domain + 2 + i, guard=True)
            time.sleep(7 + 0.037 * i)  # any phase of the control period
            at = time.monotonic()
            run.drive.kill()
            time.sleep(1)
            killed.append(1e3 * first_zero(run.finish()[0], at))
        figures["stop_killed_ms"] = (killed, "ms")
        figures["policy_p99_ms"] = ([float(np.percentile(policy_times(policy, int(10 * seconds)), 99))], "ms")
        figures["cold_start_s"] = ([cold_start(policy) for _ in range(3)], "s")
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bridge", description="Measure the bridge.")
    parser.add_argument("--seconds", type=float, default=60.0, help="length of each steady run")
    parser.add_argument("--resets", type=int, default=20)
    parser.add_argument("--kills", type=int, default=5)
    parser.add_argument("--policy", type=Path, help="policy file to measure; default: a stand-in of 10 M parameters")
    options = parser.parse_args()
    figures = measure(options.seconds, options.resets, options.kills, options.policy)

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
    main()
