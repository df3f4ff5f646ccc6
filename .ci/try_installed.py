"""Tries an installation from outside the repository: `python try_installed.py REPOSITORY`, in an empty folder.

Everything that a newcomer does first must work: list the commands, inspect and drive, step the simulator, look at runs.
"""

from __future__ import annotations

import importlib.resources
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


def main(repository: Path) -> None:
    """Try it."""
    packages = ("whill_mjx", "sysid", "dreamer", "bridge")
    for name in packages:
        place = Path(str(importlib.resources.files(name)))
        assert not place.is_relative_to(repository) or place.is_relative_to(Path(sys.prefix)), f"{name} is {place}"
        assert (place / "py.typed").exists(), f"{name} has no py.typed"
    import whill_mjx

    for name in ("whill_mjx", "sysid", "dreamer", "bridge"):
        command(name)
    chair = str(Path(str(importlib.resources.files("sysid"))) / "data" / "chair")
    command("sysid.inspect", chair, "--out", "inspected")
    command("whill_mjx.export_python", "whill_cr_physical", "--out", "vehicle.py")
    command("whill_mjx.view", "inspected", "--out", "view.html")
    command("whill_mjx.look", "--help")
    assert "nothing looks wrong" in Path("view.html").read_text()
    scripts = Path(sysconfig.get_path("scripts"))
    assert (scripts / "whill-train").exists() and (scripts / "sysid-fit").exists()
    env, vehicle = whill_mjx.make_env("obstacle_course")
    import jax

    state, first = jax.jit(lambda key: whill_mjx.reset(env, vehicle, key))(jax.random.key(0))
    assert first.obs.shape == (64, 64, 3)
    print(f"whill-mjx {whill_mjx.__version__} works on Python {sys.version.split()[0]}")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
