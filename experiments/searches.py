"""Searches for bandits and objectives that experiments compare: each goes on in a run folder of its own."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from experiments.claims import ENOUGH
from experiments.rendering import text
from experiments.reports import Report
from lpo.commands import MetaTrain
from lpo.objectives import Objective
from scb.command_line import SharedOutput
from scb.curriculum import CurriculumConfig, paper_curriculum
from scb.discovery import DiscoveryConfig, discover
from scb.errors import UserError
from scb.evolution import EvolutionConfig, judgements
from scb.locks import released
from scb.runs import log_lines
from scb.statistics import Estimate, Statistic, estimate, stratified_estimate

NONE = "none"  # the curriculum that is none


def config_of(
    environment: str, plan: Mapping[str, Any], size: Mapping[str, int], seed: int, **changes: Any
) -> DiscoveryConfig:
    """The paper's recipe (SNES from random weights) at a plan's size.

    Args:
      plan: "algorithms", "evaluation_episodes", "mean_evaluations", and where it differs from the paper
        "sigma", "combine" and "evaluate_mean_every".
      size: "generations", "population_size", "agents_per_candidate".
      changes: what else of the DiscoveryConfig is another.
    """
    evolution = EvolutionConfig(
        strategy="SNES",
        population_size=size["population_size"],
        num_generations=size["generations"],
        sigma=plan.get("sigma", 0.05),
        combine=plan.get("combine", "mean"),
        mean_evaluations=plan["mean_evaluations"],
        evaluate_mean_every=plan.get("evaluate_mean_every", 10),
        seed=seed,
    )
    given: dict[str, Any] = {
        "algorithms": tuple(plan["algorithms"]),
        "agents_per_candidate": size["agents_per_candidate"],
        "evaluation_episodes": plan["evaluation_episodes"],
        "init": "random",
        "evolution": evolution,
    }
    return DiscoveryConfig(environment, **given | changes)


def curriculum_of(environment: str, shape: str, generations: int) -> CurriculumConfig | None:
    """The paper's curriculum for an environment, scaled to a search of this length, in a shape; None for NONE.

    Raises:
      UserError: the paper has no curriculum for the environment.
    """
    if shape == NONE:
        return None
    curriculum = paper_curriculum(environment, generations)
    if curriculum is None:
        raise UserError(
            f"the paper has no curriculum for {environment}: its shape must be {NONE!r}."
        )
    return replace(curriculum, shape=shape)


def meta_training(settings: Mapping[str, Any]) -> MetaTrain:
    """The command `lpo meta-train` with flags, by name; True for a flag without a value."""
    words = [
        f"--{name.replace('_', '-')}" + ("" if value is True else f"={value}")
        for name, value in settings.items()
    ]
    return MetaTrain.parse(words)


def objective_of_run(settings: Mapping[str, Any], folder: Path) -> Objective:
    """The objective of a run folder of that command, and of no other: read, or learned first, or its run resumed."""
    resume = folder if (folder / "config.json").exists() else None
    with released():
        return replace(meta_training(settings), output=SharedOutput(folder, resume)).objective()


def searched_curve(config: DiscoveryConfig, folder: str | Path) -> dict[str, Any]:
    """`curve` of a search, its "seconds" and "machines"; searched first where that has not ended yet."""
    _, outcome = discover(config, folder)
    took = {"seconds": round(outcome.seconds, 1), "machines": machines(Path(folder))}
    return {**curve(outcome.metrics), **took}


def read_log(folder: Path) -> tuple[list[dict[str, Any]], list[float]]:
    """What a run's folder logs of each generation, and its seconds; of a run in progress, where it has both."""
    metrics, timing = log_lines(folder / "metrics.jsonl"), _timing(folder)
    number = min(len(metrics), len(timing))  # one is written before the other
    return metrics[:number], [line["seconds"] for line in timing[:number]]


def machines(folder: Path) -> list[dict[str, Any]]:
    """Where a run folder's generations were computed, in turn; empty where its log is older than that it says so."""
    return each_once(x["machine"] for x in _timing(folder) if "machine" in x)


