"""Programs that a run keeps for the next one."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path
from random import Random
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dreamer_toys import corridor_env, tiny_config

from dreamer import train
from dreamer.training import programs
from dreamer.training.programs import Programs, compile_lowered, compiled

HERE = Path(__file__).parent
ENV = corridor_env(4)
CONFIG = tiny_config()
QUIET = train.TrainingOptions(progress=False, log_every_s=0.0, checkpoint_every_s=1e9)


FACTOR = 2.0 + 2.0 ** -20 * Random().randrange(2**19)
"""So that JAX's own cache has no program of it."""


def twice(x):
    return FACTOR * x


def lowered():
    return jax.jit(twice, donate_argnums=0).lower(jnp.zeros(3))


@pytest.fixture
def kept(tmp_path):
    """A folder with one program."""
    found = Programs(tmp_path / "programs", "abc")
    found.write("twice", compile_lowered(lowered()))
    return found


def test_a_kept_program_is_read_and_nothing_is_lowered(kept):
    def never():
        raise AssertionError("lowered")

    program = compiled("twice", never, kept)
    given = jnp.arange(3.0)
    np.testing.assert_allclose(program(given), [0.0, FACTOR, 2 * FACTOR])
    assert given.is_deleted()  # the memory of what is given is used for the result, as when it was compiled


def test_a_program_of_something_else_is_not_taken_for_it(kept):
    other = dataclasses.replace(kept, made_of="abd")
    assert "twice" in kept and "twice" not in other and other.read("twice") is None and kept.read("thrice") is None


@pytest.mark.parametrize("damage", [lambda data: b"", lambda data: data[:-7], lambda data: data[:90] + data[91:]])
def test_a_damaged_program_is_compiled_anew(kept, damage):
    path = kept.folder / "abc-twice"
    path.write_bytes(damage(path.read_bytes()))
    assert kept.read("twice") is None
    np.testing.assert_allclose(compiled("twice", lowered, kept)(jnp.ones(3)), [FACTOR] * 3)


def test_a_folder_that_cannot_be_written_costs_nothing(tmp_path):
    (tmp_path / "file").write_text("")
    kept = Programs(tmp_path / "file" / "programs", "abc")
    np.testing.assert_allclose(compiled("twice", lowered, kept)(jnp.ones(3)), [FACTOR] * 3)


def test_an_option_that_this_xla_lacks_is_left_out():
    with (
        mock.patch.object(jax, "default_backend", lambda: "gpu"),
        mock.patch.object(programs, "CONCURRENT", {"xla_gpu_no_such_option": "CONCURRENT"}),
    ):
        np.testing.assert_allclose(compile_lowered(lowered())(jnp.ones(3)), [FACTOR] * 3)


RUN = """
import dataclasses, json, sys
sys.path.insert(0, sys.argv[1])
from pathlib import Path
from unittest import mock
from test_programs import CONFIG, ENV, QUIET
from dreamer.experience import iteration
from dreamer import train
from dreamer.training.programs import Programs
seen, collect = [], iteration.collect
def counted(*args):
    seen.append(1)
    return collect(*args)
out, kept = Path(sys.argv[2]), Programs(Path(sys.argv[3]), "abc")
with mock.patch.object(iteration, "collect", counted):
    options = dataclasses.replace(QUIET, kept=kept)
    result = train.train(ENV, CONFIG, out, int(sys.argv[4]), 0, options)
print(json.dumps({"traced": len(seen), "loss": result.last_metrics["loss_recon"], "steps": result.env_steps}))
"""


def run(out, kept, steps, **environment):
    done = subprocess.run(
        [sys.executable, "-c", RUN, HERE, out, kept, str(steps)], capture_output=True, text=True,
        env={**os.environ, "JAX_ENABLE_COMPILATION_CACHE": "false", **environment},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


def test_a_second_process_trains_and_goes_on_without_tracing(tmp_path):
    kept = tmp_path / "programs"
    first = run(tmp_path / "a", kept, 200)
    assert sorted(path.name for path in kept.iterdir()) == ["abc-init_state", "abc-train_iteration"]
    second = run(tmp_path / "b", kept, 120)
    onward = run(tmp_path / "b", kept, 200)
    assert first["traced"] == 1 and second["traced"] == onward["traced"] == 0
    assert onward["loss"] == first["loss"] and onward["steps"] == first["steps"]


def test_what_jax_read_from_its_own_cache_is_not_kept(tmp_path):
    kept, cache = tmp_path / "programs", {
        "JAX_ENABLE_COMPILATION_CACHE": "true", "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "cache"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }  # fmt: skip
    first = run(tmp_path / "a", kept, 120, **cache)
    names = sorted(path.name for path in kept.iterdir())
    assert names == ["abc-init_state", "abc-train_iteration"]
    for name in names:
        (kept / name).unlink()
    again = run(tmp_path / "b", kept, 120, **cache)
    assert not list(kept.iterdir()) and again == first
