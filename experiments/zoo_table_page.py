"""The page and the figure of `experiments.zoo_table`, and what the paper states beside it."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from scb import plotting
from scb.agents.spec import ALGORITHMS
from scb.environments.registry import environment_spec
from scb.errors import UserError
from scb.statistics import Estimate

ACTIONS = {"mode_actions": "most likely actions", "sampled_actions": "sampled actions"}
BANDITS = ("ours", "published")
# Classic control, then Brax by cost. An environment that isn't here comes after these.
ENVIRONMENTS = (
    "CartPole-v1",
    "Acrobot-v1",
    "MountainCar-v0",
    "MountainCarContinuous-v0",
    "Pendulum-v1",
    "hopper",
    "walker2d",
    "swimmer",
    "halfcheetah",
    "humanoidstandup",
)

# The return that a bandit of this project is meant to train agents to.
TARGETS = {
    "CartPole-v1": 500.0,
    "Acrobot-v1": -82.0,
    "MountainCar-v0": -130.0,
    "MountainCarContinuous-v0": 92.0,
    "Pendulum-v1": -170.0,
}

# Liesen et al. (2024): returns of agents trained in the published bandits, as the paper states them
# (IQM of 20 agents, 50 episodes; classic control's table, and the columns SCB of Brax's).
PAPER: dict[str, dict[str, float]] = {
    "CartPole-v1": {"ppo": 500.0, "sac": 500.0, "dqn": 500.0},
    "Acrobot-v1": {"ppo": -84.1, "sac": -85.3, "dqn": -82.6},
    "MountainCar-v0": {"ppo": -181.8, "sac": -170.1, "dqn": -118.4},
    "MountainCarContinuous-v0": {"ppo": 66.9, "sac": 91.1, "ddpg": 97.6, "td3": 97.5},
    "Pendulum-v1": {"ppo": -205.4, "sac": -188.3, "ddpg": -164.3, "td3": -168.5},
    "hopper": {"ppo": 853.5, "sac": 2738.8, "ddpg": 3012.4, "td3": 2985.3},
    "walker2d": {"ppo": 858.3, "sac": 1323.1, "ddpg": 1304.3, "td3": 1321.8},
    "swimmer": {"ppo": 348.5, "sac": 361.6, "ddpg": 365.1, "td3": 365.4},
    "halfcheetah": {"ppo": 1657.4, "sac": 5810.4, "ddpg": 6162.4, "td3": 6555.8},
    "humanoidstandup": {"ppo": 13356.1, "sac": 21105.2, "ddpg": 21039.0, "td3": 20372.0},
}


def pairs(
    entries: Sequence[Mapping[str, Any]],
) -> dict[tuple[str, str], dict[str, Mapping[str, Any]]]:
    """{(label, algorithm): {"ours": entry, "published": entry}}, in the table's order."""
    found: dict[tuple[str, str], dict[str, Mapping[str, Any]]] = {}
    for entry in sorted(entries, key=place):
        found.setdefault((label(entry), entry["algorithm"]), {})[entry["bandit"]] = entry
    return found


def label(entry: Mapping[str, Any]) -> str:
    """The environment, and for Brax its physics: one bandit can be measured in several."""
    physics = entry.get("backend")
    return f"{entry['environment']} ({physics})" if physics else entry["environment"]


def environment_rank(name: str) -> tuple[int, str]:
    return (ENVIRONMENTS.index(name) if name in ENVIRONMENTS else len(ENVIRONMENTS), name)


def algorithm_rank(name: str) -> tuple[int, str]:
    """In the registry's order, and what it doesn't hold (any more) after that."""
    names = list(ALGORITHMS)
    return (names.index(name) if name in names else len(names), name)


def place(entry: Mapping[str, Any]) -> tuple[Any, ...]:
    return (
        environment_rank(entry["environment"]),
        entry["backend"] or "",
        BANDITS.index(entry["bandit"]),
        algorithm_rank(entry["algorithm"]),
    )


