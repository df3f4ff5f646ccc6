"""Run the simulator behind the vehicle's topics; the policy node sees no difference from the chair.

    python -m bridge.simulate RUN/policy --episodes 10

Time runs like the wall clock, or `--speed` times as fast. With `--clock` the simulated time is published on /clock, and
stamps count in it. The command received by the middle of a control period drives the whole period; an image shows its
end. All publishers are reliable and drop the oldest, so default and best-effort subscribers hear them.

Between two episodes the camera is silent for RESET_SILENCE, which is longer than the age the policy node tolerates: so
it stops, forgets, and no frame of an episode can reach the next one.
"""

import argparse
import ast
import contextlib
import dataclasses
import importlib
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from bridge import ros
from bridge.episodes import EpisodeServer
from bridge.exits import Exit, OptionError
from bridge.options import Parser, ends_at_ctrl_c, in_range, result_file, whole
from bridge.parameters import command_line
from bridge.policy import PolicyFileError, pacer_of
from bridge.simulate_node import RESULTS, SimulateNode
from bridge.simulated import SCAN_HEIGHT, SCAN_RANGE, SCAN_RAYS, Frame, Grid, SimulatedVehicle

SIMULATOR = "bridge.simulate:ChairSimulator"
"""What `--simulator` names unless given."""
TOKEN_VARIABLE = "BRIDGE_TOKEN"
"""Environment variable with the token of episode control; on a command line everybody could read it."""
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


def make_vehicle(options: argparse.Namespace) -> SimulatedVehicle:
    """Return the simulator that `--simulator MODULE:FACTORY` names.

    Raises:
        ValueError, FileNotFoundError: an option, or the policy's folder, is refused.
    """
    module, _, name = options.simulator.partition(":")
    try:
        factory = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise OptionError(f"--simulator {options.simulator}: {error}. It must be MODULE:FACTORY, called with task and "
                          "vehicle. Correct it or leave it out.") from error
    changes = dict(options.set)
    if options.policy is None:
        given = {"task": options.task or "corridor", "vehicle": options.vehicle, **changes}
    else:
        from whill_mjx.evaluation.policy_world import read_world

        world = read_world(options.policy, options.task)
        given = {"task": world.task, "vehicle": options.vehicle or world.vehicle,
                 "size": (world.height, world.width), **world.fields, **changes}
        if world.senses:
            given["senses"] = world.senses
    if options.robot is None:
        if options.wheels:
            raise OptionError("--wheels names the wheels of a robot file. Give --robot too, or leave it out.")
        return factory(**given)
    from sysid.replay.robot_online import OnlineRobot
    from whill_mjx.env import as_vehicle

    if options.simulator != SIMULATOR:
        raise OptionError(f"--robot {options.robot} is driven by a simulator of its own. Leave --simulator out.")
    if given.get("senses"):
        raise OptionError(f"--robot {options.robot} shows its camera alone, and the policy reads "
                              f"{', '.join(sorted(given['senses']))}. Leave --robot out.")
    robot = OnlineRobot(options.robot, options.wheels or ())
    given["vehicle"] = robot.spec(as_vehicle(given["vehicle"])[0])
    moved: Any = MovedSimulator(robot, **given)
    return moved


def field(text: str) -> tuple[str, Any]:
    """Name and value of a NAME=VALUE option; values are Python literals or plain words."""
    name, equals, value = text.partition("=")
    if not equals or not name.isidentifier():
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE, such as gates=1")
    try:
        return name, ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return name, value


