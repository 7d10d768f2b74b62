"""Figures of objectives: one style, a fixed look for every objective, and the uncertainty always drawn.

Every function returns a `matplotlib.figure.Figure` of its own: pyplot and its global state stay
out, so figures can be made in a library, a server or a test alike. Colours are those of Okabe and
Ito (2008), which stay apart for colour-blind readers; line style and marker say the same again for
a grey print.
"""

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from lpo.inner_loop import MetaTrainingConfig
from scb.environments.registry import environment_spec
from scb.errors import UserError
from scb.plotting import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY_BLUE,
    VERMILLION,
    WIDTH,
    Look,
    estimate_curve,
    estimate_row,
    figure_style,
    figure_title,
    legend_below,
    name_rows,
    panels,
)
from scb.statistics import correlation_text, estimate, paired_difference, typeset

if TYPE_CHECKING:
    from lpo.comparison import LearningCurves
    from lpo.suite import SuiteScores

_LOOKS: dict[str, Look] = {
    "ppo": Look(BLUE, "--", "s"),
    "dpo": Look(GREEN, "-.", "^"),
    "none": Look(GREY, ":", "X"),
}
# Of `PPO.diagnose`, in the order of the panels.
_DIAGNOSES = {
    "kl": "KL from the old policy to the new (nats)",
    "outside": "share of ratios outside [0.8, 1.2]",
    "gain": "mean ratio times advantage (deviations)",
    "value_error": "value error, as a share of the targets' variance",
    "entropy": "entropy of the policy (nats)",
}
# The learned objective, the reason for the figure, has the one solid line.
_LEARNED = Look(VERMILLION, "-", "o")
_FURTHER = (
    Look(PURPLE, (0, (5, 1, 1, 1, 1, 1)), "D"),
    Look(ORANGE, (0, (8, 2)), "v"),
    Look(SKY_BLUE, (0, (1, 1)), "P"),
    Look(BLACK, (0, (3, 1, 1, 1)), "*"),
)
_ZOO_LOOKS = dict(
    zip(
        ("lpo-pendulum", "lpo-multi", "ta-lpo", "lpo-pendulum-ee", "lpo-cartpole-ee"),
        (_LEARNED, *_FURTHER),
        strict=True,
    )
)


def looks(names: Sequence[str]) -> dict[str, Look]:
    """{objective: its look}, the same in every figure.

    "ppo", "dpo", "none" and those of the zoo have their own. Of others the first is taken for the learned one;
    further names ("ppo-0.3", "dpo-4-1.2", a second learned objective) take the remaining colours in turn.
    """
    own = _LOOKS | _ZOO_LOOKS
    chosen = {name: own[name] for name in names if name in own}
    others = [name for name in dict.fromkeys(names) if name not in own]
    # Constants by value make a variant of PPO or DPO, which must not take the learned objective's look.
    learned = [name for name in others if not name.startswith(("ppo-", "dpo-"))]
    if learned and _LEARNED not in chosen.values():
        chosen[learned[0]] = _LEARNED
    further = [name for name in others if name not in chosen]
    free = [look for look in _FURTHER if look not in chosen.values()] or _FURTHER
    return chosen | {name: free[i % len(free)] for i, name in enumerate(further)}


def learning_curves(curves: "Sequence[LearningCurves]") -> Figure:
    """Interquartile mean return over the training, and each seed's return at its end.

    Bands and bars are 95 % bootstrap intervals over seeds; a single seed has none, and gets none.

    Args:
      curves: of one environment, one an objective.

    Raises:
      UserError: no curves, curves of different environments or evaluations, or a return that is
        not finite.
    """
    if not curves:
        raise UserError("there are no learning curves to draw: give at least one.")
    first = curves[0]
    for curve in curves:
        if _protocol(curve) != _protocol(first):
            raise UserError(
                f"{curve.objective} was run as {_protocol(curve)}, {first.objective} as "
                f"{_protocol(first)}: one figure compares objectives under one protocol, so draw "
                "them apart."
            )
    style = looks([curve.objective for curve in curves])
    counts = sorted({len(curve.seeds) for curve in curves})
    with figure_style():
        figure = Figure(figsize=(WIDTH, 4.4))
        training, final = figure.subplots(1, 2, width_ratios=(2.4, 1))
        for position, curve in enumerate(curves):
            look = style[curve.objective]
            points = [estimate(column) for column in curve.returns.T]
            estimate_curve(training, curve.steps, points, look, curve.objective)
            _final(final, position, curve, look)
        training.set_xlabel("environment steps")
        training.xaxis.set_major_formatter(EngFormatter(sep=""))
        training.set_ylabel("return (interquartile mean)")
        during = "no interval from one seed" if counts == [1] else "95 % intervals as bands"
        training.set_title(f"During training: {during}", fontsize=10, weight="normal")
        training.margins(x=0.02)
        crowded = len(curves) > 3 or max(len(curve.objective) for curve in curves) > 10
        slanted = {"rotation": 30, "ha": "right", "rotation_mode": "anchor"} if crowded else {}
        final.set_xticks(range(len(curves)), [curve.objective for curve in curves], **slanted)
        final.set_xlim(-0.6, len(curves) - 0.4)
        final.grid(axis="x", visible=False)
        final.set_ylabel("final return")
        final.set_title("At the end: each seed a dot", fontsize=10, weight="normal")
        figure_title(figure, f"{_protocol(first)}, {_number(counts, 'seeds')}")
        # Under its own panel, beside the names on the right; constrained layout keeps its room.
        training.legend(loc="upper center", bbox_to_anchor=(0.5, -0.17), ncols=min(len(curves), 3))
    return figure


