"""The page and the figure of `experiments.zoo_table`, and what the paper states beside it."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from experiments.harness import plan_of
from experiments.rendering import either
from scb import plotting
from scb.agents.spec import ALGORITHMS
from scb.environments.registry import environment_spec
from scb.errors import UserError
from scb.statistics import Estimate, normalized_score, stratified_estimate

ACTIONS = {"mode_actions": "most likely actions", "sampled_actions": "sampled actions"}
BANDITS = ("ours", "published")
_PLAN = plan_of("zoo_table")
ENVIRONMENTS: list[str] = _PLAN["environments"]
TARGETS: dict[str, float] = _PLAN["targets"]
PAPER: dict[str, dict[str, float]] = _PLAN["paper"]


def pairs(
    entries: Sequence[Mapping[str, Any]],
) -> dict[tuple[str, str], dict[str, Mapping[str, Any]]]:
    """{(label, algorithm): {"ours": entry, "published": entry}}, in the table's order."""
    found: dict[tuple[str, str], dict[str, Mapping[str, Any]]] = {}
    for entry in sorted(entries, key=place):
        found.setdefault((_label(entry), entry["algorithm"]), {})[entry["bandit"]] = entry
    return found


def label(environment: str, backend: str | None) -> str:
    """The environment, and for Brax its physics: one bandit can be measured in several."""
    return environment if backend is None else f"{environment} ({backend})"


def of_label(name: str) -> tuple[str, str | None]:
    """(environment, backend) of a label."""
    environment, _, backend = name.removesuffix(")").partition(" (")
    return environment, backend or None


def _label(entry: Mapping[str, Any]) -> str:
    return label(entry["environment"], entry.get("backend"))


def rank(name: str, known: Sequence[str] = ENVIRONMENTS) -> tuple[int, str]:
    """The place of an environment in this order; what it doesn't hold (any more) comes last."""
    return (known.index(name) if name in known else len(known), name)


def place(entry: Mapping[str, Any]) -> tuple[Any, ...]:
    """An entry's place in the table: by environment, physics, bandit and algorithm."""
    return (
        rank(entry["environment"]),
        entry["backend"] or "",
        BANDITS.index(entry["bandit"]),
        rank(entry["algorithm"], list(ALGORITHMS)),
    )


def facts(report: Mapping[str, Any]) -> dict[str, Any]:
    """The table's rows, and what must be said of its entries."""
    entries = report["entries"]
    published = [x["backend"] for x in entries if x["bandit"] == "published"]
    return {
        "pairs": pairs(entries),
        "actions": ACTIONS,
        "bandits": BANDITS,
        "paper": _paper,
        "target": _target,
        "failed": [
            f"{x['algorithm'].upper()} on {_label(x)} ({x['bandit']}, {text}): {x[actions]['failed']} of {x['agents']}"
            for x in entries
            for actions, text in ACTIONS.items()
            if x[actions]["failed"]
        ],
        "scores": brax_scores(entries),
        "expert": _best_of_the_paper,
        "both": BOTH,
        "published": bool(published),
        "moved": any(x not in (None, "generalized") for x in published),
    }


def _paper(pair: Mapping[str, Mapping[str, Any]]) -> float | None:
    """What the paper states of its bandit, which is of the generalized physics."""
    entry = next(iter(pair.values()))
    stated = PAPER if entry["backend"] in (None, "generalized") else {}
    return stated.get(entry["environment"], {}).get(entry["algorithm"])


def _target(pair: Mapping[str, Mapping[str, Any]]) -> tuple[float | None, list[str]]:
    """The target of a pair's environment, and by kind of actions whether ours reaches it."""
    target = TARGETS.get(next(iter(pair.values()))["environment"])
    if target is None or "ours" not in pair:
        return target, []
    iqms = (pair["ours"][actions]["iqm"] for actions in ACTIONS)
    return target, ["yes" if iqm and iqm["value"] >= target else "no" for iqm in iqms]


def returns_of(entry: Mapping[str, Any], actions: str) -> list[float]:
    """Every agent's return; one without a finite return counts as random actions."""
    agents = entry[actions]["agents"]
    if None not in agents:
        return list(agents)
    random = environment_spec(entry["environment"]).random_return(entry["backend"])
    return [random if r is None else r for r in agents]


BOTH = "all that have both"


def brax_scores(entries: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Estimate]]:
    """{environment: {"ours": score, "published": score}} over all algorithms, on the physics of the paper.

    Of most likely actions. A score is 0 for random actions and 1 for the best of the agents that the paper trained in
    the environment itself. `BOTH` is over the environments that have a bandit of either kind.
    """
    groups: dict[str, dict[str, list[Any]]] = {}
    actions = "mode_actions"
    for entry in sorted(entries, key=place):
        name = entry["environment"]
        expert = _best_of_the_paper(name)
        if entry["backend"] != "generalized" or expert is None:
            continue
        random = environment_spec(name).random_return(entry["backend"])
        score = normalized_score(returns_of(entry, actions), random, expert)
        groups.setdefault(name, {}).setdefault(entry["bandit"], []).append(score)
    both = [kinds for kinds in groups.values() if len(kinds) == len(BANDITS)]
    if both:
        groups[BOTH] = {kind: [x for kinds in both for x in kinds[kind]] for kind in BANDITS}
    return {
        name: {kind: stratified_estimate(x) for kind, x in kinds.items()}
        for name, kinds in groups.items()
    }


def _best_of_the_paper(environment: str) -> float | None:
    """What the best of the paper's agents earn that were trained in a Brax environment itself."""
    stated = [paper_return(environment, algorithm, "generalized") for algorithm in ALGORITHMS]
    return max((x for x in stated if x is not None), default=None)


