"""What becomes of a claim, judged in one place: superior to something, or not inferior by more than a margin.

An interval decides, never the failure to find a difference: a claim holds where the whole interval lies above
what is asked, does not hold where it lies below, and is undecided in between. That something is as good as
another is a claim too, and needs a margin and its reason. Where there is no interval, as with one seed
or one search, nothing is decided.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from scb.environments.registry import environment_spec
from scb.statistics import DECIDING, Estimate, few_groups_difference, iqm

HOLDS, IN_PART, FAILS, UNDECIDED, UNTESTED = OUTCOMES = (
    "holds",
    "holds in part",
    "does not hold",
    "undecided",
    "not tested at this size",
)
# Searches; of fewer nothing is decided, whose scatter two or three cannot tell.
ENOUGH = 5
CONFIDENCE = 0.95  # of all intervals of a page together


@dataclass(frozen=True)
class Claim:
    """A part of what the paper says, and what it is judged by.

    Attributes:
      text: what is claimed.
      evidence: (confidence=...) -> estimate, whose interval is then corrected for the number of comparisons; an
        estimate as a report stores it, which can't be; whether it is so, where that is counted and not
        estimated; None where the report can't tell.
      above: what the estimate must be superior to.
      margin: by how much it may be inferior.
      reason: why that margin is none that matters.
      places: of the estimate where it is written.
      of: what it is about, for whoever looks it up.
    """

    text: str
    evidence: Callable[..., Estimate] | Estimate | bool | None
    above: float = 0.0
    margin: float = 0.0
    reason: str = ""
    places: int = 2
    of: Any = None

    def __post_init__(self) -> None:
        if self.margin < 0 or bool(self.margin) != bool(self.reason):
            raise ValueError(f"a margin is positive and has a reason: {self}.")

    @property
    def least(self) -> float:
        """What the interval must lie above."""
        return self.above - self.margin


@dataclass(frozen=True)
class Judged:
    """A claim, what was measured for it, and what becomes of it: one of `OUTCOMES`."""

    claim: Claim
    estimate: Estimate | None
    outcome: str

    @property
    def stored(self) -> bool:
        """Whether its interval is a report's, which can't be corrected."""
        return isinstance(self.claim.evidence, Estimate) and self.claim.evidence.low is not None


def of_agents(evidence: Callable[..., Estimate], number: int) -> Callable[..., Estimate] | Estimate:
    """What so many agents say: without an interval where they are too few."""
    return evidence if number >= DECIDING else evidence().without_interval()


def of_searches(
    ours: ArrayLike, theirs: ArrayLike, paired: bool = False
) -> Callable[..., Estimate] | Estimate:
    """How far agents of several searches earn more than others': without an interval where searches are too few.

    Args:
      ours, theirs: [searches, agents]. A single one is nobody's search where the other side has several,
        as of PPO's clip; with several on both sides each has to have enough.
      paired: whether searches of the same position share a seed.
    """
    several = [n for n in map(len, map(np.asarray, (ours, theirs))) if n > 1]
    if several and min(several) >= ENOUGH:
        return partial(few_groups_difference, ours, theirs, paired_groups=paired)
    one, other = (float(np.mean(iqm(x, axis=1))) for x in (ours, theirs))
    return Estimate(one - other, None, None, np.size(ours))


def corrected(number: int) -> float:
    """The confidence of each of so many intervals: Bonferroni's, so that all hold together with 95 %."""
    return 1.0 - (1.0 - CONFIDENCE) / max(1, number)


def judge(claims: Sequence[Claim]) -> list[Judged]:
    """Every claim's outcome; intervals that can be are `corrected` for their number."""
    return [_judge(claim, confidence(claims)) for claim in claims]


def confidence(claims: Sequence[Claim]) -> float:
    """Of the interval of each claim."""
    return corrected(sum(callable(c.evidence) for c in claims))


def _judge(claim: Claim, confidence: float) -> Judged:
    found = claim.evidence
    if found is None:
        return Judged(claim, None, UNTESTED)
    if isinstance(found, bool):
        return Judged(claim, None, HOLDS if found else FAILS)
    if callable(found):
        found = found(confidence=confidence)
    return Judged(claim, found, {1: HOLDS, -1: FAILS, 0: UNDECIDED}[found.side(claim.least)])


def outcome(judged: Sequence[Judged]) -> str:
    """What becomes of all of them together."""
    number = Counter(x.outcome for x in judged)
    if number[HOLDS]:
        return HOLDS if number[HOLDS] == len(judged) else IN_PART
    return next((x for x in (FAILS, UNDECIDED) if number[x]), UNTESTED)


# A margin of normalised scores.
TENTH = 0.1


def of_the_way(environment: str, share: float = TENTH) -> float:
    """The same as a return: this share of the way from random actions to the expert."""
    spec = environment_spec(environment)
    return round(share * (spec.reference_return() - spec.random_return()), 1)


OF_THE_WAY = "a tenth of the way from random actions to the expert: half of what algorithms differ by in the paper"