def leads(curves: "Sequence[LearningCurves]") -> Figure:
    """By how much agents earn more along the training than those of the first objective, on the seeds of both.

    Differences of interquartile means; bands are 95 % bootstrap intervals over pairs, at each point for itself.

    Args:
      curves: of one environment, one an objective; the first is what the others are compared with.

    Raises:
      UserError: there is nothing to compare, or no seed that both have.
    """
    reference, *others = curves
    if not others or not all(len(x.paired(reference)[0]) for x in others):
        raise UserError(
            f"nothing shares a seed with {reference.objective}: give objectives that do."
        )
    style = looks([curve.objective for curve in curves])
    with figure_style():
        figure = Figure(figsize=(WIDTH, 2.8))
        panels = figure.subplots(1, len(others), sharex=True, sharey=True, squeeze=False)[0]
        for axes, curve in zip(panels, others, strict=True):
            look, (ours, theirs) = style[curve.objective], curve.paired(reference, "returns")
            points = [paired_difference(*both) for both in zip(ours.T, theirs.T, strict=True)]
            estimate_curve(axes, curve.steps, points, look)
            axes.axhline(0.0, color=BLACK, linewidth=1)
            axes.set_title(f"{curve.objective}\n{len(ours)} pairs", fontsize=10, weight="normal")
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
            axes.margins(x=0.05)
        panels[0].set_ylabel(f"return less that of {reference.objective}")
        panels[len(panels) // 2].set_xlabel("environment steps")
        figure_title(
            figure, f"{_place(reference)}: lead over {reference.objective}, of paired seeds"
        )
    return figure


def diagnosis(curves: "Sequence[LearningCurves]") -> Figure:
    """What an iteration does to the policy along the training: mean over agents, with 95 % intervals.

    Args:
      curves: of one environment, one an objective; agents that were not diagnosed are left out. The last point is
        of iterations beyond the training: where the learning rate has fallen to zero there it is left out too.

    Raises:
      UserError: an objective has no diagnosed agent.
    """
    style = looks([curve.objective for curve in curves])
    with figure_style():
        figure = Figure(figsize=(WIDTH, 8.5))
        drawn_in = panels(figure, len(_DIAGNOSES))
        for axes, (name, label) in zip(drawn_in, _DIAGNOSES.items(), strict=True):
            for curve in curves:
                if not curve.diagnosed:
                    raise UserError(
                        f"no agent of {curve.objective} was diagnosed: measure with `diagnose`."
                    )
                values = curve.diagnosis[name] if curve.diagnosis else np.empty((0, 0))
                known = values[~np.isnan(values).any(axis=1)]
                annealed = curve.hyperparameters.get("anneal_learning_rate", False)
                steps = curve.steps[:-1] if annealed else curve.steps
                points = [estimate(column, np.mean) for column in known.T[: len(steps)]]
                estimate_curve(axes, steps, points, style[curve.objective], curve.objective)
            axes.set_title(label, fontsize=10, weight="normal")
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
            axes.margins(x=0.02)
            axes.set_xlabel("environment steps")
        drawn_in[0].set_yscale("log")
        number = _number([curve.diagnosed for curve in curves], "agents")
        figure_title(figure, f"What an iteration does to the policy: {_place(curves[0])}, {number}")
        legend_below(figure, drawn_in[0].get_legend_handles_labels(), columns=4)
    return figure


def suite_scores(scores: "SuiteScores", suite: str) -> Figure:
    """Aggregate scores with intervals, and performance profiles, of objectives over a suite.

    Args:
      scores: of `lpo.suite.run_suite`.
      suite: its name, and what is left out of it.
    """
    style = looks(scores.objectives)
    thresholds = np.linspace(-0.1, 1.3, 141)
    profiles, aggregates = scores.profile(thresholds), scores.aggregate()
    with figure_style():
        figure = Figure(figsize=(WIDTH, 4.0))
        profile, aggregate = figure.subplots(1, 2, width_ratios=(2.0, 1))
        for i, name in enumerate(scores.objectives):
            look = replace(style[name], marker="")
            estimate_curve(profile, thresholds, profiles[i], look, name)
            estimate_row(aggregate, i, np.empty(0), aggregates[i], look.color)
        profile.set_xlabel("normalised score \u03c4 (0: random actions, 1: reference)")
        profile.set_ylabel("share of runs with a score above \u03c4")
        profile.set_ylim(0.0, 1.0)
        profile.set_title("Performance profiles: 95 % bands", fontsize=10, weight="normal")
        name_rows(aggregate, scores.objectives)
        aggregate.grid(axis="y", visible=False)
        aggregate.set_xlabel("normalised score")
        aggregate.set_title("Interquartile mean, 95 %", fontsize=10, weight="normal")
        environments, seeds = scores.scores.shape[1:]
        figure_title(figure, f"The suite {suite}: {environments} environments, {seeds} seeds each")
        profile.legend(
            loc="upper center", bbox_to_anchor=(0.5, -0.17), ncols=min(len(scores.objectives), 4)
        )
    return figure


def alignment_heatmap(report: Mapping[str, Any]) -> Figure:
    """Spearman's correlation of every regime's fitnesses with an environment's outcome.

    Args:
      report: of `lpo.alignment.measure_alignment`.
    """
    rows = report["regimes"]
    fitnesses = list(rows[0]["alignment"])
    labels = [regime_label(row, report["environment"]) for row in rows]
    # What is undefined is None, and becomes NaN.
    cells = [[row["alignment"][name] for name in fitnesses] for row in rows]
    values = np.array([[cell["spearman"] for cell in of_row] for of_row in cells], float)
    with figure_style():
        figure = Figure(figsize=(WIDTH, 1.6 + 0.42 * len(rows)))
        axes = figure.subplots()
        image = axes.imshow(values, cmap="RdBu", vmin=-1.0, vmax=1.0, aspect="auto")
        # Long names are broken, or they would take the room of the map.
        axes.set_xticks(range(len(fitnesses)), [textwrap.fill(name, 15) for name in fitnesses])
        axes.set_yticks(range(len(rows)), [textwrap.fill(name, 34) for name in labels])
        axes.grid(visible=False)
        axes.tick_params(length=0)
        for i, of_row in enumerate(cells):
            for j, cell in enumerate(of_row):
                text = correlation_text(cell).replace(" [", "\n[").replace(": ", ":\n")
                axes.text(
                    j,
                    i,
                    typeset(text),
                    ha="center",
                    va="center",
                    fontsize=8,
                    color="white" if abs(values[i, j]) > 0.6 else "black",
                )
        bar = figure.colorbar(image, ax=axes)
        bar.set_label("Spearman's correlation")
        number = len(report["outcome_iqm"])
        figure_title(
            figure,
            f"How fitness in the bandit ranks {number} objectives, against {report['environment']}\n"
            f"({report['agents']} agents each, 95 % intervals)",
        )
    return figure


def regime_label(row: Mapping[str, Any], environment: str) -> str:
    """A measured regime's name, which says the bandit wherever that is another environment's."""
    bandit = row["bandit"]
    if (bandit,) != MetaTrainingConfig.tasks or bandit == environment_spec(environment).bandit:
        return str(row["name"])
    rest = "" if row["name"] == "default" else f", {row['name']}"
    return f"bandit {bandit}{rest}"


def _final(axes: Axes, position: int, curve: "LearningCurves", look: Look) -> None:
    end = estimate(curve.final)
    # Seeds beside the estimate, spread evenly and in their order: the same picture every time.
    spread = np.linspace(0.2, 0.42, len(curve.seeds)) if len(curve.seeds) > 1 else [0.3]
    axes.plot(
        position + np.asarray(spread),
        curve.final,
        color=look.color,
        marker=".",
        markersize=4.5,
        alpha=0.55,
        linestyle="",
        markeredgewidth=0,
    )
    if end.low is not None and end.high is not None:
        axes.vlines(position, end.low, end.high, color=look.color, linewidth=2.2)
    axes.plot(position, end.value, color=look.color, marker=look.marker, markersize=6, linestyle="")


def _place(curve: "LearningCurves") -> str:
    physics = "" if curve.backend is None else f" ({curve.backend} physics)"
    words = {"policy_output_scale": "policy's last layer x"}
    named = {words.get(k, k): value for k, value in curve.hyperparameters.items()}
    values = "".join(f", {k}" if x is True else f", {k} {x}" for k, x in named.items())
    return f"{curve.environment}{physics}{values}"


def _protocol(curve: "LearningCurves") -> str:
    actions = "mode" if curve.mode_actions else "sampled"
    return f"{_place(curve)}: {actions} actions, {curve.episodes} episodes"


def _number(counts: Sequence[int], of: str) -> str:
    """How many there are: "1 seed", "n = 10 seeds", "n = 8 to 20 seeds"."""
    low, high = min(counts), max(counts)
    if (low, high) == (1, 1):
        return f"1 {of.removesuffix('s')}"
    return f"n = {low} {of}" if low == high else f"n = {low} to {high} {of}"
