"""Names the present cause of trouble, and what to do about it; pure, with injected time.

A cause is computed from what is so now: it disappears with what caused it.
"""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from statistics import median

from bridge.nodes.commands import TYPES, Endpoint
from bridge.nodes.ros import PROFILE, PROFILE_VARIABLES
from bridge.sensing.senses import Stream

WINDOW = 2.0
"""Seconds of frames that count."""
SHARED_MEMORY_LIMIT = 480_000
"""Bytes of the largest best-effort image that Fast DDS delivers with its default settings (measured)."""
SILENT = 0.5
"""Seconds without a frame that are named, where frames came before."""
LOW_RATE = 0.8
"""Share of the policy's rate below which a camera is too slow."""
IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")


class FrameLog:
    """The camera messages of the last WINDOW seconds, good or not."""

    def __init__(self) -> None:
        self._frames: deque[tuple[float, float, float, int]] = deque()
        self._began = math.inf
        self._lost: deque[tuple[float, int]] = deque()

    def frame(self, now: float, stamp: float, stamp_age: float, digest: int) -> None:
        """Add a message: time of receipt, its stamp, their difference on the camera's clock, a hash of its bytes."""
        if not self._frames:
            self._began = now
        self._frames.append((now, stamp, stamp_age, digest))

    def lost(self, now: float, count: int) -> None:
        """Add messages that the transport reports as lost."""
        self._lost.append((now, count))

    def trim(self, now: float) -> None:
        """Forget what is older than the window."""
        while self._frames and now - self._frames[0][0] > WINDOW:
            self._frames.popleft()
        while self._lost and now - self._lost[0][0] > WINDOW:
            self._lost.popleft()

    @property
    def count(self) -> int:
        """Messages in the window."""
        return len(self._frames)

    @property
    def rate(self) -> float:
        """Messages per second: of the upper quartile of gaps, which one pause does not change and many losses do."""
        times = [now for now, *_ in self._frames]
        gaps = sorted(after - before for before, after in zip(times, times[1:], strict=False))
        return 1 / max(gaps[3 * len(gaps) // 4], 1e-6) if len(gaps) >= 3 else len(times) / WINDOW

    def is_full(self, now: float) -> bool:
        """Return whether messages have come for as long as the window, so that their rate means something."""
        return now - self._began >= WINDOW

    def silence(self, now: float) -> float:
        """Seconds since the last message of the window; infinite without one."""
        return now - self._frames[-1][0] if self._frames else math.inf

    @property
    def losses(self) -> int:
        """Messages that the transport lost."""
        return sum(count for _, count in self._lost)

    @property
    def stamp_age(self) -> float:
        """Median age [s] of the stamps at receipt; 0 without messages."""
        return median(age for _, _, age, _ in self._frames) if self._frames else 0.0

    @property
    def pace(self) -> float:
        """Seconds of the camera's clock per second of ours; 1 where too few messages came.

        The gap over which the two clocks differ most is left out: the camera's may have been set there.
        """
        times = [(now, stamp) for now, stamp, *_ in self._frames]
        gaps = [(now - before, stamp - old) for (before, old), (now, stamp) in zip(times, times[1:], strict=False)]
        if len(gaps) < 3:
            return 1.0
        gaps.remove(max(gaps, key=lambda gap: abs(gap[1] - gap[0])))
        ours, cameras = (sum(part) for part in zip(*gaps, strict=True))
        return cameras / ours if ours > 0 else 1.0

    @property
    def has_one_stamp(self) -> bool:
        """True where at least five messages came in the window, all with the same stamp."""
        return len(self._frames) >= 5 and len({stamp for _, stamp, *_ in self._frames}) == 1

    @property
    def unchanged(self) -> bool:
        """True where at least five messages came in the window, all with the same bytes."""
        return len(self._frames) >= 5 and len({digest for *_, digest in self._frames}) == 1


@dataclass(frozen=True)
class Evidence:
    """What is known now of camera, base and graph."""

    image_topic: str
    image_type: str
    cameras: list[Endpoint]
    """Who publishes on the image topic."""
    frames: FrameLog
    rate_hz: float
    """The policy's rate."""
    stamp_limit: float
    """Largest age of a stamp [s] that is accepted."""
    command_topic: str
    command_type: str
    """Type in which commands are sent; empty where no base has been found."""
    listeners: list[Endpoint]
    """Who listens to commands."""
    guard: str
    """What is wrong with the guard."""
    sensor: str = "camera"
    """What sends the frames; of a policy without a camera another sensor."""
    silence: float = 0.0
    """Seconds since the last frame."""
    settled: bool = True
    """True where the camera has been there, and its frames have come, for long enough to judge their rate."""
    image_bytes: int = 0
    incompatible: bool = False
    """True where the image publisher's quality of service does not fit."""
    unusable: str = ""
    """Why the last frame could not be used."""
    blind: bool = False
    pace_by_stamp: bool = False
    commanders: list[str] = field(default_factory=list)
    """Other nodes that publish commands."""
    starting: bool = False
    """True in the first seconds, while silence may mean that the graph is not known yet."""


def causes(evidence: Evidence) -> list[str]:
    """Return every present cause with its remedy, the most basic one first; empty where all is well."""
    return [*_camera_causes(evidence), *_frame_causes(evidence), *_command_causes(evidence)]


def input_cause(name: str, topic: str, kind: str, publishers: list[Endpoint], stream: Stream, now: float) -> str:
    """Return what is wrong with a sensor beside the one that paces the policy, with its remedy; empty where nothing is.

    Args:
        name: of the policy's input.
        topic: resolved name.
        kind: message type that is read there.
        publishers: of the topic.
        stream: what came.
        now: steady time [s].
    """
    if len(fitting(publishers, kind)) > 1:  # it holds the vehicle, whatever else is sent there
        return mixed(topic, fitting(publishers, kind), "messages")
    wrong = sorted({one.type for one in publishers} - {kind})
    if wrong:
        return f"{topic} carries {', '.join(wrong)}, and the policy's {name} is a {kind}: remap it to the right topic"
    if not publishers:
        return f"no publisher on {topic}, the policy's {name}: start the {stream.sensor.kind}, or remap the topic"
    if now - stream.received <= SILENT and stream.unusable:
        return f"{topic}: {stream.unusable}"
    if stream.is_silent(now):
        since = now - stream.received
        return (f"{topic}: nothing came yet: check the publisher" if math.isinf(since) else
                f"{topic}: the last {name} came {since:.1f} s ago, and it counts for {stream.limit:.2f} s: check the "
                "publisher and its rate")
    if stream.is_frozen:
        return f"{topic}: {name} does not change while the vehicle moves: restart the {stream.sensor.kind}"
    return ""


def fitting(publishers: list[Endpoint], kind: str) -> list[Endpoint]:
    """Return the publishers whose messages are read; those of more than one mix."""
    return [one for one in publishers if one.type == kind]


def is_mixed(publishers: Mapping[str, list[Endpoint]], kinds: Mapping[str, str]) -> bool:
    """Return whether messages of two publishers are read as one input; both mappings are by the input's name."""
    return any(len(fitting(publishers[name], kind)) > 1 for name, kind in kinds.items())


def mixed(topic: str, publishers: list[Endpoint], what: str) -> str:
    """Return what is wrong where several nodes publish on the topic of an input."""
    names = ", ".join(sorted(one.node for one in publishers))
    return f"{topic} has {len(publishers)} publishers ({names}): their {what} mix; stop or remap all but one"


def _camera_causes(evidence: Evidence) -> list[str]:
    """Return why frames do not come, or come from more than one source."""
    topic = evidence.image_topic
    cameras = fitting(evidence.cameras, evidence.image_type)
    wrong = sorted({camera.type for camera in evidence.cameras} - {evidence.image_type})
    found = []
    if wrong:
        hint = "give --compressed for CompressedImage" if wrong == [IMAGE_TYPES[1]] else "name the camera's own topic"
        found.append(f"{topic} carries {', '.join(wrong)}, and the bridge reads {evidence.image_type}: {hint}")
    elif not evidence.cameras and not evidence.starting:
        found.append(f"no publisher on {topic}: start the {evidence.sensor}, or compare ROS_DOMAIN_ID and the topic "
                     "name")
    if len(cameras) > 1:
        found.append(mixed(topic, cameras, "images" if evidence.sensor == "camera" else "messages"))
    if not cameras or evidence.frames.count or not evidence.settled:
        return found
    if evidence.incompatible:
        found.append(f"{topic}: the publisher's quality of service does not fit a best-effort, volatile reader: "
                     "change it")
    else:
        found.append(f"{topic}: {len(cameras)} publisher(s) matched but no frame arrives. {profile_remedy()}")
    return found


def _frame_causes(evidence: Evidence) -> list[str]:
    """Return what is wrong with the frames that come."""
    topic, frames = evidence.image_topic, evidence.frames
    if not frames.count:
        return []
    found = []
    if evidence.silence > SILENT:
        return [f"{topic}: the {evidence.sensor} fell silent {evidence.silence:.1f} s ago"]
    if evidence.unusable:
        found.append(f"{topic}: {evidence.unusable}")
    slow = evidence.settled and frames.rate < LOW_RATE * evidence.rate_hz
    if frames.losses or (slow and evidence.image_bytes > SHARED_MEMORY_LIMIT):
        found.append(f"{topic}: {frames.rate:.1f} frames/s arrive and {frames.losses} were reported lost on the way in "
                     f"{WINDOW:.0f} s. {profile_remedy()}")
    elif slow and not evidence.pace_by_stamp:
        found.append(f"{topic}: {frames.rate:.1f} frames/s arrive, the policy needs {evidence.rate_hz:g}: raise the "
                     f"{evidence.sensor}'s rate")
    found += [f"{topic}: every message has the same stamp: let the {evidence.sensor}'s node stamp each one "
              "(header.stamp)"] if frames.has_one_stamp else _clock_causes(evidence)
    if frames.unchanged:
        found.append(f"{topic}: the frames do not change: the {evidence.sensor} is frozen, or looks at one still "
                     "picture")
    if evidence.blind:
        found.append(f"{topic}: the frames are uniformly black or white: check lens, light and exposure")
    return found


def _clock_causes(evidence: Evidence) -> list[str]:
    """Return what is wrong with the stamps of frames that come."""
    frames, found = evidence.frames, []
    if abs(frames.stamp_age) > evidence.stamp_limit:
        side = "behind" if frames.stamp_age > 0 else "ahead of"
        found.append(f"the {evidence.sensor}'s clock is {abs(frames.stamp_age):.2f} s {side} this computer's: "
                     "synchronise both (chrony, ptp), take the simulator's /clock (use_sim_time) where it is "
                     "simulated, or give --stamp-age inf")
    if not evidence.pace_by_stamp and not 0.8 <= frames.pace <= 1.25:
        found.append(f"the stamps run at {frames.pace:.2f} times real time: run the simulator in real time, or give "
                     "--pace stamp")
    return found


def _command_causes(evidence: Evidence) -> list[str]:
    """Return why commands do not reach the base, or not alone."""
    topic = evidence.command_topic
    types = {endpoint.type for endpoint in evidence.listeners}
    found = []
    if not types and not evidence.starting:
        found.append(f"no base listens on {topic}: start its driver, or compare ROS_DOMAIN_ID and the topic name")
    elif types and evidence.command_type not in {TYPES.get(name) for name in types}:
        sent = f"the bridge sends {evidence.command_type}" if evidence.command_type else "which the bridge cannot send"
        found.append(f"the base on {topic} listens to {', '.join(sorted(types))}, {sent}: give --command-type auto")
    elif types and not any(one.hears for one in evidence.listeners if TYPES.get(one.type) == evidence.command_type):
        found.append(f"the base on {topic} asks for a quality of service that commands (reliable, volatile, without a "
                     "deadline or a lease) do not offer: change its subscription")
    if evidence.commanders:
        found.append(f"{topic} has other publishers: {', '.join(evidence.commanders)}; stop them, or put twist_mux "
                     "between")
    if evidence.guard and evidence.command_type and not evidence.starting:
        found.append(evidence.guard)
    return found


def profile_remedy() -> str:
    """Return the remedy for images that Fast DDS loses."""
    return ("Large best-effort images are lost in a small shared-memory segment: start the camera with "
            f"{PROFILE_VARIABLES[0]}={PROFILE}")
