"""ROS domains of this computer that one program holds for itself, so that none hears the clock of another."""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import os
import random
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

LINGER = 5.0
"""Seconds for which what a program left behind may still speak: a guard stops the vehicle of a node that was killed."""


@contextlib.contextmanager
def free_domain() -> Iterator[int]:
    """Hold a ROS domain that nobody else holds on this computer, and nobody did just before."""
    first = random.randrange(100)
    for domain in (1 + (first + i) % 100 for i in itertools.count()):
        with open(Path(tempfile.gettempdir()) / f"ros-domain-{domain}.lock", "a") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            about = os.fstat(lock.fileno())
            if about.st_size and time.time() - about.st_mtime < LINGER:
                continue
            try:
                yield domain
            finally:
                lock.truncate(0)
                lock.write("used")  # at this time
            return