def facts(report: Mapping[str, Any]) -> dict[str, Any]:
    """The table's rows, and what must be said of its entries."""
    entries = report["entries"]
    rows = []
    for (name, algorithm), pair in pairs(entries).items():
        entry = next(iter(pair.values()))
        environment = entry["environment"]
        # What the paper states is of the generalized physics.
        stated = PAPER if entry["backend"] in (None, "generalized") else {}
        paper = stated.get(environment, {}).get(algorithm)
        rows.append(
            [
                name,
                algorithm.upper(),
                *(
                    cell(pair[kind][actions]["iqm"]) if kind in pair else ""
                    for kind in BANDITS
                    for actions in ACTIONS
                ),
                "" if paper is None else _number(paper),
                _target_cell(environment, pair.get("ours")),
            ]
        )
    failed = [
        f"{entry['algorithm'].upper()} on {label(entry)} ({entry['bandit']}, {ACTIONS[actions]}): "
        f"{entry[actions]['failed']} of {entry['agents']}"
        for entry in entries
        for actions in ACTIONS
        if entry[actions]["failed"]
    ]
    differences = [
        [row["environment"], row["algorithm"].upper()]
        + [cell(row.get(actions), signed=True) for actions in ACTIONS]
        for row in report["differences"]
    ]
    kinds = {entry["bandit"] for entry in entries}
    moved = any(
        x["bandit"] == "published" and x["backend"] not in (None, "generalized") for x in entries
    )
    return {
        "protocol": _protocol_text(entries),
        "rows": rows,
        "failed": failed,
        "against": differences,
        "published": "published" in kinds,
        "moved": moved,
    }


def _protocol_text(entries: Sequence[Mapping[str, Any]]) -> str:
    """The protocol as the entries have it, in one sentence or two."""

    def values(field: str, among: Iterable[Mapping[str, Any]]) -> str:
        return " or ".join(f"{x:,}".replace(",", " ") for x in sorted({e[field] for e in among}))

    brax = [entry for entry in entries if entry["backend"] is not None]
    classic = [entry for entry in entries if entry["backend"] is None]
    text = (
        f"{values('agents', entries)} agents, trained for {values('training_steps', entries)} steps in the bandit; "
        f"reporting seed {values('seed', entries)}."
    )
    if classic:
        text += (
            " Classic control: hyperparameters drawn from the paper's lists, "
            f"{values('episodes', classic)} episodes an agent."
        )
    if brax:
        physics = " or ".join(sorted({entry["backend"] for entry in brax}))
        text += (
            f" Brax ({physics} physics): the paper's fixed hyperparameters, "
            f"{values('episodes', brax)} episodes an agent."
        )
    return text


def cell(interval: Mapping[str, Any] | None, signed: bool = False) -> str:
    """An estimate as the documentation writes it: −194.2 [−262.8, −167.9]."""
    if interval is None:
        return "none"
    text = str(Estimate(**interval)).rsplit(" (n=", 1)[0].replace("-", "−")
    return f"+{text}" if signed and interval["value"] > 0 else text


def _number(x: float) -> str:
    return f"{x:g}".replace("-", "−")


def reached(environment: str, entry: Mapping[str, Any]) -> dict[str, bool]:
    """{actions: whether the interquartile mean is at the environment's target or above}."""
    iqms = {actions: entry[actions]["iqm"] for actions in ACTIONS}
    return {
        actions: iqm is not None and iqm["value"] >= TARGETS[environment]
        for actions, iqm in iqms.items()
    }


def _target_cell(environment: str, ours: Mapping[str, Any] | None) -> str:
    if environment not in TARGETS:
        return ""
    target = _number(TARGETS[environment])
    if ours is None:
        return target
    answers = ["yes" if answer else "no" for answer in reached(environment, ours).values()]
    return f"{target}: {' / '.join(answers)}"


