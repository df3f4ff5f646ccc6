"""The card of an effect: what `sysid.close_loop` needs to look for the effect in a log, to test it and to name it.

The card stands in the effect's own file. The hypotheses of the loop, its predictions and the page docs/effects.md are
made from it. Equation, parameters, usual values and source stand on the effect itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from whill_mjx.vehicle.specs import GRAVITY, WHILL_CR, VehicleSpec

QUANTITIES = (
    "speed", "yaw rate", "direction of travel", "direction of turning", "command to turn", "heading along x",
    "heading along y", "size of the step", "starting or stopping", "time in the drive",
)  # fmt: skip
"""What drives may be split by, to test whether an effect has the same size in both parts."""
STATES = ("constant command", "straight")
"""States of a drive in which some effects do nothing."""
PRESENT = 0.25
"""Share of the stronger part's size below which the weaker part counts as being without the effect. It is small because
real effects follow speed, turning or step size only roughly as the law says."""
LASTING = 2 / 3
"""The same share for early and late in a drive. Most laws do not contain the time, so the size must stay; what warms up
or wears off meanwhile does not go to zero."""


@dataclass(frozen=True)
class Falsifier:
    """One prediction of an effect's law that drives can contradict."""

    says: str
    """The prediction in words."""
    by: str
    """Quantity that drives are split by (`QUANTITIES`), or state in which the effect does nothing (`STATES`)."""
    else_: float = 0.0
    """Size of the weaker part over that of the stronger one where the prediction is wrong: 0 gone, -1 reversed."""
    least: float = PRESENT
    """Minimum size of the weaker part, as a share of the stronger one."""

    def __post_init__(self) -> None:
        if self.by not in (*QUANTITIES, *STATES):
            known = ", ".join((*QUANTITIES, *STATES))
            raise ValueError(f"prediction {self.says!r}: nothing is known as {self.by!r} (known: {known}). Correct it.")

    @property
    def kind(self) -> str:
        """"absent" where the effect does nothing in a state, else "same"."""
        return "absent" if self.by in STATES else "same"


SAME_FOR_ANY_STEP = Falsifier("lasts as long whatever the size of the command's step", "size of the step")
SHOWS_AT_BOTH_ENDS = Falsifier("shows when the vehicle starts and when it stops", "starting or stopping")
GONE_WHEN_SETTLED = Falsifier("does not show while the command is constant", "constant command")
GONE_WHEN_STRAIGHT = Falsifier("does not show while the vehicle drives straight on", "straight")
SAME_AT_ANY_SPEED = Falsifier("does not depend on the speed", "speed")
LAW_OF_SPEED = Falsifier("grows with the speed as its law says", "speed")
LAW_OF_YAW_RATE = Falsifier("grows with the yaw rate as its law says", "yaw rate")
SAME_BACKWARD = Falsifier("is the same forward and backward", "direction of travel", -1.0)
SAME_LEFT_AND_RIGHT = Falsifier("is the same in turns to the left and to the right", "direction of turning", -1.0)
SAME_IN_TURNS = Falsifier("is the same whether the command is to drive straight on or to turn", "command to turn")
SAME_ALL_DRIVE = Falsifier("is the same early and late in a drive", "time in the drive", least=LASTING)
FIXED_IN_ROOM = tuple(Falsifier("changes sign with the heading: it is fixed in the room", f"heading along {axis}", -1.0)
                      for axis in "xy")
FIXED_ON_VEHICLE = tuple(
    Falsifier("keeps its side whatever the heading: it turns with the vehicle", f"heading along {axis}", -1.0)
    for axis in "xy")


