import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dreamer.layers import distributions as dist


@pytest.mark.quick
def test_equal_logits_predict_exactly_zero():
    assert np.all(np.asarray(dist.twohot_mean(jnp.zeros((3, 255)))) == 0.0)


@pytest.mark.quick
@pytest.mark.parametrize("value", [0.0, 1.0, -0.05, 100.0, -50.0, 333.0, 217.3])
def test_two_hot_target_keeps_the_value_and_sums_to_one(value):
    target = np.asarray(dist.twohot(jnp.array([value]), 255), np.float64)[0]
    assert np.count_nonzero(target) in (1, 2)
    assert target.sum() == pytest.approx(1.0, abs=1e-6)
    assert (target * dist.twohot_bins(255)).sum() == pytest.approx(value, rel=1e-5, abs=1e-6)


def test_values_beyond_the_bins_fall_on_the_outer_ones():
    target = np.asarray(dist.twohot(jnp.array([1e12, -1e12]), 255))
    assert target[0, -1] == 1.0 and target[1, 0] == 1.0


@pytest.mark.quick
def test_bins_are_mirrored_with_an_exact_zero_in_the_middle():
    bins = dist.twohot_bins(255)
    assert bins[127] == 0.0
    np.testing.assert_array_equal(bins, -bins[::-1])
    assert bins[-1] == pytest.approx(np.expm1(20.0), rel=1e-6)


def test_sampled_classes_follow_the_probabilities():
    probs = jnp.array([0.1, 0.6, 0.3])
    uniform = (jnp.arange(1000) + 0.5) / 1000
    index = dist.sample_index(jnp.broadcast_to(probs, (1000, 3)), uniform)
    np.testing.assert_array_equal(np.bincount(np.asarray(index)), [100, 600, 300])


def test_the_uniform_share_keeps_every_class_possible():
    probs = dist.unimix_probs(jnp.array([[100.0, 0.0, 0.0, 0.0]]), 0.01)
    np.testing.assert_allclose(probs, [[0.9925, 0.0025, 0.0025, 0.0025]], rtol=1e-5)


def test_straight_through_passes_the_gradient_of_the_probabilities():
    probs = jnp.array([[0.2, 0.8]])
    sample = dist.straight_through(probs, jnp.array([0]))
    np.testing.assert_array_equal(sample, [[1.0, 0.0]])
    gradient = jax.grad(lambda p: jnp.sum(dist.straight_through(p, jnp.array([0])) * jnp.array([3.0, 5.0])))(probs)
    np.testing.assert_array_equal(gradient, [[3.0, 5.0]])


@pytest.mark.quick
def test_the_policy_starts_wide_and_stays_within_its_bounds():
    mean, std = dist.bounded_normal(jnp.array([0.0, 50.0]), jnp.array([0.0, -50.0]), 0.1, 1.0)
    assert float(std[0]) == pytest.approx(0.8927, abs=1e-4)
    assert float(std[1]) == pytest.approx(0.1, abs=1e-6)
    assert float(mean[1]) == pytest.approx(1.0)


def test_normal_log_prob_and_entropy_equal_the_closed_form():
    mean, std, x = jnp.array([0.5, -1.0]), jnp.array([0.5, 2.0]), jnp.array([1.0, 1.0])
    terms = [(0.5, 0.5), (-1.0, 2.0)]
    expected = sum(-0.5 * ((1.0 - m) / s) ** 2 - np.log(s * np.sqrt(2 * np.pi)) for m, s in terms)
    assert float(dist.normal_log_prob(mean, std, x)) == pytest.approx(expected, rel=1e-5)
    assert float(dist.normal_entropy(std)) == pytest.approx(np.log(2 * np.pi * np.e), rel=1e-5)  # log(0.5 * 2) = 0
