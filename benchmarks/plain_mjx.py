"""Ten plain MJX programs, with and without our packages imported first: `python -m benchmarks.plain_mjx`.

An import may not change what other people's programs do. Each program builds a model of its own, compiles it and steps
it on the processor. A fresh process runs all ten, in turn without and with the imports. Counted are the programs that
end their process, and those whose runs with the imports are all slower, or all faster, than every run without.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
from dataclasses import dataclass
from typing import Annotated

from benchmarks.harness import figure, record
from benchmarks.logs import CLAIM
from whill_mjx.io.command_line import Range, run

FREE = '<body pos="{x} 0 {z}"><freejoint/><geom type="{shape}" size="{size}"/></body>'
PLANE = '<geom type="plane" size="5 5 0.1"/>'
POLE = '<body><joint type="slide" axis="1 0 0"/><geom size="0.1"/><body><joint axis="0 1 0"/>{pole}</body></body>'
ROD = '<geom type="capsule" size="0.03" fromto="0 0 0 0 0 0.6"/>'
CHAIN = '<body pos="{x} 0 0"><joint axis="0 1 0"/><geom type="capsule" size="0.03" fromto="0 0 0 0.2 0 0"/>'


def two(shape: str, size: str, z: float = 0.1) -> str:
    """World of two free bodies of one shape on a plane."""
    return PLANE + "".join(FREE.format(x=x, z=z, shape=shape, size=size) for x in (0.0, 0.5))


def model(world: str, more: str = "") -> str:
    """MJCF text of a world."""
    return f"<mujoco><option iterations='4' ls_iterations='4'/>{more}<worldbody>{world}</worldbody></mujoco>"


WHEEL = (
    '<body pos="0 {y} 0" euler="90 0 0"><joint name="{name}" axis="0 0 1"/>'
    '<geom type="cylinder" size="0.1 0.02"/></body>'
)
WHEELED = (
    f'{PLANE}<body pos="0 0 0.1"><freejoint/><geom type="box" size="0.2 0.15 0.03"/>'
    f"{WHEEL.format(name='left', y=0.2)}{WHEEL.format(name='right', y=-0.2)}</body>"
)
DRIVEN = '<actuator><velocity joint="left" kv="0.1"/><velocity joint="right" kv="0.1"/></actuator>'
SENSED = '<sensor><jointpos joint="left"/><jointvel joint="right"/></sensor>'
PROGRAMS: dict[str, str] = {
    "two spheres": model(two("sphere", "0.1")),
    "two capsules": model(two("capsule", "0.05 0.1")),
    "two cylinders": model(two("cylinder", "0.1 0.1")),
    "two boxes": model(two("box", "0.1 0.1 0.1")),
    "a box and a sphere": model(PLANE + FREE.format(x=0, z=0.1, shape="box", size="0.1 0.1 0.1")
                                + FREE.format(x=0, z=0.4, shape="sphere", size="0.1")),
    "a cart and its pole": model(POLE.format(pole=ROD)),
    "a chain of five": model("".join(CHAIN.format(x=0.2 if part else 0) for part in range(5)) + "</body>" * 5),
    "two wheels": model(WHEELED),
    "two wheels with motors": model(WHEELED, DRIVEN),
    "two wheels with motors and sensors": model(WHEELED, DRIVEN + SENSED),
}  # fmt: skip
"""Of each program the model that it steps."""
CHILD = """
import json, sys, time
if sys.argv[1] == "with":
    import whill_mjx, sysid, dreamer, bridge
    import whill_mjx.env, whill_mjx.train, sysid.fit, sysid.close_loop
import jax, mujoco
from mujoco import mjx

for name, text in json.loads(sys.argv[2]).items():
    placed = mjx.put_model(mujoco.MjModel.from_xml_string(text))
    steps = jax.jit(lambda data: jax.lax.scan(lambda d, _: (mjx.step(placed, d), None), data, length=200)[0].qpos)
    start = mjx.make_data(placed)
    jax.block_until_ready(steps(start))
    times = []
    for _ in range(5):
        begun = time.perf_counter()
        jax.block_until_ready(steps(start))
        times.append(time.perf_counter() - begun)
    print("DONE", json.dumps([name, min(times)]), flush=True)
"""


@dataclass(frozen=True)
class Options:
    """Options of the benchmark."""

    repeats: Annotated[int, Range(2, 100)] = 5
    """Processes of each kind; fewer than four separate two kinds by chance too often."""
    only: tuple[str, ...] = ()
    """Only these programs."""


def seconds(kind: str, programs: dict[str, str]) -> dict[str, float | None]:
    """Time of 200 steps of each program; None of one that ended its process."""
    found: dict[str, float | None] = {}
    while left := {name: text for name, text in programs.items() if name not in found}:
        environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
        environment.pop("XLA_FLAGS", None)  # this process has set its own
        command = [sys.executable, "-c", CHILD, kind, json.dumps(left)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        for line in done.stdout.splitlines():
            if line.startswith("DONE "):
                name, took = json.loads(line.removeprefix("DONE "))
                found[name] = took
        if done.returncode:
            stopped = next(name for name in left if name not in found)
            print(f"{stopped}, {kind}: ended with {done.returncode}: {done.stderr.strip()[-300:]}", flush=True)
            found[stopped] = None
    return found


def main(options: Options) -> None:
    """Run all programs in turn, and record how many the imports break or change."""
    programs = {name: text for name, text in PROGRAMS.items() if not options.only or name in options.only}
    plain: dict[str, list[float | None]] = {name: [] for name in programs}
    ours: dict[str, list[float | None]] = {name: [] for name in programs}
    for _ in range(options.repeats):
        for kind, kept in (("without", plain), ("with", ours)):
            for name, took in seconds(kind, programs).items():
                kept[name].append(took)
    broken, changed, ratios = [], [], {}
    for name in programs:
        before = [took for took in plain[name] if took is not None]
        after = [took for took in ours[name] if took is not None]
        if len(after) < len(before):
            broken.append(name)
        if not before or not after:
            continue
        ratios[name] = statistics.median(after) / statistics.median(before)
        if max(before) < min(after) or max(after) < min(before):
            changed.append(name)
        print(f"{name}: {ratios[name]:.3f} of the time without", flush=True)
    figures = {
        "plain_mjx_aborts": {**figure([float(len(broken))], f"of {len(programs)} programs"), "programs": broken},
        "plain_mjx_changed": {**figure([float(len(changed))], f"of {len(programs)} programs"), "programs": changed},
        "plain_mjx_time_ratio": {**figure(list(ratios.values()), "ratio"), "programs": list(ratios)},
    }
    for name, one in figures.items():
        print(name, one["value"], one["programs"])
    print(record("logs", CLAIM, figures))


if __name__ == "__main__":
    run(Options, main, __doc__, positional=False)
