"""The camera against MuJoCo's own renderer on shared scenes: silhouettes within a pixel, depth within a centimetre.

The two pictures of each scene are saved side by side; see `SHEET`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.world.render import FIRST_BOX, GROUND, SKY, camera_rotation, pinhole, render_frame
from whill_mjx.world.scene import Boxes, Marker, Scene, default_looks
from whill_mjx.world.solids import Blocks, Rounds, Solids

SHEET = Path(os.environ.get("CONTACT_SHEET", Path(tempfile.gettempdir()) / "camera_against_mujoco.png"))
SIZE = 160
FOV = 1.1
EYE = np.array([0.1, -0.2, 1.0])
ROTATIONS = {"level": camera_rotation(0.05, 0.15), "tilted": camera_rotation(-0.1, 0.25, 0.3)}
KINDS = ("upright", "blocks", "cylinders", "capsules")


@pytest.fixture(scope="module")
def mujoco_frames(tmp_path_factory):
    """MuJoCo's pictures of all cases, drawn by a process of its own: a missing or unlucky OpenGL may end it."""
    folder = tmp_path_factory.mktemp("mujoco")
    cases = {f"{kind} {pose}": {"xml": scene_and_xml(kind)[1], "rotation": np.asarray(ROTATIONS[pose]).tolist()}
             for kind in KINDS for pose in ROTATIONS}
    (folder / "cases.json").write_text(json.dumps(cases))
    environment = {**os.environ, "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl")}
    answer = subprocess.run([sys.executable, __file__, folder / "cases.json", folder / "frames.npz"], env=environment,
                            capture_output=True, text=True)
    if answer.returncode != 0:
        last = (answer.stderr.strip().splitlines() or ["no message"])[-1]
        pytest.skip(f"MuJoCo cannot render with MUJOCO_GL={environment['MUJOCO_GL']}: {last}")
    return np.load(folder / "frames.npz")


def rotations(key, count):
    axis = jax.random.normal(key, (count, 4))
    w, x, y, z = (axis / jnp.linalg.norm(axis, axis=1, keepdims=True)).T
    rows = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]
    return jnp.stack([jnp.stack(row, -1) for row in rows], 1), jnp.stack([w, x, y, z], 1)


def scene_and_xml(kind):
    """A scene of `kind`, the same as MJCF, and the colours of its things."""
    keys = jax.random.split(jax.random.key(3), 6)
    count = 5
    colour = jax.random.uniform(keys[0], (count, 3), minval=0.2, maxval=0.9)
    place = jnp.stack([jnp.linspace(2.2, 5.0, count), jnp.array([-0.9, 0.8, -0.3, 1.5, -1.7])], 1)
    centre = jnp.concatenate([place, jnp.linspace(0.5, 1.2, count)[:, None]], 1)
    half = jax.random.uniform(keys[1], (count, 3), minval=0.12, maxval=0.4)
    yaw = jax.random.uniform(keys[2], (count,), maxval=3.0)
    matrix, quaternion = rotations(keys[3], count)
    on = jnp.ones(count, bool)
    boxes = Boxes(centre, half, yaw, colour, on & (kind == "upright"))
    blocks = Blocks(centre, half, matrix, colour, on) if kind == "blocks" else None
    length, capsule = half[:, 2], jnp.full(count, kind == "capsules")
    round_ = kind in ("capsules", "cylinders")
    rounds = Rounds(centre, matrix[:, :, 2], length, half[:, 0] * 0.6, capsule, colour, on) if round_ else None
    marker = Marker(jnp.array([-9.0, 0.0, 1.0]), jnp.full(3, 0.1), jnp.zeros(()), jnp.zeros(3))
    geoms = []
    for i in range(count):
        turn = [np.cos(yaw[i] / 2), 0, 0, np.sin(yaw[i] / 2)] if kind == "upright" else quaternion[i]
        size = half[i] if kind in ("upright", "blocks") else [half[i, 0] * 0.6, length[i]]
        name = {"capsules": "capsule", "cylinders": "cylinder"}.get(kind, "box")
        text = {"pos": centre[i], "quat": turn, "size": size, "rgba": [*colour[i], 1.0]}
        fields = " ".join(f'{key}="{" ".join(str(float(v)) for v in value)}"' for key, value in text.items())
        geoms.append(f'<geom type="{name}" {fields}/>')
    xml = f"""<mujoco><visual><map znear="0.01" zfar="60"/><quality offsamples="0" numslices="128" numstacks="128"/>
      <headlight ambient="0.5 0.5 0.5" diffuse="0.4 0.4 0.4" specular="0 0 0"/></visual>
      <statistic extent="1" center="0 0 0"/>
      <worldbody><geom type="plane" size="40 40 1" rgba="0.5 0.5 0.48 1"/>{"".join(geoms)}</worldbody></mujoco>"""
    solids = None if blocks is None and rounds is None else Solids(blocks, rounds)
    return Scene(boxes, marker, default_looks(), solids), xml


