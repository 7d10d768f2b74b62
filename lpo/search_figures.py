"""Figures of a search for an objective, in the style of `lpo.figures`: its fitness, and what it costs."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator, NullFormatter

from lpo.inner_loop import MetaTrainingConfig
from scb.errors import UserError
from scb.evolution import judgements
from scb.plotting import (
    BLUE,
    GREY,
    SKY_BLUE,
    VERMILLION,
    WIDTH,
    figure_style,
    figure_title,
    legend_below,
    ratio_text,
)


def meta_training_curve(metrics: list[dict[str, Any]], config: MetaTrainingConfig) -> Figure:
    """Fitness over the generations of an evolution, and the mean's, which has a scale of its own where it is validated.

    Args:
      metrics: one dict a generation, as `scb.evolution.evolve` logs them.
      config: of the meta-training.

    Raises:
      UserError: no generation was logged.
    """
    if not metrics:
        raise UserError(
            "the run has logged no generation: let it finish at least one before drawing it."
        )
    environment = ", ".join(config.judged_in)
    generations = np.array([row["generation"] for row in metrics])
    # A log line holds None where a number was not finite, which becomes NaN.
    mean, std, best = (
        np.array([row.get(f"fitness/{kind}") for row in metrics], float)
        for kind in ("mean", "std", "max")
    )
    judged = [(g, x["fitness"]) for g, x in judgements(metrics) if x["fitness"] is not None]
    with figure_style():
        figure = Figure(figsize=(WIDTH, 4.2))
        axes = figure.add_subplot()
        axes.fill_between(
            generations,
            mean - std,
            mean + std,
            color=SKY_BLUE,
            alpha=0.35,
            linewidth=0,
            label="population: ± standard deviation",
        )
        axes.plot(generations, mean, color=BLUE, label="population: mean", linestyle="--")
        axes.plot(
            generations, best, color=GREY, linewidth=1.0, linestyle=":", label="population: best"
        )
        judging = axes
        if judged:
            if config.validation:
                judging = axes.twinx()
                judging.grid(visible=False)
                judging.spines["right"].set_visible(True)
                judging.set_ylabel(f"of the mean: return on {', '.join(config.homes)}")
            judging.plot(
                *zip(*judged, strict=True),
                color=VERMILLION,
                marker="o",
                label=f"search distribution's mean ({config.evolution.mean_evaluations} agents a point)",
            )
        axes.set_xlabel("generation")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        during = " during training" if config.judgement.along else ""
        axes.set_ylabel(f"fitness: mean return{during}\nin {environment}")
        axes.margins(x=0.02)
        last = metrics[-1]
        per_generation = last.get("steps/total", 0) / (last["generation"] + 1)
        if per_generation > 0:
            top = axes.secondary_xaxis(
                "top", functions=(lambda g: g * per_generation, lambda s: s / per_generation)
            )
            top.xaxis.set_major_formatter(EngFormatter(sep=""))
            top.set_xlabel("environment steps of the population (training + evaluation)")
        figure_title(
            figure,
            f"Meta-training on {environment}, population of {config.evolution.population_size}",
        )
        handles, labels = axes.get_legend_handles_labels()
        if judged and judging is not axes:
            of_mean = judging.get_legend_handles_labels()
            handles, labels = handles + of_mean[0], labels + of_mean[1]
        legend_below(figure, (handles, labels), columns=2)
    return figure


def environment_steps(bandit: Mapping[str, int], environment: Mapping[str, int]) -> Figure:
    """What the bandit saves: environment steps of the same meta-training on either, counted apart.

    Args:
      bandit, environment: {"training", "evaluation", "total"} steps.
    """
    rows = ("training", "evaluation", "total")
    height, positions = 0.38, np.arange(len(rows))
    with figure_style():
        figure = Figure(figsize=(WIDTH, 3.0))
        axes = figure.add_subplot()
        axes.set_xscale("log")
        drawn = [steps[row] for steps in (bandit, environment) for row in rows if steps[row] > 0]
        left = 10.0 ** np.floor(np.log10(min(drawn, default=1)) - 0.3)
        for steps, offset, color, hatch, name in (
            (bandit, -height / 2, VERMILLION, "", "on the bandit"),
            (environment, height / 2, BLUE, "///", "on the environment"),
        ):
            counts = [steps[row] for row in rows]
            # A logarithmic axis has no zero: no steps are no bar.
            bars = axes.barh(
                positions + offset,
                np.maximum(np.array(counts) - left, 0),
                height=height,
                left=left,
                color=color,
                hatch=hatch,
                edgecolor="white",
                linewidth=0,
                label=name,
            )
            axes.bar_label(bars, [_count(count) for count in counts], padding=4, fontsize=9)
        for position, row in enumerate(rows):
            axes.text(
                1.0,
                position,
                ratio_text(bandit[row], environment[row]),
                transform=axes.get_yaxis_transform(),
                ha="right",
                va="center",
                fontweight="bold",
                color=VERMILLION,  # the bandit's: it is the one that takes fewer or more
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 1},
            )
        # Room on the right for the ratios, which stand in one column.
        axes.set_xlim(left, left * (max(drawn, default=10) / left) ** 1.42)
        axes.set_yticks(positions, rows)
        axes.invert_yaxis()
        axes.tick_params(axis="y", length=0)
        axes.grid(axis="y", visible=False)
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_xlabel("environment steps of all candidates of the meta-training (logarithmic)")
        figure_title(figure, "Cost of meta-training in environment steps")
        legend_below(figure, axes.get_legend_handles_labels(), columns=2)
    return figure


def _count(steps: float) -> str:
    return EngFormatter(places=None if steps < 1000 else 1, sep="\N{THIN SPACE}")(steps)
