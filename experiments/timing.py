"""Two ways to do the same, timed in one process."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import jax
import numpy as np
from jax.experimental.compilation_cache.compilation_cache import reset_cache

OWN = "scb"


def in_turn(rates: Mapping[str, Callable[[], float]], repeats: int) -> dict[str, Any]:
    """Steps a second of `OWN` and of one other, in turn so that what else the machine does meets both.

    Args:
      rates: {who: a call that times itself once, and gives its steps a second}.
      repeats: of each.

    Returns:
      {who: the median, ..., "ratios": of `OWN` to the other, one a repeat}.
    """
    found: dict[str, list[float]] = {who: [] for who in rates}
    for _ in range(repeats):
        for who, rate in rates.items():
            found[who].append(rate())
    (other,) = rates.keys() - {OWN}
    return {
        **{who: round(float(np.median(x))) for who, x in found.items()},
        "ratios": [round(a / b, 2) for a, b in zip(found[OWN], found[other], strict=True)],
    }


@contextmanager
def without_compilation_cache() -> Iterator[None]:
    """Programs are compiled whether an earlier process has compiled them or not."""
    before = jax.config.values["jax_enable_compilation_cache"]
    jax.config.update("jax_enable_compilation_cache", False)
    reset_cache()  # JAX asks once whether there is one
    try:
        yield
    finally:
        jax.config.update("jax_enable_compilation_cache", before)
        reset_cache()
