"""Two ways to do the same, timed in one process."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

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
