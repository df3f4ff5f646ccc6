"""The least-squares solver and the difference quotients, on problems with known answers."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import lsq_linear

from sysid.replay.arrays import Quotients
from sysid.search.gauss_newton import BoxStep, GaussNewton, Patience, Try

pytestmark = pytest.mark.quick
WIDE = BoxStep(-np.inf, np.inf, np.inf, floor=0.0)
CHOICES = tuple(Try(factor) for factor in (0.1, 1.0, 10.0))
DESIGN = np.random.default_rng(0).standard_normal((30, 4))
DATA = DESIGN @ np.array([0.4, 1.3, -0.2, 0.6]) + 0.1 * np.random.default_rng(1).standard_normal(30)


def solved(solver, start, residual, jacobian, rounds=60):
    """The end of starts (S, P), and the costs on the way."""
    state, costs = solver.init(start), []
    for _ in range(rounds):
        if solver.done(state).all():
            break
        found = residual(state.u)
        state = state._replace(cost=solver.cost(found, state.u))
        tried = solver.tries(state, *solver.normal(found, jacobian(state.u), state.u))
        points = tried.points.reshape(-1, start.shape[1])
        state = solver.step(state, tried, solver.cost(residual(points), points).reshape(tried.promised.shape))
        costs.append(state.cost)
    return state, np.array(costs)


def linear(u):
    return u @ DESIGN.T - DATA


def slopes(u):
    return np.broadcast_to(DESIGN, (len(u), *DESIGN.shape))


def solver_in(box, **fields):
    return GaussNewton(box, CHOICES, Patience(1e-9, times=2), **fields)


def test_an_undamped_step_of_a_linear_problem_is_its_solution_and_brings_what_it_promised():
    solver = GaussNewton(WIDE, (Try(1.0),), Patience(1e-9), damping=0.0, least=0.0)
    start = np.zeros((1, 4))
    state = solver.init(start)._replace(cost=solver.cost(linear(start), start))
    tried = solver.tries(state, *solver.normal(linear(start), slopes(start), start))
    after = solver.step(state, tried, solver.cost(linear(tried.points[0]), tried.points[0])[None])
    np.testing.assert_allclose(after.u[0], np.linalg.lstsq(DESIGN, DATA, rcond=None)[0], atol=1e-10)
    assert state.cost - after.cost == pytest.approx(tried.promised[0, 0])


@pytest.mark.parametrize("adapt", [False, True])
def test_walls_hold_what_would_leave_the_box(adapt):
    state, costs = solved(solver_in(BoxStep(adapt=adapt)), np.full((1, 4), 0.5), linear, slopes)
    np.testing.assert_allclose(state.u[0], lsq_linear(DESIGN, DATA, (0.0, 1.0)).x, atol=1e-5)
    assert (np.diff(costs[:, 0]) < 1e-12).all()


def test_a_step_that_adapts_is_the_best_one_with_what_was_cut_held_where_it_was():
    gradient, hessian = DESIGN.T @ linear(np.full((1, 4), 0.5))[0], DESIGN.T @ DESIGN
    [end] = BoxStep(adapt=True, reach=10.0, floor=0.0).points(np.full((1, 4), 0.5), gradient, hessian, 0.0)
    inside = (end > 0) & (end < 1)
    assert inside.any() and not inside.all()
    np.testing.assert_allclose((gradient + hessian @ (end - 0.5))[inside], 0.0, atol=1e-9)


def test_what_is_frozen_stays_and_the_others_are_solved_for():
    free = np.array([True, False, True, True])
    box = BoxStep(-5.0, 5.0, 5.0, free=free)
    state, _ = solved(solver_in(box), np.full((1, 4), 0.5), linear, slopes)
    rest = np.linalg.lstsq(DESIGN[:, free], DATA - 0.5 * DESIGN[:, 1], rcond=None)[0]
    assert state.u[0, 1] == 0.5
    np.testing.assert_allclose(state.u[0, free], rest, atol=1e-5)


def test_a_prior_counts_as_measurements_of_the_parameters():
    mean, precision = np.full(4, 0.3), np.diag([1.0, 10.0, 100.0, 1000.0])
    state, _ = solved(solver_in(WIDE, prior=(mean, precision)), np.zeros((1, 4)), linear, slopes)
    rows, values = np.concatenate([DESIGN, np.sqrt(precision)]), np.concatenate([DATA, np.sqrt(precision) @ mean])
    np.testing.assert_allclose(state.u[0], np.linalg.lstsq(rows, values, rcond=None)[0], atol=1e-5)


def valley(u):
    """Rosenbrock's, in which full steps fail."""
    return np.stack([10 * (u[:, 1] - u[:, 0] ** 2), 1 - u[:, 0]], axis=-1)


