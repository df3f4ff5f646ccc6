"""Work that results share is done once on a processor: what the package asks of XLA."""

import os
import subprocess
import sys

import pytest

from whill_mjx.processor import FLAG, OPTION, share_results

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


def run(flags):
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags}
    done = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True)
    return int(done.stdout.split("multiplications ")[1])


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
