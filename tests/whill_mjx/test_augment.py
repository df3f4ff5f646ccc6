"""Photometric randomisation against values worked out by hand."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.world.photometric import AugmentRanges, augment, draw_photometry, neutral

pytestmark = pytest.mark.quick
KEY = jax.random.key(0)


def changed(image, **values):
    change = dataclasses.replace(neutral(), **{name: jnp.asarray(value) for name, value in values.items()})
    return np.asarray(augment(jnp.asarray(image, jnp.uint8), change, KEY))


def grey(level, size=4):
    return np.full((size, size, 3), level, np.uint8)


def test_the_neutral_change_leaves_images_alone():
    image = np.random.default_rng(0).integers(0, 256, (8, 8, 3), np.uint8)
    np.testing.assert_array_equal(changed(image), image)


def test_brightness_scales_levels_and_saturates_at_white():
    assert (changed(grey(100), brightness=1.3) == 130).all()
    assert (changed(grey(230), brightness=1.3) == 255).all()


def test_contrast_stretches_about_the_mean_level():
    image = np.concatenate([grey(80), grey(120)])
    stretched = changed(image, contrast=1.2)
    assert (stretched[:4] == 76).all() and (stretched[4:] == 124).all()


def test_saturation_zero_gives_luma_and_greys_do_not_change():
    red = np.zeros((4, 4, 3), np.uint8)
    red[..., 0] = 200
    assert (np.abs(changed(red, saturation=0.0).astype(int) - 60) <= 1).all()  # 0.299 * 200
    assert (changed(grey(90), saturation=1.2, hue=0.1) == 90).all()


def test_hue_turns_towards_green_and_back():
    red = np.zeros((4, 4, 3), np.uint8)
    red[..., 0], red[..., 1:] = 160, 80
    turned = [changed(red, hue=sign * 0.1)[0, 0].astype(int) for sign in (1, -1)]
    assert {int(np.argmin(colour)) for colour in turned} == {1, 2}  # one way to yellow, the other to magenta
    third = changed(red, hue=1 / 3)[0, 0]
    assert np.argmax(third) != 0
    np.testing.assert_allclose(changed(changed(red, hue=0.1), hue=-0.1).astype(int), red, atol=2)


def test_noise_has_the_stated_deviation_and_differs_between_frames():
    image = jnp.full((64, 64, 3), 128, jnp.uint8)
    change = dataclasses.replace(neutral(), noise=jnp.asarray(5.0))
    one, other = (np.asarray(augment(image, change, jax.random.key(seed))).astype(float) for seed in (0, 1))
    assert one.std() == pytest.approx(5.0, rel=0.05) and one.mean() == pytest.approx(128.0, abs=0.3)
    assert (one != other).mean() > 0.8


def test_drawn_values_fill_the_papers_ranges():
    drawn = jax.vmap(draw_photometry)(jax.random.split(KEY, 500))
    ranges = AugmentRanges()
    for name in ("brightness", "contrast", "hue", "saturation", "noise"):
        low, high = getattr(ranges, name)
        values = np.asarray(getattr(drawn, name))
        assert low <= values.min() < low + 0.1 * (high - low) and high - 0.1 * (high - low) < values.max() <= high
    assert ranges.brightness == (0.8, 1.3) and ranges.hue == (-0.1, 0.1) and ranges.noise == (0.0, 5.0)
