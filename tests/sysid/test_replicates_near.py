"""Which drives are near one another, so that what the model left of one is expected of the other."""

import numpy as np
import pytest

from sysid.errors.noise import BIN_SHIFT
from sysid.logs.records import Command, OdometryStream, Start, Trial
from sysid.missing.days import alike

pytestmark = pytest.mark.quick
T = np.arange(0.0, 6.0, 0.05)


def step(v, omega, shift=0.0, start=(0.0, 0.0), shape=None):
    """A drive with the same command all the time, or of another shape (T,)."""
    shape = np.ones(len(T)) if shape is None else shape
    return Trial("run/0", "run", Command(T + shift, v * shape, omega * shape),
                 OdometryStream(T, None, None, None, v * shape, omega * shape), None, Start(v=start[0], omega=start[1]))


@pytest.mark.parametrize("other, same", [
    (step(-2.49, -0.10), True),
    (step(-2.60, -0.11), True),  # 5 and 10 % larger
    (step(-2.49, -0.10, shift=0.01), True),
    (step(-2.49, -0.10, shift=BIN_SHIFT), True),
    (step(-2.49, -0.10, shift=1.1 * BIN_SHIFT), False),
    (step(-3.10, -2.33), False),  # both backwards and to the right, but quite another drive
    (step(-2.49, 0.0), False),
    (step(-1.2, -0.05), False),  # the same bend at half the speed
    (step(2.49, 0.10), False),
    (step(-2.49, -0.10, start=(1.0, 0.0)), False),  # the same commands from another speed
    (step(-2.49, -0.10, shape=np.sign(np.sin(T))), False),
])  # fmt: skip
def test_drives_are_near_by_shape_size_and_start(other, same):
    one = step(-2.49, -0.10)
    assert alike(one, other) == alike(other, one) == same


def test_noise_on_a_channel_that_nothing_was_commanded_on_does_not_matter():
    assert alike(step(0.5, 0.0), step(0.5, 1e-4))
