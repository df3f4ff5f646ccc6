"""Which trainings share compiled programs, and what a command begins while it imports its modules."""

import dataclasses
import os
from pathlib import Path
from random import Random
from unittest import mock

import jax
import pytest

from whill_mjx.io import compiled, wake
from whill_mjx.learning import kept
from whill_mjx.learning.setup import find_preset
from whill_mjx.tasks.corridor import Corridor
from whill_mjx.vehicle.vehicle_file import load_vehicle, save_vehicle

PRESET = find_preset("paper", "corridor")


@pytest.fixture
def vehicle(tmp_path):
    """File of the wheelchair."""
    path = tmp_path / "vehicle.toml"
    save_vehicle(path, *load_vehicle("whill_cr_ramp")[:2])
    return path


@pytest.fixture
def on_gpu(tmp_path, monkeypatch):
    """As on a GPU, with a folder for compiled programs."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    values = {**jax.config.values, "jax_compilation_cache_dir": str(tmp_path), "jax_enable_compilation_cache": True}
    monkeypatch.setattr(kept.jax, "config", mock.Mock(values=values))


def programs(vehicle, preset=PRESET, learner="dreamer"):
    return kept.kept_programs(preset, learner, vehicle)


@pytest.mark.usefixtures("on_gpu")
def test_the_same_training_finds_its_programs_and_another_one_does_not(vehicle, tmp_path, monkeypatch):
    first = programs(vehicle)
    assert first == programs(vehicle) and first.folder == tmp_path / "programs"
    other = dataclasses.replace(PRESET, learner=dataclasses.replace(PRESET.learner, units=128))
    wide = tmp_path / "wide.toml"
    wide.write_text(vehicle.read_text().replace("track = 0.496", "track = 0.6"))
    found = [first, programs(vehicle, other), programs(wide), programs(vehicle, learner="ppo"),
             programs(vehicle, dataclasses.replace(PRESET, looks="rich"))]
    monkeypatch.setenv("XLA_FLAGS", "--xla_gpu_autotune_level=0")
    found.append(programs(vehicle))
    monkeypatch.setattr(kept, "code", lambda: "edited")
    found.append(programs(vehicle))
    assert len({one.made_of for one in found}) == len(found)


@pytest.mark.usefixtures("on_gpu")
def test_length_and_evaluations_share_the_programs_of_an_iteration(vehicle):
    longer = dataclasses.replace(PRESET, total_steps=PRESET.total_steps * 2)
    assert programs(vehicle, longer) == programs(vehicle)


@dataclasses.dataclass(frozen=True)
class Own(Corridor):
    """A task of somebody else's."""


@pytest.mark.usefixtures("on_gpu")
def test_programs_of_a_task_from_outside_are_not_kept(vehicle):
    assert programs(vehicle, dataclasses.replace(PRESET, task=Own())) is None


@pytest.mark.usefixtures("on_gpu")
def test_the_cache_keeps_them_when_it_is_tidied(vehicle, tmp_path):
    found = programs(vehicle)
    number = float(Random().randrange(2**20))  # so that JAX's own cache has no program of it
    found.write("one", jax.jit(lambda x: x + number).lower(1.0).compile())
    compiled.tidy(tmp_path)
    assert found.read("one")(1.0) == number + 1.0
    compiled.tidy(tmp_path, most=0)
    assert "one" not in found


@pytest.mark.usefixtures("on_gpu")
def test_programs_of_several_devices_are_not_kept(vehicle):
    devices = (jax.devices()[0], jax.devices()[0])
    assert kept.kept_programs(PRESET, "dreamer", vehicle, devices) is None and programs(vehicle) is not None


def test_nothing_is_kept_on_a_processor(vehicle):
    assert programs(vehicle) is None


def test_the_code_s_checksum_changes_with_a_file(tmp_path, monkeypatch):
    before = kept.code()
    package = tmp_path / "package"
    package.mkdir()
    monkeypatch.setattr(kept, "PACKAGES", (kept.PACKAGES[0], package))
    sums = []
    for text in ("a = 1\n", "a = 2\n"):
        (package / "one.py").write_text(text)
        kept.code.cache_clear()
        sums.append(kept.code())
    kept.code.cache_clear()
    assert len({before, *sums}) == 3


@pytest.mark.parametrize(
    "variables, devices, words, woken",
    [
        ({}, ["nvidia0", "nvidiactl"], ["--out", "run"], True),
        ({"JAX_PLATFORMS": "cuda,cpu"}, ["nvidia0"], [], True),
        ({"JAX_PLATFORMS": "cpu"}, ["nvidia0"], [], False),
        ({}, ["nvidiactl"], [], False),
        ({}, ["nvidia0"], ["--help"], False),
        ({"SLURM_STEP_NUM_TASKS": "2"}, ["nvidia0"], [], False),
    ],
)
def test_a_gpu_is_woken_where_there_is_one_and_this_process_alone_uses_it(
    tmp_path, monkeypatch, variables, devices, words, woken
):
    for name in devices:
        (tmp_path / name).touch()
    clean = {name: value for name, value in os.environ.items() if name != "JAX_PLATFORMS"}
    monkeypatch.setattr(os, "environ", {**clean, **variables, compiled.FOLDER.upper(): str(tmp_path)})
    monkeypatch.setattr(wake, "DEVICES", Path(tmp_path))
    monkeypatch.setattr(wake.sys, "argv", ["train", *words])
    thread = wake.wake_gpu()
    assert (thread is not None) is woken
    if thread is not None:
        thread.join(60.0)
        assert not thread.is_alive()
