"""Time steps of the simulation."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class VehicleConfig:
    """Time steps; hashable, so a static argument of compiled functions."""

    control_dt: float = 0.1
    """Control period [s]; the paper's 10 Hz."""
    physics_dt: float = 0.005
    """Physics step [s]; divides control_dt."""

    def __post_init__(self) -> None:
        if self.physics_dt <= 0 or abs(self.substeps * self.physics_dt - self.control_dt) > 1e-9:
            raise ValueError(
                f"physics_dt {self.physics_dt} does not divide control_dt {self.control_dt}; choose e.g. 0.005 and 0.1."
            )

    @property
    def substeps(self) -> int:
        """Physics steps per control period."""
        return round(self.control_dt / self.physics_dt)
