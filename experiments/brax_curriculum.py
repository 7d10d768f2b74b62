"""Hopper's bandit with and without a curriculum of the evaluation episodes' length.

    python -m experiments.brax_curriculum

Searches from random weights that differ in the curriculum's shape alone; run folders are under
runs/brax_curriculum and are resumed.
"""

import math
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments import searches
from experiments.page import Experiment, Save, table
from experiments.page import main as run
from experiments.searches import NONE, curriculum_of
from scb import plotting
from scb.curriculum import horizon
from scb.discovery import DiscoveryConfig
from scb.environments.registry import environment_spec
from scb.statistics import iqm

ENVIRONMENT = "hopper"
# What standing still earns in an episode of 1000 steps, the local optimum of searches without a curriculum.
STANDING = environment_spec("hopper").standing_still() or 0.0


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


def measure(plan: Mapping[str, Any], report: dict[str, Any], save: Save) -> None:
    """A search at a time, first seeds first."""
    found = report.setdefault("curves", {shape: {} for shape in plan["seeds"]})
    for seed in range(max(plan["seeds"].values())):
        for shape, number in plan["seeds"].items():
            if seed >= number or str(seed) in found[shape]:
                continue
            found[shape][str(seed)] = searches.searched_curve(
                config_of(shape, seed, plan), f"{plan['runs']}/{shape}-{seed}"
            )
            save()


def finals(report: Mapping[str, Any]) -> dict[str, searches.Final]:
    """{shape: the last judgement, over searches}."""
    return {shape: searches.final(curves, iqm) for shape, curves in report["curves"].items()}


def _best_without(report: Mapping[str, Any]) -> float:
    """Where the best search without a curriculum ends; minus infinity where all failed."""
    without = [c["fitness"][-1] for c in report["curves"][NONE].values()]
    return max((x for x in without if x is not None), default=-math.inf)


def _above(report: Mapping[str, Any]) -> list[str]:
    """The curricula that end above the best search without one; a failed search is worse than any."""
    best = _best_without(report)
    return [
        shape
        for shape, x in finals(report).items()
        if shape != NONE and x.estimate is not None and not x.failed and x.estimate.value > best
    ]


def parts(report: Mapping[str, Any]) -> list[bool | None]:
    """Shape by shape: whether it ends above; None where no search reached the local optimum of standing still."""
    above, shapes = _above(report), [x for x in report["curves"] if x != NONE]
    return [None if _untold(_best_without(report)) else x in above for x in shapes]


def _untold(best: float) -> bool:
    """Whether searches without a curriculum stay below the local optimum that the claim is about."""
    return -math.inf < best < STANDING


def verdict(report: Mapping[str, Any]) -> str:
    """Every curriculum against every search without one."""
    found, best, above = finals(report), _best_without(report), _above(report)
    shapes = [shape for shape in found if shape != NONE]
    said = (
        "every curriculum ends above the best of them"
        if len(above) == len(shapes)
        else "no curriculum ends above the best of them"
        if not above
        else f"{' and '.join(above)} {'ends' if len(above) == 1 else 'end'} above the best of them, "
        f"{', '.join(x for x in shapes if x not in above)} not"
    )
    generations = report["plan"]["generations"]
    return (
        f"after {generations} generations (the paper's searches take 2000) the agents earn {found[NONE].text()} "
        f"without a curriculum, over {found[NONE].searches} searches; with one: "
        + ", ".join(f"{shape} {found[shape].text()}" for shape in shapes)
        + (
            f". Of the searches without one the best ends at {best:.0f}: {said}."
            if math.isfinite(best)
            else ". Every search without one failed."
        )
        + (
            f" None of them earns what standing still does ({STANDING:.0f}), the local optimum that the claim is "
            "about: so few generations do not test it."
            if _untold(best)
            else ""
        )
    )