def ran_on(curves: Iterable[Mapping[str, Any]], report: Report) -> list[dict[str, Any]]:
    """The machines of searches, each once; a search that does not say which ran where the report was made."""
    here = [report["machine"]]
    return each_once(x for curve in curves for x in curve.get("machines") or here)


def elsewhere(curves: Iterable[Mapping[str, Any]], report: Report) -> list[dict[str, Any]]:
    """Those of them on which the rest of the report was not measured."""
    return [x for x in ran_on(curves, report) if x != report["machine"]]


def each_once(found: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Machines, say, each where it comes first."""
    once: list[dict[str, Any]] = []
    for x in found:
        if x not in once:
            once.append(x)
    return once


def _timing(folder: Path) -> list[dict[str, Any]]:
    return log_lines(folder / "timing.jsonl", "seconds")


def curve(metrics: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """What a search distribution's mean was worth over the generations, from a run's log.

    Returns:
      {"generation", "fitness" (interquartile mean over agents; None where all failed), "mean" (over agents),
      "failed" (mean number of candidates without a finite fitness since the last judgement)}. The judgement of an
      earlier end, of a search that went on for more generations, is left out: others have none there.
    """
    before = [
        {k: x for k, x in line.items() if not k.startswith("final_mean/")} for line in metrics[:-1]
    ]
    judged = judgements([*before, *metrics[-1:]])
    failed, last = [], 0
    for generation, _ in judged:
        since = [x["failed"] for x in metrics if last <= x["generation"] < generation]
        failed.append(round(sum(since) / len(since), 3) if since else 0.0)
        last = generation
    return {
        "generation": [generation for generation, _ in judged],
        "fitness": [_rounded(x.get("fitness_iqm")) for _, x in judged],
        "mean": [_rounded(x["fitness"], 4) for _, x in judged],
        "failed": failed,
    }


@dataclass(frozen=True)
class Final:
    """What several searches were worth at their end.

    Attributes:
      estimate: over those that didn't fail; None where every one failed.
      failed: searches whose last judgement is no number.
    """

    estimate: Estimate | None
    failed: int

    @property
    def searches(self) -> int:
        """How many there were."""
        return self.failed + (0 if self.estimate is None else self.estimate.n)

    def text(self, places: int = 0) -> str:
        """Such as "12 [9, 14]", with the failures where there are some."""
        if self.estimate is None:
            return "all failed"
        found = text(self.estimate, places)
        return f"{found} ({self.failed} of {self.searches} failed)" if self.failed else found


def last(curves: Mapping[str, Mapping[str, Any]]) -> list[float]:
    """The last judgements of the searches of {seed: curve} that didn't fail."""
    return [c["fitness"][-1] for c in curves.values() if c["fitness"][-1] is not None]


def final(curves: Mapping[str, Mapping[str, Any]], statistic: Statistic) -> Final:
    """The last judgement, over the searches of {seed: curve}."""
    found = last(curves)
    return Final(estimate(found, statistic) if found else None, len(curves) - len(found))


def difference(
    one: Mapping[str, Mapping[str, Any]],
    other: Mapping[str, Mapping[str, Any]],
    statistic: Statistic,
) -> Callable[..., Estimate] | Estimate:
    """How far the searches of one kind end above those of another, as evidence of a claim.

    There is no interval of fewer than five searches, and none where one of either failed, which is worse than any
    return: what the others earn then says too little for it or too much.
    """
    above, below = last(one), last(other)
    whole = len(above) == len(one) and len(below) == len(other)
    if whole and min(len(above), len(below)) >= ENOUGH:
        return partial(
            stratified_estimate,
            [above],
            [below],
            statistic=statistic,
            paired=False,
            student=True,
        )
    value = np.nan if not (above and below) else float(statistic(above) - statistic(below))
    return Estimate(value, None, None, len(one))


def _rounded(value: float | None, digits: int = 2) -> float | None:
    return None if value is None or not math.isfinite(value) else round(float(value), digits)
