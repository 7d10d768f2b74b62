"""Learning curves of full-size trainings that ship with the library, for a short run to be seen beside.

`python -m experiments.locomotion` measures them and writes measured/locomotion.json.
"""

import json
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from lpo.comparison import Comparison, LearningCurves
from scb.agents.ppo import DIAGNOSIS

PATH = Path(__file__).with_name("measured") / "locomotion.json"


def full_size(environment: str) -> Comparison | None:
    """What was measured there at the paper's full number of steps, the first objective PPO's own; None for nothing."""
    found = _kept()["environments"].get(environment)
    return None if found is None else as_comparison(environment, found)


def longer(comparison: Comparison) -> Comparison | None:
    """What was measured at full size where a comparison trained for fewer steps."""
    whole = full_size(comparison.curves[0].environment)
    if whole is None or whole.curves[0].steps[-1] <= comparison.curves[0].steps[-1]:
        return None
    return whole


@cache
def _kept() -> dict[str, Any]:
    return dict(json.loads(PATH.read_text()))


def as_comparison(environment: str, found: Mapping[str, Any]) -> Comparison:
    """The curves of one environment of a report, {"agents": {objective: {seed: {"returns": "0.5 0.7", ...}}}, ...}.

    Objectives that have agents on the same seeds as the first are compared on these.
    """
    curves = []
    for objective, agents in found["agents"].items():
        returns = _lines("returns", agents, found["steps"])
        lengths, speeds = (
            # Of the end alone, and not known of every agent.
            np.array([[np.nan if a[of] is None else a[of]] for a in agents.values()])
            for of in ("length", "speed")
        )
        curves.append(
            LearningCurves(
                environment,
                found["backend"],
                objective,
                np.asarray(found["steps"]),
                returns,
                [int(seed) for seed in agents],
                found["episodes"],
                mode_actions=True,
                lengths=lengths,
                speeds=speeds,
                diagnosis={name: _lines(name, agents, found["steps"]) for name in DIAGNOSIS},
            )
        )
    return Comparison(curves)


def _lines(of: str, agents: Mapping[str, Any], steps: Sequence[int]) -> np.ndarray:
    """[S, P] numbers that are kept in one line an agent; NaN where an agent has none."""
    unknown = " ".join(["nan"] * len(steps))
    return np.array([[float(x) for x in a.get(of, unknown).split()] for a in agents.values()])