def figure(report: Mapping[str, Any]) -> Figure:
    """One panel an environment: every algorithm's interquartile mean and interval, ours and published."""
    entries = report["entries"]
    if not entries:
        raise UserError("nothing has been measured yet: there is no figure to draw.")
    found = pairs(entries)
    environments = list(dict.fromkeys(environment for environment, _ in found))
    looks = {"ours": (plotting.VERMILLION, "o"), "published": (plotting.BLUE, "s")}
    offsets = {
        (kind, actions): offset
        for (kind, actions), offset in zip(
            [(kind, actions) for kind in BANDITS for actions in ACTIONS],
            (-0.3, -0.1, 0.1, 0.3),
            strict=True,
        )
    }
    columns = min(2, len(environments))
    rows = math.ceil(len(environments) / columns)
    with plotting.figure_style():
        drawn = Figure(figsize=(plotting.WIDTH, 2.1 * rows + 1.1))
        grid = drawn.subplots(rows, columns, squeeze=False).flat
        for panel, (axes, environment) in enumerate(zip(grid, environments, strict=False)):
            algorithms = [a for e, a in found if e == environment]
            for position, algorithm in enumerate(algorithms):
                if position % 2 == 0:
                    axes.axhspan(position - 0.5, position + 0.5, color="#F4F4F4", linewidth=0)
                for (kind, actions), offset in offsets.items():
                    entry = found[environment, algorithm].get(kind)
                    if entry is None or entry[actions]["iqm"] is None:
                        continue
                    iqm, (color, marker) = entry[actions]["iqm"], looks[kind]
                    y = position + offset
                    if iqm["low"] is not None and iqm["high"] is not None:
                        axes.hlines(y, iqm["low"], iqm["high"], color=color, linewidth=1.6)
                    axes.plot(
                        iqm["value"],
                        y,
                        color=color,
                        marker=marker,
                        markerfacecolor=color if actions == "mode_actions" else "white",
                        markeredgewidth=1.4,
                        markersize=6,
                        linestyle="",
                    )
            expert = _paper_expert(environment)
            if expert is not None:
                axes.axvline(expert, color=plotting.BLACK, linewidth=1.4, linestyle=":")
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
        kinds = [kind for kind in BANDITS if any(e["bandit"] == kind for e in entries)]
        handles = [
            Line2D(
                [],
                [],
                color=looks[kind][0],
                marker=looks[kind][1],
                markerfacecolor=looks[kind][0] if actions == "mode_actions" else "white",
                markeredgewidth=1.4,
                linewidth=1.6,
            )
            for kind in kinds
            for actions in ACTIONS
        ]
        names = [f"{kind}, {text}" for kind in kinds for text in ACTIONS.values()]
        if any(_paper_expert(environment) is not None for environment in environments):
            handles.append(Line2D([], [], color=plotting.BLACK, linewidth=1.4, linestyle=":"))
            names.append("SAC trained on the environment (paper)")
        agents = " or ".join(str(n) for n in sorted({entry["agents"] for entry in entries}))
        plotting.figure_title(
            drawn,
            f"Agents trained in a bandit, in its environment: IQM of {agents} agents, 95 % intervals",
        )
        plotting.legend_below(drawn, (handles, names), columns=3)
    return drawn


def _paper_expert(name: str) -> float | None:
    """What the paper's SAC agents earn in the environment itself, by label."""
    environment, _, physics = name.removesuffix(")").partition(" (")
    expert = environment_spec(environment).reference(physics or None, "sac")
    return None if expert is None else expert.value


def _panel_title(environment: str, entries: Sequence[Mapping[str, Any]]) -> str:
    of_it = [entry for entry in entries if label(entry) == environment]
    if of_it[0]["backend"] is None:
        return environment
    episodes = " or ".join(str(n) for n in sorted({entry["episodes"] for entry in of_it}))
    return f"{environment.removesuffix(')')}, {episodes} episodes)"
