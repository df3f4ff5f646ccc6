"""MuJoCo Warp's ray tracer on the scene of `benchmarks.camera`, for comparison. Empty without mujoco_warp and a GPU."""

from __future__ import annotations

from collections.abc import Callable

import jax
import numpy as np

from benchmarks.warp_graph import graph_rates


def warp_rates(worlds: int, calls: int, repeats: int, make_scene: Callable) -> list[float]:
    """Frames/s of each repeat, for 64x64 RGB without shadows; refit and render in one captured graph."""
    try:
        import mujoco
        import mujoco_warp as mjw
        import warp as wp
    except ImportError as error:
        print(f"peer: left out, {error}")
        return []
    if not wp.is_cuda_available():
        print("peer: left out, Warp finds no GPU")
        return []
    position, rotation, scene = jax.tree.map(np.asarray, make_scene(jax.random.key(0)))
    model = mujoco.MjModel.from_xml_string(_mjcf(position, rotation, scene))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    m, d = mjw.put_model(model), mjw.put_data(model, data, nworld=worlds)
    context = mjw.create_render_context(model, nworld=worlds, cam_res=(64, 64), render_rgb=True, render_depth=False,
                                        use_textures=True, use_shadows=False)

    def draw():
        mjw.refit_bvh(m, d, context)
        mjw.render(m, d, context)

    rates = graph_rates(draw, worlds, calls, repeats)
    print(f"peer: {sorted(rates)[len(rates) // 2]:,.0f} frames/s")
    return rates


def _mjcf(position, rotation, scene) -> str:
    """The scene as MJCF: boxes, a chequered ground, one light and the camera; MuJoCo's cameras look along -z, y up."""
    boxes, marker = scene.boxes, scene.marker

    def text(values):
        return " ".join(f"{float(value):.6g}" for value in values)

    geoms = [(marker.position, marker.half, marker.yaw, marker.colour)]
    geoms += list(zip(boxes.centre, boxes.half, boxes.yaw, boxes.colour, strict=True))
    xml = [
        f'<geom type="box" pos="{text(centre)}" size="{text(half)}" euler="0 0 {float(np.rad2deg(yaw)):.6g}"'
        f' rgba="{text(colour)} 1"/>'
        for centre, half, yaw, colour in geoms
    ]
    axes = text([*rotation[:, 0], *-rotation[:, 1]])
    return f"""<mujoco><asset><texture name="t" type="2d" builtin="checker" width="64" height="64" rgb1=".5 .5 .48"
      rgb2=".42 .42 .41"/><material name="m" texture="t" texrepeat="40 40"/></asset><worldbody>
      <light pos="0 0 5" dir="0.48 -0.36 -0.8" directional="true" castshadow="false"/>
      <camera name="eye" pos="{text(position)}" xyaxes="{axes}" fovy="68.75"/>
      <geom type="plane" size="40 40 1" material="m"/>{"".join(xml)}</worldbody></mujoco>"""
