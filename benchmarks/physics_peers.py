"""Other simulators stepping a powered chair on wheel contacts (`benchmarks.plant.chair`), for `benchmarks.physics`.

All peers step the same MuJoCo model: free chassis, two driven ellipsoid wheels, a pivoting front beam on two spheres,
four contacts with elliptic cones. Every world has its own constant wheel torques. Each prints why it is left out.
Steps are counted at the chair's own time step; simulated seconds also at the steps of equal trajectory error, which
`benchmarks.physics_peers_step` finds and records.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from benchmarks.harness import device_name, figure, time_calls
from benchmarks.physics_peers_step import equal_error_steps
from benchmarks.plant.chair import TIMESTEP, Chair, build
from benchmarks.warp_graph import graph_rates

TORQUE = 3.0  # N m, largest on either wheel


def contact_chair() -> tuple[mujoco.MjModel, mujoco.MjData, list[int]]:
    """The chair's model, its state settled on its wheels, and the degrees of freedom of the two driven wheels."""
    model = build(Chair())
    data = mujoco.MjData(model)
    for _ in range(round(1.0 / model.opt.timestep)):
        mujoco.mj_step(model, data)
    return model, data, [int(model.joint(f"wheel_{side}").dofadr[0]) for side in ("left", "right")]


def torques(model: mujoco.MjModel, wheels: list[int], worlds: int) -> np.ndarray:
    """Generalised forces (worlds, nv), random and constant on the wheels."""
    force = np.zeros((worlds, model.nv))
    force[:, wheels] = np.random.default_rng(0).uniform(-TORQUE, TORQUE, (worlds, 2))
    return force


def mjx_rates(dts: list[float], worlds: int, steps: int, repeats: int) -> tuple[list[list[float]], dict[str, Any]]:
    """Steps/s of `mjx.step` with its contact solver, for each time step of `dts` [s]; compiled once."""
    from mujoco import mjx

    model, data, wheels = contact_chair()
    static = mjx.put_model(model, impl="jax")
    start = mjx.put_data(model, data, impl="jax")
    force = jnp.asarray(torques(model, wheels, worlds), jnp.float32)

    def one(force: jax.Array, dt: jax.Array) -> jax.Array:
        stepped = static.replace(opt=static.opt.replace(timestep=dt))
        begun = start.replace(qfrc_applied=force)
        end = jax.lax.scan(lambda d, _: (mjx.step(stepped, d), None), begun, length=steps)[0]
        return end.qpos

    compiled = jax.jit(jax.vmap(one, (0, None))).lower(force, jnp.float32(dts[0])).compile()
    finite, rates = True, []
    for dt in map(jnp.float32, dts):
        rates.append([worlds * steps / one for one in time_calls(partial(compiled, force, dt), repeats)])
        finite &= bool(jnp.isfinite(compiled(force, dt)).all())
    return rates, {"worlds": worlds, "finite": finite}


def c_rates(dts: list[float], worlds: int, steps: int, repeats: int) -> tuple[list[list[float]], dict[str, Any]]:
    """The same of C MuJoCo on all cores of the host."""
    from mujoco import rollout

    model, data, wheels = contact_chair()
    cores = len(os.sched_getaffinity(0))
    state = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    states = np.tile(state, (worlds, 1))
    force = np.repeat(torques(model, wheels, worlds)[:, None], steps, axis=1)
    workers = [mujoco.MjData(model) for _ in range(cores)]
    finite, rates = True, []
    with rollout.Rollout(nthread=cores) as pool:

        def call() -> np.ndarray:
            return pool.rollout(model, workers, states, force, control_spec=mujoco.mjtState.mjSTATE_QFRC_APPLIED)[0]

        for dt in dts:
            model.opt.timestep = dt
            finite &= bool(np.isfinite(call()).all())
            rates.append([worlds * steps / one for one in time_calls(call, repeats, warm_up=0)])
    return rates, {"worlds": worlds, "cores": cores, "finite": finite}


def warp_rates(dts: list[float], worlds: int, steps: int, repeats: int) -> tuple[list[list[float]], dict[str, Any]]:
    """The same of MuJoCo Warp, its step captured in one graph for each time step."""
    import mujoco_warp as mjw
    import warp as wp

    if not wp.is_cuda_available():
        raise ImportError("Warp finds no GPU")
    model, data, wheels = contact_chair()
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)  # Warp knows no other
    force = wp.array(torques(model, wheels, worlds).astype(np.float32), dtype=wp.float32)
    finite, rates = True, []
    for dt in dts:
        model.opt.timestep = dt
        m, d = mjw.put_model(model), mjw.put_data(model, data, nworld=worlds)
        wp.copy(d.qfrc_applied, force)
        rates.append(graph_rates(partial(mjw.step, m, d), worlds, steps, repeats))
        finite &= bool(np.isfinite(d.qpos.numpy()).all())
    return rates, {"worlds": worlds, "finite": finite}


def measure_peers(worlds: int, steps: int, repeats: int) -> dict[str, dict[str, Any]]:
    """Figures of all peers that run here: steps/s at the chair's own step, simulated s/s at those of equal error."""
    equal = equal_error_steps()
    dts = [TIMESTEP, *equal.values()]
    host = f"cpu, {len(os.sched_getaffinity(0))} cores"
    few = max(worlds // 16, 64)  # C MuJoCo's rate does not depend on it
    peers: dict[str, tuple[Callable, int, str]] = {
        "mjx_contact": (mjx_rates, worlds, device_name()),
        "mujoco_c": (c_rates, few, device_name() if jax.devices()[0].platform == "cpu" else host),
        "mujoco_warp": (warp_rates, worlds, device_name()),
    }
    figures = {}
    for name, (rates_of, count, device) in peers.items():
        try:
            rates, about = rates_of(dts, count, steps, repeats)
        except (ImportError, NotImplementedError) as error:  # not installed, or unable to run this model
            print(f"peer {name}: left out, {type(error).__name__}: {error}")
            continue
        entry = {**figure(rates[0], "physics steps/s", device), "dt_s": TIMESTEP, **about}
        figures[f"peer_{name}_steps_per_s"] = entry
        print(f"peer {name}: {entry['value'] / 1e6:.3f} M steps/s of {TIMESTEP * 1e3:g} ms, {about}")
        for (ending, dt), each in zip(equal.items(), rates[1:], strict=True):
            entry = {**figure([rate * dt for rate in each], "s/s", device), "dt_s": dt, **about}
            figures[f"peer_{name}_simulated_s_per_s{ending}"] = entry
            print(f"  {entry['value']:,.0f} simulated s/s at {dt * 1e3:g} ms {ending.strip('_')}")
    return figures
