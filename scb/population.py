"""A population's members side by side, over all devices and processes, and how they are compared."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec
from scipy.stats import rankdata

from scb import processes


def map_population(
    function: Callable[..., Any], size: int, in_axes: tuple[int | None, ...]
) -> Callable[..., Any]:
    """`jit(vmap(function))` whose mapped axis is spread over the devices of all processes; results are numpy arrays.

    Each device runs its part alone: no collective inside, so a device that is late holds nobody up,
    and a vmapped `while_loop` ends when the device's own part has ended. A size that the devices
    don't divide is padded by repeating entries, whose results are dropped.

    Args:
      function: of one population member.
      size: length of the mapped axes, which are all first axes.
      in_axes: 0 for arguments with one entry a member, None for those that all share.
    """
    mine, devices = processes.part(size)
    mesh = jax.sharding.Mesh(np.array(devices), ("population",))
    specs = tuple(
        PartitionSpec() if axis is None else PartitionSpec("population") for axis in in_axes
    )
    mapped = jax.jit(
        jax.shard_map(
            jax.vmap(function, in_axes=in_axes),
            mesh=mesh,
            in_specs=specs,
            out_specs=PartitionSpec("population"),
            check_vma=False,  # carries initialised inside a training loop are not marked as varying
        )
    )

    def place(argument: Any, axis: int | None, spec: PartitionSpec) -> Any:
        if axis is not None and not np.array_equal(mine, np.arange(size)):
            argument = jax.tree.map(lambda x: x[mine], argument)
        return jax.device_put(argument, NamedSharding(mesh, spec))

    def call(*arguments: Any) -> Any:
        results = jax.device_get(mapped(*map(place, arguments, in_axes, specs)))
        return jax.tree.map(lambda x: x[:size], processes.gathered(results))

    return call


def combine_tasks(fitness: np.ndarray, how: str) -> np.ndarray:
    """One number a candidate from one number a candidate and task.

    Args:
      fitness: [N, K] of N candidates on K tasks (agents with their own hyperparameters and seeds,
        the same for all candidates; several bandits).
      how: "mean"; or "ranks", the mean over tasks of a candidate's rank among the candidates, so
        that a task on which returns scatter widely counts no more than one on which they don't.

    Returns:
      [N]; NaN for a candidate that failed on any task.
    """
    if how == "mean":
        return np.asarray(fitness.mean(axis=1))
    failed = ~np.isfinite(fitness).all(axis=1)
    ranks = rankdata(np.where(np.isfinite(fitness), fitness, -np.inf), axis=0).mean(axis=1)
    return np.where(failed, np.nan, ranks)


def rank_failed_last(fitness: np.ndarray) -> np.ndarray:
    """[N] fitness, not all of it failed, with a value below the worst finite one for NaN and infinities.

    For the strategy alone: one NaN, where it standardises, would poison the mean for ever.
    """
    finite = np.isfinite(fitness)
    best, worst = fitness[finite].max(), fitness[finite].min()
    below = worst - max((best - worst) / len(fitness), 1e-6 * max(1.0, abs(worst)))
    return np.where(finite, fitness, below)
