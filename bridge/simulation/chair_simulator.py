"""The simulated vehicle behind the topics: the batch simulator's environment, one instance at a time."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bridge.policy import pacer_of
from bridge.simulation.simulated import SCAN_HEIGHT, SCAN_RANGE, SCAN_RAYS, Frame, Grid

EYE = "the camera"
"""Name of the camera image where a policy reads none."""
CELL, BORDER, CELLS = 0.05, 1.0, 1000
"""Of the map: edge of a cell [m], free space around everything [m], cells along an edge at most."""


class ChairSimulator:
    """The batch simulator's environment, driven one instance at a time.

    Commands outside the task's range are limited to it. An action repeat is the policy's affair, so here every step is
    one control period.
    """

    def __init__(
        self, task: str = "corridor", vehicle: str | Path | None = None, size: tuple[int, int] = (64, 64),
        senses: Mapping[str, tuple[Any, Any]] | None = None, **changes: Any,
    ) -> None:
        """Compile the environment of a task with some of its fields changed, and of a vehicle file or preset.

        Args:
            task: its name.
            vehicle: None takes the built-in chair.
            size: height and width of the camera image.
            senses: what a policy reads by name, a sensor of whill_mjx and its `SensorInput`; none: the camera alone.
            changes: fields of the task.
        """
        import jax

        import whill_mjx.env as environment
        from whill_mjx.sensors.camera import Camera
        from whill_mjx.tasks.tasks import make_task
        from whill_mjx.vehicle.kinematics import reference_pose
        from whill_mjx.world.lidar import first_hits
        from whill_mjx.world.people.contact import scene_without_people
        from whill_mjx.world.render import pinhole

        fields = {**changes, "action_repeat": 1}
        senses = senses or {}
        self.sensors = {name: about for name, (_, about) in senses.items()}
        pacer = pacer_of(self.sensors)
        self._eye = pacer.name if pacer is not None and pacer.kind == "camera" else EYE
        observed = {name: sensor for name, (sensor, _) in senses.items()}
        if senses and self._eye == EYE:
            observed[EYE] = Camera()
        env, params = environment.make_env(
            make_task(task, **fields), vehicle, height=size[0], width=size[1], observations=observed
        )  # what the policy reads, whatever the task observes
        self.env, self.params = env, params
        self.period = float(env.model.config.control_dt)
        self._low = np.array([env.task.v_min, -env.task.omega_max])
        self._span = np.array([env.task.v_max, env.task.omega_max]) - self._low
        mount = getattr(observed.get(self._eye), "mount", None) or env.model.spec.camera
        camera = pinhole(mount.fov_y, *size)
        self.intrinsics = (float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy))
        angles = np.arange(SCAN_RAYS) * 2 * np.pi / SCAN_RAYS

        def scan(state: Any) -> Any:
            x, y, yaw = reference_pose(env.model, state.vehicle.qpos)
            return jax.numpy.minimum(first_hits(state.scene, x, y, yaw + angles, SCAN_HEIGHT), SCAN_RANGE)

        self._scan = jax.jit(scan)
        self._occupied = jax.jit(lambda scene, x, y: _touched(scene_without_people(scene), x, y))
        self._key = jax.random.key
        self._reset = jax.jit(lambda key: environment.reset(env, params, key))
        self._step = jax.jit(lambda state, action: environment.step(env, params, state, action))
        self._state: Any = None

    def reset(self, seed: int) -> Frame:
        """Begin the episode of a seed."""
        self._state, time_step = self._reset(self._key(seed))
        return self._frame(time_step)

    @property
    def grid(self) -> Grid:
        """Map of the episode's room at the height of the scanner."""
        scene = self._state.scene
        low, high = _extent(scene)
        cell = max(CELL, float((high - low).max()) / CELLS)
        x, y = (np.arange(low[axis], high[axis], cell) + cell / 2 for axis in (0, 1))
        occupied = np.stack([np.asarray(self._occupied(scene, x, np.full_like(x, one))) for one in y])
        return Grid(occupied, cell, float(low[0]), float(low[1]))

    def step(self, v: float, omega: float) -> Frame:
        """Advance one control period."""
        action = (np.array([v, omega]) - self._low) / self._span * 2 - 1
        self._state, time_step = self._step(self._state, action.astype(np.float32))
        return self._frame(time_step)

    def _frame(self, time_step: Any) -> Frame:
        metrics, odometry, obs = time_step.metrics, self._state.vehicle.odometry, time_step.obs
        sensed = {name: np.asarray(obs[name]) for name in self.sensors}
        names = ("x", "y", "yaw", "v", "omega")
        x, y, yaw, v, omega = (float(metrics[name]) for name in names)
        reported = [float(getattr(odometry, name)) for name in names]
        image = np.asarray(obs[self._eye] if sensed else obs)
        return Frame(image, x, y, yaw, v, omega, collided=bool(metrics["collision"]),
                     reached_goal=bool(metrics["success"]), done=bool(time_step.terminated | time_step.truncated),
                     terminated=bool(time_step.terminated), reward=float(time_step.reward),
                     odometry=(reported[0], reported[1], reported[2], reported[3], reported[4]),
                     ranges=np.asarray(self._scan(self._state)), sensed=sensed)


def _extent(scene: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (2,) of the floor that a map of a scene shows [m]."""
    boxes, points = scene.boxes, [np.asarray(scene.marker.position)[None, :2]]
    reach = np.hypot(*np.asarray(boxes.half)[:, :2].T)[:, None]
    used = np.asarray(boxes.mask)
    points += [(np.asarray(boxes.centre)[:, :2] + sign * reach)[used] for sign in (-1, 1)]
    if scene.walls is not None:
        points.append(np.asarray(scene.walls.segments).reshape(-1, 2))
    if scene.solids is not None and scene.solids.rounds is not None:
        rounds = scene.solids.rounds
        points.append(np.asarray(rounds.centre)[np.asarray(rounds.mask)][:, :2])
    every = np.concatenate(points)
    return every.min(axis=0) - BORDER, every.max(axis=0) + BORDER


def _touched(scene: Any, x: Any, y: Any) -> Any:
    """Return (N,) whether the cells around places are occupied."""
    import jax
    import jax.numpy as jnp

    from whill_mjx.world.collision import obstacles_of, touches
    from whill_mjx.world.scene import Footprint

    yaw, half, height = (jnp.asarray(value) for value in (0.0, CELL / 2, SCAN_HEIGHT))

    def one(x: Any, y: Any) -> Any:
        return touches(Footprint(x, y, yaw, half, half, height), obstacles_of(scene, x, y))

    return jax.vmap(one)(x, y)
