"""Interquartile means, bootstrap intervals and normalised scores (Agarwal et al., 2021).

The interquartile mean (IQM) drops the lowest and the highest quarter of the runs and averages the
rest: it is as robust as the median against a lucky or a failed seed, and wastes less data.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, partial

import numpy as np
import scipy.stats
from numpy.typing import ArrayLike, NDArray

from scb.errors import UserError

# A group's resamples are drawn in batches of about this many indices (80 MB); of a group of groups each takes so many.
_NUMBERS_PER_BATCH = 10_000_000
PERCENTILES = 0.95  # confidence beyond which they are not the resamples'
DECIDING = 10  # agents; of fewer a bootstrap's interval is too narrow to decide anything

Statistic = Callable[..., NDArray[np.floating]]
Draw = Callable[[int], NDArray[np.integer]]


@dataclass(frozen=True)
class Estimate:
    """A statistic of n runs and its confidence interval (None for a single run), in the unit of the runs."""

    value: float
    low: float | None
    high: float | None
    n: int

    def __str__(self) -> str:
        known = [end for end in (self.value, self.low, self.high) if end is not None]
        # Four digits for the largest number, and the same places for all: the eye compares columns.
        largest = max(abs(end) for end in known)
        places = places_apart(places_of(largest, 4), self.low, self.high)
        if self.low is None or self.high is None:
            return f"{self.value:.{places}f} [no interval] (n={self.n})"
        return (
            f"{self.value:.{places}f} [{self.low:.{places}f}, {self.high:.{places}f}] (n={self.n})"
        )

    def side(self, of: float = 0.0) -> int:
        """1 where the whole interval lies above a number, -1 where it lies below, and 0 where nothing is decided."""
        if self.low is None or self.high is None:
            return 0
        return int(self.low > of) - int(self.high < of)

    def without_interval(self) -> "Estimate":
        """The value alone, of what is too few to tell its spread."""
        return replace(self, low=None, high=None)

    def as_dict(self) -> dict[str, float | int | None]:
        """{"value", "low", "high", "n"}, ready for JSON: an unknown end is None, never NaN."""
        return asdict(self)


def places_of(size: float, digits: int) -> int:
    """Decimal places with which a size has so many digits, none of a whole number's cut."""
    return max(0, digits - 1 - math.floor(math.log10(size))) if size > 0 else 1


def typeset(text: str) -> str:
    """Numbers with the typographic minus, which no line break separates from its number."""
    return text.replace("-", "\N{MINUS SIGN}")


def places_apart(places: int, *ends: float | None, most: int = 6) -> int:
    """Decimal places with which no end of an interval looks like 0 that is not, for its sign decides.

    Where even `most` do not show it, as many as were asked for.
    """
    given = [end for end in ends if end]
    enough = (x for x in range(places, most + 1) if all(round(end, x) for end in given))
    return next(enough, places)


def iqm(x: ArrayLike, axis: int | None = None) -> NDArray[np.floating]:
    """Interquartile mean: the mean after dropping the lowest and the highest quarter.

    Args:
      x: finite numbers; of k along `axis`, floor(k / 4) are dropped at either end.
      axis: None averages over everything.

    Returns:
      x's shape without `axis`.

    Raises:
      UserError: NaN or infinity in x, or nothing to average.
    """
    values = _finite("x", x)
    return np.asarray(scipy.stats.trim_mean(values, 0.25, axis=axis))


def estimate(x: ArrayLike, statistic: Statistic = iqm, confidence: float = 0.95) -> Estimate:
    """The statistic of [N] runs, one number each, with its interval.

    Raises:
      UserError: x is not a vector, is empty, or holds NaN or infinity.
    """
    values = _runs("x", x)
    return _bootstrapped(
        lambda rows: statistic(values[rows(values.size)], axis=1), [values.size], confidence
    )


