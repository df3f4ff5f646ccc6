"""The simulated vehicle behind the topics where another physics moves it: a robot file, or a plant of one's own."""

import dataclasses
from typing import Any, Protocol

import numpy as np

from bridge.simulation.chair_simulator import ChairSimulator
from bridge.simulation.simulated import Frame


class Mover(Protocol):
    """Any physics of one vehicle on a flat floor."""

    def place(self, x: float, y: float, yaw: float) -> None:
        """Stand still with the driven-axle centre at x, y [m], heading yaw [rad]."""

    def advance(self, v: float, omega: float, seconds: float) -> None:
        """Drive with a command, v [m/s], omega [rad/s]."""

    @property
    def motion(self) -> np.ndarray:
        """(5,) x, y [m], yaw [rad], v [m/s], omega [rad/s] now."""

    @property
    def odometry(self) -> np.ndarray:
        """(5,) the same as the vehicle reports it, from its start."""


class MovedSimulator(ChairSimulator):
    """The world and the camera of a task around another physics: a robot file, or a plant of one's own."""

    def __init__(self, mover: Mover, task: str = "corridor", vehicle: Any = None, size: tuple[int, int] = (64, 64),
                 **changes: Any) -> None:
        """Prepare the world of a task; the vehicle gives camera and outline alone. Arguments as of `ChairSimulator`."""
        super().__init__(task, vehicle, size, **changes)
        self.mover = mover
        self._look = self._make_look()

    def _make_look(self) -> Any:
        """Return the function that puts the vehicle into the scene and says what the camera and the task see."""
        import jax
        import jax.numpy as jnp

        from whill_mjx.env import endings_of, moment_of, observe
        from whill_mjx.vehicle.dynamics import place
        from whill_mjx.vehicle.kinematics import reference_pose
        from whill_mjx.world.people.contact import poses_among_people, walk_around
        from whill_mjx.world.scene import footprint

        env, params, spec, task = self.env, self.params, self.env.model.spec, self.env.task
        fastest = max(abs(task.v_min), abs(task.v_max))
        poses = poses_among_people(fastest, task.omega_max, self.period, spec.body_length / 2, spec.body_width / 2)

        def look(state: Any, motion: Any, command: Any) -> Any:
            x, y, yaw, v, omega = motion
            vehicle = place(env.model, params, x, y, yaw, (v, omega))
            count = state.step_count + 1
            ran_into = jnp.asarray(False)
            if state.scene.people is not None:
                before, now = (footprint(spec, *reference_pose(env.model, one.qpos))
                               for one in (state.vehicle, vehicle))
                scene, ran_into, _ = walk_around(state.scene, before, now, self.period, poses)
                state = dataclasses.replace(state, scene=scene)
            moment = moment_of(env, state, vehicle, command, count)
            moment = dataclasses.replace(moment, collided=moment.collided | ran_into,
                                         reached=moment.reached & ~ran_into)
            ends = endings_of(env.task, moment)
            after = dataclasses.replace(state, vehicle=vehicle, command=jnp.asarray(command), step_count=count,
                                        goal_distance=moment.goal_distance)
            late = count >= env.task.max_steps
            over = jnp.stack([*ends.values()]).any()
            return after, observe(env, after), ends["collision"], ends["success"], over, late

        return jax.jit(look)

    def reset(self, seed: int) -> Frame:
        """Begin the episode of a seed."""
        frame = super().reset(seed)
        self.mover.place(frame.x, frame.y, frame.yaw)
        return dataclasses.replace(frame, odometry=(0.0,) * 5)

    def step(self, v: float, omega: float) -> Frame:
        """Advance one control period."""
        command = np.clip([v, omega], self._low, self._low + self._span)
        self.mover.advance(float(command[0]), float(command[1]), self.period)
        motion = self.mover.motion
        self._state, image, collided, reached, ended, late = self._look(
            self._state, motion.astype(np.float32), command.astype(np.float32))
        x, y, yaw, speed, turn = motion.tolist()
        return Frame(np.asarray(image), x, y, yaw, speed, turn, collided=bool(collided), reached_goal=bool(reached),
                     done=bool(ended | late), terminated=bool(ended), ranges=np.asarray(self._scan(self._state)),
                     odometry=tuple(self.mover.odometry.tolist()))