def body(report: Mapping[str, Any]) -> list[str]:
    """How it was searched, and the final judgements."""
    plan = report["plan"]
    algorithms = searches.algorithms_text(plan["algorithms"])
    rows = [
        [
            shape,
            str(found.searches),
            found.text(),
            f"{np.mean([c['seconds'] for c in report['curves'][shape].values()]) / 60:.1f}",
        ]
        for shape, found in finals(report).items()
    ]
    return [
        f"Hopper in `{plan['backend']}` physics. SNES from random weights with standard deviation 0.05, "
        f"{plan['generations']} generations of {plan['population_size']} candidates, inner loop {algorithms} with the "
        f"paper's fixed hyperparameters, {plan['evaluation_episodes']} evaluation episodes. The paper's curriculum "
        "(100 to 1000 steps between the first and the ninth tenth of the search) in several shapes; the mean of the "
        f"search distribution is judged over whole episodes by {plan['mean_evaluations']} agents, whatever "
        "the curriculum. Interquartile means, 95 % intervals over searches where there are several.",
        "",
        *table(["curriculum", "searches", "return at the end", "minutes a search"], rows),
    ]


def draw(report: Mapping[str, Any]) -> Figure:
    """Left the curricula, right what the search distribution's mean is worth."""

    looks = (
        (plotting.BLACK, "-"),
        (plotting.BLUE, "--"),
        (plotting.ORANGE, "-."),
        (plotting.GREEN, ":"),
        (plotting.PURPLE, (0, (3, 1, 1, 1))),
        (plotting.VERMILLION, (0, (5, 1))),
    )
    generations = report["plan"]["generations"]
    with plotting.figure_style():
        figure = Figure(figsize=(plotting.WIDTH, 3.8))
        left, right = figure.subplots(1, 2)
        for (shape, curves), (color, style) in zip(report["curves"].items(), looks, strict=False):
            curriculum = curriculum_of(ENVIRONMENT, shape, generations)
            times = np.arange(generations + 1)
            lengths: Any = (
                np.full(times.size, 1000)
                if curriculum is None
                else np.asarray(horizon(curriculum)(times))
            )
            left.plot(times, lengths, color=color, linestyle=style, label=shape)
            number = len(curves)
            label = f"{shape} ({number} {'search' if number == 1 else 'searches'})"
            plotting.search_curve(right, list(curves.values()), label, color, style, iqm)
        left.set_title("Evaluation episodes' length")
        left.set_ylabel("steps")
        right.set_title("Meta-training on Hopper")
        right.set_ylabel("return of agents")
        for axes in (left, right):
            axes.set_xlabel("generation")
        right.legend(fontsize=8)
    return figure


EXPERIMENT = Experiment(
    name="brax_curriculum",
    title="Hopper's bandit with and without a curriculum",
    paper="figure 4",
    claim="without a curriculum the search on Hopper converges quickly to a local optimum; with one it goes on to "
    "better returns, whatever the curriculum's shape.",
    presets={
        "quick": {
            "runs": "runs/brax_curriculum/quick",
            "backend": "spring",
            "algorithms": ["ppo"],
            "mode": "all",
            "population_size": 16,
            "generations": 60,
            "agents_per_candidate": 1,
            "evaluation_episodes": 4,
            "mean_evaluations": 8,
            "evaluate_mean_every": 5,
            "seeds": {NONE: 3, "linear": 3, "exponential": 3, "step": 3},
        },
        "paper": {
            "runs": "runs/brax_curriculum/paper",
            "backend": "generalized",
            "algorithms": [],
            "mode": "sequential",
            "population_size": 256,
            "generations": 2000,
            "agents_per_candidate": 1,
            "evaluation_episodes": 16,
            "mean_evaluations": 64,
            "evaluate_mean_every": 20,
            "seeds": {
                NONE: 9,
                "linear": 1,
                "quadratic": 1,
                "cosine": 1,
                "exponential": 1,
                "step": 1,
            },
        },
    },
    minutes={"quick": "25", "paper": "weeks; for a GPU"},
    measure=measure,
    parts=parts,
    verdict=verdict,
    body=body,
    draw=draw,
    needs="keeps its searches under runs/brax_curriculum",
)


if __name__ == "__main__":
    sys.exit(run(EXPERIMENT))