def mujoco_frame(xml, rotation):
    """Image, depth and geom numbers (-1: nothing) of a camera at EYE."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(xml)
    model.vis.global_.fovy = np.rad2deg(FOV)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, SIZE, SIZE) as renderer:
        renderer.update_scene(data)
        forward, up = np.asarray(rotation)[:, 2], -np.asarray(rotation)[:, 1]
        for camera in renderer.scene.camera:
            camera.pos, camera.forward, camera.up = EYE, forward, up
            near, high = 0.01, 0.01 * np.tan(FOV / 2)
            camera.frustum_bottom, camera.frustum_top = -high, high
            camera.frustum_center, camera.frustum_width, camera.frustum_near, camera.frustum_far = 0.0, high, near, 60.0
        image = renderer.render().copy()
        renderer.enable_depth_rendering()
        depth = renderer.render().copy()
        renderer.disable_depth_rendering()
        renderer.enable_segmentation_rendering()
        return image, depth, renderer.render()[..., 0].copy()


def within_a_pixel(one, other):
    """Whether each mask lies in the other grown by one pixel."""
    def grown(mask):
        padded = np.pad(mask, 1)
        return np.max([padded[i : i + SIZE, j : j + SIZE] for i in range(3) for j in range(3)], 0)

    return not (one & ~grown(other)).any() and not (other & ~grown(one)).any()


PICTURES: dict[str, np.ndarray] = {}


@pytest.mark.parametrize("pose", list(ROTATIONS))
@pytest.mark.parametrize("kind", KINDS)
def test_silhouettes_and_depth_are_those_of_mujoco(mujoco_frames, kind, pose):
    rotation = ROTATIONS[pose]
    scene, _ = scene_and_xml(kind)
    picture, depth, geom = (mujoco_frames[f"{kind} {pose} {what}"] for what in ("image", "depth", "geom"))
    draw = jax.jit(lambda s, turn: render_frame(jnp.asarray(EYE), turn, pinhole(FOV, SIZE, SIZE), s))
    frame = draw(scene, rotation)
    PICTURES[f"{kind} {pose}"] = np.hstack([np.asarray(frame.rgb), picture])
    label = np.asarray(frame.label).astype(int)
    first = FIRST_BOX if kind == "upright" else FIRST_BOX + 5  # blocks and rounds come after the unused boxes
    for index in range(5):
        ours, theirs = label == first + index, geom == index + 1
        assert theirs.sum() > 30
        assert within_a_pixel(ours, theirs), f"{kind} {index}"
    number = np.where(label >= FIRST_BOX, label - first + 1, np.where(label == GROUND, 0, -1))
    inside = (number == geom) & (label != SKY)
    inside &= np.pad(geom[1:-1, 1:-1] == geom[:-2, 1:-1], 1) & np.pad(geom[1:-1, 1:-1] == geom[1:-1, :-2], 1)
    near = inside & (depth < 5.0)
    error = np.abs(np.asarray(frame.depth) - depth)[near]
    assert near.sum() > 5000 and np.quantile(error, 0.999) < 0.01  # MuJoCo's rounds have 128 flat sides


def test_contact_sheet_of_both_renderers_is_saved():
    if not PICTURES:
        pytest.skip("no pictures: MuJoCo could not render")
    import cv2

    rows = [np.hstack(list(PICTURES.values())[i : i + 2]) for i in range(0, len(PICTURES) - 1, 2)]
    assert cv2.imwrite(str(SHEET), np.vstack(rows)[..., ::-1]) and SHEET.stat().st_size > 10_000


def draw_all(cases, out):
    """Draw the cases of a JSON file into an npz file."""
    frames = {}
    for name, case in json.loads(Path(cases).read_text()).items():
        drawn = mujoco_frame(case["xml"], np.array(case["rotation"]))
        frames.update({f"{name} {what}": array for what, array in zip(("image", "depth", "geom"), drawn, strict=True)})
    np.savez(out, **frames)


if __name__ == "__main__":
    draw_all(*sys.argv[1:])
