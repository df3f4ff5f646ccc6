"""The study of the learner: its other forms compute the same, its profile adds up, and one failure stops nothing."""

from __future__ import annotations

import argparse
from types import SimpleNamespace
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import learner, learner_fused, learner_profile, learner_study
from benchmarks.learner_profile import Event
from dreamer.config import preset
from dreamer.model import rssm

CONFIG = preset("cpu", deter=16, hidden=8, stoch=3, classes=4, blocks=4)
PROGRAM = """HloModule jit_block
%body {
  %fusion.1 = f32[8]{0} fusion(%a), kind=kLoop, metadata={op_name="jit(f)/while/transpose(jvp(part_observe))/add"}
  ROOT %dot.2 = f32[8]{0} dot(%a, %b), metadata={op_name="jit(f)/part_imagine/while/part_heads/dot" id=3}
  %copy.3 = f32[8]{0} copy(%a), metadata={op_name="jit(block)/while/body"}
}
"""


def sequences(config, batch):
    """Parameters, the state before, and sequences that hold an episode's start."""
    params = jax.jit(lambda key: rssm.init(config, 6, 2, key))(jax.random.PRNGKey(0))
    keys = jax.random.split(jax.random.PRNGKey(1), 3)
    start = jax.tree.map(lambda x: x + 0.3, rssm.initial(config, batch))
    return params, start, (
        jax.random.normal(keys[0], (5, batch, 2)), jax.random.normal(keys[1], (5, batch, 6)),
        jnp.zeros((5, batch), bool).at[2, 0].set(True), jax.random.uniform(keys[2], (5, batch, config.stoch)))


def observed(form):
    """States, probabilities and gradients."""
    params, start, args = sequences(CONFIG, 2)

    def total(params):
        states, probs = rssm.observe(CONFIG, params, start, rssm.Sequences(*args))
        weight = jax.random.normal(jax.random.PRNGKey(2), probs.shape)
        return jnp.sum(weight * probs) + jnp.sum(jnp.square(states.features())), (states, probs)

    with learner_study.in_form(form):
        return jax.jit(jax.grad(total, has_aux=True))(params)


@pytest.fixture(scope="module")
def as_it_is():
    return observed("")


@pytest.mark.parametrize("form", learner_study.FORMS)
def test_every_form_of_the_observing_scan_gives_the_same_states_and_gradients(form, as_it_is):
    for one, other in zip(jax.tree.leaves(as_it_is), jax.tree.leaves(observed(form)), strict=True):
        np.testing.assert_allclose(one, other, rtol=2e-4, atol=2e-5)
    assert rssm.observe is not learner_study.plain_observe


def test_the_fused_kernel_gives_the_states_of_the_scan():
    config = preset("cpu", deter=64, hidden=16, stoch=2, classes=16, blocks=2, batch_size=16)
    params, start, args = sequences(config, 16)
    params = jax.tree.map(lambda x: x + 0.1 * jax.random.normal(jax.random.PRNGKey(x.size), x.shape), params)
    scanned = rssm.observe(config, params, start, rssm.Sequences(*args))
    alone = learner_fused.fused_scan(learner_fused.Layout(alone=True))
    with mock.patch.object(rssm, "scan_products", alone):
        fused = rssm.observe(config, params, start, rssm.Sequences(*args))
    for one, other in zip(jax.tree.leaves(scanned), jax.tree.leaves(fused), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5)


def test_widths_that_the_fused_kernel_cannot_have_are_refused():
    config = preset("cpu", deter=48, hidden=16, stoch=2, classes=16, blocks=2, batch_size=16)
    params, start, args = sequences(config, 16)
    with mock.patch.object(rssm, "scan_products", learner_fused.fused_scan(learner_fused.Layout(alone=True))):
        with pytest.raises(ValueError, match="deter is 48"):
            rssm.observe(config, params, start, rssm.Sequences(*args))


def test_an_instruction_counts_for_the_outermost_part_that_asked_for_it():
    assert learner_profile.parts_of(PROGRAM) == {"fusion.1": "observe", "dot.2": "imagine", "copy.3": "other"}


def test_time_in_which_kernels_run_side_by_side_counts_once():
    events = [Event("a", "", 0.0, 10.0), Event("b", "", 5.0, 10.0), Event("c", "", 7.0, 2.0), Event("d", "", 20.0, 5.0)]
    assert learner_profile.busy_ns(events) == 20.0


def test_the_traced_update_is_shared_out_over_its_parts(monkeypatch):
    def block(x):
        return jnp.tanh(learner_profile.world_model.head(x, x))

    monkeypatch.setattr(learner_profile.world_model, "head", lambda params, x: params @ x)
    with learner_profile.named_parts():
        program = jax.jit(block).lower(jnp.ones((64, 64))).compile()
    parts = learner_profile.parts_of(program.as_text())
    events = learner_profile.traced(lambda: program(jnp.ones((64, 64))).block_until_ready())
    assert "heads" in {parts.get(one.op) for one in events}


def test_a_variant_that_fails_is_left_out_and_the_rest_is_measured(monkeypatch, capsys):
    class Updates:
        def __init__(self, config, per_block, runs):
            if config.batch_size == 2:
                raise ValueError("does not trace")
            self.batch, self.runs = config.batch_size, runs

        def compile(self):
            if self.batch == 3:
                raise RuntimeError("does not compile")
            return 1.0

        def time(self, blocks):
            return [0.5] * blocks, [0.5] * blocks

    monkeypatch.setattr(learner_study, "Updates", Updates)
    args = learner.arguments().parse_args("--batches 2 3 4 --seeds-under-vmap 4 --compile-threads 2".split())
    found = {}
    learner_study.run("size12m", preset("size12m"), args, found.update)
    assert {name: one["value"] for name, one in found.items()} == {
        "compile_s_12m_batch4": 1.0, "updates_per_s_12m_batch4": 2.0, "replayed_steps_per_s_12m_batch4": 2.0 * 4 * 64,
        "compile_s_12m_seeds4": 1.0, "updates_per_s_12m_seeds4": 8.0, "replayed_steps_per_s_12m_seeds4": 8.0 * 16 * 64,
    }  # fmt: skip
    said = capsys.readouterr().out
    assert "12m_batch2: failed, ValueError: does not trace" in said
    assert "12m_batch3: failed, RuntimeError: does not compile" in said


def test_nothing_is_begun_after_the_limit(capsys):
    args = argparse.Namespace(compile_threads=1, per_block=1, blocks=1)
    variant = learner_study.Variant("12m_unroll1", preset("size12m"))
    assert not [one for one in learner_study.time_variants([variant], args, until=0.0) if one]
    assert "12m_unroll1: left out" in capsys.readouterr().out


def test_a_process_that_fails_gives_its_last_line_and_no_figures(monkeypatch, capsys):
    answer = SimpleNamespace(returncode=1, stdout="", stderr="long story\nUnknown flag in XLA_FLAGS")
    monkeypatch.setattr(learner_study.subprocess, "run", lambda *args, **kwargs: answer)
    args = learner.arguments().parse_args([])
    assert learner_study.in_process("no_autotune", args, "--xla_no_such_flag=1", []) == {}
    assert "no_autotune: failed, Unknown flag in XLA_FLAGS" in capsys.readouterr().out