@dataclass(frozen=True)
class Axis:
    """One coordinate q of a hypothesis and the parameter it moves: q = 0 is neutral, |q| = 1 small but noticeable."""

    parameter: str
    """On a card: of the effect itself, or "effect.parameter" of another one. In a hypothesis it is always dotted."""
    unit: float
    """Change of the parameter at q = 1; for `inverse` its value there."""
    signed: bool = False
    form: str = "add"
    """add: value = neutral + unit q.  inverse: unit / q.  factor: base value x exp(unit q).  moment: unit q / mass.
    along: neutral + unit q q_0, with q_0 that of the first axis."""
    limit: float = 12.0
    """Largest |q| that a refit may reach."""
    open: tuple[float, float] = (1.0, 1.0)
    """Smallest and largest factor on the size that drives cannot determine, because the effect leaves it open."""
    dependent: bool = False
    """Whether it does nothing by itself, but changes what the other axes do."""
    start: float | None = None
    """Value at q = 0 where the base model lacks the effect; by default the neutral one, which is the chair's."""
    reach: float = float("inf")
    """Largest value of a `moment`, either way."""


@dataclass(frozen=True)
class Variant:
    """One way in which an effect may be missing: the parameters that a fit frees together."""

    axes: tuple[Axis, ...]
    name: str = ""
    """Distinguishes the variants of one effect."""
    kind: str = "effect"
    """"parameter_shift" where the axes are parameters of the base model; left out where the base model lacks them."""
    constants: tuple[tuple[str, float], ...] = ()
    """Other parameters and the values they take."""


@dataclass(frozen=True)
class Scale:
    """A vehicle by which a card chooses sizes: they grow with its weight, track and speed."""

    spec: VehicleSpec
    parameters: frozenset[str]
    """Dotted names of the base model's parameters."""

    @property
    def weight(self) -> float:
        """Weight [N]."""
        return self.spec.mass * GRAVITY

    @property
    def force(self) -> float:
        """A small force on the vehicle [N]."""
        return 0.01 * self.weight

    @property
    def speed(self) -> float:
        """A usual speed [m/s]."""
        return min(self.spec.v_max, 1.0)

    @property
    def power(self) -> float:
        """Power at that speed against a force that is the same share of the weight, over the chair's [-]."""
        return self.weight / (WHILL_CR.mass * GRAVITY) * self.speed

    @property
    def length(self) -> float:
        """Wheelbase over the chair's [-]."""
        return self.spec.wheelbase / WHILL_CR.wheelbase

    @property
    def width(self) -> float:
        """Track over the chair's [-]."""
        return self.spec.track / WHILL_CR.track

    @property
    def height(self) -> float:
        """Height of the body over the chair's [-]."""
        return self.spec.body_height / WHILL_CR.body_height


@dataclass(frozen=True)
class Alike:
    """Effects that ordinary drives with odometry and outside pose can hardly separate from the one with this note."""

    names: tuple[str, ...]
    why: str
    separated_by: str
    """What separates them."""


@dataclass(frozen=True)
class Card:
    """What the loop knows of an effect besides its equation. It does not look for an effect without variants."""

    variants: Sequence[Variant] | Callable[[Scale], Sequence[Variant]] = ()
    """What it frees and how large, or a function of the vehicle's scale that returns it."""
    forbids: tuple[Falsifier, ...] = ()
    """What its law predicts. An effect that drives contradict in one of these is not named."""
    sensor: str = ""
    """What measures the effect by itself, where no drive separates it from another; empty for motor currents."""
    shown_by_pose: bool = False
    """Whether an outside pose shows it without odometry. Such an effect depends on the heading in the room, or changes
    when the vehicle moves or how far it moves for a command."""
    order: float = float("inf")
    """Place among the hypotheses. Random draws of the search follow it, so it stays as it is; new cards come last."""
    alike: tuple[Alike, ...] = ()
    limits: str = ""
    """What the model leaves out."""
    drives: bool = False
    """Whether it is a controller without which nothing drives, so that a vehicle without it is no reference."""
    stepped: bool = False
    """Whether its output jumps, so that finite differences across a jump mean nothing."""
    mirrored: tuple[str, ...] = ()
    """Parameters that change sign where left becomes right."""

    def variants_of(self, scale: Scale) -> tuple[Variant, ...]:
        """The variants for a vehicle."""
        return tuple(self.variants(scale) if callable(self.variants) else self.variants)