def parse_arguments(arguments: list[str]) -> argparse.Namespace:
    """Return the options of the command line."""
    parser = Parser(prog="bridge.simulate", description="Serve the simulator on the vehicle's topics.")
    parser.add_argument("policy", nargs="?", type=Path, help="folder of a policy or of its training: task, gates, "
                        "vehicle and camera are those that it was trained with")
    parser.add_argument("--task", help="default: that of the policy, or corridor")
    parser.add_argument("--set", type=field, action="append", default=[], metavar="NAME=VALUE",
                        help="change a field of the task, such as gates=1 or layout=fixed; repeat for more")
    parser.add_argument("--vehicle", help="vehicle file or built-in vehicle; default: that of the policy, "
                        "or the task's own")
    parser.add_argument("--robot", type=Path, metavar="FILE",
                        help="an MJCF, URDF or xacro file, which drives in place of the vehicle; the camera stays that "
                        "of --vehicle")
    parser.add_argument("--wheels", nargs="+", metavar="NAME",
                        help="of --robot: joints or actuators of its driven wheels, left and right")
    parser.add_argument("--episodes", type=whole(0), default=0, help="end after this many episodes; 0: never")
    parser.add_argument("--seed", type=whole(0), default=0, help="of the first episode; each next one adds 1")
    parser.add_argument("--wait", type=in_range(0), default=10.0,
                        help="wait this long for a driver before the first episode [s]")
    parser.add_argument("--linger", type=in_range(0), default=1.0, help="listen this long after the last episode [s]")
    parser.add_argument("--results", type=result_file(*RESULTS), help="JSON file for the outcome of the episodes")
    parser.add_argument("--image-size", type=whole(1, 10_000), nargs=2, metavar=("HEIGHT", "WIDTH"),
                        help="enlarge the camera image")
    parser.add_argument("--clock", action="store_true", help="publish the simulated time on /clock and stamp with it")
    parser.add_argument("--speed", type=in_range(0.01, 100), default=1.0,
                        help="simulated seconds per second, such as 0.5; default 1")
    parser.add_argument("--port", type=whole(0, 65535), metavar="PORT",
                        help="serve episode control over TCP: resets and lock-step (bridge.episodes); 0: any free port")
    parser.add_argument("--bind", default="127.0.0.1", metavar="ADDRESS",
                        help=f"address of the port; another than the loopback needs a token in {TOKEN_VARIABLE}")
    parser.add_argument("--command-type", choices=("Twist", "TwistStamped"), default="Twist",
                        help="message that the simulated vehicle listens to")
    parser.add_argument("--realtime", type=whole(0, 99), default=0, metavar="PRIORITY",
                        help="SCHED_FIFO priority, like 20")
    parser.add_argument("--simulator", default=SIMULATOR, metavar="MODULE:FACTORY",
                        help="another simulator behind the same topics")
    return parser.parse_args(arguments)


@ends_at_ctrl_c
def main(arguments: list[str] | None = None) -> int:
    """Run the node until its episodes are over, SIGTERM or Ctrl-C; return an `Exit`."""
    own, ros_arguments = command_line(arguments, "bridge.simulate", "policy")
    options = parse_arguments(own)
    compiling: Any = contextlib.nullcontext()
    if options.simulator.startswith("bridge.simulate:"):  # others may abort with it
        os.environ.setdefault("JAX_PLATFORMS", "cpu")  # one vehicle is ready earlier and steps faster there
        from whill_mjx.io.command_line import guarded
        from whill_mjx.io.compiled import keep_compiled
        from whill_mjx.processor import share_results

        share_results()
        keep_compiled()
        compiling = guarded("bridge.simulate: stopped")  # a signal ends it while XLA compiles, too
    with compiling:
        try:
            vehicle = make_vehicle(options)
        except (ValueError, FileNotFoundError) as error:
            print(f"bridge.simulate: {error}", file=sys.stderr)
            return Exit.FAULT if isinstance(error, PolicyFileError) else Exit.REFUSED
    with ros.node_session("bridge_simulate", ros_arguments, options.realtime) as node:
        simulate = SimulateNode(node, vehicle, options)
        try:
            server = None if options.port is None else EpisodeServer(
                simulate.calls(), options.bind, options.port, os.environ.get(TOKEN_VARIABLE, ""))
        except (ValueError, OSError, OverflowError) as error:
            print(f"bridge.simulate: --port {options.port}: {error}", file=sys.stderr)
            return Exit.REFUSED
        if server is not None:
            node.get_logger().info(f"episode control on {options.bind}, port {server.port}")
        ros.spin(node, simulate.finished)
        if server is not None:
            server.close()
        if options.results:
            ros.write_json(options.results, simulate.results())
    return Exit.DONE


if __name__ == "__main__":
    sys.exit(main())
