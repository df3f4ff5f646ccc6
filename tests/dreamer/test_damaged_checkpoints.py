"""Any damage to a checkpoint gives the state that was written, the one before it, or an error that names the file."""

import json
import shutil
import warnings
from dataclasses import dataclass
from pathlib import Path

import damage
import jax.numpy as jnp
import numpy as np
import pytest
from dreamer_toys import tiny_config
from hypothesis import given
from hypothesis import strategies as st

from dreamer.training import checkpoint
from dreamer.training.metrics_log import Log


@dataclass(frozen=True)
class Config:
    lr: float = 1e-3


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two checkpoints of ten and twenty steps."""
    path = tmp_path_factory.mktemp("run") / "checkpoints"
    for steps in (10, 20):
        checkpoint.save(path, state(steps), Config(), checkpoint.Moment(steps))
    checkpoint.restore(path, state(0), Config())  # what orbax does only once is no cost of a file
    return path


def state(steps):
    return {"params": {"w": jnp.arange(24.0).reshape(4, 6) + steps}, "steps": jnp.array(steps)}


@damage.few(6)
@given(data=st.data())
def test_a_damaged_checkpoint_is_passed_over_or_refused_by_name(data, folder):
    broken = folder.with_name("damaged")
    shutil.rmtree(broken, ignore_errors=True)
    shutil.copytree(folder, broken)
    for newest in broken.glob("*20") if data.draw(st.booleans()) else sorted(broken.iterdir()):
        files = sorted(path for path in newest.rglob("*") if path.is_file())
        path = data.draw(st.sampled_from([newest / "meta.json", *files]))
        if path.name == "meta.json" and data.draw(st.booleans()):
            path.write_bytes(data.draw(damage.damaged_table(json.loads(path.read_text()))))
        elif data.draw(st.integers(0, 9)) == 0:
            path.unlink()
        else:
            path.write_bytes(data.draw(damage.damaged(path.read_bytes())))
    with damage.Costs(), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        try:
            found = checkpoint.restore(broken, state(0), Config())
        except checkpoint.CheckpointError as error:
            assert str(broken) in str(error) and len(str(error)) < 4000
            return
    if found is None:  # no meta.json is left
        assert not checkpoint.complete(broken)
        return
    steps = int(found[0]["steps"])
    assert steps in (10, 20)
    np.testing.assert_array_equal(found[0]["params"]["w"], state(steps)["params"]["w"])


@damage.few(60)
@given(data=st.data())
def test_damaged_lines_of_a_log_are_left_out(data, tmp_path_factory):
    path = Path(tmp_path_factory.getbasetemp()) / "metrics.jsonl"
    good = b'{"env_steps": 10, "loss": 0.5}\n{"env_steps": 20, "eval/return": 1.5}\n'
    path.write_bytes(data.draw(damage.damaged(good)))
    log = Log(path, tiny_config(), 15, None, False)
    assert all(json.loads(line)["env_steps"] <= 15 for line in path.read_text().splitlines())
    log.write({"env_steps": 30.0})
    assert json.loads(path.read_text().splitlines()[-1]) == {"env_steps": 30.0}


def test_a_figure_that_json_cannot_say_is_left_out_of_its_line(tmp_path):
    log = Log(tmp_path / "metrics.jsonl", tiny_config(), 0, None, False)
    log.write({"env_steps": 30, "loss": float("nan"), "eval/return": float("-inf"), "grad_norm": 2.5})
    assert log.last["grad_norm"] == 2.5
    assert (tmp_path / "metrics.jsonl").read_text() == '{"env_steps": 30, "grad_norm": 2.5}\n'


@pytest.mark.parametrize("every_s, took_s, expected_s", [
    (None, 0.5, 60.0), (None, 30.0, 570.0), (5.0, 30.0, 5.0), (0.0, 30.0, 0.0),
])  # fmt: skip
def test_checkpoints_that_take_long_are_written_less_often(monkeypatch, every_s, took_s, expected_s):
    now = [100.0]
    monkeypatch.setattr(checkpoint.time, "monotonic", lambda: now[0])
    pace = checkpoint.Pace(every_s)
    now[0] += 1000.0
    with pace:
        now[0] += took_s
    assert pace.every_s == pytest.approx(expected_s)
    now[0] += 0.9 * expected_s
    assert pace.due() == (expected_s == 0.0)
    now[0] += 0.11 * expected_s
    assert pace.due()
