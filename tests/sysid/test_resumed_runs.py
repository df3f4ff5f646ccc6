"""A fit that was stopped goes on after its last step, and ends in the bits of one that was left alone."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from random import Random

import jax.numpy as jnp
import numpy as np
import pytest
from cart import cart
from conftest import SHORT, TRUTH, unicycle_plant

from sysid.fit import Arguments, main
from sysid.logs.synthetic import write_dataset
from whill_mjx.io import steps
from whill_mjx.io.command_line import OptionError
from whill_mjx.vehicle.specs import WHILL_CR

ROOT = Path(__file__).parents[2]
PARAMETERS = '''{"tau_v": (0.1, 0.02, 1.0), "tau_omega": (0.1, 0.02, 1.0), "turn": (1.0, 0.5, 1.5)}'''


class Stop(BaseException):
    """Stands for a kill."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A dataset of a cart, and the cart as a model to fit."""
    folder = tmp_path_factory.mktemp("resumed")
    write_dataset(folder / "log", WHILL_CR, jnp.asarray(TRUTH), replicates=1, scenario=SHORT, plant=unicycle_plant(),
                  seed=3)
    (folder / "cart.py").write_text(cart("tau_v", "tau_omega", PARAMETERS))
    return folder


def arguments(folder, out, **more):
    return Arguments(dataset=folder / "log", out=out, **{
        "model": str(folder / "cart.py"), "method": "both", "trials": 8, "iterations": 4, "quick": True, **more})


def results(out):
    """What a fit wrote, without the times that it took."""
    report = json.loads((out / "report.json").read_text())
    report["search"].pop("seconds")
    with np.load(out / "series.npz") as series:
        return report, (out / "model.toml").read_text(), {name: series[name].tobytes() for name in series.files}


@pytest.mark.parametrize("more", [{"method": "tpe"}, pytest.param({"method": "both"}, marks=pytest.mark.long)])
def test_a_fit_stopped_at_random_steps_ends_in_the_same_bits(more, folder, tmp_path, monkeypatch):
    main(arguments(folder, tmp_path / "straight", **more))
    broken, random, kept, left = tmp_path / "broken", Random(2), steps.whole_file, 0

    def stopping(path):
        nonlocal left
        left -= 1
        if not left:
            raise Stop
        return kept(path)

    monkeypatch.setattr(steps, "whole_file", stopping)
    stops = 0
    while not (broken / "report.json").exists():
        left = random.randint(2, 12 if more["method"] == "both" else 3)
        try:
            main(arguments(folder, broken, **more))
        except Stop:
            stops += 1
            assert not (broken / "model.toml").exists()
    assert stops and not (broken / "steps").exists()
    assert results(broken) == results(tmp_path / "straight")
    with pytest.raises(OptionError, match="iterations is 4 there and 5 here"):
        main(arguments(folder, broken, **more, iterations=5))


def test_a_full_disk_at_the_end_keeps_what_was_computed(folder, tmp_path, monkeypatch):
    quick = {"method": "lm", "iterations": 3, "elsewhere": False}

    def full(*words):
        raise OSError(28, "No space left on device", "report.json")

    monkeypatch.setattr("sysid.pages.fit_report.write_report", full)
    with pytest.raises(OSError) as failed:
        main(arguments(folder, tmp_path / "run", **quick))
    assert f"is in {tmp_path / 'run' / 'steps'}; the same command goes on there." in failed.value.__notes__[0]
    monkeypatch.undo()
    monkeypatch.setattr("sysid.search.least_squares._Descent.advanced", lambda *words: pytest.fail("computed again"))
    main(arguments(folder, tmp_path / "run", **quick))
    assert (tmp_path / "run" / "report.json").exists()


LONG = {
    "fit": ["sysid.fit", "{log}", "--model", "{cart}", "--quick"],
    "vehicle": ["sysid.fit", "{chair}", "--quick"],
    "close_loop": ["sysid.close_loop", "{chair}", "--quick", "--refit-nulls", "20"],
}
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)


def command(which, folder, out):
    names = {"log": folder / "log", "cart": folder / "cart.py", "chair": ROOT / "sysid" / "data" / "chair"}
    words = [word.format(**names) for word in LONG[which]]
    return subprocess.Popen([sys.executable, "-m", *words, "--out", str(out)], cwd=ROOT, stdout=subprocess.DEVNULL,
                            stderr=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)})  # fmt: skip


def kept_steps(out):
    return len(list((out / "steps").glob("*.npz")))


def report_of(out):
    """The report without times."""
    report = json.loads((out / "report.json").read_text())
    report.pop("seconds", None)
    report.get("search", {}).pop("seconds", None)
    return report


@pytest.mark.long
@pytest.mark.parametrize("which", LONG)
def test_a_command_killed_ten_times_by_each_signal_ends_in_the_same_bits(which, folder, tmp_path):
    straight, broken, random = tmp_path / "straight", tmp_path / "broken", Random(4)
    child = command(which, folder, straight)
    most = 0
    while child.poll() is None:
        most = max(most, kept_steps(straight))
        time.sleep(0.1)
    assert child.returncode == 0, child.stderr.read()
    kills = [number for number in SIGNALS for _ in range(10)]
    random.shuffle(kills)
    for index, number in enumerate(kills):
        child, wanted = command(which, folder, broken), (index + 1) * most // (len(kills) + 1)
        if index % 3 == 0:
            time.sleep(random.uniform(0.5, 8.0))  # some fall into its start
        while index % 3 and child.poll() is None and kept_steps(broken) < wanted:
            time.sleep(0.01)
        before = kept_steps(broken)
        child.send_signal(number)
        told = child.communicate()[1]
        assert child.returncode in ((-number, 0) if number == signal.SIGKILL else (130, 0)), told
        assert "Traceback" not in told and kept_steps(broken) >= before
    child = command(which, folder, broken)
    assert child.communicate() and child.returncode == 0
    assert report_of(broken) == report_of(straight)
    name = "model.toml" if which == "fit" else "vehicle.toml"
    assert (broken / name).read_bytes() == (straight / name).read_bytes()


@pytest.mark.long
def test_two_fits_at_once_in_one_folder_give_one_fit_and_one_refusal(folder, tmp_path):
    children = [command("fit", folder, tmp_path / "run") for _ in range(2)]
    told = [child.communicate()[1] for child in children]
    assert sorted(child.returncode for child in children) == [0, 2]
    assert sum("writes there" in text for text in told) == 1
