"""Which errors of a log are independent of one another: those of samples, of pieces, of drives, or of places.

Variances are sums within blocks before they are squared (CR2), with Satterthwaite's degrees of freedom. Sources: Bell
and McCaffrey (2002); Pustejovsky and Tipton (2018). Blocks are trials; pieces, where too few trials inform a parameter;
manoeuvres, where replicates share more than by chance; and places of manoeuvres. The widest of the intervals is taken,
and a wild bootstrap corrects for that choice. Source: Cameron, Gelbach and Miller (2008).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

LEAST_LEFT = 1e-3  # of a direction of which a block keeps less than this share of its errors, its residual says nothing


@dataclass(frozen=True)
class Sandwich:
    """How G independent blocks move P estimates."""

    moves: np.ndarray  # (G, P, P): of each block's J^T r, corrected for what the estimates follow
    freedom: np.ndarray  # (P,) degrees of freedom of the variances
    informed: np.ndarray  # (P,) expected variance for independent errors, over what it is then

    def covariance(self, scores: np.ndarray) -> np.ndarray:
        """(P, P) of the estimates, from J_g^T r_g (G, P) of each block at the minimum."""
        moved = np.einsum("gpq,gq->gp", self.moves, scores)
        return moved.T @ moved

    def variances(self, scores: np.ndarray) -> np.ndarray:
        """(N, P) diagonals of covariances, from scores (N, G, P)."""
        moved = scores.swapaxes(0, 1) @ self.moves.swapaxes(1, 2)  # large: other memory would take longer than squaring
        return np.square(moved, out=moved).sum(0)


def sandwich(blocks: np.ndarray, inverse: np.ndarray) -> Sandwich:
    """The variances of a minimum of squares, from J_g^T J_g (G, P, P) of blocks and the inverse (P, P) of their sum."""
    value, vector = np.linalg.eigh(inverse)
    half = (vector * np.sqrt(np.maximum(value, 0.0))) @ vector.T
    share, axes = np.linalg.eigh(half @ blocks @ half)  # (G, P), (G, P, P): of the errors that the estimates follow
    left = 1.0 - np.clip(share, 0.0, 1.0)
    gain = np.where(left > LEAST_LEFT, np.maximum(left, LEAST_LEFT) ** -0.5, 0.0)
    local = axes.swapaxes(1, 2) @ half  # (G, P, P)
    # Of independent errors of variance 1, blocks g and h move p with the covariance lengths_gp (g = h) - z_gp^T z_hp.
    lengths = np.einsum("gkp,gk->gp", local**2, share * gain**2)
    z = axes @ ((share * gain)[..., None] * local)  # (G, P, P)
    freedom, expected = np.empty(len(inverse)), np.empty(len(inverse))
    for p in range(len(inverse)):
        products = np.diag(lengths[:, p]) - z[:, :, p] @ z[:, :, p].T
        expected[p] = np.trace(products)
        freedom[p] = expected[p] ** 2 / max(float(np.square(products).sum()), 1e-300)
    return Sandwich(local.swapaxes(1, 2) @ (gain[..., None] * local), freedom,
                    expected / np.maximum(np.diag(inverse), 1e-300))


CONFIDENCE = 0.90
ENOUGH = 2.0  # degrees of freedom from which the variance between blocks is taken: three or four drives that inform
CHANCE = 0.05  # probability below which what replicates share is taken for the model's error
FLIPS, AT_ONCE = 999, 2**22  # draws of the signs of blocks; numbers that are drawn together


@dataclass(frozen=True)
class Information:
    """Information of a log at a fitted point: sums over K pieces of each of B trials, in P unit coordinates."""

    u: np.ndarray  # (P,)
    scores: np.ndarray  # (B, K, P) J^T r of pieces of trials
    blocks: np.ndarray  # (B, K, P, P) J^T J of them
    groups: np.ndarray  # (B,) number of the manoeuvre that each trial is a replicate of
    alike: float  # how probable residuals of replicates that are so much alike are, were they independent
    variance: float  # of residuals
    precision: np.ndarray  # (P, P) of what is known besides
    share: float  # variance that the precision is stated for
    ahead: np.ndarray = field(default_factory=lambda: np.ones((2, 1)))  # (2, P) widths from their lower and upper ends

    @property
    def inverse(self) -> np.ndarray:
        """(P, P) of the information, with what is known besides."""
        return np.linalg.inv(self.blocks.sum((0, 1)) + self.precision)

    @property
    def scale(self) -> float:
        """How many times squared errors count the same information: of pieces, or one by one where that is more."""
        pieces = float(np.square(self.scores).sum()) / max(float(np.trace(self.blocks.sum((0, 1)))), 1e-12)
        return max(self.variance, pieces, 1e-12)


@dataclass(frozen=True)
class StandardErrors:
    """Of P estimates, in unit coordinates."""

    deviation: np.ndarray  # (P,) standard errors
    quantile: np.ndarray  # (P,) standard errors on either side of an estimate that the interval reaches
    covariance: np.ndarray  # (P, P)


@dataclass(frozen=True)
class Kind:
    """Pieces of trials, put together to blocks that are taken as independent."""

    sandwich: Sandwich
    label: np.ndarray  # (B, K) number of the block of each piece

    def sums(self, scores: np.ndarray) -> np.ndarray:
        """(N, G, P) of blocks, of scores (N, B, K, P) of pieces."""
        from scipy.sparse import csr_array

        label = self.label.ravel()
        add = csr_array((np.ones(len(label)), (label, np.arange(len(label)))))
        flat = np.moveaxis(scores.reshape(len(scores), len(label), -1), 1, 0)  # (B K, N, P)
        return np.moveaxis((add @ flat.reshape(len(label), -1)).reshape(-1, *flat.shape[1:]), 0, 1)

    @property
    def counts(self) -> np.ndarray:
        """(P,) whether the blocks are enough to know their variance."""
        return (self.sandwich.informed > 0.5) & (self.sandwich.freedom >= ENOUGH)


def errors_of(evidence: Information, confidence: float = CONFIDENCE) -> StandardErrors:
    hessian, inverse = evidence.blocks.sum((0, 1)), evidence.inverse
    independent = np.sqrt(np.diag(inverse @ hessian @ inverse) * evidence.variance)
    kinds = _kinds(evidence, inverse)
    deviation, quantile = (one[0] for one in _widest(kinds, evidence.scores[None], independent, confidence))
    needed = np.zeros(len(inverse))
    for name, kind in kinds.items():
        found = []
        for moved, scores in _flipped(evidence, kind, inverse, np.random.default_rng(0)):
            reach = np.multiply(*_widest(kinds, scores, independent, confidence))
            found.append(np.abs(moved) / np.maximum(reach, 1e-300))
        if name != "manoeuvres":
            share = np.quantile(np.concatenate(found), confidence, axis=0)
            needed = np.where(kind.counts | (name == "pieces"), np.maximum(needed, share), needed)
    known = inverse @ evidence.precision @ inverse * evidence.share  # what the prior's own error adds
    covariances = [kind.sandwich.covariance(kind.sums(evidence.scores[None])[0]) for kind in kinds.values()]
    return StandardErrors(np.sqrt(deviation**2 + np.diag(known)), needed * quantile,
                          max(covariances, key=np.trace) + known)


def shared_error(series: np.ndarray, groups: np.ndarray) -> float:
    """Probability that residuals (B, K) of independent trials of a group (B,) are so much alike; 1 without such a
    group.

    Their products with one another are compared with those for random signs of the trials. Each trial's residuals are
    in its own frame.
    """
    alike = (groups[:, None] == groups) & ~np.eye(len(groups), dtype=bool)
    if not alike.any():
        return 1.0
    pairs = (series @ series.T) * alike
    signs = np.random.default_rng(0).choice((-1.0, 1.0), (FLIPS, len(groups)))
    drawn = np.einsum("nb,bc,nc->n", signs, pairs, signs, optimize=True)
    return float((1 + (drawn >= pairs.sum()).sum()) / (1 + FLIPS))


def _kinds(evidence: Information, inverse: np.ndarray) -> dict[str, Kind]:
    """All that blocks may be: manoeuvres where the model is wrong about them, places where there are replicates."""
    trials, pieces = evidence.scores.shape[:2]
    piece = np.arange(pieces)
    drive = np.repeat(np.arange(trials)[:, None], pieces, 1)
    labels = {"drives": drive, "pieces": drive * pieces + piece}
    if evidence.alike < CHANCE:
        labels["manoeuvres"] = np.repeat(evidence.groups[:, None], pieces, 1)
    if evidence.groups.max() + 1 < trials:
        labels["places"] = evidence.groups[:, None] * pieces + piece
    found = {}
    for name, label in labels.items():
        blocks = np.zeros((label.max() + 1, *inverse.shape))
        np.add.at(blocks, label, evidence.blocks)
        found[name] = Kind(sandwich(blocks, inverse), label)
    return found


def _widest(
    kinds: Mapping[str, Kind], scores: np.ndarray, independent: np.ndarray, confidence: float
) -> tuple[np.ndarray, np.ndarray]:
    """Standard errors (N, P) and quantiles (N, P) of scores (N, B, K, P): between drives where they know it, else
    within; none is less than by any other kind, or than `independent` (P,) of independent samples."""
    from scipy import stats

    deviation = {name: np.sqrt(kind.sandwich.variances(kind.sums(scores))) for name, kind in kinds.items()}
    quantile = {name: stats.t.ppf((1 + confidence) / 2, np.maximum(kind.sandwich.freedom, 1.0))
                for name, kind in kinds.items()}
    widest = np.maximum(deviation["pieces"], independent), np.tile(quantile["pieces"], (len(scores), 1))
    for name in ("drives", "manoeuvres", "places"):
        if name in kinds:
            informed = kinds[name].counts & (deviation[name] * quantile[name] > widest[0] * widest[1])
            if name == "manoeuvres":  # a few at most
                informed = (kinds[name].sandwich.informed > 0.5) & (deviation[name] > widest[0])
            widest = np.where(informed, deviation[name], widest[0]), np.where(informed, quantile[name], widest[1])
    return widest


def _flipped(
    evidence: Information, kind: Kind, inverse: np.ndarray, random: np.random.Generator
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """How far estimates are off (N, P), and scores (N, B, K, P) there, with random signs of blocks, `FLIPS` at a time.
    """
    moves = kind.sandwich.moves[kind.label]  # (B, K, P, P)
    errors = np.einsum("pr,bkrq,bkq->bkp", np.linalg.inv(inverse), moves, evidence.scores, optimize=True)
    count = max(AT_ONCE // errors.size, 1)
    for first in range(0, FLIPS, count):
        signs = random.choice((-1.0, 1.0), (min(count, FLIPS - first), kind.label.max() + 1))
        drawn = signs[:, kind.label, None] * errors
        moved = drawn.sum((1, 2)) @ inverse
        drawn -= np.einsum("bkpq,nq->nbkp", evidence.blocks, moved, optimize=True)
        yield moved, drawn