def median(x: ArrayLike, confidence: float = 0.95) -> Estimate:
    """The median of [N] runs, with an interval between two of them that no ties make too narrow.

    By order statistics, whose confidence is at least what is asked for whatever the runs are distributed like
    (`scipy.stats.quantile_test`); no interval where there are too few runs for one.

    Raises:
      UserError: x is not a vector, is empty, or holds NaN or infinity.
    """
    _check_confidence(confidence)
    values = _runs("x", x)
    ends = scipy.stats.quantile_test(values, p=0.5).confidence_interval(confidence)
    found = Estimate(float(np.median(values)), float(ends.low), float(ends.high), values.size)
    return found if np.isfinite(ends).all() else found.without_interval()


def paired_difference(a: ArrayLike, b: ArrayLike, confidence: float = 0.95) -> Estimate:
    """IQM(a) - IQM(b) of two methods that ran on the same seeds.

    This is the difference of the two numbers that a table shows, not the IQM of a - b, which in
    general is another number. The bootstrap draws seeds, each with its run of either method, so
    that what a seed does to both (an easy start, a hard bandit) cancels and the interval is as
    narrow as pairing allows.

    Args:
      a: [N] one number per seed.
      b: [N] the same seeds in the same order.

    Raises:
      UserError: different numbers of runs, no runs, NaN or infinity.
    """
    return stratified_estimate([_runs("a", a)], [_runs("b", b)], confidence, num_resamples=10_000)


def stratified_estimate(
    groups: Sequence[ArrayLike],
    minus: Sequence[ArrayLike] | None = None,
    confidence: float = 0.95,
    num_resamples: int = 2000,
    statistic: Statistic = iqm,
    paired: bool = True,
    shared: bool = False,
    student: bool = False,
) -> Estimate:
    """The mean over groups of their interquartile means, with an interval that resamples within every group.

    Every group (the runs of an environment) counts alike, however many runs it has. There is no
    interval where a group has a single run, which cannot tell.

    Args:
      groups: [N_g] one number per run, for each group; or [N_g, K_g], K_g runs of each of N_g draws, such as of
        hyperparameters for several algorithms, where draws are resampled and not runs.
      minus: as many groups; the estimate is then that of the difference.
      statistic: of a group, in place of its interquartile mean.
      paired: whether `minus` has the same runs on the same seeds, which are then drawn together.
      shared: whether groups of as many draws have the same ones, as where every environment is given the same
        hyperparameters: they are then drawn together.
      student: whether the interval is Student's t at every confidence, for few runs that are to decide something.

    Raises:
      UserError: no groups, or other sizes in `minus`.
    """
    first = [_draws("a group", group) for group in groups]
    second = [_draws("a group", group) for group in (() if minus is None else minus)]
    if not first:
        raise UserError("there is no group: give at least one.")
    if minus is not None and (
        len(first) != len(second) or (paired and list(map(len, first)) != list(map(len, second)))
    ):
        raise UserError("the groups to subtract have other sizes: pair run by run.")

    def mean(rows: Draw) -> NDArray[np.floating]:
        ours = cache(rows) if shared else rows
        theirs = cache(rows) if shared else rows
        found = np.zeros(())
        for i, group in enumerate(first):
            drawn = ours(len(group))
            found = found + statistic(group[drawn].reshape(len(drawn), -1), axis=1)
            if second:
                other = drawn if paired else theirs(len(second[i]))
                found = found - statistic(second[i][other].reshape(len(other), -1), axis=1)
        return found / len(first)

    sizes = [len(group) for group in (*first, *second)]
    found = _bootstrapped(mean, sizes, confidence, num_resamples, student)
    return replace(found, n=sum(group.size for group in first))


