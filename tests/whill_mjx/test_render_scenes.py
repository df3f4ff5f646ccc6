"""The scenes of the camera's benchmark show what they claim."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.camera import BOXES, LENS, crowded_scene, map_scene
from whill_mjx.world.render import render_frame
from whill_mjx.world.render.visibility import FIRST_BOX


def shown(make, labels, worlds):
    """(worlds, labels) bool: which labels have a pixel."""

    def one(key):
        position, rotation, scene = make(key)
        label = render_frame(position, rotation, LENS, scene).label
        return jnp.zeros(labels, bool).at[label.reshape(-1)].set(True)

    draw = jax.jit(lambda keys: jax.lax.map(one, keys, batch_size=20))
    return np.asarray(draw(jax.random.split(jax.random.key(0), worlds)))


def test_crowd_shows_fifteen_boxes_on_average_and_not_all():
    boxes = shown(crowded_scene, FIRST_BOX + BOXES - 1, 200)[:, FIRST_BOX:].sum(1)  # without the marker
    assert 15.0 <= boxes.mean() < 18.0  # the others are behind, aside or hidden
    assert boxes.min() >= 5


def test_map_shows_walls_and_people():
    position, rotation, scene = map_scene(jax.random.key(0))
    walls, rounds = scene.boxes.yaw.shape[0], scene.solids.rounds.mask.shape[0]
    assert walls == 200 and rounds >= 8
    seen = shown(map_scene, FIRST_BOX + walls + rounds, 10)[:, FIRST_BOX:]
    assert seen[:, :walls].sum(1).min() >= 5
    assert seen[:, walls:].sum(1).mean() >= 3
