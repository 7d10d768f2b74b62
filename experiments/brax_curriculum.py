"""Hopper's bandit with and without a curriculum of the evaluation episodes' length.

    python -m experiments brax_curriculum

Searches from random weights that differ in the curriculum's shape alone; run folders are under
runs/brax_curriculum and are resumed.
"""

import math
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments import searches
from experiments.claims import Claim
from experiments.harness import Experiment
from experiments.parts import InParts, Part
from experiments.reports import Report
from experiments.searches import NONE, curriculum_of
from scb import plotting
from scb.curriculum import horizon
from scb.discovery import DiscoveryConfig
from scb.environments.registry import environment_spec
from scb.statistics import iqm

ENVIRONMENT = "hopper"
# What standing still earns, the local optimum of searches without a curriculum.
LOCAL_OPTIMUM = environment_spec(ENVIRONMENT).standing["generalized"]


def config_of(shape: str, seed: int, plan: Mapping[str, Any]) -> DiscoveryConfig:
    """The search with this curriculum: the paper's recipe, at the plan's size."""
    return searches.config_of(
        ENVIRONMENT,
        plan,
        plan,
        seed,
        backend=plan["backend"],
        mode=plan["mode"],
        curriculum=curriculum_of(ENVIRONMENT, shape, plan["generations"]),
    )


def parts(plan: Mapping[str, Any], report: dict[str, Any]) -> Iterator[Part]:
    """Searches, first seeds first."""
    for seed in range(max(plan["seeds"].values())):
        for shape, number in plan["seeds"].items():
            if seed < number:
                config, folder = config_of(shape, seed, plan), f"{plan['runs']}/{shape}-{seed}"
                searched = partial(searches.searched_curve, config, folder)
                yield Part(("curves", shape, str(seed)), searched)


measure = InParts(parts)


def finals(report: Mapping[str, Any]) -> dict[str, searches.Final]:
    """{shape: the last judgement, over searches}."""
    return {shape: searches.final(curves, iqm) for shape, curves in report["curves"].items()}


def _best_without(report: Report) -> float:
    """Where the best search without a curriculum ends; minus infinity where all failed."""
    return max(searches.last(report["curves"][NONE]), default=-math.inf)


def claims(report: Report) -> list[Claim]:
    """Shape by shape: whether it ends above; untold where no search without a curriculum reached the local optimum."""
    curves, untold = report["curves"], -math.inf < _best_without(report) < LOCAL_OPTIMUM
    return [
        Claim(
            f"with a curriculum ({shape}) searches end higher",
            None if untold else searches.difference(curves[shape], curves[NONE], iqm),
            places=0,
        )
        for shape in curves
        if shape != NONE
    ]


def facts(report: Report) -> dict[str, Any]:
    """Where searches end."""
    return {"finals": finals(report), "best": _best_without(report), "standing": LOCAL_OPTIMUM}


def draw(report: Mapping[str, Any]) -> Figure:
    """Left the curricula, right what the search distribution's mean is worth."""
    generations = report["plan"]["generations"]
    figure = Figure(figsize=(plotting.WIDTH, 3.8))
    left, right = figure.subplots(1, 2)
    for (shape, curves), look in zip(report["curves"].items(), plotting.LINES, strict=False):
        curriculum = curriculum_of(ENVIRONMENT, shape, generations)
        times = np.arange(generations + 1)
        lengths: Any = (
            np.full(times.size, 1000)
            if curriculum is None
            else np.asarray(horizon(curriculum)(times))
        )
        left.plot(times, lengths, label=shape, **vars(look))
        number = len(curves)
        label = f"{shape} ({number} {'search' if number == 1 else 'searches'})"
        plotting.search_curve(right, list(curves.values()), label, look, iqm)
    left.set(title="Evaluation episodes' length", xlabel="generation", ylabel="steps")
    right.set(
        title="Meta-training on Hopper;\nbands: the range of searches",
        xlabel="generation",
        ylabel="return of agents",
    )
    right.legend(fontsize=8)
    return figure


EXPERIMENT = Experiment.of_the_paper("brax_curriculum", measure, draw, claims, facts=facts)
