"""The camera of the foreign room: MuJoCo's renderer, exposure control with its lag, white balance, noise, JPEG."""

from __future__ import annotations

import math
from typing import Any

import cv2
import mujoco
import numpy as np

from benchmarks.foreign.drive import PERIOD, Pose

RENDERED = 128
"""Edge of the rendered picture, which is averaged down to the policy's [pixels]."""


class Camera:
    """What the policy sees. `plain` leaves MuJoCo's picture as it is."""

    def __init__(self, model: mujoco.MjModel, mount: dict[str, Any], plain: bool, random: np.random.Generator) -> None:
        self.model, self.data = model, mujoco.MjData(model)
        self.renderer: mujoco.Renderer | None = None
        self.plain, self.random = plain, random
        self.gain: float | None = None
        options = mujoco.MjvOption()
        options.geomgroup[4] = 0
        self.options = options
        off = np.zeros(3) if plain else np.radians(random.normal(0, (0.6, 1.0, 0.6)))
        self.mount = (np.array([mount["x"], mount["y"], mount["z"]]),
                      np.array([mount["roll"], mount["pitch"], mount["yaw"]]) + off)  # fmt: skip
        camera = model.camera("eye").id
        model.cam_fovy[camera] = math.degrees(mount["fov_y"])
        model.cam_pos[camera] = self.mount[0]
        model.cam_quat[camera] = _looking(*self.mount[1])
        self.target = random.uniform(95, 135)
        self.white = np.exp(random.normal(0, 0.06, 3))
        self.noise = random.uniform(1.0, 5.0)
        self.lag = random.uniform(0.2, 0.8)
        self.corner = random.uniform(0.0, 0.35)
        self.quality = int(random.integers(55, 95))
        self.blur = random.uniform(0.0, 0.7)
        self.gamma = random.uniform(0.85, 1.15)

    def close(self) -> None:
        """Give the renderer's memory back."""
        if self.renderer is not None:
            self.renderer.close()

    def touches(self) -> bool:
        """Whether the chair, as placed last, touches anything solid."""
        chair = self.model.geom("chair").id
        contacts = self.data.contact[: self.data.ncon]
        return any(chair in pair for pair in np.asarray(contacts.geom).reshape(-1, 2))

    def place(self, pose: Pose) -> None:
        """Put the chair's body at the pose of its drive axle."""
        self.data.qpos[:3] = pose.x, pose.y, 0.0
        quat = np.array([math.cos(pose.yaw / 2), 0, 0, math.sin(pose.yaw / 2)])
        self.data.qpos[3:7] = quat
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        mujoco.mj_collision(self.model, self.data)

    def image(self, size: int) -> np.ndarray:
        """(size, size, 3) uint8 of the chair as placed last."""
        if self.renderer is None:  # drivers that see nothing need no graphics
            self.renderer = mujoco.Renderer(self.model, RENDERED, RENDERED)
        self.renderer.update_scene(self.data, camera="eye", scene_option=self.options)
        picture = self.renderer.render()
        if self.plain:
            return cv2.resize(picture, (size, size), interpolation=cv2.INTER_AREA)
        light = picture.astype(np.float32)
        wanted = min(max(self.target / max(float(light.mean()), 4.0), 0.4), 3.5)
        before = wanted if self.gain is None else self.gain
        self.gain = before + (wanted - before) * (1 - math.exp(-PERIOD / self.lag))
        row = np.linspace(-1, 1, RENDERED, dtype=np.float32)
        shade = 1 - self.corner * 0.5 * (row[:, None] ** 2 + row[None] ** 2)
        light = light * self.gain * self.white.astype(np.float32) * shade[..., None]
        light = 255.0 * np.clip(light / 255.0, 0, 1) ** self.gamma
        if self.blur > 0.2:
            light = cv2.GaussianBlur(light, (0, 0), 2 * self.blur)
        light = cv2.resize(light, (size, size), interpolation=cv2.INTER_AREA)
        light = light + self.random.normal(0, self.noise, light.shape)
        sent = np.clip(light + 0.5, 0, 255).astype(np.uint8)
        large = cv2.resize(sent, (4 * size, 4 * size), interpolation=cv2.INTER_LINEAR)
        packed = cv2.imencode(".jpg", large, [cv2.IMWRITE_JPEG_QUALITY, self.quality])[1]
        received = np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR))
        return cv2.resize(received, (size, size), interpolation=cv2.INTER_AREA)


def _looking(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Quaternion of MuJoCo's camera (it looks along -z, y up) that looks along +x and is tilted down by pitch."""
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
    turn = (
        np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
        @ np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    )
    axes = turn @ np.array([[0, 0, -1], [-1, 0, 0], [0, 1, 0]], float)  # right, up, backward
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, axes.reshape(-1))
    return quat
