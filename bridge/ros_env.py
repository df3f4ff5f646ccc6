"""A Gymnasium environment over ROS 2: the simulator in lock-step, or the vehicle on the wall clock.

    env = RosEnv(port=5005)      # python -m bridge.simulate --port 5005
    env = RosEnv(period=0.1)     # a vehicle: commands and images on topics, no resets by wire

In the simulator each step goes over the episode control (`bridge.episodes`), and the observation is the image with the
stamp that the answer names: never one of an earlier step or episode, however late or in whatever order images come. On
the vehicle a step publishes the command and waits for the next image.
"""

import time
from typing import Any

import gymnasium
import numpy as np

from bridge.episodes import EpisodeClient
from bridge.nodes import ros
from bridge.nodes.commands import CommandTopic
from bridge.safeguards.safety import SafetyConfig
from bridge.sensing.image import to_rgb8
from bridge.sensing.senses import AGE

PATIENCE = 5.0
"""Seconds without the image that is waited for."""
ONCE_MORE = 1.0
"""Seconds after which a reset whose first image did not come is repeated."""
STOPS = 5
"""Zeros that a vehicle gets at the end of an episode."""


class RosEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """Observations (H, W, 3) uint8, actions (2,) float32: v [m/s], omega [rad/s]."""

    metadata = {"render_modes": ["rgb_array"]}

    def __init__(self, port: int | None = None, address: str = "127.0.0.1", token: str = "", *,
                 period: float | None = None, v_limits: tuple[float, float] = (0.0, 1.0),
                 omega_limits: tuple[float, float] = (-1.0, 1.0), size: tuple[int, int] = (64, 64),
                 namespace: str = "", image_topic: str = ros.IMAGE_TOPIC, command_topic: str = ros.COMMAND_TOPIC
                 ) -> None:
        """Join the graph, and the simulator's episode control where a port is given.

        Args:
            port: of `bridge.simulate --port`; None drives a vehicle.
            address, token: of the episode control.
            period: control period of the vehicle [s]; the simulator has its own.
            v_limits, omega_limits: range of actions [m/s, rad/s]; actions beyond it are cut.
            size: height and width of observations; other images are resized as the policy node does.
            namespace, image_topic, command_topic: where the vehicle is.

        Raises:
            ValueError: neither a port nor a period, or both.
            OSError, bridge.episodes.ProtocolError: there is no episode control at the port, or it refuses.
        """
        if (port is None) == (period is None):
            raise ValueError("RosEnv: give either the port of a simulator or the control period of a vehicle.")
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from sensor_msgs.msg import Image

        self.render_mode = "rgb_array"
        self.observation_space = gymnasium.spaces.Box(0, 255, (*size, 3), np.uint8)
        low, high = zip(v_limits, omega_limits, strict=True)
        self.action_space = gymnasium.spaces.Box(np.array(low, np.float32), np.array(high, np.float32))
        self._client = None if port is None else EpisodeClient(port, address, token)
        self.period = float(period if self._client is None else self._client.period)  # type: ignore[arg-type]
        self._size = size
        self._context = rclpy.Context()
        ros.use_dds_profile()
        rclpy.init(context=self._context)
        self._node = rclpy.create_node("ros_env", namespace=namespace or None, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._images: dict[tuple[int, int], Any] = {}
        self._newest: tuple[int, int] = (0, 0)
        self._image = np.zeros((*size, 3), np.uint8)
        self._next_step = -np.inf
        self._commands = None
        if self._client is None:
            self._commands = CommandTopic(self._node, command_topic, "auto", lambda v, omega, marked: None)
        profile = ros.best_effort() if self._client is None else ros.reliable(10)
        self._node.create_subscription(Image, image_topic, self._on_image, profile)
        if self._client is not None:
            self._client.call("mode", mode="step")

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None
              ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode; on a vehicle, stop it and take the next image.

        Raises:
            ValueError: options are given; there are none.
            TimeoutError: no image came.
        """
        super().reset(seed=seed)
        if options:
            raise ValueError(f"RosEnv.reset: unknown options {', '.join(options)}. It takes none.")
        if self._client is None:
            self._send(0.0, 0.0)
            self._next_step = -np.inf
            return self._wait_for_newer(self._now()), {}
        drawn = int(self.np_random.integers(2**31 - 1)) if seed is None else seed
        end = time.monotonic() + PATIENCE
        while True:  # an image that was sent before the camera had found this reader is lost: begin again
            result = self._client.call("reset", seed=drawn)
            try:
                return self._wait_for(tuple(result["stamp"]), ONCE_MORE), {}
            except TimeoutError:
                if time.monotonic() > end:
                    raise

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Drive one control period.

        Raises:
            ValueError: an action that is not two finite numbers.
            TimeoutError: no image came.
            bridge.episodes.ProtocolError: the episode is over, or the simulator refuses.
        """
        action = np.asarray(action, float)
        if action.shape != (2,) or not np.isfinite(action).all():
            raise ValueError(f"RosEnv.step: action {action!r} is not two finite numbers v [m/s], omega [rad/s].")
        v, omega = np.clip(action, self.action_space.low, self.action_space.high)  # type: ignore[attr-defined]
        if self._client is None:
            before = self._newest
            self._pace()
            self._send(float(v), float(omega))
            return self._wait_for_newer(before), 0.0, False, False, {}
        result = self._client.call("step", v=float(v), omega=float(omega))
        image = self._wait_for(tuple(result["stamp"]))
        info = {name: result[name] for name in ("collided", "reached_goal")}
        return image, float(result["reward"]), bool(result["terminated"]), bool(result["truncated"]), info

    def render(self) -> np.ndarray:
        """Return the last observation."""
        return self._image

    def close(self) -> None:
        """Stop the vehicle and leave the graph."""
        if self._commands is not None:
            self._commands.publish_stops(STOPS)
        if self._client is not None:
            self._client.close()
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def _on_image(self, message: Any) -> None:
        stamp = (message.header.stamp.sec, message.header.stamp.nanosec)
        self._images[stamp] = message
        self._newest = max(self._newest, stamp)
        while len(self._images) > 20:  # of a camera that nobody reads
            del self._images[min(self._images)]

    def _wait_for(self, stamp: tuple[int, ...], seconds: float = PATIENCE) -> np.ndarray:
        """Return the image of a stamp; older ones are dropped."""
        end = time.monotonic() + seconds
        while stamp not in self._images:
            self._executor.spin_once(timeout_sec=0.05)
            if time.monotonic() > end:
                raise TimeoutError(f"no image with the stamp {stamp} came within {seconds:g} s: the simulator's camera "
                                   "does not reach this node. Check ROS_DOMAIN_ID, the namespace and the topic.")
        return self._take(stamp)

    def _wait_for_newer(self, than: tuple[int, int]) -> np.ndarray:
        """Return the next image of a vehicle, which is stopped where none comes for as long as the bridge tolerates."""
        began, stopped = time.monotonic(), False
        while self._newest <= than:
            self._executor.spin_once(timeout_sec=0.05)
            waited = time.monotonic() - began
            if not stopped and waited > max(SafetyConfig.frame_age, AGE * self.period):
                self._send(0.0, 0.0)
                stopped = True
            if waited > PATIENCE:
                raise TimeoutError(f"no new image came within {PATIENCE:g} s. Check the camera and its topic.")
        return self._take(self._newest)

    def _take(self, stamp: tuple[int, ...]) -> np.ndarray:
        message = self._images[stamp]  # type: ignore[index]
        self._images = {one: image for one, image in self._images.items() if one > stamp}
        self._image = to_rgb8(message, self._size)
        return self._image

    def _now(self) -> tuple[int, int]:
        stamp = self._node.get_clock().now().to_msg()
        return stamp.sec, stamp.nanosec

    def _send(self, v: float, omega: float) -> None:
        """Publish a command as soon as the base's type is known."""
        assert self._commands is not None
        end = time.monotonic() + PATIENCE
        while not self._commands.look():
            self._executor.spin_once(timeout_sec=0.05)
            if time.monotonic() > end:
                raise TimeoutError(f"no base listens on {self._commands.name}. Start its driver.")
        self._commands.publish(v, omega)

    def _pace(self) -> None:
        """Wait until a control period has passed since the last step."""
        while (left := self._next_step - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)
        self._next_step = max(self._next_step, time.monotonic() - self.period) + self.period
