"""Subscriptions that lose nothing: reliable where the publishers offer it, and deep enough for a pause."""

from collections.abc import Callable
from typing import Any

from bridge.nodes import ros

DEPTH = 1000
"""Messages that may wait: 10 s of a topic at 100 Hz."""


class Stream:
    """Hears all messages of a topic, once each, whatever quality of service its publishers offer.

    A best-effort reader hears every publisher but may lose messages; a reliable one loses none but does not hear a
    best-effort publisher. So the reader is made when the publishers are known, and made again when others come. A whole
    recording also gets what its publishers keep for late joiners, such as a map or /tf_static.
    """

    def __init__(self, node: Any, kind: Any, topic: str, on_message: Callable[[Any], None], raw: bool = False) -> None:
        """Watch a topic; call `look` some times a second. With `raw` messages come serialised, and kept ones too."""
        self.node, self.kind, self.name, self.raw = node, kind, node.resolve_topic_name(topic), raw
        self.lost = 0
        """Messages that the middleware reports as lost."""
        self._on_message = on_message
        self._reader: Any = None
        self._quality = (False, False)  # of the reader: reliable, and gets what is kept

    def look(self) -> bool:
        """Make the reader that suits the publishers; return whether there is one."""
        offered = [info.qos_profile for info in self.node.get_publishers_info_by_topic(self.name)]
        if offered:
            reliable = all(ros.is_reliable(one.reliability) for one in offered)
            wanted = reliable, reliable and self.raw and all(ros.is_latched(one.durability) for one in offered)
            if self._reader is None or wanted != self._quality:
                self._open(wanted)
        return self._reader is not None

    def _open(self, wanted: tuple[bool, bool]) -> None:
        before, self._quality = self._reader, wanted
        reliable, kept = wanted
        profile = (ros.latched if kept else ros.reliable if reliable else ros.best_effort)(DEPTH)
        topic = ros.Topic(self.kind, self.name, profile)
        # the one before ends within this callback, so no message comes by both
        self._reader = ros.subscribe_counting_losses(self.node, topic, self._on_message, self._count, self.raw)
        if before is not None:
            self.node.destroy_subscription(before)

    def _count(self, event: Any) -> None:
        self.lost += event.total_count_change
