"""Learning curves of full-size trainings that ship with the library, for a short run or a bandit to be held against.

`python -m experiments locomotion` measures them and writes measured/locomotion.json.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from lpo.comparison import Comparison, LearningCurves
from lpo.objectives import REFERENCE
from scb.agents.ppo import DIAGNOSIS
from scb.files import unpacked
from scb.seeds import reporting

PATH = Path(__file__).with_name("measured") / "locomotion.json"


@dataclass(frozen=True)
class Confirmation:
    """One claim, stated before agents of its seeds were trained, and decided when all have been.

    Attributes:
      environment, objective: whose it is; "hopper at 0.0005" is Hopper with that learning rate, and "hopper at 0.001,
        annealed" with one that falls from there to zero.
      seeds: of its pairs of agents, none of which suggested the claim.
      of: what is said of them: "final" (no lower at the end, within a margin), "late" (no less over the last quarter,
        within a margin), "late lead" (more over it), "early" (more over the first half) or "area" (more over all).
      reference: which objective its agents are compared with.
      known: the one of both whose agents of these seeds had been trained, and seen, before.
      suggested: what earlier pairs said of it, in words.
      reference_in: where the reference's agents are trained; "" for the same environment and learning rate.
    """

    environment: str
    objective: str
    seeds: Sequence[int]
    of: str = "final"
    reference: str = REFERENCE
    known: str | None = None
    suggested: str = ""
    reference_in: str = ""

    def __post_init__(self) -> None:
        if self.known not in (None, self.reference, self.objective):
            raise ValueError(f"known is one of both objectives, or None: {self}.")

    @property
    def both(self) -> tuple[tuple[str, str], tuple[str, str]]:
        """(entry, objective) of what is compared, the reference first."""
        return (self.reference_in or self.environment, self.reference), (
            self.environment,
            self.objective,
        )

    @property
    def trained(self) -> list[tuple[str, str]]:
        """Those of which agents are trained for it."""
        return [(entry, name) for entry, name in self.both if name != self.known]


CONFIRMATIONS = (
    Confirmation(
        "hopper",
        "ta-lpo",
        reporting(30, offset=20),
        suggested="10, over the last quarter +204 [\u2212131, 568], corrected, which ten more took back",
    ),
    Confirmation(
        "hopper",
        "lpo-pendulum",
        reporting(40, offset=10),
        "late",
        known=REFERENCE,
        suggested="10, +167",
    ),
    Confirmation(
        "hopper",
        "ta-lpo",
        reporting(60, offset=50),
        "area",
        suggested="50, +91 [\u221213, 216], corrected",
    ),
    Confirmation(
        "hopper",
        "ta-lpo",
        reporting(40, offset=110),
        "early",
        suggested="110, +173 [60, 286], corrected",
    ),
    Confirmation(
        "hopper",
        "lpo-pendulum-ee",
        reporting(40, offset=10),
        "area",
        known=REFERENCE,
        suggested="10, +163",
    ),
    Confirmation(
        "hopper",
        "ta-lpo",
        reporting(40, offset=30),
        "area",
        "dpo",
        known="ta-lpo",
        suggested="30, +150 [76, 229]",
    ),
    Confirmation("hopper at 0.0005", "ta-lpo", reporting(40), "area", suggested="4, +210"),
    Confirmation(
        "hopper at 0.0005",
        "ta-lpo",
        reporting(40, offset=40),
        "late lead",
        suggested="40, +236 [\u221278, 550], corrected",
    ),
    Confirmation(
        "hopper",
        "lpo-cartpole-ee",
        reporting(60),
        "area",
        known=REFERENCE,
        suggested="4 that report nothing and were not kept, +110",
    ),
    Confirmation(
        "hopper",
        "lpo-cartpole-ee",
        reporting(60),
        "area",
        "dpo",
        known="dpo",
        suggested="the same four, +267",
    ),
    Confirmation(
        "hopper at 0.001",
        "ta-lpo",
        reporting(60),
        "late lead",
        suggested="12 that report nothing, +348 [107, 604]",
    ),
    Confirmation(
        "hopper at 0.001, annealed",
        "ta-lpo",
        reporting(60),
        "late lead",
        suggested="12 that report nothing, +307 [53, 619]",
    ),
    Confirmation(
        "hopper at 0.001, annealed",
        "ta-lpo",
        reporting(60),
        "area",
        suggested="the same twelve, +112 [\u221292, 302]",
    ),
    Confirmation(
        "hopper at 0.001",
        "ta-lpo",
        reporting(60),
        "late",
        known="ta-lpo",
        suggested="the same twelve, +57 [\u2212201, 377]",
        reference_in="hopper at 0.001, annealed",
    ),
    Confirmation(
        "hopper at 0.001, annealed",
        "ta-lpo",
        reporting(60),
        "area",
        "dpo",
        known="ta-lpo",
        suggested="60 beside the clip, +169 [104, 232]",
    ),
)


def full_size(environment: str) -> Comparison | None:
    """What was measured there at the paper's full number of steps, the first objective PPO's own; None for nothing."""
    found = looked_at(_kept()).get(environment)
    return None if found is None else as_comparison(environment, found)


def validated(environment: str) -> dict[str, LearningCurves]:
    """{objective: curves of agents that report nothing}, at the same number of steps; {} where there are none."""
    entry = _kept()["environments"].get(environment, {})
    agents = entry.get("sweep")
    return as_comparison(environment, entry, agents).by_name if agents else {}


def with_pairs(report: Mapping[str, Any]) -> Iterator[tuple[Confirmation, list[str]]]:
    """Every confirmation of what a report has agents of, and its seeds of which both agents are there."""
    for asked in CONFIRMATIONS:
        reference, ours = (
            report["environments"].get(entry, {}).get("agents", {}).get(name, {})
            for entry, name in asked.both
        )
        if reference and ours:
            yield asked, [str(s) for s in asked.seeds if str(s) in reference.keys() & ours.keys()]


def looked_at(report: Mapping[str, Any]) -> dict[str, Any]:
    """{name: entry} without the agents that are trained for confirmations which are not complete.

    Who looks at a difference while it grows sees it pass its margin sooner or later. An entry that has none of PPO's
    agents then is left out: there is nothing to compare with.
    """
    pending = [asked for asked, seeds in with_pairs(report) if len(seeds) < len(asked.seeds)]
    found = {}
    for environment, entry in report["environments"].items():
        agents = {name: dict(of_it) for name, of_it in entry.get("agents", {}).items()}
        for asked in pending:
            for name in (name for place, name in asked.trained if place == environment):
                for seed in asked.seeds:
                    agents[name].pop(str(seed), None)
        found[environment] = {**entry, "agents": {k: of_it for k, of_it in agents.items() if of_it}}
    return {name: entry for name, entry in found.items() if REFERENCE in entry["agents"]}


def comparisons(report: Mapping[str, Any]) -> dict[str, Comparison]:
    """{entry: its curves} of what is `looked_at`."""
    return {name: as_comparison(name, entry) for name, entry in looked_at(report).items()}


def longer(comparison: Comparison) -> Comparison | None:
    """What was measured at full size where a comparison trained for fewer steps."""
    whole = full_size(comparison.curves[0].environment)
    if whole is None or whole.curves[0].steps[-1] <= comparison.curves[0].steps[-1]:
        return None
    return whole


@cache
def _kept() -> dict[str, Any]:
    return dict(json.loads(PATH.read_text()))


def as_comparison(
    environment: str, found: Mapping[str, Any], agents: Mapping[str, Any] | None = None
) -> Comparison:
    """The curves of one entry of a report, {"agents": {objective: {seed: {"returns": "0.5 0.7", ...}}}, ...}.

    Of other agents than those where they are given, of its "sweep" for instance.

    An entry bears the environment's name, but where it says "environment" and the "hyperparameters" that differ there.

    PPO's clip comes first and agents by their seeds, in whatever order they ended. Objectives that have agents on the
    same seeds as the first are compared on these.
    """
    agents = found["agents"] if agents is None else agents
    curves = []
    for objective in sorted(agents, key=lambda name: name != REFERENCE):
        of_it = dict(sorted(agents[objective].items(), key=lambda item: int(item[0])))
        returns = _lines("returns", of_it, found["steps"])
        lengths, speeds = (
            # Of the end alone, and not known of every agent.
            np.array([[np.nan if a[of] is None else a[of]] for a in of_it.values()])
            for of in ("length", "speed")
        )
        curves.append(
            LearningCurves(
                found.get("environment", environment),
                found["backend"],
                objective,
                np.asarray(found["steps"]),
                returns,
                [int(seed) for seed in of_it],
                found["episodes"],
                mode_actions=True,
                hyperparameters=found.get("hyperparameters", {}),
                lengths=lengths,
                speeds=speeds,
                diagnosis={name: _lines(name, of_it, found["steps"]) for name in DIAGNOSIS},
            )
        )
    return Comparison(curves)


def _lines(of: str, agents: Mapping[str, Any], steps: Sequence[int]) -> np.ndarray:
    """[S, P] numbers that are kept in one line an agent; NaN where an agent has none."""
    unknown = " ".join(["nan"] * len(steps))
    return unpacked([agent.get(of, unknown) for agent in agents.values()])
