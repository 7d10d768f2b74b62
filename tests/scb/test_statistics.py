import json

import numpy as np
import pytest
import scipy.stats

from scb.errors import UserError
from scb.statistics import (
    Estimate,
    estimate,
    few_groups_difference,
    halves_agree,
    iqm,
    median,
    normalized_score,
    paired_difference,
    pooled_estimate,
    rank_correlations,
    spearman,
    stratified_estimate,
    worst_decile,
)


def test_iqm_drops_the_lowest_and_the_highest_quarter():
    # Eight numbers: two go at either end. (3 + 4 + 5 + 6) / 4 = 4.5, whatever the outliers are.
    assert iqm([1, 2, 3, 4, 5, 6, 7, 8]) == 4.5
    assert iqm([-1e9, 2, 3, 4, 5, 6, 7, 1e9]) == 4.5


def test_iqm_of_fewer_than_four_numbers_is_their_mean():
    # floor(3 / 4) = 0: nothing is dropped. (0 + 0 + 6) / 3 = 2.
    assert iqm([0, 0, 6]) == 2.0


def test_iqm_reduces_the_axis_it_is_told():
    x = np.array([[1.0, 2.0, 3.0, 100.0], [0.0, 10.0, 20.0, 30.0]])
    # Rows: (2 + 3) / 2 and (10 + 20) / 2. Columns of two: plain means.
    np.testing.assert_allclose(iqm(x, axis=1), [2.5, 15.0])
    np.testing.assert_allclose(iqm(x, axis=0), [0.5, 6.0, 11.5, 65.0])


def test_constant_runs_have_an_interval_of_width_zero():
    assert estimate([7.0] * 10) == Estimate(7.0, 7.0, 7.0, 10)


def test_a_single_run_has_a_value_but_no_interval():
    assert estimate([7.0]) == Estimate(7.0, None, None, 1)


def test_interval_of_two_runs_is_their_range():
    # Resamples of {0, 1} have means 0, 1/2, 1 with probability 1/4, 1/2, 1/4: the outer 2.5 % on
    # either side lie inside the quarters at 0 and at 1.
    assert estimate([0.0, 1.0]) == Estimate(0.5, 0.0, 1.0, 2)


def test_interval_of_a_mean_agrees_with_the_normal_approximation():
    # The mean of 400 numbers with standard deviation s: +- 1.96 s / sqrt(400).
    x = np.random.default_rng(0).normal(3.0, 2.0, 400)
    half_width = 1.96 * x.std() / 20
    found = estimate(x, statistic=np.mean)
    np.testing.assert_allclose(
        (found.low, found.high), (x.mean() - half_width, x.mean() + half_width), atol=0.02
    )


def test_higher_confidence_gives_a_wider_interval():
    x = np.arange(20.0)
    narrow, wide = estimate(x, confidence=0.5), estimate(x, confidence=0.99)
    assert wide.low < narrow.low < iqm(x) < narrow.high < wide.high


def test_intervals_are_those_of_scipy():
    x, y = np.random.default_rng(1).normal(size=(2, 12))
    settings = {"method": "percentile", "n_resamples": 10_000, "paired": True}

    def difference(x, y, axis):
        return iqm(x, axis=axis) - iqm(y, axis=axis)

    for found, samples, statistic in (
        (estimate(x), (x,), iqm),
        (paired_difference(x, y), (x, y), difference),
    ):
        rng = np.random.default_rng(0)
        low, high = scipy.stats.bootstrap(
            samples, statistic, rng=rng, **settings
        ).confidence_interval
        np.testing.assert_allclose((found.low, found.high), (low, high), rtol=1e-12)


def test_the_interval_does_not_depend_on_how_resamples_are_batched(monkeypatch):
    x = np.random.default_rng(1).normal(size=10)
    whole = estimate(x)
    monkeypatch.setattr("scb.statistics._NUMBERS_PER_BATCH", 70)
    assert estimate(x) == whole


def test_a_medians_interval_lies_between_two_runs():
    # Of ten runs the second and the ninth: below either is a median with probability 11 / 1024.
    assert median(np.arange(10.0)) == Estimate(4.5, 1.0, 8.0, 10)
    # With three the whole range holds the median in three of four cases only.
    assert median([1.0, 2.0, 3.0]) == Estimate(2.0, None, None, 3)


