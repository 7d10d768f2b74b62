"""Running mean and variance of observations (Chan et al., 1979: merging two samples' moments)."""

import jax
import jax.numpy as jnp
from flax import struct


@struct.dataclass
class RunningStatistics:
    count: jax.Array  # [] observations seen
    mean: jax.Array  # [O]
    squares: jax.Array  # [O] sum of squared deviations from the mean

    @classmethod
    def start(cls, size: int) -> "RunningStatistics":
        return cls(count=jnp.float32(0.0), mean=jnp.zeros(size), squares=jnp.zeros(size))


def update_statistics(statistics: RunningStatistics, batch: jax.Array) -> RunningStatistics:
    """Adds a [B, O] batch of observations."""
    mean = batch.mean(axis=0)
    return _merged(statistics, batch.shape[0], mean, jnp.sum((batch - mean) ** 2, axis=0))


def merge_statistics(statistics: RunningStatistics, others: RunningStatistics) -> RunningStatistics:
    """Adds what [N] others have seen; of those that are one observation, count says whether it counts."""
    count, counts = others.count.sum(), others.count[:, None] > 0
    # What does not count may be no number: nothing times that were none either.
    means = jnp.where(counts, others.mean, 0.0)
    mean = jnp.sum(others.count[:, None] * means, axis=0) / jnp.maximum(count, 1)
    spread = others.count[:, None] * (means - mean) ** 2
    squares = jnp.where(counts, others.squares, 0.0)
    merged = _merged(statistics, count, mean, jnp.sum(squares + spread, axis=0))
    return jax.tree.map(lambda new, old: jnp.where(count > 0, new, old), merged, statistics)


def _merged(
    statistics: RunningStatistics, size: jax.Array | int, mean: jax.Array, squares: jax.Array
) -> RunningStatistics:
    delta = mean - statistics.mean
    count = statistics.count + size
    return RunningStatistics(
        count=count,
        mean=statistics.mean + delta * size / count,
        squares=statistics.squares + squares + delta**2 * statistics.count * size / count,
    )


def normalize(
    statistics: RunningStatistics, observation: jax.Array, power: float = 1.0
) -> jax.Array:
    """[..., O] -> [..., O] with mean 0 and variance 1, clipped at ten deviations either way.

    Divided by deviation**power: a power of 1 standardises, one of 0 only centres. Before any observation the mean
    counts as 0 and the deviation as 1.
    """
    variance = jnp.where(
        statistics.count > 0, statistics.squares / jnp.maximum(statistics.count, 1.0), 1.0
    )
    deviation = jnp.sqrt(variance + 1e-8)
    normal = jnp.clip((observation - statistics.mean) / deviation, -10.0, 10.0)
    return normal if power == 1 else normal * deviation ** (1 - power)
