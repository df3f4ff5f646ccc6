"""A vehicle as one file of plain numpy does what the simulator does."""

from __future__ import annotations

import ast
import dataclasses
import runpy

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from whill_mjx.effects import EFFECTS, make_effect
from whill_mjx.effects.base import Effect, place_of
from whill_mjx.export.numpy_check import largest_distance
from whill_mjx.export.numpy_file import vehicle_source
from whill_mjx.export_python import Options, main
from whill_mjx.io.command_line import OptionError
from whill_mjx.vehicle.presets import preset
from whill_mjx.vehicle.types import parameter

NAMED = {"wheel_radius_difference": 0.012, "slope": None, "sensor_delay": None}


def typical(name, value=None):
    """An effect of the catalogue at a usual size."""
    cls = EFFECTS[name]
    sizes = {key: value if value is not None else 0.3 * low + 0.7 * high for key, (low, high) in cls.typical.items()}
    return make_effect(name, **sizes)


def with_effects(vehicle, effects):
    spec, params = preset(vehicle)
    present = {effect.name for effect in params.effects}
    new = tuple(effect for effect in effects if effect.name not in present)
    return spec, dataclasses.replace(params, effects=(*params.effects, *new))


def drive(steps):
    """Commands (T, 2) that start, turn both ways, stop and reverse."""
    t = np.arange(steps) / steps
    return np.stack([0.7 * np.sin(7 * t), 0.8 * np.sin(11 * t)], axis=1)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    spec, params = with_effects("whill_cr_physical", [typical(name, value) for name, value in NAMED.items()])
    path = tmp_path_factory.mktemp("exported") / "vehicle.py"
    path.write_text(vehicle_source(spec, params))
    return spec, params, path, runpy.run_path(str(path))


def test_a_vehicle_with_named_effects_drives_as_in_the_simulator(exported):
    spec, params, path, _ = exported
    assert largest_distance(path, spec, params, drive(150)) < 1e-10


def test_the_file_imports_numpy_alone(exported):
    tree = ast.parse(exported[2].read_text())
    names = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    assert names == {"numpy"} and not any(isinstance(node, ast.ImportFrom) for node in ast.walk(tree))


def test_the_name_of_a_vehicle_stays_text():
    spec, params = preset("whill_cr")
    name = '"""; raise SystemExit #'
    space: dict = {}
    exec(vehicle_source(dataclasses.replace(spec, name=name), params), space)
    assert space["NAME"] == name


def test_a_limit_that_is_not_there_is_infinite_in_the_file_too():
    spec, params = with_effects("whill_cr", [make_effect("acceleration_limit", wheel=2.0)])
    space: dict = {}
    exec(vehicle_source(spec, params), space)
    assert space["PARAMETERS"]["acceleration_limit.linear"] == (np.inf, "m/s^2")


def test_many_vehicles_at_once_drive_as_one_by_one(exported):
    start, step, pose = (exported[3][name] for name in ("start", "step", "pose"))
    yaw, v = np.array([0.0, 1.0]), np.array([0.5, -0.3])
    both = start(yaw=yaw)
    alone = [start(yaw=one) for one in yaw]
    for _ in range(20):
        both = step(both, v, 0.2)
        alone = [step(state, one, 0.2) for state, one in zip(alone, v, strict=True)]
    expected = np.concatenate([np.stack(pose(state)) for state in alone], axis=1)
    np.testing.assert_allclose(np.stack(pose(both)), expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("module", ["jax.numpy", "torch"])
def test_arrays_of_another_module_give_the_same_drive(exported, module):
    xp = pytest.importorskip(module, reason=f"{module} is not installed")
    start, step, odometry = (exported[3][name] for name in ("start", "step", "odometry"))
    other, own = start(count=2, xp=xp), start(count=2)
    for _ in range(2):
        other, own = step(other, 0.6, 0.4, xp=xp), step(own, 0.6, 0.4)
    np.testing.assert_allclose(np.array([np.asarray(one) for one in odometry(other)]), odometry(own), atol=1e-5)


@struct.dataclass
class Sorted(Effect):
    """Orders the command, which plain numbers cannot."""

    name = "sorted"
    size: jax.Array = parameter("-", 0.0, 1.0, 0.0, "no size")

    def command(self, memory, command, motion):
        return memory, jnp.sort(command)


def test_an_effect_without_a_form_in_plain_numbers_is_refused():
    spec, params = with_effects("whill_cr", [Sorted(jnp.float32(0.0))])
    with pytest.raises(ValueError, match="sort.*Leave out the effect"):
        vehicle_source(spec, params)


def test_a_wrong_name_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(OptionError, match="must be a file that ends in .py"):
        main(Options("whill_cr", out=tmp_path / "vehicle.txt"))
    assert not list(tmp_path.iterdir())


@pytest.mark.long
@pytest.mark.parametrize("name", [name for name, cls in EFFECTS.items() if place_of(cls) != "outside"])
def test_every_effect_of_the_catalogue_drives_as_in_the_simulator(name, tmp_path):
    spec, params = with_effects("whill_cr_physical", [typical(name)])
    path = tmp_path / "vehicle.py"
    path.write_text(vehicle_source(spec, params))
    assert largest_distance(path, spec, params, drive(100)) < 1e-10
