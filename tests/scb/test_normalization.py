import jax
import jax.numpy as jnp
import numpy as np

from scb.agents.normalization import (
    RunningStatistics,
    merge_statistics,
    normalize,
    update_statistics,
)


def seen(*batches):
    statistics = RunningStatistics.start(batches[0].shape[1])
    for batch in batches:
        statistics = update_statistics(statistics, jnp.asarray(batch))
    return statistics


def batches():
    # Sizes, means and deviations differ between batches, so that weighting them wrongly shows.
    rng = np.random.default_rng(0)
    shape = [(5, 2.0, 1.0), (1, -7.0, 0.0), (40, 100.0, 3.0), (3, 0.0, 10.0)]
    return [rng.normal(mean, std, (size, 3)).astype(np.float32) for size, mean, std in shape]


def test_statistics_are_numpys_over_everything_seen():
    everything = np.concatenate(batches()).astype(np.float64)
    statistics = seen(*batches())
    assert statistics.count == 49
    np.testing.assert_allclose(statistics.mean, everything.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(statistics.squares / 49, everything.var(axis=0), rtol=1e-5)


def test_a_large_offset_does_not_swallow_the_variance():
    # The naive E x^2 - (E x)^2 has nothing left of a variance of 1 beside 1e8 in float32.
    rng = np.random.default_rng(1)
    parts = [rng.normal(1e4, 1.0, (500, 1)).astype(np.float32) for _ in range(4)]
    statistics = seen(*parts)
    variance = np.concatenate(parts).astype(np.float64).var()
    np.testing.assert_allclose(statistics.squares[0] / 2000, variance, rtol=0.01)


def test_normalised_observations_have_mean_zero_and_variance_one():
    everything = np.concatenate(batches())
    normalised = np.asarray(normalize(seen(*batches()), everything))
    np.testing.assert_allclose(normalised.mean(axis=0), 0.0, atol=1e-5)
    np.testing.assert_allclose(normalised.std(axis=0), 1.0, rtol=1e-4)


def test_normalisation_by_hand_and_its_limit():
    # Seen 1 and 5: mean 3, variance 4. (6 - 3) / 2 = 1.5; (103 - 3) / 2 = 50 is cut to 10.
    statistics = seen(np.array([[1.0], [5.0]]))
    np.testing.assert_allclose(
        normalize(statistics, jnp.array([[6.0], [103.0], [-97.0]])), [[1.5], [10.0], [-10.0]]
    )


def test_what_does_not_count_may_be_no_number():
    one = RunningStatistics(jnp.array([0.0]), jnp.array([[jnp.nan]]), jnp.array([[jnp.nan]]))
    for before in (RunningStatistics.start(1), seen(np.array([[1.0], [5.0]]))):
        jax.tree.map(np.testing.assert_array_equal, merge_statistics(before, one), before)


def test_before_any_observation_nothing_changes():
    observation = jnp.array([0.5, -3.0])
    np.testing.assert_allclose(normalize(RunningStatistics.start(2), observation), observation)


def test_of_a_batch_only_those_count_that_are_counted():
    # 1 and 5 of three.
    batch, counted = jnp.array([[1.0], [77.0], [5.0]]), jnp.array([True, False, True])
    single = RunningStatistics(counted, batch, jnp.zeros_like(batch))
    statistics = merge_statistics(RunningStatistics.start(1), single)
    assert (statistics.count, statistics.mean[0], statistics.squares[0]) == (2.0, 3.0, 8.0)


def test_what_several_have_seen_is_what_one_would_have_seen():
    first, *others = batches()
    several = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(seen(batch) for batch in others))
    merged, alone = merge_statistics(seen(first), several), seen(*batches())
    assert merged.count == 49
    np.testing.assert_allclose(merged.mean, alone.mean, rtol=1e-5)
    np.testing.assert_allclose(merged.squares, alone.squares, rtol=1e-5)