def test_ties_make_no_medians_interval_too_narrow():
    generator = np.random.default_rng(0)
    # Half and a little more of all runs are 0; a bootstrap of the median is here often a single number.
    runs = generator.choice([0.0, 1.0, 2.0], p=[0.52, 0.4, 0.08], size=(1000, 25))
    found = [median(x) for x in runs]
    assert np.mean([x.low <= 0.0 <= x.high for x in found]) > 0.95


def test_paired_difference_is_the_difference_of_the_two_iqms():
    a, b = np.array([0.0, 1.0, 2.0, 9.0]), np.array([3.0, 0.0, 1.0, 0.0])
    # IQM(a) = (1 + 2) / 2 = 1.5, IQM(b) = (0 + 1) / 2 = 0.5. The IQM of a - b = [-3, 1, 1, 9]
    # is (1 + 1) / 2 = 1 here too; with b reversed, [0, 0, 2, 6] has 1 and the IQMs stay.
    difference = paired_difference(a, b)
    assert difference.value == 1.0
    assert difference.n == 4
    b = np.array([9.0, 2.0, 0.0, 1.0])
    # IQM(b) = (1 + 2) / 2 = 1.5: no difference, though the IQM of [-9, -1, 2, 8] is 0.5.
    assert paired_difference(a, b).value == 0.0


def test_what_a_seed_does_to_both_methods_cancels_in_a_paired_difference():
    # One method is better by 1 on every seed: whichever seeds are drawn, the difference is 1 up to
    # rounding, however far the seeds are apart.
    a = np.array([-100.0, 0.0, 50.0, 1000.0, 3.0])
    difference = paired_difference(a + 1.0, a)
    np.testing.assert_allclose([difference.value, difference.low, difference.high], 1.0, rtol=1e-12)


def test_paired_difference_wants_the_same_number_of_runs():
    with pytest.raises(UserError, match="have other sizes: pair run by run"):
        paired_difference([1.0, 2.0, 3.0], [1.0, 2.0])
    with pytest.raises(UserError, match=r"a has shape \(2, 3\): give a vector"):
        paired_difference(np.zeros((2, 3)), np.zeros((2, 3)))


def test_normalized_score_is_zero_for_random_and_one_for_the_expert():
    # Pendulum: random -1200, expert -200. (-450 + 1200) / (-200 + 1200) = 0.75.
    scores = normalized_score(np.array([-1200.0, -200.0, -450.0]), random=-1200.0, expert=-200.0)
    np.testing.assert_allclose(scores, [0.0, 1.0, 0.75])


def test_normalized_score_takes_one_random_and_expert_return_per_environment():
    # [seeds, environments]: (5 - 0) / (10 - 0) and (-50 + 100) / (0 + 100).
    scores = normalized_score([[5.0, -50.0]], random=[0.0, -100.0], expert=[10.0, 0.0])
    np.testing.assert_allclose(scores, [[0.5, 0.5]])


def test_normalized_score_refuses_an_expert_that_is_no_better_than_random():
    with pytest.raises(UserError, match="nothing to normalise by"):
        normalized_score([1.0], random=2.0, expert=2.0)


def test_spearman_sees_order_only():
    assert spearman([1.0, 2.0, 3.0], [1.0, 10.0, 1000.0]) == pytest.approx(1.0)
    assert spearman([1.0, 2.0, 3.0], [5.0, 4.0, -3.0]) == pytest.approx(-1.0)
    # Ranks (1, 2, 3, 4) and (2, 1, 4, 3): 1 - 6 * (1 + 1 + 1 + 1) / (4 * 15) = 0.6.
    assert spearman([1.0, 2.0, 3.0, 4.0], [2.0, 1.0, 4.0, 3.0]) == pytest.approx(0.6)


def test_correlations_of_many_rows_are_those_of_each():
    generator = np.random.default_rng(0)
    a = generator.integers(0, 4, (50, 7)).astype(float)  # with ties
    b = generator.normal(size=(50, 7))
    a[3] = 1.0  # undefined
    each = [
        scipy.stats.spearmanr(*pair).statistic if np.ptp(pair[0]) else 0.0
        for pair in zip(a, b, strict=True)
    ]
    np.testing.assert_allclose(rank_correlations(a, b), each, atol=1e-12)


