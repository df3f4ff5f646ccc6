"""Programs stay small: what is written out one by one takes minutes to compile on a GPU."""

from __future__ import annotations

from collections import Counter

import jax
import jax.numpy as jnp
import pytest

from whill_mjx.env import make_env, reset_state
from whill_mjx.world.render import culling
from whill_mjx.world.scene import no_boxes


def operations(jaxpr):
    """How often each operation is written, inner programs counted."""
    found = Counter()
    for one in jaxpr.eqns:
        found[one.primitive.name] += 1
        for inner in jax.tree.leaves(list(one.params.values()), is_leaf=lambda value: hasattr(value, "jaxpr")):
            if hasattr(inner, "jaxpr"):
                found += operations(inner.jaxpr)
    return found


@pytest.mark.parametrize("task", ["obstacle_course", "corridor", "doorway", "docking", "point_goal", "kerb_ramp"])
def test_numbers_of_a_world_are_drawn_together(task):
    env, params = make_env(task)
    found = operations(jax.make_jaxpr(lambda key: reset_state(env, params, key))(jax.random.key(0)).jaxpr)
    assert 0 < found["random_bits"] <= 6  # each is a hundred operations; a world has some twenty numbers


def test_bounds_do_not_write_out_corners():
    boxes, eye = no_boxes(8), culling.Eye(jnp.zeros(3), jnp.eye(3), jnp.array([0.5, 0.3, 0.8]))

    def rectangles(boxes):
        return culling.bounds(eye, culling.upright_body(boxes), boxes.mask)  # 16 corners, 32 edges

    written = operations(jax.make_jaxpr(rectangles)(boxes).jaxpr).total()
    assert written < 1000  # corner by corner it were three thousand
