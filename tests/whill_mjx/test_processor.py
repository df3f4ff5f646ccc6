"""Work that results share is done once on a processor: what the package asks of XLA."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.processor import FLAG, OPTION, as_one_function, share_results

pytestmark = pytest.mark.quick

PROGRAM = """
import whill_mjx
import jax, jax.numpy as jnp

def results(x, y):
    for step in range(60):
        x = x * y + step
    return [x * number + y for number in range(1, 21)]

compiled = jax.jit(results).lower(jnp.ones(64), jnp.ones(64)).compile().as_text()
print("multiplications", compiled.count(" multiply("))
"""


CONSTANTS = """
import jax, jax.numpy as jnp
from whill_mjx.processor import as_one_function

def swinging(carry, pushes):
    def step(carry, push):
        angle, speed = carry
        speed = speed - 0.01 * jnp.sin(angle) + push
        return (angle + 0.01 * speed, speed), angle.sum()

    return jax.lax.scan(step, carry, pushes)[1]

def from_rest(function):
    return jax.jit(lambda: function((jnp.zeros(1024), jnp.ones(1024)), jnp.ones(50)))()

print("difference", abs(from_rest(swinging) - from_rest(as_one_function(swinging))).max())
"""


def printed(program, flags):
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1])


def run(flags):
    return printed(PROGRAM, flags)


def test_twenty_results_of_one_chain_do_not_compute_it_twenty_times():
    assert run("") < 2 * (60 + 20)


def test_without_the_option_they_do():
    assert run(f"{FLAG}=xla_another_option") > 10 * 60


def test_options_that_were_given_are_kept(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_max_isa=AVX2")
    share_results()
    assert os.environ["XLA_FLAGS"] == f"--xla_cpu_max_isa=AVX2 {FLAG}={OPTION}"
    share_results()
    assert os.environ["XLA_FLAGS"].count(OPTION) == 1
    monkeypatch.setenv("XLA_FLAGS", f"{FLAG}=xla_another_option")
    share_results()
    assert os.environ["XLA_FLAGS"] == f"{FLAG}=xla_another_option"


def swinging(x, pushes):
    """A loop with several fused loops in each of its steps."""

    def step(carry, push):
        angle, speed = carry
        speed = speed - 0.01 * jnp.sin(angle) + push
        around = jnp.roll(angle, 1) + 0.01 * speed
        return (around, speed), around.sum()

    return jax.lax.scan(step, (x, jnp.zeros_like(x)), pushes)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="what a processor compiles")
def test_a_loop_as_one_function_is_kept_as_one_call_and_computes_the_same():
    x, pushes = jnp.linspace(-1.0, 1.0, 1024), jnp.linspace(0.0, 0.1, 50)
    both = [jax.jit(one).lower(x, pushes).compile() for one in (swinging, as_one_function(swinging))]
    lines = both[1].as_text().splitlines()  # XLA itself keeps small loops so, and newer versions larger ones
    assert any(" call(" in line and "xla_cpu_small_call" in line for line in lines)
    for one, other in zip(*(jax.tree.leaves(program(x, pushes)) for program in both), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6)


def test_operands_of_a_loop_as_one_function_may_be_constants():
    """In a process of its own: XLA aborts where it meets them."""
    assert printed(CONSTANTS, "") < 1e-3


def test_a_loop_as_one_function_is_mapped_and_differentiated_like_the_loop():
    x, pushes = jnp.linspace(-1.0, 1.0, 6).reshape(2, 3), jnp.linspace(0.0, 0.1, 5)

    def slope(function):
        totals = jax.vmap(lambda one: function(one, pushes)[1].sum())
        return jax.jvp(lambda x: totals(x).sum(), (x,), (jnp.ones_like(x),))

    one, other = slope(swinging), slope(as_one_function(swinging))
    np.testing.assert_allclose(one, other, rtol=1e-5)
