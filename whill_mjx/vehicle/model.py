"""The static part of a vehicle, and its MuJoCo model, which is built where it is asked for: our own step needs none."""

from __future__ import annotations

import io
import xml.etree.ElementTree as ElementTree
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.types import Body

if TYPE_CHECKING:
    import mujoco

ASSET = Path(__file__).parents[1] / "assets" / "whill_cr.xml"
CHASSIS = 1  # body ids, in the order of the asset


@dataclass(frozen=True)
class WheelBodies:
    """Either driven wheel as a rigid body, the same inertia about every axis, on a hinge along y."""

    x: float
    """Place of the axle in the chassis frame [m]; its height is that of the chassis origin."""
    y: float
    """Distance of either wheel from the middle [m]."""
    mass: float
    """[kg]"""
    inertia: float
    """Of the body [kg m^2]; next to nothing, the spin inertia is the armature."""
    armature: float
    """Spin inertia on the hinge [kg m^2]."""


@dataclass(frozen=True, eq=False)
class VehicleModel:
    """Static part of a vehicle: spec, time steps and the bodies of its wheels. Closed over by compiled functions."""

    spec: VehicleSpec
    config: VehicleConfig
    wheels: WheelBodies
    """The two driven wheels, as bodies of the MuJoCo model."""

    @cached_property
    def mjx(self) -> Any:
        """The vehicle with nominal mass for MJX (mjx.Model); made when first asked for, by dynamics "mjx"."""
        mjx = import_mjx()
        with jax.ensure_compile_time_eval():  # it may be asked for while tracing, and is kept
            return mjx.put_model(mujoco_model(self.spec, self.config))

    @cached_property
    def data(self) -> Any:
        """An mjx.Data of the right shapes; only qpos, qvel and qfrc_applied of it are ever set."""
        mjx = import_mjx()
        with jax.ensure_compile_time_eval():
            return mjx.make_data(self.mjx)


def import_mjx() -> ModuleType:
    """The module mujoco.mjx. It prints to stdout that Warp is not installed, which it does without: that is dropped."""
    with redirect_stdout(io.StringIO()):
        from mujoco import mjx
    return mjx


def mujoco_model(
    spec: VehicleSpec, config: VehicleConfig | None = None, body: Body | None = None
) -> mujoco.MjModel:
    """C MuJoCo model of `spec`: the asset with the spec's geometry put in, and the mass distribution of `body`.

    Without `body`: nominal mass, centre of mass at the origin, inertia of a box.
    """
    import mujoco  # takes a tenth of a second, and a simulation does without it

    config = config or VehicleConfig()
    editable = mujoco.MjSpec.from_file(str(ASSET))
    editable.modelname = spec.name
    editable.option.timestep = config.physics_dt
    chassis = editable.body("chassis")
    chassis.pos = [0.0, 0.0, spec.wheel_radius]
    roll, pitch, yaw = box_inertia(spec)
    if body is None:
        chassis.mass, chassis.inertia = spec.mass, [roll, pitch, yaw]
    else:
        chassis.mass = float(body.mass)
        scale = chassis.mass / spec.mass
        chassis.inertia = [roll * scale, pitch * scale, float(body.yaw_inertia)]
        chassis.ipos = [float(body.com_x), float(body.com_y), float(body.com_z)]
    for name, side in (("left_wheel", 1.0), ("right_wheel", -1.0)):
        editable.body(name).pos = [spec.reference_x, side * spec.track / 2, 0.0]
        editable.joint(name).armature = spec.wheel_inertia
    return editable.compile()


def box_inertia(spec: VehicleSpec) -> tuple[float, float, float]:
    """Roll, pitch and yaw inertia of a uniform box of the vehicle's mass and size [kg m^2]: a first guess."""
    length, width, height = spec.body_length, spec.body_width, spec.body_height
    squares = np.array([width**2 + height**2, length**2 + height**2, length**2 + width**2])
    roll, pitch, yaw = spec.mass / 12.0 * squares
    return float(roll), float(pitch), float(yaw)


@lru_cache(maxsize=16)
def build_model(spec: VehicleSpec, config: VehicleConfig | None = None) -> VehicleModel:
    """The static model of `spec`; built once per (spec, config)."""
    return VehicleModel(spec, config or VehicleConfig(), wheel_bodies(spec))


def wheel_bodies(spec: VehicleSpec) -> WheelBodies:
    """The driven wheels as `mujoco_model` makes them: of the spec's geometry, with the asset's mass and inertia."""
    inertial = ElementTree.parse(ASSET).find(".//body[@name='left_wheel']/inertial")
    assert inertial is not None
    mass, inertia = inertial.attrib["mass"], inertial.attrib["diaginertia"].split()[1]
    numbers = (spec.reference_x, spec.track / 2, mass, inertia, spec.wheel_inertia)
    return WheelBodies(*(float(number) for number in numbers))
