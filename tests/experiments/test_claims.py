from functools import partial

import numpy as np
import pytest

from experiments import claims
from experiments.claims import Claim, judge
from scb.statistics import Estimate, estimate

REASON = "a margin needs one"


def outcome(low, high, **fields):
    (found,) = judge([Claim("a claim", Estimate(0.0, low, high, 9), **fields)])
    return found.outcome


def test_superiority_takes_the_whole_interval():
    assert outcome(0.1, 2.0) == "holds"
    assert outcome(-0.1, 2.0) == "undecided"
    assert outcome(-2.0, -0.1) == "does not hold"
    assert outcome(0.1, 2.0, above=1.0) == "undecided"


def test_sameness_takes_a_margin_and_its_reason():
    same = {"margin": 0.5, "reason": REASON}
    # That no difference was found decides nothing: a wide interval is no sign of sameness.
    assert outcome(-9.0, 9.0, **same) == "undecided"
    assert outcome(-0.4, 0.1, **same) == "holds"
    assert outcome(-0.9, -0.6, **same) == "does not hold"
    with pytest.raises(ValueError, match="has a reason"):
        Claim("as good as", None, margin=0.5)


def test_one_run_has_no_interval_and_decides_nothing():
    assert outcome(None, None) == "undecided"
    (found,) = judge([Claim("better", partial(estimate, [100.0]))])
    assert found.outcome == "undecided" and found.estimate.value == 100.0


def test_intervals_are_corrected_for_their_number():
    values = np.random.default_rng(0).normal(size=40)
    evidence = partial(estimate, values)
    (alone,) = judge([Claim("one", evidence)])
    assert alone.estimate == estimate(values)
    # What is counted, stored or not there is no comparison.
    others = [
        Claim("counted", True),
        Claim("none", None),
        Claim("stored", Estimate(1.0, 0.5, 2.0, 3)),
    ]
    assert claims.confidence([Claim("one", evidence), *others]) == pytest.approx(0.95)
    many = [Claim(str(i), evidence) for i in range(10)]
    assert claims.confidence(many) == pytest.approx(0.995)
    corrected = judge(many)[0].estimate
    assert corrected == estimate(values, confidence=claims.confidence(many))
    assert corrected.low < alone.estimate.low and corrected.high > alone.estimate.high
    # One of twenty that just excludes zero alone does not together with the others.
    shifted = partial(estimate, values - alone.estimate.low + 1e-6)
    assert judge([Claim("one", shifted)])[0].outcome == "holds"
    assert {x.outcome for x in judge([Claim(str(i), shifted) for i in range(20)])} == {"undecided"}


@pytest.mark.parametrize(
    ("parts", "whole"),
    [
        ([True, True], "holds"),
        ([True, False], "holds in part"),
        ([True, None], "holds in part"),
        ([False, None], "does not hold"),
        ([None, Estimate(1.0, None, None, 1)], "undecided"),
        ([None, None], "not tested at this size"),
    ],
)
def test_a_claim_is_the_sum_of_its_parts(parts, whole):
    assert claims.outcome(judge([Claim("a part", x) for x in parts])) == whole
