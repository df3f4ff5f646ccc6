"""Sizes keep their stated values where held-back drives are foretold no worse by them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sysid.errors.prior import Prior, bounds_alone
from sysid.errors.space import Space
from sysid.intervals.independence import Information
from sysid.intervals.uncertainty import PIECES
from sysid.logs.log import load_log
from sysid.pages.report import error_rows, summaries
from sysid.search.fitting import fit_log, predict
from sysid.search.settings import FitConfig
from sysid.search.stated import chosen_sizes, contradicted, simplest

NAMES = ("body.yaw_inertia", "track_width.error", "wheel_radius_difference.common", "odometry_scale.linear")
DRIVES, SAMPLES = 6, 80


@dataclass(frozen=True)
class Linear:
    """Residuals of drives that are linear in the parameters: as a fit and as whole poses."""

    space: Space
    target: np.ndarray  # (B, K)
    slopes: np.ndarray  # (B, K, P)
    prior: Prior | None = None
    equations: None = None

    @property
    def counted(self) -> int:
        return self.target.size

    @property
    def measured(self) -> SimpleNamespace:
        return SimpleNamespace(pose=np.zeros((*self.target.shape, 3)), odometry=np.zeros((*self.target.shape, 5)))

    def residuals(self, u: np.ndarray) -> np.ndarray:
        return np.einsum("bkp,np->nbk", self.slopes, self.space.to_values(u)) - self.target

    def jacobian(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.residuals(u), np.tile(self.slopes * self.space.slope(u)[0], (len(u), 1, 1, 1))

    def pieces(self, count: int) -> np.ndarray:
        return np.arange(SAMPLES) * count // SAMPLES


def choice(values: tuple[float, ...], groups: np.ndarray, **options):
    """What is chosen for drives with these true values; the drives' noise is 1."""
    space = Space(NAMES, np.array([0.0, -0.2, -0.2, 0.8]), np.array([2.0, 0.2, 0.2, 1.2]),
                  np.array([1.0, 0.0, 0.0, 1.0]), np.zeros(4, bool))
    random = np.random.default_rng(3)
    slopes = 30 * random.standard_normal((len(groups), SAMPLES, 4))
    target = slopes @ np.array(values) + random.standard_normal(slopes.shape[:2])
    fit = Linear(space, target, slopes)
    free = np.linalg.lstsq(slopes.reshape(-1, 4), target.ravel(), rcond=None)[0]
    u = space.to_unit(free)
    residual, jacobian = (one[0] for one in fit.jacobian(u[None]))
    parts = jacobian.reshape(len(groups), PIECES, -1, 4)
    scores = np.einsum("bckp,bck->bcp", parts, residual.reshape(len(groups), PIECES, -1))
    prior = bounds_alone(space)
    evidence = Information(u, scores, parts.swapaxes(-1, -2) @ parts, groups, 1.0, 1.0, prior.precision, 1.0)
    known = SimpleNamespace(evidence=evidence, deviation=np.sqrt(np.diag(evidence.inverse)))
    found = chosen_sizes(replace(fit, prior=None), fit, known, 1.0, robust=False, **options)
    return found.names, space.to_values(found.u)


@pytest.mark.quick
@pytest.mark.parametrize("groups", [np.array([0, 0, 1, 1, 2, 3]), np.zeros(3, int), np.zeros(1, int)],
                         ids=["manoeuvres", "replicates of one", "one drive"])  # fmt: skip
def test_only_sizes_that_are_wrong_are_freed(groups):
    names, values = choice((1.2, -0.05, 0.0, 0.97), groups)
    assert "track" not in names and "scales of the odometry" not in names
    np.testing.assert_allclose(values, (1.2, -0.05, 0.0, 0.97), atol=0.01)
    if "wheel radii" in names:
        assert values[2] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.quick
def test_sizes_that_are_right_stay_as_stated_unless_a_person_frees_them():
    groups = np.array([0, 0, 1, 1, 2, 3])
    names, values = choice((0.7, 0.0, 0.0, 1.0), groups)
    assert len(names) >= 2
    kept, _ = choice((0.7, 0.0, 0.0, 1.0), groups, kept=("track_width.error",))
    assert "track" not in kept


@pytest.mark.quick
def test_gains_within_their_noise_free_nothing_and_a_gain_in_one_manoeuvre_does():
    noisy = np.array([[0.1, 0.0], [-0.03, 0.0], [-0.03, 0.0], [0.04, 0.0], [-0.06, 0.0]])
    assert simplest(noisy, np.array([2, 0])) == 0
    clear = np.array([[3.0, 0.0], [0.01, 0.0], [-0.01, 0.0], [0.0, 0.0]])
    assert simplest(clear, np.array([2, 0])) == 1
    assert simplest(np.array([[0.2, 0.1, 0.1], [0.2, 0.1, 0.1]]), np.array([0, 1, 2])) == 2


@pytest.mark.long
def test_seven_drives_of_a_chair_of_stated_sizes_foretell_others_as_well_as_their_replicates():
    log = load_log(Path(__file__).parents[2] / "sysid" / "data" / "chair")
    fit = fit_log(log, FitConfig(elsewhere=False))
    assert "track" in fit.stated and "wheel radii" in fit.stated
    rows = error_rows(log.trials, *predict(fit, log.trials))
    one = summaries(rows, log.trials)["summary"]["held_out"]["ground_truth"]["trajectory"]
    assert one["fitted"] < 1.2 * one["noise_floor"]


@pytest.mark.quick
def test_what_all_drives_contradict_is_free_and_what_they_hardly_show_is_not():
    space = Space(NAMES[:3], np.array([0.0, -0.2, -0.2]), np.array([2.0, 0.2, 0.2]), np.array([1.0, 0.0, 0.0]),
                  np.zeros(3, bool))  # fmt: skip
    deviation = np.array([0.01, 0.005, 0.2])
    u = space.to_unit(np.array([1.0, -0.05, 0.02]))
    known = SimpleNamespace(evidence=SimpleNamespace(u=u), deviation=deviation)
    assert contradicted(known, space) == {"track_width.error"}
