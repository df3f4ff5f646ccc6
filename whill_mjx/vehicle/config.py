"""Time steps of the simulation."""

from __future__ import annotations

from dataclasses import dataclass

from whill_mjx.io.fields import TIMES, check_fields


@dataclass(frozen=True)
class VehicleConfig:
    """Time steps; hashable, so a static argument of compiled functions."""

    control_dt: float = 0.1
    """Control period [s]; the paper's 10 Hz."""
    physics_dt: float = 0.005
    """Physics step [s]; divides control_dt."""
    dynamics: str = "fused"
    """How a physics step is computed: "fused" takes the rigid bodies in closed form and everything on single numbers,
    so that it compiles into few kernels; "mjx" calls `mjx.step`. Both give the same motion to rounding."""
    kernel: bool | None = None
    """Whether all physics steps of a control period are one GPU kernel (`vehicle/kernel.py`), with "fused" dynamics.
    None: on NVIDIA GPUs since Ampere, for effects whose operations it has. True interprets it elsewhere: slow."""
    limited: bool = True
    """Whether commands are limited to the spec's limits; a replay of a log takes them as they were recorded."""

    def __post_init__(self) -> None:
        check_fields("time steps", TIMES, self)
        if abs(self.substeps * self.physics_dt - self.control_dt) > 1e-9:
            raise ValueError(
                f"physics_dt {self.physics_dt} does not divide control_dt {self.control_dt}; choose e.g. 0.005 and 0.1."
            )
        if self.kernel not in (None, True, False):
            raise ValueError(f"kernel is {self.kernel!r}; it must be True, False or None. Leave it out for None.")
        if self.dynamics not in ("fused", "mjx"):
            raise ValueError(f"dynamics is {self.dynamics!r}; it must be 'fused' or 'mjx'. Leave it out for 'fused'.")

    @property
    def substeps(self) -> int:
        """Physics steps per control period."""
        return round(self.control_dt / self.physics_dt)