def pooled_estimate(groups: ArrayLike) -> Estimate:
    """The interquartile mean over groups and their runs, with an interval that resamples both.

    For groups that are drawn themselves: what one search would find, or one expert teach, is as
    uncertain as what one agent would earn. Runs of the same position in all groups share a seed and are
    drawn together. Of a single group the interval is that of its runs; with a single run there is none.

    Args:
      groups: [G, N] N runs of each of G groups (searches, experts).

    Raises:
      UserError: another shape; NaN or infinity.
    """
    runs = _groups("the groups", groups)

    def pooled(rows: Draw) -> NDArray[np.floating]:
        run, group = rows(runs.shape[1]), rows(len(runs))
        return iqm(runs[group[:, :, None], run[:, None, :]].reshape(len(group), -1), axis=1)

    return _bootstrapped(pooled, [runs.shape[1]] * len(runs), 0.95, num_resamples=5000)


def few_agents(number: int) -> str:
    """That there are too few agents for an interval to tell anything; empty where there are enough."""
    if number >= DECIDING:
        return ""
    return f"With fewer than {DECIDING} agents no interval decides anything; here are {number}."


def few_groups_difference(
    groups: ArrayLike,
    minus: ArrayLike,
    paired_groups: bool = False,
    confidence: float = 0.95,
) -> Estimate:
    """The mean over groups of their interquartile means, less that of others, with an interval for few groups.

    Resampling five searches covers too little, the less the higher the confidence: no resample is beyond the
    worst of them. Here it is Student's t: one interval of the variance over groups, and one of the jackknife's over
    runs, for what runs of one seed share in all groups; the squares of their halves are added.

    Of five simulated groups of 20 runs (normal, or a fifth of them failing; groups that scatter by up to twice the
    runs' deviation) it leaves the truth out no more often than it says at 95, 99 and 99.83 %, and where both sides
    are drawn less often: at 95 % in about 1 %. But where whole groups
    fail against a single one that never does: that five groups show no failure says little of how many do, and no
    interval knows.

    Args:
      groups: [G, N] N runs of each of G groups. Unlike in `pooled_estimate`, a group that fails counts in full.
      minus: [G', N] runs on the same seeds. Of one of the two there may be a single group, which nobody drew.
      paired_groups: whether groups of the same position in both belong together.

    Raises:
      UserError: another shape; groups of other numbers to pair; a single group, or run; NaN or infinity.
    """
    _check_confidence(confidence)
    first, second = _comparable(groups, minus, paired_groups)
    if len(first) == len(second) == 1 or first.shape[1] < 2:
        raise UserError(
            "there is one group, or one run: give several, of which each could be others."
        )
    ours, theirs = iqm(first, axis=1), iqm(second, axis=1)
    drawn = [x for x in ([ours - theirs] if paired_groups else [ours, theirs]) if len(x) > 1]
    without = [
        float(
            np.mean(iqm(np.delete(first, i, 1), axis=1))
            - np.mean(iqm(np.delete(second, i, 1), axis=1))
        )
        for i in range(first.shape[1])
    ]
    freedoms = np.array([*(len(x) - 1 for x in drawn), len(without) - 1])
    variances = np.array(
        [*(np.var(x, ddof=1) / len(x) for x in drawn), (len(without) - 1) * np.var(without)]
    )
    value = float(ours.mean() - theirs.mean())
    half = float(
        np.sqrt(np.sum(scipy.stats.t.ppf((1 + confidence) / 2, freedoms) ** 2 * variances))
    )
    return Estimate(value, value - half, value + half, first.size)


def worst_decile(x: ArrayLike, axis: int | None = None) -> NDArray[np.floating]:
    """The tenth percentile: what nine runs of ten are better than, which an interquartile mean drops."""
    return np.asarray(np.percentile(_finite("x", x), 10, axis=axis))


def normalized_score(
    returns: ArrayLike, random: ArrayLike, expert: ArrayLike
) -> NDArray[np.floating]:
    """(R - R_random) / (R_expert - R_random): 0 is a random policy, 1 the expert.

    Args:
      returns: any shape.
      random: return of the random policy; broadcast against `returns`, as is `expert`.
      expert: return of the expert.

    Raises:
      UserError: random and expert return are equal somewhere; NaN or infinity anywhere.
    """
    value = _finite("returns", returns)
    floor, ceiling = _finite("random", random), _finite("expert", expert)
    if np.any(floor == ceiling):
        raise UserError(
            "the random and the expert return are equal, which leaves nothing to normalise by: "
            "check where they were measured."
        )
    return np.asarray((value - floor) / (ceiling - floor))


