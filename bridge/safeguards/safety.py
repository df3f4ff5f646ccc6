"""The safety state machine: decides on every frame and every tick whether the vehicle may move, and who drives it.

Pure Python with injected time: it never sleeps and never reads a clock, so each edge is tested with made-up times. All
times `now` are seconds of a steady (monotonic) clock, which no clock change can move. `EDGES` is the whole machine;
docs/bridge.md draws it, and a test compares the drawing with the table.
"""

import math
from collections import Counter, deque
from dataclasses import dataclass
from enum import Enum

import numpy as np

from bridge.sensing.frames import FrameWatch, Verdict

NO_FRAME = "no frame yet"
WAITING = "waiting for fresh frames"


class State(Enum):
    """Who drives, and what it takes until the policy does."""

    DISARMED = "disarmed"
    """The vehicle stands until an operator arms it."""
    STANDING = "standing"
    """Armed; the vehicle stands until no condition holds it and fresh frames have come."""
    DRIVING = "driving"
    """The policy drives."""
    YIELDED = "yielded"
    """Another node drives, a person or a planner; the bridge is silent."""


class Event(Enum):
    """What moves the machine."""

    ARM = "arm"
    """An operator arms, and nothing holds the vehicle."""
    FRAMES = "fresh frames"
    """Enough fresh frames in a row, and nothing holds the vehicle."""
    FAULT = "fault"
    """A cause that may pass by itself: silence of the camera, a released dead-man button, a slow policy."""
    LATCH = "latch"
    """A cause that a person must look at: emergency stop, collision, repeated non-finite actions."""
    FOREIGN = "foreign command"
    """Another node sent a command on the bridge's command topic."""
    QUIET = "quiet"
    """The other node has sent nothing for a while."""


EDGES: dict[tuple[State, Event], State] = {
    (State.DISARMED, Event.ARM): State.STANDING,
    (State.STANDING, Event.FRAMES): State.DRIVING,
    (State.DRIVING, Event.FAULT): State.STANDING,
    (State.DRIVING, Event.LATCH): State.DISARMED,
    (State.STANDING, Event.LATCH): State.DISARMED,
    (State.DISARMED, Event.FOREIGN): State.YIELDED,
    (State.STANDING, Event.FOREIGN): State.YIELDED,
    (State.DRIVING, Event.FOREIGN): State.YIELDED,
    (State.YIELDED, Event.QUIET): State.DISARMED,
}
"""The machine. An event without an edge leaves the state as it is."""


@dataclass(frozen=True)
class SafetyConfig:
    """Limits and times of the supervisor."""

    low: tuple[float, float]
    """Smallest command the vehicle may get: v [m/s], omega [rad/s]."""
    high: tuple[float, float]
    """Largest command the vehicle may get."""
    slew: tuple[float, float] = (math.inf, math.inf)
    """Largest change of a command: of v [m/s2], of omega [rad/s2]. A stop is not slowed by it."""
    frame_age: float = 0.25
    """Frames older than this [s] since their receipt stop the vehicle."""
    tick: float = 0.01
    """Seconds between two ticks: an age that would pass its limit before the next one stops the vehicle now."""
    stamp_age: float = 0.3
    """Stamps further than this [s] from the time of receipt are discarded; infinite where clocks are not shared."""
    resume_frames: int = 3
    """Fresh frames in a row before the vehicle moves, at the start and after every stop."""
    frozen_frames: int = 5
    """Frames with identical pixels, received while moving, that count as a frozen camera."""
    moving: tuple[float, float] = (0.05, 0.1)
    """Commands above either count as moving: |v| [m/s], |omega| [rad/s]."""
    bad_actions: int = 3
    """Non-finite actions within `bad_window` after which only an operator re-arms."""
    bad_window: float = 10.0
    """[s]"""
    overrun: float = 0.08
    """A policy step longer than this [s] is an overrun; three in a row stop the vehicle."""
    quiet: float = 0.5
    """Another driver that was silent for this long [s] has let go."""
    hold_zeros: bool = True
    """True: repeat zeros for as long as the vehicle stands. False: send `stop_zeros` of them, then fall silent."""
    expiry: float = math.inf
    """The base forgets a command after this long [s], so it is sent again before."""
    stop_zeros: int = 6
    """Zeros per stop where they are not held."""
    require_arm: bool = False
    """True: begin disarmed."""
    auto_resume: bool = True
    """False: every stop needs an operator, also one whose cause passes by itself."""
    slow_factor: float = 0.3
    """Share of the policy's command that is sent while something asks to drive slowly."""

    def __post_init__(self) -> None:
        if not all(-math.inf < a <= 0 <= b < math.inf for a, b in zip(self.low, self.high, strict=True)):
            raise ValueError(f"SafetyConfig: limits {self.low} to {self.high} must be finite and include 0, because "
                             "stopping is a zero command. Correct the limits.")
        if not all(limit > 0 for limit in self.slew):
            raise ValueError(f"SafetyConfig: slew limits {self.slew} must be above 0, or the vehicle never moves. "
                             "Correct them or leave them out.")


