"""Latency and reaction times of the bridge: separate processes over real DDS on this machine.

    python -m benchmarks.bridge --seconds 60
    python -m benchmarks.bridge --parts steady --seconds 720 --together     # each steady run on two cores of its own
    python -m benchmarks.bridge --parts steady --steady healthy --seconds 1800   # stops, late commands, memory

The policy is a stand-in of 10 million random parameters with the shape of a trained one (recurrent, 64x64 RGB), unless
--policy names another. A trained policy cannot be made to fail on purpose, so faults always use the stand-in. All times
are of the system's one steady clock. Figures named `_realtime` are taken with both nodes under SCHED_FIFO, and left out
where that is not permitted. Faults are those of benchmarks.bridge_faults; a reaction is the time from the injection to
the first zero that the base hears.
"""

from __future__ import annotations

import contextlib
import dataclasses
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
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bridge_faults import FAULTS, Figures, fault_rows, measure_faults
from benchmarks.bridge_robot import environment_of
from bridge.nodes.options import Parser, in_range, whole
from bridge.simulation.simulated import Frame
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
    """Write a recurrent policy of random parameters; a white image makes its action NaN, a pale one surprises it."""
    import jax
    import jax.numpy as jnp

    from dreamer.policy_files.export import PolicyContract, export_policy

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
        surprise = jnp.where((x.mean() > 0.7) & (x.mean() < 0.9), 100.0, 1.0)
        return ({"deter": deter, "surprise": jnp.full_like(carry["surprise"], surprise)},
                jnp.where(x.mean() > 0.99, jnp.nan, action))

    contract = PolicyContract(action_low=(-0.5, -0.6), action_high=(1.0, 0.6), task="stand-in", novelty=(10.0, 50.0))
    carry = {"deter": np.zeros(HIDDEN, np.float32), "surprise": np.zeros(1, np.float32)}
    return export_policy(folder, step, carry, weights, contract, check_steps=1000)


@dataclasses.dataclass(frozen=True)
class Place:
    """Where two nodes run."""

    domain: int
    """ROS domain."""
    cores: Sequence[int] = ()
    """That they have for themselves; none takes all."""
    realtime: bool = False
    """Under SCHED_FIFO."""


