"""Slopes averaged over likely errors: a plane's are its own, a rippled one's those beneath; intervals follow them."""

from __future__ import annotations

import numpy as np
import pytest
from test_intervals import DRIVES, SAMPLES, Linear, designs

from sysid.intervals import uncertainty
from sysid.search import least_squares, slopes

pytestmark = pytest.mark.quick


class Rippled(Linear):
    """Wheels that stick and slip: ripples, finer than the errors, as steep as the plane on which they lie."""

    def __init__(self, design: np.ndarray, errors: np.ndarray, height: float, length: float):
        super().__init__(design, errors)
        self._height, self._wave = height, 2 * np.pi / length

    def residuals(self, u):
        plane = np.einsum("bkp,np->nbk", self._design, u)
        return super().residuals(u) + self._height * np.sin(self._wave * plane)

    def jacobian(self, u):
        plane = np.einsum("bkp,np->nbk", self._design, u)
        steep = 1 + self._height * self._wave * np.cos(self._wave * plane)
        return self.residuals(u), steep[..., None] * self._design


def test_slopes_of_a_plane_are_its_own_and_the_residual_is_that_of_the_point():
    random = np.random.default_rng(0)
    plane = Linear(designs(random), random.standard_normal((DRIVES, SAMPLES)))
    u = np.array([0.5, 0.001, 0.999])  # near two walls, which reflect
    residual, jacobian = slopes.average_slopes(plane, u, np.diag([1e-4, 1e-3, 1e-4]) + 1e-5)
    np.testing.assert_allclose(residual, plane.residuals(u[None])[0])
    np.testing.assert_allclose(jacobian, plane.jacobian(u[None])[1][0], atol=1e-8)


def test_slopes_of_a_rippled_plane_are_those_beneath_the_ripples():
    random = np.random.default_rng(0)
    rippled = Rippled(designs(random), np.zeros((DRIVES, SAMPLES)), height=0.02, length=0.05)
    u, smooth = np.full(3, 0.5), designs(np.random.default_rng(0))
    wrong = np.abs(rippled.jacobian(u[None])[1][0] - smooth).max()
    covariance = slopes.likely_by(slopes.products(smooth), 1.0)
    left = np.abs(slopes.average_slopes(rippled, u, covariance)[1] - smooth).max()
    assert wrong > 30 and left < 0.1 * wrong


def test_walls_turn_moves_back_to_where_they_are_as_likely():
    random = np.random.default_rng(0)
    root = random.standard_normal((3, 3)) * 0.1
    covariance = root @ root.T
    moves = random.standard_normal((200, 3)) @ np.linalg.cholesky(covariance).T
    u = np.array([0.02, 0.5, 0.5])
    inside = slopes.within(u, moves, covariance)
    assert (u + inside >= -1e-12).all() and (u + inside <= 1 + 1e-12).all()
    reflected = np.abs(inside - moves).max(1) > 0
    assert 50 < reflected.sum() < 150
    likely = [np.einsum("np,pq,nq->n", one, np.linalg.inv(covariance), one) for one in (inside, moves)]
    once = reflected & (np.abs(moves[:, 1:]).max(1) < 0.3)
    np.testing.assert_allclose(likely[0][once], likely[1][once], rtol=1e-6)


def test_moves_that_no_reflection_brings_inside_are_shortened():
    """Two walls at once and a correlation that sends what one turns back beyond the other."""
    covariance = np.array([[1.0, -0.99], [-0.99, 1.0]])
    inside = slopes.within(np.zeros(2), np.array([[0.3, -0.3], [-0.3, 0.3]]), covariance)
    assert (inside >= 0.0).all()


def test_intervals_of_a_rippled_model_hold_the_truth_as_often_as_they_say():
    """With the slopes of the very point they would not: ripples make what is told look larger than it is."""
    random, inside, narrow = np.random.default_rng(2), [], []
    for _ in range(60):
        design, errors = designs(random), random.standard_normal((DRIVES, SAMPLES))
        rippled = Rippled(design, errors, height=0.05, length=0.05)
        start = least_squares.fit(rippled, stop=least_squares.Stopping(10))
        u = slopes.descend(rippled, start).u
        known = uncertainty.estimate(rippled, u)
        inside.append([one.low <= 0.5 <= one.high for one in known.estimates])
        plain = np.sqrt(np.diag(np.linalg.inv(np.einsum("bkp,bkq->pq", *2 * [rippled.jacobian(u[None])[1][0]]))))
        narrow.append(plain / known.deviation)
    assert np.mean(inside) == pytest.approx(0.92, abs=0.05)
    assert np.median(narrow) < 0.5


def test_a_descent_never_ends_higher_and_counts_what_it_replays():
    random = np.random.default_rng(3)
    rippled = Rippled(designs(random), random.standard_normal((DRIVES, SAMPLES)), height=0.25, length=0.3)
    start = least_squares.fit(rippled, stop=least_squares.Stopping(10))
    told = []
    end = slopes.descend(rippled, start, progress=lambda count, text: told.append(count))
    assert end.cost < start.cost and end.cost == pytest.approx(
        least_squares.costs_of(rippled, end.u[None])[0]) and (np.diff(end.history[len(start.history) :]) <= 0).all()
    assert sum(told) == len(end.history) - len(start.history)
    assert end.evaluations - start.evaluations >= len(told) * 6 * 3
