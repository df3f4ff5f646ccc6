"""Work that results share is done once on a processor: what the package asks of XLA."""

import dataclasses
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sysid import command_line as commands
from whill_mjx import processor
from whill_mjx.io import command_line
from whill_mjx.processor import (
    FLAG,
    OPTION,
    VECTORS,
    WIDE,
    as_one_function,
    keep_results_apart,
    share_results,
    shares_results,
)

pytestmark = pytest.mark.quick

PROGRAM = """
import whill_mjx
whill_mjx.share_results()
import jax, jax.numpy as jnp

def results(x, y):
    for step in range(60):
        x = x * y + step
    return [x * number + y for number in range(1, 21)]

compiled = jax.jit(results).lower(jnp.ones(64), jnp.ones(64)).compile().as_text()
print("multiplications", compiled.count(" multiply("))
"""

PLAIN = """
import os
before = dict(os.environ)
import whill_mjx, sysid, dreamer, bridge
import sysid.fit, whill_mjx.env, whill_mjx.train, bridge.simulate
assert dict(os.environ) == before
import jax, mujoco
from mujoco import mjx

def speed(shape):
    bodies = "".join(f'<body pos="{x} 0 0.1"><freejoint/><geom type="{shape}" size="0.1 0.1 0.1"/></body>'
                     for x in (0, 0.5))
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><geom type="plane" size="5 5 0.1"/>{bodies}</worldbody></mujoco>')
    placed = mjx.put_model(model)
    return abs(jax.jit(mjx.step)(placed, mjx.make_data(placed)).qvel).max()

print("speed", max(speed("cylinder"), speed("box")))
"""

DRIVE = """

import whill_mjx
if SHARED:
    whill_mjx.share_results()
import jax, jax.numpy as jnp
from whill_mjx.vehicle.dynamics import place, substep
from whill_mjx.vehicle.model import build_model

spec, params = whill_mjx.preset("whill_cr")
model = build_model(spec)

@jax.jit
def driven(command):
    state = place(model, params, 0.0, 0.0, 0.0)
    return jax.lax.scan(lambda state, _: (substep(model, params, state, command), None), state, length=200)[0].qpos

print("distance", driven(jnp.array([0.5, 0.3]))[0])
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


CORES = """
import os
from whill_mjx import device_per_core
many = len(os.sched_getaffinity(0))
every, some, one = device_per_core(6 * many), device_per_core(7 * many + 1), device_per_core(1)
assert (7 * many + 1) % len(some) == 0 and len(one) == 1
print("devices", len(every))
"""


def run(flags):
    return printed(PROGRAM, flags)


def test_twenty_results_of_one_chain_do_not_compute_it_twenty_times():
    assert run("") < 2 * (60 + 20)


def test_each_core_is_a_device_where_the_instances_can_be_split_evenly():
    assert printed(CORES, "") == len(os.sched_getaffinity(0))


def test_without_the_option_they_do():
    assert run(f"{FLAG}=xla_another_option") > 10 * 60


def test_importing_the_packages_changes_nothing_for_plain_mjx_programs():
    """Two cylinders and two boxes on a plane: XLA aborts on either with the option."""
    assert printed(PLAIN, "") < 1.0


def test_the_vehicle_drives_the_same_way_with_and_without_the_option():
    one, other = (printed(f"SHARED = {shared}" + DRIVE, "") for shared in (True, False))
    assert one == pytest.approx(other, rel=1e-4) and one > 0.1


@dataclasses.dataclass(frozen=True)
class Options(commands.OwnModels):
    """Of a command that may step another model."""

    model: str = ""


@pytest.mark.parametrize("flags", ["", f"{FLAG}={OPTION}", "--xla_cpu_max_isa=AVX2"])
@pytest.mark.parametrize(("model", "shared"), [
    ("", True), ("robot.urdf", False), ("a/robot.xml", False), ("robot.urdf.xacro", False), ("plain.py", True),
    ("wrapped.py", False), ("wrapped.py:cart", False)])
def test_commands_share_results_unless_they_step_a_users_robot(monkeypatch, tmp_path, model, shared, flags):
    (tmp_path / "plain.py").write_text("import whill_mjx\nmodel = function_model(...)\n")
    (tmp_path / "wrapped.py").write_text("from sysid import mjcf_model\nmodel = mjcf_model('robot.xml')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XLA_FLAGS", flags)
    seen = []
    commands.run(Options, lambda chosen: seen.append(shares_results()), "A command.",
                 args=["--model", model] if model else [])
    assert seen == [shared]
    assert ("--xla_cpu_max_isa=AVX2" in os.environ["XLA_FLAGS"]) == ("AVX2" in flags)


def test_commands_of_the_simulator_share_results(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "")
    seen = []
    command_line.run(Options, lambda chosen: seen.append(shares_results()), "A command.", args=[])
    assert seen == [True]


def test_options_that_were_given_are_kept(monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    monkeypatch.setenv("XLA_FLAGS", f"--xla_cpu_max_isa=AVX2 {WIDE}=128")
    share_results()
    assert os.environ["XLA_FLAGS"] == f"--xla_cpu_max_isa=AVX2 {WIDE}=128 {FLAG}={OPTION},{VECTORS}"
    share_results()
    assert os.environ["XLA_FLAGS"].count(OPTION) == 1
    monkeypatch.setenv("XLA_FLAGS", f"{FLAG}=xla_another_option {WIDE}=128")
    share_results()
    assert os.environ["XLA_FLAGS"] == f"{FLAG}=xla_another_option {WIDE}=128"


@pytest.mark.parametrize(("asked", "device", "wanted"), [
    ("", "", True), ("cpu", "nvidia0", True), ("", "nvidia0", False), ("cuda,cpu", "", False), ("", "accel0", False)])
def test_llvm_is_asked_only_where_no_accelerator_reads_it_too(monkeypatch, tmp_path, asked, device, wanted):
    monkeypatch.setenv("JAX_PLATFORMS", asked)
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setattr(processor, "DEVICES", tmp_path)
    if device:
        (tmp_path / device).touch()
    share_results()
    assert shares_results() and (VECTORS in os.environ["XLA_FLAGS"]) == wanted
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")  # of a process that this one starts
    share_results()
    assert os.environ["XLA_FLAGS"].count(VECTORS) == os.environ["XLA_FLAGS"].count(FLAG) == 1
    keep_results_apart()
    assert not shares_results() and VECTORS not in os.environ["XLA_FLAGS"]


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
