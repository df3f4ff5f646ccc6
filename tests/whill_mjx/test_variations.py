"""Parameters of the vehicle that are drawn from ranges, and how a training is told of them."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest

from whill_mjx.learning.setup import find_preset, make_training_env, variations_of
from whill_mjx.vehicle.presets import preset
from whill_mjx.vehicle.vehicle_file import save_vehicle
from whill_mjx.world.randomize import Variation, read_variation, vary_params

pytestmark = pytest.mark.quick


def test_each_parameter_fills_its_range_and_the_others_stay():
    _, params = preset("whill_cr")
    chosen = (read_variation("body.mass=0.8x:1.2x"), read_variation("command_delay.delay=0.05:0.2"))
    drawn = jax.vmap(lambda key: vary_params(key, params, chosen))(jax.random.split(jax.random.key(0), 400))
    mass = np.asarray(drawn.body.mass) / float(params.body.mass)
    assert 0.8 <= mass.min() < 0.82 and 1.18 < mass.max() <= 1.2
    assert drawn.effects[-1].name == "command_delay"  # which the vehicle did not have
    delay = np.asarray(drawn.effects[-1].delay)
    assert 0.05 <= delay.min() < 0.06 and 0.19 < delay.max() <= 0.2
    assert abs(np.corrcoef(mass, delay)[0, 1]) < 0.2
    np.testing.assert_array_equal(drawn.body.com_x, params.body.com_x)
    assert [effect.name for effect in drawn.effects[:-1]] == [effect.name for effect in params.effects]


def test_fit_stands_for_the_intervals_of_the_vehicle_file(tmp_path):
    spec, params = preset("whill_cr")
    path = save_vehicle(tmp_path / "vehicle.toml", spec, params, {"body.mass": (50.0, 55.0)})
    assert variations_of(["fit"], path) == (Variation("body.mass", 50.0, 55.0),)
    with pytest.raises(ValueError, match="no intervals"):
        variations_of(["fit"], save_vehicle(tmp_path / "plain.toml", spec, params))
    with pytest.raises(ValueError, match="no intervals"):
        variations_of(["fit"], "whill_cr")


@pytest.mark.parametrize("interval", [(-45.0, 60.0), (-np.inf, np.inf)])
def test_an_interval_of_a_file_that_no_vehicle_can_have_is_refused(tmp_path, interval):
    spec, params = preset("whill_cr")
    path = save_vehicle(tmp_path / "vehicle.toml", spec, params, {"body.mass": interval})
    with pytest.raises(ValueError, match=r"vehicle.toml: body.mass.interval: body.mass is -.*; it must be positive"):
        variations_of(["fit"], path)


@pytest.mark.parametrize(("text", "said"), [
    ("command_delay.delay=0.5x:2x", "the vehicle lacks command_delay, so a factor changes nothing. Give values"),
    ("body.mass=0.9x:1.1x", None), ("command_delay.delay=0.1:0.2", None),
])  # fmt: skip
def test_a_factor_on_what_a_vehicle_lacks_is_refused(text, said):
    task = dataclasses.replace(find_preset("smoke", "corridor"), vary=(text,), instances=2)
    if said is None:
        make_training_env(task, "whill_cr_ramp")
        return
    with pytest.raises(ValueError, match=said):
        make_training_env(task, "whill_cr_ramp")


@pytest.mark.parametrize(("text", "said"), [
    ("body.mass", "is no variation"), ("body.mass=1:0", "is no variation"), ("body.mass=0.9x:2", "is no variation"),
    ("body.mass=a:b", "is no variation"), ("body.mass=0:inf", "is no variation"),
    ("body.weight=1:2", "no parameter 'weight'"), ("glue.force=1:2", "no effect 'glue'"),
    ("mass=1:2", "no effect 'mass'"), ("body.mass=-5:3", "body.mass is -5"), ("body.mass=0x:1x", "factor is 0"),
    ("yaw_scrub.torque=0:1e9", "yaw_scrub.torque is 1000000000"),
])  # fmt: skip
def test_a_wrong_variation_is_refused(text, said):
    with pytest.raises(ValueError, match=said):
        read_variation(text)


def test_a_training_takes_them_and_they_are_part_of_what_it_is():
    from whill_mjx.learning.identity import identity_of
    from whill_mjx.learning.options import TrainOptions, choose_preset
    from whill_mjx.train import check

    options = TrainOptions(preset="smoke", vary=("body.mass=0.9x:1.1x",), spread=0.05)
    chosen = choose_preset(options)
    assert chosen.vary == ("body.mass=0.9x:1.1x",) and chosen.spread == 0.05
    assert identity_of(chosen, "ppo", 0, "v", None)["vary"] == ["body.mass=0.9x:1.1x"]
    assert find_preset("smoke", "corridor").vary == ()
    wrong = TrainOptions(preset="smoke", vary=("body.weight=1:2",))
    with pytest.raises(ValueError, match="no parameter 'weight'"):
        check(wrong, choose_preset(wrong))