def spearman(a: ArrayLike, b: ArrayLike) -> float | None:
    """Spearman's rank correlation of two [N] vectors, ties ranked by their mean rank.

    Returns:
      Between -1 and 1; None where it is undefined (one of them is constant, or N < 2).

    Raises:
      UserError: different lengths, no numbers, NaN or infinity.
    """
    first, second = _runs("a", a), _runs("b", b)
    if first.size != second.size:
        raise UserError(
            f"a has {first.size} numbers and b has {second.size}: a rank correlation needs pairs."
        )
    if np.ptp(first) == 0 or np.ptp(second) == 0:
        return None
    return float(rank_correlations(first[None], second[None])[0])


def rank_correlations(a: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.floating]:
    """[R] Spearman's, of the rows of two [R, N] arrays; 0 where it is undefined."""
    first, second = (scipy.stats.rankdata(x, axis=1) - (x.shape[1] + 1) / 2 for x in (a, b))
    spread = np.sqrt(np.sum(first**2, axis=1) * np.sum(second**2, axis=1))
    products = np.sum(first * second, axis=1)
    return np.divide(products, spread, out=np.zeros_like(products), where=spread > 0)


def correlation_text(correlation: Mapping[str, float | None]) -> str:
    """Such as "0.93 [0.81, 0.98]"; where all earn the same there is nothing to rank."""
    value, low, high = (correlation[name] for name in ("spearman", "low", "high"))
    if value is None:
        return "none: all alike"
    if low is None or high is None:
        return f"{value:.2f}, one agent: no interval"
    places = places_apart(2, low, high)
    return f"{value:.{places}f} [{low:.{places}f}, {high:.{places}f}]"


def halves_agree(x: ArrayLike, splits: int = 1000) -> float:
    """How far the means of one half of the runs rank groups as those of the other half do.

    That bounds what anything else can rank them by: all runs together agree with as many others by about
    2 r / (1 + r) (Spearman and Brown, 1910), and with what has no scatter by the root of that.

    Args:
      x: [N, S] of N groups, S runs of each.
      splits: drawn, of which the result is the mean rank correlation.

    Raises:
      UserError: fewer than two groups, or than two runs of each.
    """
    runs = np.asarray(x, np.float64)
    if runs.ndim != 2 or min(runs.shape) < 2:
        raise UserError(
            f"halves of runs of the shape {runs.shape} rank nothing: give 2 groups or more, of 2 runs or more each."
        )
    generator = np.random.default_rng(0)
    orders = generator.permuted(np.tile(np.arange(runs.shape[1]), (splits, 1)), axis=1)
    half = runs.shape[1] // 2
    one, other = (
        runs[:, of].mean(axis=2).T for of in (orders[:, :half], orders[:, half : 2 * half])
    )
    return float(rank_correlations(one, other).mean())


def _check_confidence(confidence: float) -> None:
    if not 0 < confidence < 1:
        raise UserError(f"confidence is {confidence}: give a number between 0 and 1, such as 0.95.")


