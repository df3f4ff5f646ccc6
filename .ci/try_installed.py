"""Tries an installation from outside the repository: `python try_installed.py PACKAGE REPOSITORY`, in an empty folder.

Of `whill_mjx`, what a newcomer does first must work: list the commands, inspect, step the simulator, look at runs. Of
`whill_bridge`, its commands must be listed and its reader of policies imported, with nothing else of the project there.
"""

from __future__ import annotations

import importlib.metadata
import importlib.resources
import importlib.util
import subprocess
import sys
import sysconfig
import time
from pathlib import Path


def command(*words: str) -> str:
    """Run a command of the installation; its output."""
    began = time.perf_counter()
    done = subprocess.run([sys.executable, "-m", *words], capture_output=True, text=True)
    print(f"  python -m {' '.join(words)}: {time.perf_counter() - began:.0f} s", flush=True)
    if done.returncode:
        sys.exit(f"exit code {done.returncode}: {done.stderr[-2000:]}")
    return done.stdout


def check_places(packages: tuple[str, ...], repository: Path) -> None:
    """Packages must be those of this environment, with their type information."""
    for name in packages:
        place = Path(str(importlib.resources.files(name)))
        assert place.is_relative_to(Path(sys.prefix)) or not place.is_relative_to(repository), f"{name} is {place}"
        assert (place / "py.typed").exists(), f"{name} has no py.typed"
        command(name)


def try_bridge(repository: Path) -> None:
    """The bridge alone."""
    check_places(("bridge",), repository)
    from bridge.policy import PolicyFileError, read_policy

    try:
        read_policy("nowhere")
    except PolicyFileError as error:
        print(f"  a missing policy: {error}")
    assert importlib.util.find_spec("whill_mjx") is None, "the bridge brought the simulator with it"


def try_simulator(repository: Path) -> None:
    """The whole project."""
    check_places(("whill_mjx", "sysid", "dreamer", "bridge"), repository)
    chair = str(Path(str(importlib.resources.files("sysid"))) / "data" / "chair")
    command("sysid.inspect", chair, "--out", "inspected")
    command("whill_mjx.export_python", "whill_cr_physical", "--out", "vehicle.py")
    command("whill_mjx.view", "inspected", "--out", "view.html")
    assert "nothing looks wrong" in Path("view.html").read_text()
    scripts = Path(sysconfig.get_path("scripts"))
    assert (scripts / "whill-train").exists() and (scripts / "sysid-fit").exists()
    import jax

    import whill_mjx

    env, vehicle = whill_mjx.make_env("obstacle_course")
    state, first = jax.jit(lambda key: whill_mjx.reset(env, vehicle, key))(jax.random.key(0))
    assert first.obs.shape == (64, 64, 3)


def main(package: str, repository: Path) -> None:
    """Try it."""
    (try_bridge if package == "whill_bridge" else try_simulator)(repository)
    print(f"{package} {importlib.metadata.version(package)} works on Python {sys.version.split()[0]}")


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]).resolve())