def valley_slopes(u):
    zero = np.zeros(len(u))
    return np.stack([np.stack([-20 * u[:, 0], zero + 10], -1), np.stack([zero - 1, zero], -1)], axis=1)


def test_starts_side_by_side_come_to_where_each_comes_alone():
    solver, starts = solver_in(BoxStep(-2.0, 2.0, 0.5)), np.array([[-1.2, 1.0], [0.0, 0.0], [1.5, -1.0]])
    together, _ = solved(solver, starts, valley, valley_slopes)
    np.testing.assert_allclose(together.u, 1.0, atol=1e-3)
    for number, start in enumerate(starts):
        alone, _ = solved(solver, start[None], valley, valley_slopes, rounds=int(together.steps[number]))
        np.testing.assert_allclose(alone.u[0], together.u[number], atol=1e-12)


def test_a_step_that_gains_nothing_moves_nothing_and_is_damped_more_until_the_start_is_done():
    solver = GaussNewton(BoxStep(), CHOICES, Patience(1e-3), most=1.0)
    state = solver.init(np.full((1, 2), 0.5))._replace(cost=np.ones(1))
    tried = solver.tries(state, np.ones((1, 2)), np.eye(2)[None])
    worse = np.array([[2.0, np.nan, 3.0]])
    seen = [state]
    for _ in range(2):
        seen.append(solver.step(seen[-1], tried, worse))
    assert all((one.u == 0.5).all() and one.cost == 1 for one in seen)
    assert [float(one.damping[0]) for one in seen] == [0.01, 1.0, 1.0]
    assert [bool(solver.done(one)[0]) for one in seen] == [False, False, True]
    blind = solver.step(seen[1], tried, worse, exact=False)  # derivatives of elsewhere say nothing
    assert blind.damping == seen[1].damping and not solver.done(blind)


def test_difference_quotients_are_central_and_one_sided_at_a_bound():
    """Of the square: 2 x, and at a bound half the step less or more."""
    x = np.array([[0.5, 0.0, 1.0], [0.25, 0.3, 0.95]])
    pairs = Quotients.central(x, 0.1)
    above, below = (np.square(side).sum(-1)[..., None] for side in (pairs.above, pairs.below))
    found = pairs.slopes(above, below)
    np.testing.assert_allclose(found, [[[1.0, 0.1, 1.9]], [[0.5, 0.6, 1.85]]])
    assert pairs.points.shape == (2, 6, 3) and pairs.points.min() >= 0 and pairs.points.max() <= 1
    traced = Quotients.central(jnp.asarray(x), 0.1)
    np.testing.assert_allclose(traced.slopes(jnp.asarray(above), jnp.asarray(below)), found, rtol=1e-5)


def test_difference_quotients_are_by_the_coordinates_that_points_are_mapped_to():
    pairs = Quotients.central(np.array([0.5, 0.5]), 0.01).mapped(lambda u: 10 * u)
    np.testing.assert_allclose(pairs.slopes(pairs.above, pairs.below), np.eye(2), atol=1e-9)


def test_forward_quotients_need_one_more_point_for_each_coordinate():
    x, sizes = np.array([1.0, 2.0]), np.array([0.1, 0.2])
    own = Quotients.forward(x, sizes)
    values = own.above @ np.array([[3.0, 0.0], [0.0, 5.0]])  # (P, K)
    np.testing.assert_allclose(own.slopes(values, x * [3.0, 5.0]), np.diag([3.0, 5.0]))
