"""A chair, motions and signals to try single effects on."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.effects.base import place_of
from whill_mjx.vehicle.dynamics import measure, nominal_world, place
from whill_mjx.vehicle.model import build_model
from whill_mjx.vehicle.presets import preset
from whill_mjx.vehicle.types import Drive, Odometry, Yielding

DT = 0.005  # s
WEIGHT = 52 * 9.81  # N
quick = pytest.mark.quick


@lru_cache
def chair(name="whill_cr"):
    spec, params = preset(name)
    return build_model(spec), params


def motion_at(v=0.0, omega=0.0, sideways=0.0, yaw=0.0, name="whill_cr"):
    """Motion of a vehicle rolling at v [m/s], omega [rad/s], with a sideways speed added."""
    model, params = chair(name)
    state = place(model, params, 0.0, 0.0, yaw, (v, omega))
    shift = sideways * jnp.array([-np.sin(yaw), np.cos(yaw)])
    return measure(model, params, nominal_world(model), replace(state, qvel=state.qvel.at[:2].add(shift)))


@lru_cache
def still():
    return motion_at()


def signal(force=(0.0, 0.0), torque=(0.0, 0.0)):
    return Drive(jnp.zeros(2), jnp.asarray(force, jnp.float32), jnp.asarray(torque, jnp.float32))


def yielding(target, force, torque):
    """Drive, leaves (..., 2), whose torque yields within 30 N m."""
    about = Yielding(*(jnp.full_like(torque, value) for value in (0.1, 2.0, 0.0, -30.0, 30.0, 1.0)))
    return Drive(target, force, torque, about)


def reading(x=0.0, y=0.0, yaw=0.0, v=0.0, omega=0.0, gyro=0.0):
    return Odometry(*(jnp.asarray(value) for value in (x, y, yaw, v, omega, gyro)))


def path(v, omega):
    """Odometry (T leaves) of speeds (T,) every 5 ms, from the origin."""
    v, omega = jnp.asarray(v), jnp.asarray(omega)
    yaw = jnp.cumsum(omega) * DT
    x, y = (jnp.cumsum(v * along(yaw - omega * DT / 2)) * DT for along in (jnp.cos, jnp.sin))
    return Odometry(x, y, yaw, v, omega, omega)


def run(effect, inputs, motion=None):
    """Outputs of a command, actuation or sensing effect for a sequence of inputs (leaves with T in front)."""
    method = getattr(effect, place_of(effect))
    motion = motion or still()
    return jax.lax.scan(lambda memory, value: method(memory, value, motion), effect.init(), inputs)[1]


def step_command(v, omega=0.0, steps=200):
    return jnp.broadcast_to(jnp.array([v, omega]), (steps, 2))
