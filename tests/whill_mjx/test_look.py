"""The pictures that `whill_mjx.look` writes."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from whill_mjx.env import make_env, reset_state
from whill_mjx.env.view_from_above import top_view
from whill_mjx.evaluation.output import planner_pictures
from whill_mjx.io.png import write_png
from whill_mjx.look import Look, main
from whill_mjx.tasks.check import why_no_world
from whill_mjx.tasks.tasks import TASKS
from whill_mjx.world.gallery_pictures import depth_picture


@pytest.mark.quick
def test_nearer_is_brighter_and_the_sky_is_black():
    grey = depth_picture(np.array([[1.0, 2.0, 4.0, np.inf]]))[0, :, 0].astype(int)
    assert grey[0] == 255 and grey[2] == 40 and grey[3] == 0
    assert grey[1] == pytest.approx((grey[0] + grey[2]) / 2, abs=1)
    assert not depth_picture(np.full((2, 3), np.inf)).any()
    assert depth_picture(np.array([[0.0, 3.0]]))[0, 0, 0] == 255  # inside a box


@pytest.mark.quick
def test_a_png_holds_the_colours_it_was_given(tmp_path):
    cv2 = pytest.importorskip("cv2")
    image = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    write_png(tmp_path / "new" / "a.png", image)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "new" / "a.png"))[..., ::-1], image)
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["a.png"]


@pytest.mark.quick
@pytest.mark.parametrize("options, words", [({"scene": "moon"}, "unknown scene 'moon'"), ({"out": "a.jpg"}, ".png")])
def test_unknown_scenes_and_endings_are_refused(tmp_path, options, words):
    out = tmp_path / options.get("out", "a.png")
    with pytest.raises(ValueError, match=words):
        main(Look(scene=options.get("scene", "gallery"), out=out))
    assert not list(tmp_path.iterdir())


@pytest.mark.quick
def test_a_task_that_needs_a_map_is_left_out_of_all():
    assert "a name is missing" in why_no_world(TASKS["map_goal"]) and not why_no_world(TASKS["corridor"])


def test_a_furnished_room_is_seen_from_above_without_its_ceiling():
    env, params = make_env("corridor", looks="rich", height=16, width=16)
    image = np.asarray(jax.jit(lambda key: top_view(env, reset_state(env, params, key)))(jax.random.key(0)))
    assert image.shape == (32, 16, 3) and image.std() > 20.0
    assert image[22:28, 5:11].max(-1).min() < 40  # the vehicle at its start, below the middle


def test_the_view_from_above_follows_a_vehicle_that_would_leave_it():
    env, params = make_env("point_goal", observations={}, height=16, width=16)
    start = reset_state(env, params, jax.random.key(0))

    @jax.jit
    def view(x, y):
        qpos = start.vehicle.qpos.at[:2].set(jnp.stack([x, y]))
        return top_view(env, dataclasses.replace(start, vehicle=dataclasses.replace(start.vehicle, qpos=qpos)))

    for x, y in ((0.0, 0.0), (-3.0, 0.0), (0.0, 3.3), (1.0, -3.3)):
        assert (np.asarray(view(x, y)).max(-1) < 40).sum() >= 3  # its dark box


def test_a_video_lasts_as_long_as_the_drive_whatever_a_step_holds(tmp_path, monkeypatch):
    monkeypatch.setattr(planner_pictures, "first_plan", lambda *_: jnp.zeros(1))
    monkeypatch.setattr(planner_pictures, "plan_action", lambda config, env, state, plan, key: (jnp.zeros(2), plan))
    grey = jnp.ones((8, 8, 3), jnp.uint8)
    monkeypatch.setattr(planner_pictures, "observe", lambda env, state: grey * state.step_count.astype(jnp.uint8))
    main(Look(scene="point_goal", out=tmp_path / "a.gif", set=("action_repeat=4", "max_steps=12")))
    with Image.open(tmp_path / "a.gif") as film:
        assert film.n_frames == 3 and film.info["duration"] == 400  # 12 control periods of 0.1 s [ms]