def test_spearman_of_a_constant_is_undefined():
    assert spearman([1.0, 1.0, 1.0], [1.0, 2.0, 3.0]) is None
    assert spearman([1.0], [2.0]) is None


@pytest.mark.parametrize(
    "call",
    [
        iqm,
        estimate,
        lambda x: paired_difference([0.0, 0.0, 0.0], x),
        lambda x: normalized_score(x, 0.0, 1.0),
        lambda x: spearman(x, [1.0, 2.0, 3.0]),
    ],
)
def test_nan_is_refused_with_its_count(call):
    with pytest.raises(UserError, match="2 NaN and 0 infinite among 3 numbers"):
        call([np.nan, 1.0, np.nan])
    with pytest.raises(UserError, match="0 NaN and 1 infinite among 3 numbers"):
        call([np.inf, 1.0, 2.0])


def test_runs_must_be_a_vector_and_confidence_a_probability():
    with pytest.raises(UserError, match=r"x has shape \(2, 3\): give a vector"):
        estimate(np.zeros((2, 3)))
    with pytest.raises(UserError, match="x is empty"):
        estimate([])
    with pytest.raises(UserError, match="confidence is 95"):
        estimate([1.0, 2.0], confidence=95)


@pytest.mark.parametrize(
    ("numbers", "text"),
    [
        ((-205.41, -230.12, -190.2, 20), "-205.4 [-230.1, -190.2] (n=20)"),
        ((0.95, 0.9312, 0.97, 8), "0.9500 [0.9312, 0.9700] (n=8)"),
        ((12345.6, 9999.9, 20000.0, 5), "12346 [10000, 20000] (n=5)"),
        ((0.0, 0.0, 0.0, 3), "0.0 [0.0, 0.0] (n=3)"),
        ((1000.0, -0.2, 2000.0, 9), "1000.0 [-0.2, 2000.0] (n=9)"),  # not -0
        ((1000.0, 1e-12, 2000.0, 9), "1000 [0, 2000] (n=9)"),
        ((-205.41, None, None, 1), "-205.4 [no interval] (n=1)"),
    ],
)
def test_an_estimate_prints_four_digits(numbers, text):
    assert str(Estimate(*numbers)) == text


def test_an_estimate_goes_into_json():
    # allow_nan=False: the unknown interval of a single run must not be NaN.
    assert json.loads(json.dumps(estimate([2.0]).as_dict(), allow_nan=False)) == {
        "value": 2.0,
        "low": None,
        "high": None,
        "n": 1,
    }


# -- groups
# ----------------------------------------------------------------------------------------


def test_groups_count_alike_however_many_runs_they_have():
    few, many = np.full(4, 1.0), np.full(40, 3.0)
    found = stratified_estimate([few, many])
    assert (found.value, found.low, found.high, found.n) == (2.0, 2.0, 2.0, 44)


def test_the_stratified_interval_covers_as_often_as_it_says():
    generator = np.random.default_rng(0)
    hits = 0
    for _ in range(200):
        groups = [generator.normal(mean, 1.0, 20) for mean in (0.0, 10.0)]
        found = stratified_estimate(groups, num_resamples=400)
        hits += found.low <= 5.0 <= found.high
    assert 170 <= hits <= 199


def test_paired_differences_of_groups_cancel_what_is_common():
    generator = np.random.default_rng(1)
    common = [generator.normal(0.0, 100.0, 12) for _ in range(3)]
    found = stratified_estimate([x + 1.0 for x in common], common)
    np.testing.assert_allclose([found.value, found.low, found.high], 1.0, atol=1e-9)
    assert stratified_estimate(common).high - stratified_estimate(common).low > 30.0