def _bootstrapped(
    statistic: Callable[[Draw], NDArray[np.floating]],
    sizes: Sequence[int],
    confidence: float,
    num_resamples: int = 10_000,
    student: bool = False,
) -> Estimate:
    """A statistic with its interval: the percentile bootstrap's up to 95 %, beyond it, or if asked for, Student's t.

    The percentile method and not BCa: the literature that reports IQMs uses it, it stays defined
    where BCa divides by zero (constant runs get an interval of width zero), and for the IQM of 5,
    10 or 20 normal, log-normal or bimodal runs it covered the true value at least as often
    (0.83 to 0.94 for a nominal 0.95; 600 simulations each). Both are too narrow for few runs: with
    5 runs read "95 %" as about 90 %; for the difference of the means of 5 runs and 5 others it is 87 %.

    Of higher confidence, as many comparisons ask for, percentiles are no matter of taste: no resample lies beyond the
    worst of few runs. For a difference of two IQMs of 5 runs without any they left it out in 6 to 7 % where 0.17 %
    were asked for, of 10 runs in 1 %. With the resamples' deviation (times sqrt(n / (n - 1)), which they lack) and
    Student's t of n - 1 degrees, n being the smallest group, it was 0 to 0.3 % of 5 to 50 normal, log-normal or
    bimodal runs, and below 1.2 % for 1 % (1500 simulations each).

    Args:
      statistic: rows -> [R] values, where rows(size) are [R, size] indices of runs.
      sizes: runs of every group; a single run cannot tell its spread.
    """
    _check_confidence(confidence)
    value, n = float(statistic(lambda size: np.arange(size)[None])[0]), sum(sizes)
    if min(sizes) < 2:
        return Estimate(value, None, None, n)
    generator = np.random.default_rng(0)  # the same input gives the same interval
    batch = max(1, _NUMBERS_PER_BATCH // max(sizes))
    found = [
        statistic(partial(_drawn, generator, min(batch, num_resamples - done)))
        for done in range(0, num_resamples, batch)
    ]
    resampled = np.concatenate(found)
    if student or confidence > PERCENTILES:
        fewest = min(sizes)
        deviation = resampled.std() * math.sqrt(fewest / (fewest - 1))
        half = float(deviation * scipy.stats.t.ppf((1.0 + confidence) / 2.0, fewest - 1))
        return Estimate(value, value - half, value + half, n)
    tail = 50.0 * (1.0 - confidence)
    low, high = np.percentile(resampled, [tail, 100.0 - tail])
    return Estimate(value, float(low), float(high), n)


def _drawn(generator: np.random.Generator, resamples: int, size: int) -> NDArray[np.integer]:
    return generator.integers(0, size, (resamples, size))


def _runs(name: str, x: ArrayLike) -> NDArray[np.floating]:
    values = _finite(name, x)
    if values.ndim != 1:
        raise UserError(
            f"{name} has shape {values.shape}: give a vector with one number per run, averaged "
            "over episodes first."
        )
    return values


def _draws(name: str, x: ArrayLike) -> NDArray[np.floating]:
    """[N, K] runs of N draws, of each of which a vector has one."""
    values = np.asarray(x)
    return _groups(name, values) if values.ndim > 1 else _runs(name, x)[:, None]


def _groups(name: str, x: ArrayLike) -> NDArray[np.floating]:
    values = _finite(name, x)
    if values.ndim != 2:
        raise UserError(
            f"{name} have shape {values.shape}: give a row for each, with a run a column."
        )
    return values


def _comparable(
    groups: ArrayLike, minus: ArrayLike, paired_groups: bool
) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    first, second = _groups("the groups", groups), _groups("the groups to subtract", minus)
    if first.shape[1] != second.shape[1] or (paired_groups and len(first) != len(second)):
        raise UserError(
            f"groups of shape {first.shape} and {second.shape} can't be compared: pair run by run"
            + (" and group by group." if paired_groups else ".")
        )
    return first, second


def _finite(name: str, x: ArrayLike) -> NDArray[np.floating]:
    values = np.asarray(x, dtype=np.float64)
    if values.size == 0:
        raise UserError(f"{name} is empty: give at least one number.")
    number_nan = int(np.isnan(values).sum())
    number_infinite = int(np.isinf(values).sum())
    if number_nan or number_infinite:
        raise UserError(
            f"{name} holds {number_nan} NaN and {number_infinite} infinite among {values.size} "
            "numbers: leave failed runs out and report how many, or count each as the worst run."
        )
    return values
