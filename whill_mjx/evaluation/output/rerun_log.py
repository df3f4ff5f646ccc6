"""Episodes for the Rerun viewer: chair, camera, scan, people, way and rewards, live or into a file.

Needs the package `rerun-sdk` (the extra `viewer`), which is imported when a log is opened.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.env import Env, State, moment_of, observe, step_state
from whill_mjx.sensors.lidar import Lidar
from whill_mjx.vehicle.kinematics import camera_pose, reference_pose
from whill_mjx.vehicle.types import VehicleParams
from whill_mjx.world.lidar import first_hits
from whill_mjx.world.people import body
from whill_mjx.world.people.contact import scene_without_people
from whill_mjx.world.render import pinhole
from whill_mjx.world.scene import Scene, footprint
from whill_mjx.world.solids import Rounds

TIMELINE = "time"
FAR = 10.0
"""Reach of the scan of tasks without a scanner [m]."""
CHAIR, WAY, SCAN, WALL = (40, 44, 52), (240, 200, 40), (230, 60, 60), (170, 160, 150)


def load_rerun() -> ModuleType:
    """The package rerun; ImportError says how to install it."""
    try:
        import rerun
    except ImportError as error:
        raise ImportError("the viewer needs rerun-sdk, which is not installed. Run: pip install 'whill-mjx[viewer]'") \
            from error  # fmt: skip
    return rerun


class RerunLog:
    """A recording of episodes of one environment. Leave it with `close`, or use it in a `with` statement.

    Args:
        env: static model and task.
        path: file to write (.rrd); None writes none.
        live: open the viewer on this machine, and show what is logged as it comes.
        connect: address of a viewer that runs elsewhere, such as rerun+http://HOST:9876/proxy.

    Raises:
        ImportError: rerun-sdk is not installed.
        ValueError: neither file nor viewer is asked for.
    """

    def __init__(self, env: Env, path: str | Path | None = None, live: bool = False, connect: str | None = None):
        if path is None and not live and connect is None:
            raise ValueError("a recording goes nowhere: give a path, live=True or connect=ADDRESS.")
        self._rr = load_rerun()
        self._env, self._way = env, []  # type: ignore[var-annotated]
        self._stream = self._rr.RecordingStream(f"whill_mjx {env.task.name}")
        sinks = []
        if path is not None:
            sinks.append(self._rr.FileSink(str(path)))
        if live:
            self._rr.spawn(recording=self._stream, connect=False)
            sinks.append(self._rr.GrpcSink())
        elif connect is not None:
            sinks.append(self._rr.GrpcSink(connect))
        self._stream.set_sinks(*sinks, default_blueprint=self._blueprint())
        self._measure = jax.jit(lambda state: _picture(env, state))
        self._count, self._begun = 0, 0.0

    def __enter__(self) -> RerunLog:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def begin(self, state: State) -> None:
        """Start an episode: everything that stands, then the first moment. Episodes follow one another in time."""
        rr, scene = self._rr, state.scene
        self._way = []
        self._begun = self._count * self._env.model.config.control_dt
        self._at(state)
        self._log("world/boxes", _boxes(rr, scene))
        if scene.walls is not None:
            self._log("world/walls", rr.LineStrips3D(_outlines(scene), colors=[WALL], radii=0.01))
        standing = scene_without_people(scene).solids
        if standing is not None and standing.rounds is not None:
            self._log("world/rounds", _capsules(rr, standing.rounds))
        marker = jax.tree.map(np.asarray, scene.marker)
        self._log("world/goal", rr.Boxes3D(
            centers=[marker.position], half_sizes=[marker.half], colors=[_bytes(marker.colour)],
            rotation_axis_angles=[_about_z(rr, float(marker.yaw))], fill_mode="solid"))  # fmt: skip
        self.moment(state)

    def moment(self, state: State, rewards: Mapping[str, Any] | None = None) -> None:
        """Log one state of the episode, and the terms of the reward that led to it by name."""
        rr, env = self._rr, self._env
        self._at(state)
        seen = jax.device_get(self._measure(state))
        self._way.append([*seen["pose"][:2], 0.02])
        spec = env.model.spec
        x, y, yaw = seen["body"]
        half = [spec.body_length / 2, spec.body_width / 2, spec.body_height / 2]
        self._log("world/chair", rr.Boxes3D(
            centers=[[x, y, half[2]]], half_sizes=[half], rotation_axis_angles=[_about_z(rr, float(yaw))],
            colors=[CHAIR]))  # fmt: skip
        self._log("world/way", rr.LineStrips3D([self._way], colors=[WAY], radii=0.02))
        self._log("world/scan", rr.Points3D(seen["scan"][seen["returns"]], colors=[SCAN], radii=0.03))
        position, rotation = seen["camera"]
        lens = pinhole(spec.camera.fov_y, env.height, env.width)
        self._log("world/camera", rr.Transform3D(translation=position, mat3x3=rotation))
        self._log("world/camera/image", rr.Pinhole(
            focal_length=[float(lens.fx), float(lens.fy)], width=env.width, height=env.height,
            camera_xyz=rr.ViewCoordinates.RDF, image_plane_distance=0.4))  # fmt: skip
        self._log("world/camera/image", rr.Image(seen["image"]))
        if state.scene.people is not None and state.scene.solids is not None:
            self._log("world/people", _capsules(rr, body.own_rounds(state.scene.solids, state.scene.people)))
        for name, value in (rewards or {}).items():
            self._log(f"reward/{name}", rr.Scalars([float(value)]))
        self._log("speed/v", rr.Scalars([float(seen["twist"][0])]))
        self._log("speed/omega", rr.Scalars([float(seen["twist"][1])]))
        self._log("goal/distance", rr.Scalars([float(state.goal_distance)]))
        self._count += 1

    def close(self) -> None:
        """Write what is left."""
        self._stream.flush()
        self._stream.disconnect()

    def _log(self, name: str, what: Any) -> None:
        self._stream.log(name, what)

    def _at(self, state: State) -> None:
        seconds = self._begun + float(state.step_count) * self._env.model.config.control_dt
        self._stream.set_time(TIMELINE, duration=seconds)

    def _blueprint(self) -> Any:
        import rerun.blueprint as rrb

        charts = [rrb.TimeSeriesView(origin=origin, name=origin) for origin in ("reward", "speed", "goal")]
        return rrb.Blueprint(rrb.Horizontal(
            rrb.Spatial3DView(origin="world", name="world"),
            rrb.Vertical(rrb.Spatial2DView(origin="world/camera/image", name="camera"), *charts),
            column_shares=[3, 2],
        ))  # fmt: skip


def step_with_terms(
    env: Env, params: VehicleParams, state: State, action: jax.Array
) -> tuple[State, dict[str, jax.Array]]:
    """Advance one instance by one control period, and the terms of its reward () by name; nothing moves after the end.

    Args:
        env: of a task with an `action_repeat` of 1.
        params: of the vehicle.
        state: before.
        action: (2,) in [-1, 1].
    """
    after, outcome = step_state(env, params, state, action)
    before = state.replace(scene=after.scene)  # type: ignore[attr-defined]
    collided = outcome.metrics["collision"] > 0.5
    moment = moment_of(env, before, after.vehicle, after.command, after.step_count, collided)
    return after, {"total": outcome.reward, **env.task.rewards(moment)}


def _picture(env: Env, state: State) -> dict[str, Any]:
    """What a moment shows: pose, camera, image, and the ends (R, 3) of a scan's rays."""
    x, y, yaw = reference_pose(env.model, state.vehicle.qpos)
    outline = footprint(env.model.spec, x, y, yaw)
    scanner = next((sensor for _, sensor in env.sensors if isinstance(sensor, Lidar)), Lidar(reach=FAR))
    c, s = jnp.cos(outline.yaw), jnp.sin(outline.yaw)
    ox, oy = outline.x + scanner.x * c - scanner.y * s, outline.y + scanner.x * s + scanner.y * c
    angle = outline.yaw + scanner.angles()
    far = first_hits(state.scene, ox, oy, angle, scanner.z)
    ends = jnp.stack([ox + far * jnp.cos(angle), oy + far * jnp.sin(angle), jnp.full(far.shape, scanner.z)], -1)
    here = moment_of(env, state, state.vehicle, state.command, state.step_count)
    return {
        "pose": jnp.stack([x, y, yaw]), "body": jnp.stack([outline.x, outline.y, outline.yaw]), "twist": here.twist,
        "scan": ends, "returns": far <= scanner.reach, "camera": camera_pose(env.model, state.vehicle.qpos),
        "image": observe(env, state),
    }  # fmt: skip