def test_draws_that_groups_share_are_drawn_together():
    generator = np.random.default_rng(2)
    draws = generator.normal(0.0, 10.0, 12)
    own = [draws + generator.normal(size=12) for _ in range(4)]
    # What all groups have in common does not average out over them.
    apart, together = (stratified_estimate(own, shared=x) for x in (False, True))
    assert apart.value == together.value
    assert together.high - together.low > 1.7 * (apart.high - apart.low)
    # Twelve draws of four agents each are no 48.
    columns = stratified_estimate([np.transpose(own)])
    assert columns.n == 48 and columns.value == pytest.approx(iqm(np.ravel(own)))
    width = columns.high - columns.low
    assert width > 1.7 * (estimate(np.ravel(own)).high - estimate(np.ravel(own)).low)
    # Of two sides each has its own draws where they are not paired.
    found = stratified_estimate(own, [x[:7] for x in own], paired=False, shared=True)
    assert found.low < found.value < found.high


@pytest.mark.parametrize(
    ("groups", "minus", "message"),
    [
        ([], None, "there is no group"),
        ([[1.0, 2.0]], [[1.0]], "the groups to subtract have other sizes"),
        ([[1.0, np.nan]], None, "a group holds 1 NaN"),
    ],
)
def test_groups_that_cannot_be_compared_are_refused(groups, minus, message):
    with pytest.raises(UserError, match=message):
        stratified_estimate(groups, minus)


def test_pooled_is_the_interquartile_mean_over_groups_and_runs():
    x = pooled_estimate([[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0]])
    # Of eight values the two lowest and the two highest are left out.
    assert (x.value, x.n) == (4.5, 8)
    assert 1.0 <= x.low < 4.5 < x.high <= 8.0


def test_groups_that_differ_widen_the_interval_beyond_that_of_their_runs():
    rng = np.random.default_rng(0)
    agents = rng.normal(size=(4, 20))
    alike = pooled_estimate(agents.tolist())
    apart = pooled_estimate((agents + np.array([[-30.0], [-10.0], [10.0], [30.0]])).tolist())
    assert apart.high - apart.low > 5 * (alike.high - alike.low)


def test_a_pooled_estimate_refuses_what_it_cannot_pool():
    with pytest.raises(UserError, match=r"shape \(3,\): give a row for each"):
        pooled_estimate([1.0, 2.0, 3.0])
    with pytest.raises(UserError, match="1 NaN"):
        pooled_estimate([[1.0, np.nan]])


def test_a_single_run_of_a_group_has_no_interval():
    assert stratified_estimate([[1.0], [3.0, 3.0]]) == Estimate(2.0, None, None, 3)
    assert pooled_estimate([[1.0], [2.0]]) == Estimate(1.5, None, None, 2)


# -- few groups
# ------------------------------------------------------------


def with_failures(generator, groups, scatter, failing):
    """[groups, 20] runs of deviation 1, of which a fifth fails, in groups that scatter by this, or fail as a whole."""
    runs = generator.normal(0.0, 1.0, (groups, 20))
    runs = np.where(generator.random(runs.shape) < 0.2, runs - 6.0, runs)
    whole = np.where(generator.random((groups, 1)) < failing, -10.0, 0.0)
    return runs + whole + generator.normal(0.0, scatter, (groups, 1))


@pytest.mark.parametrize("confidence", [pytest.param(0.95, marks=pytest.mark.slow), 0.9983])
@pytest.mark.parametrize("failing", [0.0, 0.3])
def test_few_groups_leave_the_truth_out_no_more_often_than_they_say(confidence, failing):
    generator, outside, number = np.random.default_rng(0), 0, 200
    for _ in range(number):
        first, second = (with_failures(generator, 5, 1.0, failing) for _ in range(2))
        found = few_groups_difference(first, second, True, confidence)
        assert found.value == pytest.approx(float(np.mean(iqm(first, 1) - iqm(second, 1))))
        outside += not found.low <= 0.0 <= found.high
    # More of 200 there are by chance in one of a thousand such tests.
    assert outside <= scipy.stats.binom.ppf(0.999, number, 1 - confidence)


@pytest.mark.parametrize("paired", [True, False])
def test_few_runs_leave_the_truth_out_no_more_often_than_a_high_confidence_says(paired):
    generator, number, confidence = np.random.default_rng(0), 300, 0.99
    outside = 0
    for _ in range(number):
        ours, theirs = generator.normal(size=(2, 1, 10 if paired else 5))
        found = stratified_estimate(ours, theirs, confidence, paired=paired)
        outside += not found.low <= 0.0 <= found.high
    # Of percentiles it would be about 8 and 21.
    assert outside <= scipy.stats.binom.ppf(0.95, number, 1 - confidence)


