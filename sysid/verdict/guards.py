"""What a named effect must stand: manoeuvres that were held back, agreement of those that excite it, its falsifiers."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from sysid.logs.records import Trial
from sysid.missing.refit import Refitter
from sysid.verdict.agreement import foretold, heterogeneity, interval_of_sum, sizes_apart
from sysid.verdict.falsification import put_to_test
from sysid.verdict.found import Search
from sysid.verdict.posterior import Thresholds, contradicted
from sysid.verdict.result import Support


def stand(
    found: Search, refitter: Refitter, trials: Sequence[Trial], groups: Sequence[Sequence[int]], track: float,
    p_excess: Callable[[float], float],
) -> list[Support]:
    """The evidence for each effect of the final fit, in its order."""
    fit, out = found.final, []
    tested = put_to_test(fit, refitter, trials, groups, track, p_excess)
    for number, (one, part) in enumerate(zip(fit.hypotheses, fit.parts, strict=True)):
        sizes, errors = sizes_apart(fit, part, groups, refitter.precision)
        gains = foretold(fit, part, groups, refitter.precision)
        out.append(Support(one.effect, sizes, errors, heterogeneity(sizes, errors), gains, interval_of_sum(gains),
                         tuple(tested[number])))
    return out


def guarded(found: Search, stood: Sequence[Support], thresholds: Thresholds) -> Search:
    """The search without a name where one of its effects is contradicted."""
    named = {one.hypothesis.effect for one in found.accepted}
    against = [each for one in stood if one.effect in named for each in one.against(thresholds)]
    if found.findings is not None:
        return found.judged(found.findings.put_to_test([one.hypothesis.effect for one in found.accepted], against),
                            thresholds)
    if against:
        found.verdict, found.reason = "unexplained", contradicted(named, found.share, against)
    return found