def _boxes(rr: ModuleType, scene: Scene) -> Any:
    boxes = jax.tree.map(np.asarray, scene.boxes)
    keep = boxes.mask.shape[0] - (0 if scene.walls is None else scene.walls.keep)
    there = np.flatnonzero(boxes.mask[:keep])
    return rr.Boxes3D(
        centers=boxes.centre[there], half_sizes=boxes.half[there], colors=_bytes(boxes.colour[there]),
        rotation_axis_angles=[_about_z(rr, float(boxes.yaw[index])) for index in there],
    )  # fmt: skip


def _outlines(scene: Scene) -> np.ndarray:
    """(S, 5, 3) outline of each wall of a map."""
    assert scene.walls is not None
    start, end = scene.walls.segments[:, 0], scene.walls.segments[:, 1]
    low, high = np.zeros((len(start), 1)), np.full((len(start), 1), scene.walls.height)
    corners = [(start, low), (end, low), (end, high), (start, high), (start, low)]
    return np.stack([np.concatenate([place, z], 1) for place, z in corners], 1)


def _capsules(rr: ModuleType, rounds: Rounds) -> Any:
    """Cylinders and capsules, all with round ends."""
    rounds = jax.tree.map(np.asarray, rounds)
    there = rounds.mask
    axis = rounds.axis[there] * np.where(rounds.axis[there, 2:] < 0.0, -1.0, 1.0)
    foot = rounds.centre[there] - rounds.half[there, None] * axis  # Rerun's capsule begins at its origin, along z
    # The quaternion x, y, z, w that turns z into the axis, which points upwards.
    quaternion = np.column_stack([-axis[:, 1], axis[:, 0], np.zeros(len(axis)), 1.0 + axis[:, 2]])
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    return rr.Capsules3D(
        lengths=2 * rounds.half[there], radii=rounds.radius[there], translations=foot, quaternions=quaternion,
        colors=_bytes(np.asarray(rounds.colour)[there]), fill_mode="solid",
    )  # fmt: skip


def _about_z(rr: ModuleType, yaw: float) -> Any:
    return rr.RotationAxisAngle(axis=[0, 0, 1], radians=yaw)


def _bytes(colour: np.ndarray) -> np.ndarray:
    return np.clip(np.asarray(colour) * 255.0, 0, 255).astype(np.uint8)
