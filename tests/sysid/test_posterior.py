"""The posterior on planted linear problems with known answers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sysid.weighing.linear_model import Model
from sysid.weighing.posterior import Posterior, noise_factors, posterior, proposals
from sysid.weighing.priors import DEFAULT
from sysid.weighing.saved_evidence import Axis, Effect, Evidence, Point, load, save
from sysid.weighing.verdict import decide, tempered

B, K, C = 12, 48, 3
LEVELS = (1.0, 4.0)
NAMES = ("lag", "drag", "slope", "scale", "wind", "play")


def smooth(random, *shape):
    """Random courses (B, K, C, *shape) that drives of one manoeuvre share, smooth over 5 bins."""
    white = random.standard_normal((B // 2, K, C, *shape))
    kernel = np.exp(-0.5 * (np.arange(-6, 7) / 2.5) ** 2)
    kernel /= np.linalg.norm(kernel)
    course = np.apply_along_axis(lambda row: np.convolve(row, kernel, "same"), 1, white)
    return np.repeat(course, 2, axis=0)


def problem(seed=0, noise=1.0, planted=None):
    """Evidence of 12 drives, two of each of six manoeuvres, with `planted` (B, K, C) beside base and noise."""
    random = np.random.default_rng(seed)
    base, response = smooth(random, 3), 0.5 * smooth(random, len(NAMES))
    columns = np.stack([size * response[..., i] for i in range(len(NAMES)) for size in LEVELS], axis=-1)
    effects = tuple(
        Effect(name, name, "effect", (Axis(f"{name}.size", False, 12.0, False),), LEVELS, ((2 * i,), (2 * i + 1,)))
        for i, name in enumerate(NAMES))
    t = np.arange(K) * 0.25
    drive = np.arange(B)[:, None] // 2
    v, omega = np.sin(0.5 * t + drive), np.cos(0.3 * t + 2 * drive)
    motion = np.stack([np.ones((B, K)), v, omega, v, omega, np.mod(20 * t + drive, 2 * np.pi),
                       np.mod(17 * t - drive, 2 * np.pi), 2 * np.sin(0.2 * t + drive), 2 * np.cos(0.25 * t + drive),
                       np.broadcast_to(np.sin(0.1 * t), (B, K))], axis=-1)
    residual = base @ random.standard_normal(3) + noise * random.standard_normal((B, K, C))
    made = Evidence(
        tuple(f"drive_{b}" for b in range(B)), np.arange(B) // 2, np.arange(B) // 2, ("v", "omega", "yaw"), np.ones(C),
        0.25, np.ones((B, K, C)), residual, ("kp", "mass", "drag"), base, np.eye(3), effects, columns,
        np.diag([0.01 / size**2 for _ in NAMES for size in LEVELS]), motion, random.standard_normal((B, K, C)),
        np.arange(B) // 2, np.arange(B) % 2, np.arange(B) // 2, 0.6)
    return made if planted is None else replace(made, residual=residual + planted(made))


def response(evidence, name):
    return evidence.columns[..., evidence.effect(name).columns[0][0]]


def point(evidence, sizes):
    """What a nonlinear refit of a set would add, in a problem that is linear."""
    columns = np.stack([response(evidence, name) for name in sizes], axis=-1)
    q = np.array(list(sizes.values()))
    return Point(tuple(sizes), q, evidence.residual, columns, columns * q)


@pytest.mark.parametrize("seed", range(3))
def test_nothing_planted_scores_below_every_planted_effect(seed):
    nothing = posterior(problem(seed))
    one = posterior(problem(seed, planted=lambda e: 2.0 * response(e, "drag")))
    assert nothing.score < 6.0 < 30.0 < one.score


@pytest.mark.parametrize("noise", [0.5, 2.0, 4.0])
def test_other_noise_is_a_factor_and_nothing_missing(noise):
    found = posterior(problem(3, noise))
    assert found.score < 6.0
    assert (found.noise_low < noise).all() and (found.noise_high > noise).all()
    assert found.noise == pytest.approx(np.full(C, noise), rel=0.25)


def test_noise_of_one_channel_is_that_channels():
    loud = np.array([1.0, 3.0, 1.0])
    made = problem(4)
    random = np.random.default_rng(9)
    made = replace(made, residual=made.residual + np.sqrt(loud**2 - 1) * random.standard_normal((B, K, C)))
    factor, low, high = noise_factors(made, DEFAULT)
    assert factor == pytest.approx(loud, rel=0.25)
    assert low[1] > 2.0 and high[0] < 1.5


@pytest.mark.parametrize("name", NAMES)
def test_a_planted_effect_has_the_weight_and_its_size_lies_in_its_interval(name):
    found = posterior(problem(5, planted=lambda e: 3.0 * response(e, name)))
    best = found.sets[0]
    assert best.keys == (name,) and found.unknown < best.log_evidence - 10
    assert abs(best.q[0] - 3.0) < 3 * best.deviation[0]
    assert tempered(found, 0.0)[name] > 0.95


def test_an_effect_is_found_under_noisier_sensors():
    found = posterior(problem(6, noise=2.5, planted=lambda e: 4.0 * response(e, "wind")))
    assert found.sets[0].keys == ("wind",) and found.score > 20.0
    assert (found.noise_low > 1.5).all()


def test_an_effect_of_another_form_keeps_its_name():
    def planted(evidence):
        size = np.where(evidence.manoeuvre == 2, 4.0, 3.0)
        return size[:, None, None] * (1 + 0.2 * evidence.motion[..., 1:2]) * response(evidence, "lag")

    found = posterior(problem(7, planted=planted))
    assert found.sets[0].keys == ("lag",) and found.sets[0].log_evidence > found.unknown


@pytest.mark.parametrize("family, planted", [
    ("place", lambda m: np.exp(-0.5 * ((m[..., 7] - 1.0) / 0.3) ** 2) * np.sign(m[..., 1])),
    ("speed", lambda m: m[..., 1] ** 2),
    ("left wheel's angle", lambda m: np.sin(2 * m[..., 5])),
])  # fmt: skip
def test_what_no_effect_explains_is_unknown_and_lives_where_it_was_planted(family, planted):
    found = posterior(problem(8, planted=lambda e: 2.0 * planted(e.motion)[..., None] * np.array([1.0, -0.5, 0.0])))
    assert found.unknown > found.none + 20 and found.unknown > found.sets[0].log_evidence
    ranked = sorted(found.families, key=lambda name: -found.families[name])
    assert family in ranked[:3]


def test_a_refitted_pair_outweighs_its_parts_only_where_both_are_there():
    both = problem(10, planted=lambda e: 3.0 * response(e, "lag") + 2.0 * response(e, "play"))
    one = problem(10, planted=lambda e: 3.0 * response(e, "lag"))
    for made, keys in ((both, ("lag", "play")), (one, ("lag",))):
        points = tuple(point(made, sizes) for sizes in ({"lag": 3.0}, {"play": 1.0}, {"lag": 3.0, "play": 2.0}))
        assert posterior(replace(made, points=points)).sets[0].keys == keys


def test_proposals_hold_the_planted_effect_then_the_planted_pair_and_then_end():
    made = problem(11, planted=lambda e: 3.0 * response(e, "lag") + 2.5 * response(e, "play"))
    singles = proposals(made)
    assert {("lag",), ("play",)} <= {keys for keys, _ in singles}
    made = replace(made, points=tuple(point(made, dict(zip(keys, q, strict=True))) for keys, q in singles))
    pairs = proposals(made)
    assert any(set(keys) == {"lag", "play"} for keys, _ in pairs)
    made = replace(made, points=(*made.points, *(point(made, dict(zip(keys, q, strict=True))) for keys, q in pairs)))
    assert proposals(made) == []


def test_nothing_is_refitted_where_nothing_stands_out():
    assert proposals(problem(12)) == []


def test_evidence_of_columns_is_that_of_the_dense_gaussian():
    """Against the marginal likelihood with all covariances written out."""
    made = problem(13)
    model = Model(made, DEFAULT, np.ones(C))
    column = made.columns[..., :1]
    setting = replace(DEFAULT.settings(calm=True)[0], colour=0.1, day=0.3, wander=1.0, weight=0.0)
    extra = np.concatenate([model.rows_of(column), model.rows_of(made.residual)], axis=-1)
    mine = model.solve(*model.products(0.1, extra).after_bumps(0.3), setting, np.eye(1)).log_evidence
    plain = replace(setting, colour=0.0, day=0.0)
    mine -= model.solve(*model.products(0.0, extra).after_bumps(0.0), plain, np.eye(1)).log_evidence
    assert mine == pytest.approx(dense(model, column, 0.1, 0.3) - dense(model, column, 0.0, 0.0), abs=1e-3)


def dense(model, column, colour, day):
    made = model.evidence
    size = B * K * C
    rows = np.concatenate([made.base, model.wander, column], axis=-1).transpose(2, 0, 1, 3).reshape(size, -1)
    prior = np.diag(np.concatenate([1 / np.diag(model.base_precision), np.ones(rows.shape[1] - 3)]))
    apart = np.abs(np.subtract.outer(np.arange(K), np.arange(K))) * made.width
    noise = np.eye(K) + colour * np.exp(-apart / DEFAULT.colour_time)
    covariance = rows @ prior @ rows.T + np.kron(np.eye(C * B), noise)
    centre = np.linspace(0.0, K - 1.0, DEFAULT.day_bumps)
    shape = np.exp(-0.5 * ((np.arange(K)[:, None] - centre) / ((K - 1) / (DEFAULT.day_bumps - 1))) ** 2)
    covariance += day**2 * np.kron(np.kron(np.eye(C * B // 2), np.ones((2, 2))), shape @ shape.T)
    residual = made.residual.transpose(2, 0, 1).reshape(-1)
    square = residual @ np.linalg.solve(covariance, residual)
    return model.student(square) - 0.5 * np.linalg.slogdet(covariance)[1]


def test_a_saved_file_gives_the_same_posterior(tmp_path):
    made = problem(14, planted=lambda e: 3.0 * response(e, "slope"))
    made = replace(made, points=(point(made, {"slope": 3.0}),))
    save(tmp_path / "log.npz.xz", made)
    again = load(tmp_path / "log.npz.xz")
    assert again.effects == made.effects and again.trials == made.trials
    assert np.abs(again.residual - made.residual).max() < 0.05
    first, second = posterior(made), posterior(again)
    assert second.score == pytest.approx(first.score, rel=0.01)  # values are stored in steps
    assert [one.keys for one in second.sets[:1]] == [one.keys for one in first.sets[:1]]


def test_the_verdict_ranks_the_score_among_days_with_nothing_missing():
    made = problem(15, planted=lambda e: 2.0 * response(e, "drag"))
    found = posterior(made)
    nulls = list(np.linspace(-3.0, 12.0, 199))
    said = decide(found, made.channels, nulls)
    assert said.verdict == "named" and said.effects[0].name == "drag" and said.p_value == pytest.approx(1 / 200)
    assert decide(found, made.channels, [*nulls, *np.full(20, found.score + 1.0)]).verdict == "none"


def test_effects_that_drives_cannot_distinguish_are_one_class():
    made = problem(16)
    twin = made.columns.copy()
    twin[..., 2:4] = twin[..., 0:2]
    made = replace(made, columns=twin, residual=made.residual + 3.0 * response(made, "lag"))
    said = decide(posterior(made), made.channels, np.zeros(199))
    assert said.verdict == "named" and set(said.effects[0].members) == {"lag", "drag"}


def test_tempered_weights_sum_to_one_and_leave_a_tie_a_tie():
    found = Posterior(0.0, (), 1000.0, 1000.0, {}, np.ones(C), np.ones(C), np.ones(C))
    weights = tempered(found, 0.02)
    assert sum(weights.values()) == pytest.approx(1.0) and weights["unknown"] > 0.99
