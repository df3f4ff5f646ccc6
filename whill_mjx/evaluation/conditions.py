"""What an evaluation may change in an episode: obstacle, start, light, camera pose, latency. One value per instance."""

from __future__ import annotations

import copy
import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.env import Env, State
from whill_mjx.env.moments import view_of
from whill_mjx.sensors.base import begin_sensors
from whill_mjx.tasks.tasks import World
from whill_mjx.vehicle.dynamics import place
from whill_mjx.vehicle.ground import on_ground
from whill_mjx.vehicle.kinematics import quaternion_from_angles, reference_pose, rotation_from_quaternion
from whill_mjx.vehicle.types import VehicleParams
from whill_mjx.world.scene import Scene


@struct.dataclass
class Condition:
    """Changes to one episode; `nominal()` changes nothing."""

    obstacle_x: jax.Array  # () m, puts all obstacles' centre there; NaN leaves them where they were drawn
    obstacle_y: jax.Array  # () m, the same across
    obstacle_shift_y: jax.Array  # () m, added to the obstacles' places
    start_x: jax.Array  # () m, added to the start
    start_y: jax.Array  # () m
    start_yaw_deg: jax.Array  # () degrees
    light: jax.Array  # () factor on all light, sky included; the exposure does not follow
    camera_x: jax.Array  # () m, ahead of where the camera was in the training
    camera_y: jax.Array  # () m, to the left
    camera_z: jax.Array  # () m, up
    camera_pitch_deg: jax.Array  # () degrees, downwards
    camera_yaw_deg: jax.Array  # () degrees, to the left
    latency: jax.Array  # () control periods by which the image is late, a whole number


def nominal() -> Condition:
    """No change."""
    values = {field.name: jnp.zeros(()) for field in dataclasses.fields(Condition)}
    return Condition(**{**values, "light": jnp.ones(()), "obstacle_x": jnp.nan * jnp.ones(()),
                        "obstacle_y": jnp.nan * jnp.ones(())})


NAMES = tuple(field.name for field in dataclasses.fields(Condition))


def arranged(condition: Condition, env: Env) -> Env:
    """The environment with the obstacles of its worlds where the condition has them.

    They are there before a room is furnished: its shadows and the passage along its things suit their new place.
    """
    task = copy.copy(env.task)

    def sample_world(key: jax.Array) -> World:
        world = env.task.sample_world(key)
        return dataclasses.replace(world, scene=_with_obstacles(condition, world.scene, env.task.walls))

    object.__setattr__(task, "sample_world", sample_world)  # the record is frozen
    return dataclasses.replace(env, task=task)


def begin_under(condition: Condition, env: Env, params: VehicleParams, state: State) -> State:
    """State of an episode that begins, with start and light of the condition; `arranged` has seen to the obstacles."""
    x, y, yaw = reference_pose(env.model, state.vehicle.qpos)
    x, y = x + condition.start_x, y + condition.start_y
    scene = _lit(condition, state.scene)
    params, yaw = on_ground(params, scene.ground), yaw + jnp.deg2rad(condition.start_yaw_deg)
    vehicle = place(env.model, params, x, y, yaw)
    state = dataclasses.replace(
        state,
        vehicle=vehicle,
        scene=scene,
        goal_distance=jnp.linalg.norm(env.task.goal(scene) - jnp.stack([x, y])),
        trail=None if state.trail is None else jnp.broadcast_to(vehicle.qpos[:7], state.trail.shape),
    )
    if not env.sensors:
        return state
    return dataclasses.replace(state, sensors=begin_sensors(env.sensors, view_of(env, params, state)))


def _with_obstacles(condition: Condition, scene: Scene, walls: int) -> Scene:
    """Scene of a task with the boxes behind the first `walls` moved."""
    centre = scene.boxes.centre
    obstacle = (jnp.arange(centre.shape[0]) >= walls)[:, None]
    wanted = jnp.stack([condition.obstacle_x, condition.obstacle_y, jnp.nan * jnp.ones(())])
    moved = jnp.where(jnp.isnan(wanted), centre, wanted) + jnp.array([0.0, 1.0, 0.0]) * condition.obstacle_shift_y
    boxes = dataclasses.replace(scene.boxes, centre=jnp.where(obstacle, moved, centre))
    return dataclasses.replace(scene, boxes=boxes)


def _lit(condition: Condition, scene: Scene) -> Scene:
    """Scene under all of its light times a factor."""
    looks, light, rich, finish = scene.looks, condition.light, scene.rich, scene.finish
    if rich is not None:
        # Exposure control would divide a factor on the lamps out again, so the factor is on what the film gets after
        # it. Its pixels are the root of linear light.
        eye = dataclasses.replace(rich.eye, white=rich.eye.white * jnp.sqrt(light))
        return dataclasses.replace(scene, rich=dataclasses.replace(rich, eye=eye))
    if finish is not None:
        finish = dataclasses.replace(
            finish, lamp_colour=finish.lamp_colour * light, fog_colour=jnp.clip(finish.fog_colour * light, 0.0, 1.0)
        )
    return dataclasses.replace(
        scene,
        finish=finish,
        looks=dataclasses.replace(
            looks,
            ambient=looks.ambient * light,
            diffuse=looks.diffuse * light,
            sky_horizon=jnp.clip(looks.sky_horizon * light, 0.0, 1.0),
            sky_zenith=jnp.clip(looks.sky_zenith * light, 0.0, 1.0),
        ),
    )


def seen_under(condition: Condition, env: Env, state: State) -> State:
    """State to take the picture of: the chassis is moved so that its camera gets to where the condition has it.

    The camera is fixed to the chassis, which is not in its own picture, so that moving the one moves the other.
    """
    mount = env.model.spec.camera
    turn = quaternion_from_angles(
        jnp.zeros(()), jnp.deg2rad(condition.camera_pitch_deg), jnp.deg2rad(condition.camera_yaw_deg)
    )
    at = jnp.array([mount.x, mount.y, mount.z])
    shift = jnp.stack([condition.camera_x, condition.camera_y, condition.camera_z])
    # Turned about the camera, which then is displaced: chassis' = chassis * move(at + shift) * turn * move(-at).
    offset = at + shift - rotation_from_quaternion(turn) @ at

    def moved(pose: jax.Array) -> jax.Array:
        """Pose (7,) of the chassis: place and quaternion."""
        position = pose[:3] + rotation_from_quaternion(pose[3:7]) @ offset
        return jnp.concatenate([position, _product(pose[3:7], turn)])

    qpos = state.vehicle.qpos
    return dataclasses.replace(
        state,
        vehicle=dataclasses.replace(state.vehicle, qpos=qpos.at[:7].set(moved(qpos[:7]))),
        trail=None if state.trail is None else jax.vmap(moved)(state.trail),
    )


def _product(a: jax.Array, b: jax.Array) -> jax.Array:
    """Quaternion (4,) of turning by `b` in the frame that `a` has turned."""
    scalar = a[0] * b[0] - jnp.dot(a[1:], b[1:])
    return jnp.concatenate([scalar[None], a[0] * b[1:] + b[0] * a[1:] + jnp.cross(a[1:], b[1:])])