def figures(report: Mapping[str, Any]) -> dict[str, Figure]:
    """{file: figure}: returns, and where Brax was measured its scores."""
    drawn = {"zoo_table": figure(report)}
    scores = brax_scores(report["entries"])
    if scores:
        drawn["zoo_table_brax"] = brax_figure(scores)
    return drawn


def brax_figure(scores: Mapping[str, Mapping[str, Estimate]]) -> Figure:
    """The paper's figure 1 (2): a line an environment, ours above the published."""
    drawn = Figure(figsize=(plotting.WIDTH, 1.3 + 0.4 * len(scores)))
    axes = drawn.subplots()
    for position, found in enumerate(scores.values()):
        if position % 2 == 0:
            axes.axhspan(position - 0.5, position + 0.5, color="#F4F4F4", linewidth=0)
        for (kind, color), offset in zip(_COLORS.items(), (-0.15, 0.15), strict=True):
            if kind in found:
                plotting.estimate_row(axes, position + offset, np.array([]), found[kind], color)
    axes.axvline(1.0, **_EXPERT)
    axes.set_yticks(range(len(scores)), list(scores))
    axes.set_ylim(len(scores) - 0.5, -0.5)
    axes.set_xlim(left=0.0)
    axes.grid(axis="y", visible=False)
    axes.set_xlabel("score: 0 random actions, 1 the paper's best agents trained in the environment")
    plotting.figure_title(drawn, "Agents of four algorithms, trained in Brax bandits: mean of IQMs")
    shown = {kind: {"color": color, "marker": "o"} for kind, color in _COLORS.items()}
    plotting.legend_of(drawn, shown, columns=2)
    return drawn


def figure(report: Mapping[str, Any]) -> Figure:
    """One panel an environment: every algorithm's interquartile mean and interval, ours and published."""
    entries = report["entries"]
    if not entries:
        raise UserError("nothing has been measured yet: there is no figure to draw.")
    found = pairs(entries)
    environments = list(dict.fromkeys(environment for environment, _ in found))
    looks = {
        (kind, actions): {
            "color": color,
            "marker": marker,
            "markerfacecolor": color if actions == "mode_actions" else "white",
            "markeredgewidth": 1.4,
        }
        for (kind, color), marker in zip(_COLORS.items(), "os", strict=True)
        for actions in ACTIONS
    }
    experts = {x: value for x in environments if (value := _paper_expert(x)) is not None}
    columns = min(2, len(environments))
    rows = math.ceil(len(environments) / columns)
    drawn = Figure(figsize=(plotting.WIDTH, 2.1 * rows + 1.1))
    grid = drawn.subplots(rows, columns, squeeze=False).flat
    for panel, (axes, environment) in enumerate(zip(grid, environments, strict=False)):
        algorithms = [a for e, a in found if e == environment]
        for position, algorithm in enumerate(algorithms):
            if position % 2 == 0:
                axes.axhspan(position - 0.5, position + 0.5, color="#F4F4F4", linewidth=0)
            for ((kind, actions), look), offset in zip(
                looks.items(), (-0.3, -0.1, 0.1, 0.3), strict=True
            ):
                iqm = found[environment, algorithm].get(kind, {}).get(actions, {}).get("iqm")
                if iqm is None:
                    continue
                y = position + offset
                if iqm["low"] is not None and iqm["high"] is not None:
                    axes.hlines(y, iqm["low"], iqm["high"], color=look["color"], linewidth=1.6)
                axes.plot(iqm["value"], y, **look, markersize=6, linestyle="")
        if environment in experts:
            axes.axvline(experts[environment], **_EXPERT)
        axes.set_yticks(range(len(algorithms)), [a.upper() for a in algorithms])
        axes.set_ylim(len(algorithms) - 0.5, -0.5)
        axes.tick_params(axis="y", length=0)
        axes.grid(axis="y", visible=False)
        axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))
        axes.margins(x=0.06)
        axes.set_title(_panel_title(environment, entries))
        if panel + columns >= len(environments):  # nothing below it
            axes.set_xlabel("return in the environment")
    for axes in drawn.axes[len(environments) :]:
        axes.remove()
    measured = {entry["bandit"] for entry in entries}
    shown = {
        f"{kind}, {ACTIONS[actions]}": {**look, "linewidth": 1.6}
        for (kind, actions), look in looks.items()
        if kind in measured
    }
    if experts:
        shown["SAC trained on the environment (paper)"] = _EXPERT
    agents = either(entry["agents"] for entry in entries)
    plotting.figure_title(
        drawn,
        f"Agents trained in a bandit, in its environment: IQM of {agents} agents, 95 % intervals",
    )
    plotting.legend_of(drawn, shown, columns=3)
    return drawn


_COLORS = dict(zip(BANDITS, (plotting.VERMILLION, plotting.BLUE), strict=True))
_EXPERT: dict[str, Any] = {"color": plotting.BLACK, "linewidth": 1.4, "linestyle": ":"}


def _paper_expert(name: str) -> float | None:
    """What the paper's SAC agents earn in the environment itself, by label."""
    environment, backend = of_label(name)
    return paper_return(environment, "sac", backend)


def paper_return(environment: str, algorithm: str, backend: str | None = None) -> float | None:
    """What the paper's agents earn that were trained in the environment itself."""
    found = environment_spec(environment).reference(backend, algorithm)
    return None if found is None else found.value


def _panel_title(environment: str, entries: Sequence[Mapping[str, Any]]) -> str:
    of_it = [entry for entry in entries if _label(entry) == environment]
    if of_it[0]["backend"] is None:
        return environment
    episodes = either(entry["episodes"] for entry in of_it)
    return f"{environment.removesuffix(')')}, {episodes} episodes)"
