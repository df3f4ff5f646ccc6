"""Subscriptions that lose nothing: reliable where the publishers offer it, and deep enough for a pause."""

from collections.abc import Callable
from typing import Any

from bridge import ros

DEPTH = 1000
"""Messages that may wait: 10 s of a topic at 100 Hz."""


class Stream:
    """Hears all messages of a topic, once each, whatever quality of service its publishers offer.

    A best-effort reader hears every publisher but may lose messages; a reliable one loses none but does not hear a
    best-effort publisher. So the reader is made when the publishers are known, and made again when others come.
    """

    def __init__(self, node: Any, kind: Any, topic: str, on_message: Callable[[Any], None], raw: bool = False) -> None:
        """Watch a topic; call `look` some times a second. With `raw` messages come serialised."""
        self.node, self.kind, self.name, self.raw = node, kind, node.resolve_topic_name(topic), raw
        self.lost = 0
        """Messages that the middleware reports as lost."""
        self._on_message = on_message
        self._reader: Any = None
        self._reliable = False
        self._stamp: tuple[int, int] | None = None

    def look(self) -> bool:
        """Make the reader that suits the publishers; return whether there is one."""
        offered = [info.qos_profile.reliability for info in self.node.get_publishers_info_by_topic(self.name)]
        if offered:
            wanted = all(ros.is_reliable(one) for one in offered)
            if self._reader is None or wanted != self._reliable:
                self._open(wanted)
        return self._reader is not None

    def _open(self, reliable: bool) -> None:
        before, self._reliable = self._reader, reliable
        profile = ros.reliable(DEPTH) if reliable else ros.best_effort(DEPTH)
        if before is not None and self.raw:  # whose messages cannot be distinguished while there are two readers
            self.node.destroy_subscription(before)
            before = None
        topic = ros.Topic(self.kind, self.name, profile)
        self._reader = ros.subscribe_counting_losses(self.node, topic, self._heard, self._count, self.raw)
        if before is not None:
            self.node.destroy_subscription(before)

    def _heard(self, message: Any) -> None:
        header = getattr(message, "header", None)
        if header is not None:
            stamp = (header.stamp.sec, header.stamp.nanosec)
            if stamp == self._stamp and any(stamp):
                return  # heard by two readers while one replaces the other
            self._stamp = stamp
        self._on_message(message)

    def _count(self, event: Any) -> None:
        self.lost += event.total_count_change