def test_a_group_that_fails_counts_in_full():
    groups = [[0.0, 0.0]] * 4 + [[-100.0, -100.0]]
    found = few_groups_difference(groups, [[0.0, 0.0]])
    # Its variance over groups is 2000, of the mean 400; Student's t of four degrees has 2.776.
    assert (found.value, found.high) == (-20.0, pytest.approx(-20.0 + 2.776 * 20.0, rel=1e-3))


def test_runs_that_all_groups_share_are_drawn_too():
    # Without the first run the mean is 10, without the second 0: the jackknife's variance is 1 / 2 of (10 - 5)^2 +
    # (0 - 5)^2, and Student's t of one degree has 12.706.
    found = few_groups_difference([[0.0, 10.0]] * 3, [[0.0, 0.0]])
    assert (found.value, found.high) == (5.0, pytest.approx(5.0 + 12.706 * 5.0, rel=1e-4))


@pytest.mark.parametrize("confidence", [95.0, 1.5, 0.0])
def test_the_confidence_of_few_groups_is_a_probability(confidence):
    with pytest.raises(UserError, match=f"confidence is {confidence}: give a number between"):
        few_groups_difference([[1.0, 2.0]] * 5, [[1.0, 2.0]], confidence=confidence)


def test_the_worst_decile_is_what_nine_of_ten_are_better_than():
    assert worst_decile(range(11)) == 1.0


def test_a_difference_of_groups_is_drawn_together_only_where_it_is_paired():
    runs = [[1.0, 2.0, 3.0, 9.0]]
    together = stratified_estimate(runs, runs)
    assert (together.low, together.high) == (0.0, 0.0)
    apart = stratified_estimate(runs, runs, paired=False)
    assert apart.low < 0.0 < apart.high


def test_few_groups_that_differ_in_nothing_have_no_width():
    found = few_groups_difference([[1.0, 1.0]] * 5, [[0.0, 0.0]])
    assert (found.value, found.low, found.high) == (1.0, 1.0, 1.0)


@pytest.mark.parametrize(
    ("groups", "minus", "paired", "message"),
    [
        ([[1.0, 2.0]], [[1.0, 3.0]], False, "there is one group, or one run"),
        ([[1.0]] * 5, [[1.0]], False, "there is one group, or one run"),
        ([[1.0, 2.0]] * 5, [[1.0, 2.0, 3.0]], False, "can't be compared: pair run by run."),
        ([[1.0, 2.0]] * 5, [[1.0, 2.0]] * 4, True, "pair run by run and group by group."),
    ],
)
def test_few_groups_that_cannot_be_compared_are_refused(groups, minus, paired, message):
    with pytest.raises(UserError, match=message):
        few_groups_difference(groups, minus, paired)


def test_halves_of_runs_agree_as_far_as_groups_are_apart():
    generator = np.random.default_rng(1)
    groups, noise = np.arange(40.0)[:, None], generator.normal(size=(40, 6))
    assert halves_agree(groups + 0.001 * noise) == pytest.approx(1.0)
    assert abs(halves_agree(noise)) < 0.3
    # Two runs of each have one split: the correlation of the one with the other.
    pair = groups + 20 * noise[:, :2]
    assert halves_agree(pair) == pytest.approx(spearman(pair[:, 0], pair[:, 1]))
    # Of three runs a half is one, and a third stays out each time: the mean of the three pairs.
    three = groups + 20 * noise[:, :3]
    pairs = [spearman(three[:, i], three[:, j]) for i, j in ((0, 1), (0, 2), (1, 2))]
    assert halves_agree(three) == pytest.approx(np.mean(pairs), abs=0.02)


@pytest.mark.parametrize("runs", [[[1.0, 2.0]], [[1.0], [2.0]], [1.0, 2.0]])
def test_one_group_or_one_run_of_each_has_no_halves(runs):
    with pytest.raises(UserError, match="2 groups or more, of 2 runs or more each"):
        halves_agree(runs)