class Run:
    """One simulator and one policy node, and what they report."""

    def __init__(self, folder: Path, policy: Path, robot: str, place: Place, *options: str) -> None:
        domain = place.domain
        self.results, self.drive_results = folder / f"simulate_{domain}.json", folder / f"drive_{domain}.json"
        for path in (self.results, self.drive_results):
            path.unlink(missing_ok=True)
        self._cores = place.cores
        self._environment = environment_of(domain)
        scheduling = ("--realtime", "20") if place.realtime else ()
        self.drive = self._start("bridge.drive", str(policy), "--results", str(self.drive_results), *scheduling)
        self.simulate = self._start("bridge.simulate", "--simulator", f"benchmarks.bridge:{robot}", "--results",
                                    str(self.results), *scheduling, *options)

    def _start(self, module: str, *arguments: str) -> subprocess.Popen[bytes]:
        process = subprocess.Popen([sys.executable, "-m", module, *arguments], env=self._environment,
                                   stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        if self._cores:
            os.sched_setaffinity(process.pid, self._cores)
        return process

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


def may_run_in_real_time() -> bool:
    """Return whether SCHED_FIFO is permitted here; say so where it is not."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except PermissionError:
        print("SCHED_FIFO is not permitted here: figures in real time are left out", flush=True)
        return False
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    return True


def processor_seconds(pid: int) -> float:
    """Return the processor time [s] that a process has taken."""
    with open(f"/proc/{pid}/stat") as file:
        fields = file.read().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def memory_mb(pid: int) -> float:
    """Return the resident memory of a process [MB]."""
    with open(f"/proc/{pid}/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


@contextlib.contextmanager
def burners(count: int, cores: Sequence[int] = ()) -> Iterator[None]:
    """Processes that take a core each, of these cores where some are named."""
    running = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        for one in running:
            if cores:
                os.sched_setaffinity(one.pid, cores)
        yield
    finally:
        for one in running:
            one.kill()
            one.wait()


def fuzz(count: int) -> tuple[int, int]:
    """Return how many commands of a supervisor left its limits, and its slew limits, of so many outputs of any bits."""
    from bridge.safeguards.safety import SafetyConfig, Supervisor

    low, high, slew = np.array([-0.5, -1.0]), np.array([1.0, 1.0]), np.array([0.5, 1.0])
    plain = SafetyConfig((-0.5, -1.0), (1.0, 1.0))
    supervisors = [Supervisor(plain), Supervisor(dataclasses.replace(plain, slew=(0.5, 1.0)))]
    rng, now, wrong, jumps, before = np.random.default_rng(0), 0.0, 0, 0, np.zeros(2)
    for number, bits in enumerate(rng.integers(0, 2**64, (count, 2), np.uint64)):
        now += 0.1
        for supervisor in supervisors:
            supervisor.frame(now, now, number)
            command = supervisor.action(now, bits.view(np.float64))
            sent = np.array([command.v, command.omega])
            wrong += not (np.all(low <= sent) and np.all(sent <= high))
            supervisor.arm()
        jumps += bool(sent.any() and np.any(np.abs(sent - before) > 0.1 * slew + 1e-9))
        before = sent
    return wrong, jumps


def policy_times(policy_path: Path, steps: int) -> np.ndarray:
    """Return the durations and the processor times (steps, 2) [ms] of policy steps paced at 10 Hz.

    The duration is from an image to its command. What the bridge computes before the image comes is only in the
    processor time. A step that waits for a core, because others are busy, lasts longer but takes no more of that.
    """
    from bridge.policy import Policy

    policy = Policy.load(policy_path)
    seen = {name: np.full_like(value, 90) for name, value in policy.zeros().items()}
    times = []
    for _ in range(steps):
        start = time.perf_counter(), time.thread_time()
        policy.step(seen)
        duration = time.perf_counter() - start[0]
        policy.prepare()
        times.append((duration, time.thread_time() - start[1]))
        time.sleep(0.1)
    return 1e3 * np.array(times)


def cold_start(policy_path: Path) -> float:
    """Return the seconds from starting a process to its first command."""
    code = ("import sys, numpy as np; from bridge.policy import Policy; p = Policy.load(sys.argv[1]); "
            "assert np.isfinite(p.step(p.zeros())).all()")
    start = time.perf_counter()
    subprocess.run([sys.executable, "-c", code, str(policy_path)], check=True)
    return time.perf_counter() - start


@dataclasses.dataclass(frozen=True)
class Steady:
    """An undisturbed drive of some kind."""

    suffix: str
    """Of its figures' names."""
    options: tuple[str, ...] = ()
    """Of the simulator."""
    burners: int = 0
    """Busy processes on the same cores."""

    @property
    def realtime(self) -> bool:
        """Whether the nodes run under SCHED_FIFO."""
        return self.suffix.endswith("_realtime")

    @property
    def healthy(self) -> bool:
        """Whether it is the long one, whose stops, late commands and memory count."""
        return self.suffix == "_healthy"


START = 15.0
"""Seconds after which nodes have found each other, and all that is loaded once is in memory."""
LARGE = ("--image-size", "720", "1280")
STEADY = {
    "usual": Steady(""), "realtime": Steady("_realtime"),
    "large": Steady("_720p", LARGE), "large_realtime": Steady("_720p_realtime", LARGE),
    "busy": Steady("_busy", burners=2), "busy_realtime": Steady("_busy_realtime", burners=2),
    "healthy": Steady("_healthy"),
}


class SteadyRun:
    """One steady drive while it runs."""

    def __init__(self, kind: Steady, folder: Path, policy: Path, domain: int, cores: Sequence[int]) -> None:
        self.kind = kind
        self._stack = contextlib.ExitStack()
        self._stack.enter_context(burners(kind.burners, cores))
        self._run = Run(folder, policy, "EndlessRobot", Place(domain, cores, kind.realtime), *kind.options)
        self.memory: list[float] = []
        self._taken = 0.0

    def mark(self) -> None:
        """Note memory and processor time now."""
        self.memory.append(memory_mb(self._run.drive.pid))
        self._taken = processor_seconds(self._run.drive.pid) - self._taken

    def finish(self, seconds: float) -> tuple[Figures, int, int]:
        """End it; return its figures, stops and missed ticks."""
        with self._stack:
            results, drive = self._run.finish()
        delays, intervals = settled(results)
        suffix, error = self.kind.suffix, np.abs(intervals - 100)
        figures: Figures = {}
        if self.kind.burners:
            figures[f"interval_p99{suffix.removeprefix('_busy')}_ms"] = (
                [float(np.percentile(error, 99))], f"ms off the period, {self.kind.burners} busy processes")
        elif self.kind.options:
            suffix = suffix.removeprefix("_720p")
            figures[f"frame_720p_p99{suffix}_ms"] = ([float(np.percentile(delays, 99))], "ms", histogram(delays))
            end = results["commands"][-results["stops_at_end"]][0]  # the policy node's farewell
            shown = sum(t < end - 0.01 for t in results["image_times"])
            figures[f"frames_720p_delivered{suffix}"] = ([min(1.0, drive["counts"]["frames"] / shown)], "share")
        else:
            for name, share, more in (("p50", 50, (histogram(delays),)), ("p99", 99, ()), ("max", 100, ())):
                figures[f"frame_to_command_{name}{suffix}_ms"] = (
                    [float(np.percentile(delays, share))], f"ms, of {len(delays)} frames a drive", *more)
            figures[f"tick_error_p99{suffix}_ms"] = ([float(np.percentile(error, 99))], "ms")
            figures[f"drive_processor{suffix}_share"] = ([self._taken / seconds], "of a core, by the policy node")
        return figures, stops(drive), int((intervals > 150).sum())


def histogram(delays: np.ndarray) -> dict[str, list[float]]:
    """Return how many delays lie between each two of some bounds [ms]; the last bin has no upper one."""
    bounds = [0, 1, 2, 3, 4, 5, 6, 8, 10, 12, 15, 20, 30, 40, 60, 100]
    counts, _ = np.histogram(delays, [*bounds, np.inf])
    return {"histogram_from_ms": [float(one) for one in bounds], "histogram_counts": [float(one) for one in counts]}


def with_former(name: str, former: tuple, one: tuple) -> tuple:
    """Return a figure of a drive with that of drives of the same kind before it: their median counts, of `max` the
    largest.
    """
    values = former[0] + one[0]
    counts = "histogram_counts"
    more = [{**b, counts: [x + y for x, y in zip(a[counts], b[counts], strict=True)]}
            for a, b in zip(former[2:], one[2:], strict=True)]
    return [max(values)] if "_max_" in name else values, *former[1:2], *more


def measure_steady(policy: Path, folder: Path, domain: int, seconds: float, kinds: Sequence[str], together: bool
                   ) -> Figures:
    """Return latency, pacing, delivery, spurious stops and memory of undisturbed drives.

    Args:
        policy: what drives.
        folder: for the results of the nodes.
        domain: ROS domain of the first drive.
        seconds: of each drive.
        kinds: which of `STEADY`, one after the other; of one that is named several times all drives count.
        together: drive all at once, each on two cores of its own, instead of one after another on all cores.
    """
    cores = sorted(os.sched_getaffinity(0))
    batches = [list(kinds)] if together else [[kind] for kind in kinds]
    figures: Figures = {}
    healthy_stops, missed, growth, memory, healthy, load = 0, 0, [], [], 0.0, []
    for number, batch in enumerate(batches):
        runs = [SteadyRun(STEADY[kind], folder, policy, domain + number + i, cores[2 * i:2 * i + 2] if together else ())
                for i, kind in enumerate(batch)]
        time.sleep(START)
        for run in runs:
            run.mark()
        time.sleep(seconds)
        load.append(os.getloadavg()[0])
        for run in runs:
            run.mark()
            found, stopped, late = run.finish(seconds)
            figures |= {name: with_former(name, figures[name], one) if name in figures else one
                        for name, one in found.items()}
            if run.kind.healthy:
                healthy_stops, missed, healthy = healthy_stops + stopped, missed + late, healthy + seconds
                memory.append(run.memory[-1])
                growth.append(run.memory[-1] - run.memory[0])
    figures["load_average"] = (load, f"processes wanting one of {os.cpu_count()} cores, during the runs above")
    if healthy:
        about = f"in {healthy:.0f} healthy seconds of {len(memory)} drives"
        figures["healthy_stops"] = ([float(healthy_stops)], f"stops {about}")
        figures["missed_ticks"] = ([float(missed)], f"commands 50 ms late {about}")
        figures["drive_memory_mb"] = (memory, "MB of the policy node, resident, after a drive")
        figures["memory_growth_mb"] = (growth, f"MB in {seconds:.0f} s, after the first {START:.0f} s")
    return figures


def measure_episodes(policy: Path, stand_in: Path, folder: Path, domain: int, resets: int) -> Figures:
    """Return the reactions to a camera that falls silent, at resets, and to an action that is not a number."""
    run = Run(folder, policy, "ShortRobot", Place(domain), "--episodes", str(resets))
    run.simulate.wait(30 + 4 * resets)
    results, _ = run.finish()
    moved = [t for t, v, omega in results["commands"] if v or omega]
    # the first episodes may be over before the nodes have found each other: nothing moves, and nothing needs a zero
    episodes = [episode for episode in results["episodes"] if any(0 <= episode["ended"] - t < 0.2 for t in moved)]
    stale = sum(1 for begin in (episode["began"] for episode in episodes[1:])
                for t, v, omega in results["commands"] if begin - 0.15 < t < begin + 0.1 and (v or omega))
    run = Run(folder, stand_in, "WhiteRobot", Place(domain + 1), "--episodes", "4")
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
        "policy_p99_ms": ([wall], "ms from an image to its command"),
        "policy_processor_p99_ms": ([processor], "ms of processor time, the part before the image included"),
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
    parser.add_argument("--faults", nargs="+", choices=FAULTS, default=FAULTS)
    parser.add_argument("--policy", type=Path, help="policy file to measure; default: a stand-in of 10 M parameters")
    parser.add_argument("--parts", nargs="+", choices=parts, default=parts)
    parser.add_argument("--steady", nargs="+", choices=tuple(STEADY), default=tuple(STEADY),
                        help="which steady runs, also several times; busy: beside two processes that take all they "
                             "get; healthy: the one whose stops, late commands and memory are counted")
    parser.add_argument("--together", action="store_true",
                        help="all steady runs at once, each on two cores of its own")
    parser.add_argument("--domain", type=whole(1, 95), help="first of six ROS domains; none takes one by the process")
    options = parser.parse_args()
    cores = len(os.sched_getaffinity(0))
    if options.together and cores < 2 * len(options.steady):
        parser.error(f"--together: {len(options.steady)} steady runs need {2 * len(options.steady)} cores, and there "
                     f"are {cores}. Leave it out")
    figures: Figures = {}
    domain = options.domain or 1 + os.getpid() % 90
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        stand_in = export_stand_in(folder / "stand_in")
        policy = options.policy or stand_in
        if "steady" in options.parts:
            options.steady = [kind for kind in options.steady if not STEADY[kind].realtime or may_run_in_real_time()]
            figures |= measure_steady(policy, folder, domain, options.seconds, options.steady, options.together)
        if "episodes" in options.parts:
            figures |= measure_episodes(policy, stand_in, folder, domain, options.resets)
        if "faults" in options.parts:
            figures |= measure_faults(stand_in, domain, options.repeats, options.faults)
            rows = fault_rows()
            figures["faults_untested"] = ([float(sum(not checks for _, checks in rows))],
                                          f"of {len(rows)} rows of the fault table, without figure or test")
            figures["faults_load_average"] = ([os.getloadavg()[0]], "processes wanting a core, during the faults")
        if "fuzz" in options.parts:
            of = "of 1,000,000 outputs of any 64 bits"
            for name, found in zip(("fuzz_outside_limits", "fuzz_outside_slew"), fuzz(1_000_000), strict=True):
                figures[name] = ([float(found)], of)
        if "policy" in options.parts:
            figures |= measure_policy(policy, options.seconds)

    from benchmarks.harness import record

    cpu = f"cpu, {len(os.sched_getaffinity(0))} cores, {cpu_model()}"
    path = record("bridge", CLAIM, entries(figures, cpu))
    for name, (repeats, unit, *_) in figures.items():
        print(f"{name:28s} {statistics.median(repeats):10.3f} {unit}")
    print(path)


def entries(figures: Figures, device: str) -> dict[str, Any]:
    """Return figures as a result file has them."""
    from benchmarks.harness import figure

    return {name: {**figure(repeats, unit, device), **(more[0] if more else {})}
            for name, (repeats, unit, *more) in figures.items()}


def cpu_model() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "unknown")


if __name__ == "__main__":
    with guarded():
        main()