@dataclass(frozen=True)
class Command:
    """What is sent to the wheels, and why."""

    v: float
    """[m/s]"""
    omega: float
    """[rad/s]"""
    reason: str = ""
    """Empty while driving, else the rule that stopped the vehicle."""


class Supervisor:
    """Safety state of one drive.

    The caller passes each frame to `frame`; while it then says `may_drive`, runs the policy and passes its action to
    `action`; and calls `tick` regularly. After any of them `take_reset` says whether the policy must forget its state,
    and `take_turn` whether a command may be sent at all.
    """

    def __init__(self, config: SafetyConfig) -> None:
        self.config = config
        self.state = State.DISARMED if config.require_arm else State.STANDING
        self.counts: Counter[str] = Counter()
        """How often each rule acted."""
        self.slow: set[str] = set()
        """What asks to drive slowly."""
        self.latched = "not armed" if config.require_arm else ""
        """Why only an operator can end the stop; empty where none is needed."""
        self._cause = NO_FRAME
        self._holds: set[str] = set()  # conditions that hold the vehicle while they last
        self._frames = FrameWatch(config.frame_age, config.stamp_age, config.frozen_frames)
        self._fresh = 0
        self._bad: deque[float] = deque()
        self._overruns = 0
        self._reset = True
        self._foreign = -math.inf
        self._zeros = 0
        self._commanded = -math.inf
        self._command = Command(0.0, 0.0, self.reason)

    @property
    def reason(self) -> str:
        """Why the policy may not drive; empty while it may."""
        if self.state is State.DRIVING:
            return ""
        if self.state is State.YIELDED:
            return "another node drives"
        if self.state is State.DISARMED:
            return self.latched
        return ", ".join(self.holds) or self._cause

    @property
    def holds(self) -> list[str]:
        """The conditions that hold the vehicle now."""
        return sorted(self._holds)

    @property
    def may_drive(self) -> bool:
        """True while the policy may be asked for an action."""
        return self.state is State.DRIVING

    def take_reset(self) -> bool:
        """Return whether the policy must reset its recurrent state now; asking clears the request."""
        reset, self._reset = self._reset, False
        return reset

    def take_turn(self) -> bool:
        """Return whether the command may be sent now; asking counts it as sent.

        A standing bridge repeats zeros where the base needs them held. Where the base stops by itself, it sends a few
        and then leaves the base to its rider. A bridge that yielded never speaks.
        """
        if self.state is State.DRIVING or (self.config.hold_zeros and self.state is not State.YIELDED):
            return True
        if self._zeros > 0:
            self._zeros -= 1
            return True
        return False

    def frame(self, now: float, stamp: float, digest: int, stamp_age: float = 0.0) -> Verdict:
        """Judge one valid frame. Only a fresh one may reach the policy.

        Args:
            now: steady time of receipt [s].
            stamp: the frame's own stamp [s].
            digest: hash of its pixels.
            stamp_age: time of receipt minus stamp, both of the camera's clock [s].
        """
        silent = self._frames.is_silent(now)
        verdict = self._frames.judge(now, stamp, digest, stamp_age, self.is_moving)
        if verdict != "fresh":
            self.counts[verdict] += 1
            return verdict
        if self._cause == NO_FRAME:
            self._cause = WAITING
        elif silent:
            self.fault("frame age")
        if self._frames.frozen:
            self.fault("frozen pixels")
        self._fresh = 0 if self._frames.frozen else self._fresh + 1
        self.counts["frames"] += 1
        if self._fresh >= self.config.resume_frames and not self._holds and self._advance(Event.FRAMES):
            self._cause, self._reset, self._commanded = "", True, now
        return verdict

    def action(self, now: float, action: np.ndarray, elapsed: float = 0.0, before: float = 0.0) -> Command:
        """Return the command for a policy output.

        Args:
            now: steady time [s].
            action: (2,) v [m/s], omega [rad/s] as the policy wants them.
            elapsed: how long the policy step took [s].
            before: how long it took before its frame came [s].
        """
        self._overruns = self._overruns + 1 if before + elapsed > self.config.overrun else 0
        if self._overruns:
            self.counts["overrun"] += 1
        if not np.isfinite(action).all():
            self._count_bad_action(now)
        elif self._frames.is_silent(now + elapsed):
            self.fault("frame age")  # the step, or the whole process, was held up
        elif self._overruns >= 3:
            self._overruns = 0
            self.fault("policy too slow")
        if not self.may_drive:
            return self._zero()
        wanted = np.asarray(action, float) * (self.config.slow_factor if self.slow else 1.0)
        limited = np.clip(wanted, self.config.low, self.config.high)
        if np.abs(limited - wanted).max() > 1e-6:
            self.counts["clamped"] += 1
        limited = self._limit_slew(now, limited)
        self._commanded, self._command = now, Command(float(limited[0]), float(limited[1]))
        return self._command

    def tick(self, now: float) -> Command:
        """Return the command to hold: the last one while its frame is young enough, else zero."""
        if self._cause != NO_FRAME and self._frames.is_silent(now + self.config.tick):
            self.fault("frame age")
        if self.state is State.YIELDED and now - self._foreign > self.config.quiet:
            self.latched = self.latched or "another node drove"
            self._advance(Event.QUIET)
        return self._command if self.may_drive else self._zero()

    def clock_jump(self) -> None:
        """The camera's clock was set: stop, forget the stamps, go on with fresh frames."""
        self._frames.forget_stamps()
        self.fault("clock jump")

    def fault(self, cause: str) -> None:
        """Stop for a cause that fresh frames end."""
        self._fresh = 0
        self._reset = True
        if self.state is State.DRIVING and not self.config.auto_resume:
            self.latch(cause)
            return
        if self._advance(Event.FAULT):
            self.counts[f"stop: {cause}"] += 1
        if self._cause != NO_FRAME:
            self._cause = cause
        self._zero()

    def latch(self, reason: str) -> None:
        """Stop until an operator re-arms: collision, emergency stop."""
        if not self.latched:
            self.counts[reason] += 1
            self.counts[f"stop: {reason}"] += 1
        self.latched = self.latched or reason
        self._fresh = 0
        self._reset = True
        self._advance(Event.LATCH)
        self._zero()

    def block(self, reason: str, active: bool, latching: bool = False) -> None:
        """Hold the vehicle while a condition is active; a drive that a `latching` one ends needs an operator."""
        if active and reason not in self._holds:
            self._holds.add(reason)
            if latching and self.state is State.DRIVING:
                self.latch(reason)
            else:
                self.fault(reason)
        elif not active and reason in self._holds:
            self._holds.discard(reason)
            if self._cause == reason:
                self._cause = WAITING

    def arm(self) -> bool:
        """Operator: release the latch. Returns False, and stays latched, while a condition holds or another drives."""
        if self._holds or self.state is State.YIELDED:
            return False
        if self._advance(Event.ARM):
            self.latched = ""
            if self._cause != NO_FRAME:
                self._cause = WAITING  # what stopped it is over
            self._bad.clear()
        return True

    def foreign_command(self, now: float) -> None:
        """Another node sent a command: it drives now. The bridge falls silent at once, even without a zero."""
        self._foreign = now
        self._fresh = 0
        self._reset = True
        if self._advance(Event.FOREIGN):
            self.counts["stop: another node drives"] += 1
        self._zeros = 0
        self._zero()

    def _advance(self, event: Event) -> bool:
        """Follow the edge of an event; return whether there is one."""
        after = EDGES.get((self.state, event))
        if after is None:
            return False
        if self.state is State.DRIVING:
            self._zeros = self.config.stop_zeros
        self.state = after
        return True

    def _count_bad_action(self, now: float) -> None:
        self.counts["not finite"] += 1
        self._bad.append(now)
        while now - self._bad[0] > self.config.bad_window:
            self._bad.popleft()
        self.fault("non-finite action")
        if len(self._bad) >= self.config.bad_actions:
            self.latch("repeated non-finite actions")

    def _limit_slew(self, now: float, wanted: np.ndarray) -> np.ndarray:
        """Return the command nearest to the wanted one that the slew limits allow since the last."""
        elapsed = min(max(now - self._commanded, 0.0), self.config.frame_age)
        before = np.array([self._command.v, self._command.omega])
        reach = np.array([limit * elapsed if math.isfinite(limit) else math.inf for limit in self.config.slew])
        limited = np.clip(wanted, before - reach, before + reach)
        if np.abs(limited - wanted).max() > 1e-6:
            self.counts["slew limited"] += 1
        return limited

    @property
    def is_moving(self) -> bool:
        """True while the vehicle is commanded to move."""
        v_moving, omega_moving = self.config.moving
        return abs(self._command.v) > v_moving or abs(self._command.omega) > omega_moving

    def _zero(self) -> Command:
        self._command = Command(0.0, 0.0, self.reason)
        return self._command
