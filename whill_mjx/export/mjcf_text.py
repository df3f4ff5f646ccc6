"""The rigid bodies of a vehicle as MJCF."""

from __future__ import annotations

import mujoco
import numpy as np

from whill_mjx.effects.base import apply_chain
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.dynamics import mass_distribution, nominal_world
from whill_mjx.vehicle.model import ASSET, build_model, mujoco_model
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.types import VehicleParams


def vehicle_mjcf(spec: VehicleSpec, params: VehicleParams, physics_dt: float = 0.005) -> str:
    """MJCF of a vehicle: its bodies with their fitted mass distribution, on a floor, with `v` and `omega` as controls.

    Payload and gravity are those of its effects. The controls have no force of their own: the callback reads them.
    The vehicle's shapes touch nothing; contacts of other bodies are on.
    """
    config = VehicleConfig(control_dt=physics_dt, physics_dt=physics_dt)
    model = build_model(spec, config)
    memory = tuple(effect.init() for effect in params.effects)
    _, world = apply_chain(params.effects, memory, "world", nominal_world(model))
    mass, inertia, com = (np.asarray(value, float) for value in mass_distribution(model, params, world))
    host = mujoco_model(spec, config, params.body)
    editable = mujoco.MjSpec.from_file(str(ASSET))
    editable.modelname = spec.name
    editable.option.timestep = physics_dt
    editable.option.gravity = np.asarray(world.gravity, float)
    editable.option.disableflags = 0
    chassis = editable.body("chassis")
    chassis.pos, chassis.mass, chassis.inertia, chassis.ipos = host.body("chassis").pos, float(mass), inertia, com
    for name in ("left_wheel", "right_wheel"):
        editable.body(name).pos = host.body(name).pos
        for geom in editable.body(name).geoms:
            geom.size = [spec.wheel_radius, geom.size[1], 0.0]
        joint = editable.joint(name)
        joint.armature = spec.wheel_inertia * float(world.wheel_inertia)
        limits = (spec.v_min, spec.v_max) if name == "left_wheel" else (-spec.omega_max, spec.omega_max)
        control = editable.add_actuator(name="v" if name == "left_wheel" else "omega", target=name,
                                        trntype=mujoco.mjtTrn.mjTRN_JOINT)
        control.gainprm[0] = 0.0
        control.ctrlrange, control.ctrllimited = limits, True
    editable.compile()
    return str(editable.to_xml())
