"""Where programs are computed: on JAX's own choice of devices, or on one that a user names."""

import os
import subprocess
import sys

import jax
import pytest

from whill_mjx.devices import find_device, held_to, platform
from whill_mjx.gym import WhillEnv

pytestmark = pytest.mark.quick

HELD = """
import jax, jax.numpy as jnp
from whill_mjx.devices import held_to, platform
second = jax.devices()[1]
called = held_to(second, jax.jit(lambda x: (x + 1, jax.random.normal(jax.random.key(0)))))
print([one.devices() == {second} for one in called(2)], held_to(second, platform)(), jnp.ones(3).devices() == {second})
"""


def test_all_that_a_function_computes_stays_on_the_device_that_holds_it():
    environ = {**os.environ, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": "--xla_force_host_platform_device_count=2"}
    done = subprocess.run([sys.executable, "-c", HELD], capture_output=True, text=True, env=environ, check=True)
    assert done.stdout.strip() == "[True, True] cpu False"


def test_without_a_device_a_function_stays_as_it_is():
    assert held_to(None, len) is len
    assert find_device(None) is None and find_device(jax.default_backend()) is None


def test_the_platform_is_that_of_the_default_device():
    with jax.default_device(jax.devices("cpu")[0]):
        assert platform() == "cpu"
    with jax.default_device("gpu"):
        assert platform() == "gpu"


def test_a_device_that_is_not_there_is_refused_with_what_to_do():
    with pytest.raises(ValueError, match=r"device is 'abacus', which JAX does not have here .* Give None"):
        WhillEnv("corridor", device="abacus").reset(seed=0)
