"""A fit that was stopped goes on after its last step, and ends in the bits of one that was left alone."""

from __future__ import annotations

import json
import time
from contextlib import suppress
from functools import partial
from pathlib import Path
from random import Random

import jax.numpy as jnp
import numpy as np
import pytest
from cart import cart
from conftest import SHORT, TRUTH, unicycle_plant
from killed import Process, check_whole, killed_again_and_again, left_alone
from warm_starter import Warm

from benchmarks.planted_logs import Schedule, write_dataset
from sysid.fit import Arguments, main
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
    write_dataset(folder / "log", WHILL_CR, jnp.asarray(TRUTH), Schedule(replicates=1, scenario=SHORT, seed=3),
                  plant=unicycle_plant())
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


COMMANDS = {
    "fit": ["sysid.fit", "{log}", "--model", "{cart}", "--quick"],
    "vehicle": ["sysid.fit", "{chair}", "--quick"],
    "close_loop": ["sysid.close_loop", "{chair}", "--quick", "--refit-nulls", "20"],
}


def words_of(which, folder, out):
    names = {"log": folder / "log", "cart": folder / "cart.py", "chair": ROOT / "sysid" / "data" / "chair"}
    return [*(word.format(**names) for word in COMMANDS[which]), "--out", str(out)]


def kept_steps(out):
    with suppress(FileNotFoundError):  # the command may remove the folder at any moment
        return len(list((out / "steps").glob("[0-9]*.npz")))
    return 0


def files_of(out):
    """Everything that a run wrote but pictures and locks, without the times that it took."""
    found = {}
    for path in sorted(one for one in out.rglob("[!.]*") if one.is_file() and one.suffix not in (".png", ".html")):
        found[str(path.relative_to(out))] = path.read_bytes()
        if path.name == "report.json":
            report = json.loads(path.read_text())
            report.pop("seconds", None)
            report.get("search", {}).pop("seconds", None)
            found[str(path.relative_to(out))] = report
        elif path.suffix == ".npz":
            with np.load(path) as archive:
                found[str(path.relative_to(out))] = {name: archive[name].tobytes() for name in archive.files}
    return found


def ended_again_and_again(start, which, folder, outs, kills, said):
    """Module and words of a command that was left alone in the first folder and ended `kills` times by each signal in
    the other one."""
    (module, *straight), (_, *words) = (words_of(which, folder, out) for out in outs)
    alone, broken = (partial(kept_steps, out) for out in outs)
    most, seconds = left_alone(start(module, straight, said), said, alone)
    last = outs[1] / "report.json"
    killed_again_and_again(partial(start, module, words, said), last, kills, broken, most, seconds, said)
    return module, words


def test_a_fit_killed_three_times_by_each_signal_and_then_short_of_disk_ends_in_the_same_bits(folder, tmp_path):
    said, other, outs = tmp_path / "said", tmp_path / "other", [tmp_path / name for name in ("straight", "broken")]
    with Warm("sysid.fit", "sysid.pages.fit_report") as warm:
        module, words = ended_again_and_again(warm.start, "fit", folder, outs, 3, said)
        assert warm.start(module, words, said, largest=20_000).wait() == 1
        told = said.read_text()
        assert f"is in {outs[1] / 'steps'}; the same command goes on there." in told.splitlines()[-1], told
        check_whole(outs[1])
        child = warm.start(module, words, said)
        while f'"pid": {child.pid},' not in (outs[1] / ".lock").read_text():
            time.sleep(0.005)
        if warm.start(module, words, other).wait() != 0:
            assert f"process {child.pid} on " in other.read_text() and "writes there" in other.read_text()
        assert child.wait() == 0 and files_of(outs[1]) == files_of(outs[0])


@pytest.mark.long
@pytest.mark.parametrize("which", COMMANDS)
def test_a_command_killed_ten_times_by_each_signal_ends_in_the_same_bits(which, folder, tmp_path):
    said, outs = tmp_path / "said", [tmp_path / name for name in ("straight", "broken")]
    module, words = ended_again_and_again(Process, which, folder, outs, 10, said)
    assert Process(module, words, said).wait() == 0 and files_of(outs[1]) == files_of(outs[0])


@pytest.mark.long
@pytest.mark.parametrize("which", ["fit", "close_loop"])
def test_two_commands_at_once_in_one_folder_give_one_result_and_one_refusal(which, folder, tmp_path):
    module, *words = words_of(which, folder, tmp_path / "run")
    said = [tmp_path / f"said{k}" for k in range(2)]
    children = [Process(module, words, each) for each in said]
    assert sorted(child.wait() for child in children) == [0, 2]
    assert sum("writes there" in each.read_text() for each in said) == 1
