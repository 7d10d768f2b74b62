"""What the bandits of classic control say about their environments: best actions, and what the reward depends on.

    python -m experiments.interpretability

`scb explain NAME` shows the same of any bandit.
"""

import sys
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import scb
from experiments.page import (
    ACTIONS,
    CLASSIC_CONTROL,
    Experiment,
    Save,
    packed,
    table,
    text,
    unpacked,
)
from experiments.page import main as run
from scb import plotting
from scb.analysis import figures
from scb.analysis.explain import explain
from scb.analysis.importance import reward_variance
from scb.analysis.planes import Plane
from scb.analysis.states import bandit_states
from scb.environments.registry import environment_spec
from scb.environments.zoo import bandit_metadata, open_bandit
from scb.keys import root_key, split_key
from scb.statistics import estimate

POINTS = 60  # of the grid of best actions, in either direction
# An entry that causes less than this share of the reward's variance is one that it hardly depends on.
HARDLY = 0.1


def measure(plan: Mapping[str, Any], report: dict[str, Any], save: Save) -> None:
    """Everything of an environment at a time."""
    for name in CLASSIC_CONTROL:
        if name not in report.setdefault("environments", {}):
            report["environments"][name] = _examine(name, plan)
            save()


def _examine(name: str, plan: Mapping[str, Any]) -> dict[str, Any]:

    bandit = open_bandit(environment_spec(name).bandit)
    env, env_params = scb.make(name)
    numbers, drawn = explain(bandit, env, env_params, name, plan["episodes"], plan["seed"])
    keys = split_key(root_key(plan["seed"] + 1), plan["repetitions"])
    shares = []
    for key in keys:
        key_contexts, key_vary = split_key(key)
        contexts = jnp.asarray(bandit_states(bandit, key_contexts, 2000))
        shares.append(np.asarray(reward_variance(bandit, contexts, key_vary)))
    plane = drawn["plane"]
    _, _, nodes = plane.grid(POINTS)
    actions = drawn["best"](nodes)
    return {
        "sha256": bandit_metadata(bandit.name)["sha256"],
        "return": numbers["return_of_optimal_policy"],
        "importance": {
            entry: estimate(column).as_dict()
            for entry, column in zip(drawn["names"], np.transpose(shares), strict=True)
        },
        "labels": list(plane.labels),
        "limits": [list(x) for x in plane.limits],
        "num_actions": drawn["num_actions"],
        "bounds": drawn["bounds"],
        "actions": packed(actions.reshape(POINTS, POINTS)),
        "episode": packed(plane.project(drawn["episode"])),
    }


def nothing_done(entry: Mapping[str, Any]) -> float:
    """The share of the plane where the best action of a mountain car is next to none."""
    actions = unpacked(entry["actions"])
    if entry["num_actions"]:
        return float(np.mean(actions == 1))  # of push left, nothing, push right
    return float(np.mean(np.abs(actions) < 0.1))


def _shares(report: Mapping[str, Any], environment: str) -> dict[str, float]:
    importance = report["environments"][environment]["importance"]
    return {name: x["value"] for name, x in importance.items()}


def parts(report: Mapping[str, Any]) -> list[bool]:
    """Of Acrobot's angles, CartPole's position and angle, and either mountain car."""
    x = _observed(report)
    return [
        x["angles"] < x["speeds"],
        max(x["position"], x["angle"]) < HARDLY,
        x["idle"] < 0.01,
        x["idle_continuous"] > 0.1,
    ]


def _observed(report: Mapping[str, Any]) -> dict[str, float]:
    acrobot, cart = _shares(report, "Acrobot-v1"), _shares(report, "CartPole-v1")
    return {
        "angles": max(x for name, x in acrobot.items() if "angle" in name),
        "speeds": min(x for name, x in acrobot.items() if "velocity" in name),
        "position": cart["position (m)"],
        "angle": cart["angle (rad)"],
        "idle": nothing_done(report["environments"]["MountainCar-v0"]),
        "idle_continuous": nothing_done(report["environments"]["MountainCarContinuous-v0"]),
    }


def verdict(report: Mapping[str, Any]) -> str:
    """Each of the paper's three observations, with its figures."""
    angles, speeds, position, angle, idle, idle_continuous = _observed(report).values()
    fewer_angles, both_hardly, never_idle, often_idle = parts(report)
    said = [
        f"Acrobot's reward depends less on its angles (no more than {angles:.0%} of the variance each) than on its "
        f"angular velocities (at least {speeds:.0%}): "
        + ("holds." if fewer_angles else "does not hold."),
        f"CartPole's position causes {position:.1%} and its angle {angle:.1%}: the near-invariance (less than "
        f"{HARDLY:.0%}) "
        + (
            "holds for both."
            if both_hardly
            else "holds for the position only."
            if position < HARDLY
            else "holds for the angle only."
            if angle < HARDLY
            else "does not hold in this bandit."
        ),
        f"MountainCar's best action is to do nothing in {idle:.1%} of the plane, and the continuous one's next to "
        f"nothing in {idle_continuous:.1%}: "
        + (
            "holds."
            if never_idle and often_idle
            else "the first half holds."
            if never_idle
            else "the second half holds."
            if often_idle
            else "does not hold."
        ),
    ]
    return " ".join(said)


def body(report: Mapping[str, Any]) -> list[str]:
    """The table."""
    rows = [
        [environment, entry, text(x, 2)]
        for environment, found in report["environments"].items()
        for entry, x in found["importance"].items()
    ]
    returns = "; ".join(
        f"{environment} {text(found['return'], 1)}"
        for environment, found in report["environments"].items()
    )
    return [
        "Top: the action with the largest reward, by trying all where they are discrete and by gradient ascent where "
        "they are continuous; the line is an episode of that policy in the environment. Where an observation has more "
        "than two entries, the two that matter most span the plane and the others are at their median (Pendulum: angle "
        "and angular velocity). Bottom: the share of the reward's variance that an entry of the observation causes "
        "when it alone takes other values (Sobol's total-effect index, each entry drawn from 2000 of the bandit's "
        "contexts apart from the others; several draws).",
        "",
        f"What the best-action policy earns in the environment, with no training at all: {returns}.",
        "",
        *table(["environment", "entry of the observation", "share of the reward's variance"], rows),
    ]


def draw(report: Mapping[str, Any]) -> Figure:
    """Best actions above, importance below, a column an environment."""

    with plotting.figure_style():
        figure = Figure(figsize=(15.0, 6.0))
        panels: Any = figure.subplots(2, len(CLASSIC_CONTROL), height_ratios=[1.6, 1.0])
        for column, (name, found) in enumerate(report["environments"].items()):
            top, bottom = panels[:, column]
            limits: Any = tuple(map(tuple, found["limits"]))
            # Already in the plane, both the actions and the episode.
            plane = Plane(tuple(found["labels"]), limits, lambda x: x, lambda x: x)
            drawn = figures.action_grid(
                top, plane, unpacked(found["actions"]), found["num_actions"], found["bounds"]
            )
            bar = figure.colorbar(drawn, ax=top, location="bottom", aspect=30)
            bar.set_label(f"best action: {ACTIONS[name]}", fontsize=8)
            if found["num_actions"]:
                bar.set_ticks(range(found["num_actions"]))
            figures.draw_trajectory(top, plane, unpacked(found["episode"]))
            top.set_title(name, fontsize=10)
            shares = [x["value"] for x in found["importance"].values()]
            intervals = [(x["low"], x["high"]) for x in found["importance"].values()]
            figures.importance_bars(bottom, list(found["importance"]), shares, intervals=intervals)
            bottom.tick_params(labelsize=8)
        plotting.figure_title(
            figure,
            "The bandits' best actions, with an episode in the environment (\u00d7 its end); what their rewards "
            "depend on (95 % intervals)",
        )
    return figure


EXPERIMENT = Experiment(
    name="interpretability",
    title="What a bandit says about its environment",
    paper="figure 6 and its section",
    claim="SCBs give insights into their environment: the reward hardly depends on Acrobot's angles (compared with its "
    "angular velocities), nor on CartPole's position and angle; MountainCar's bandit never does nothing, its "
    "continuous sibling's often does.",
    presets={
        "quick": {"episodes": 50, "repetitions": 5, "seed": 0},
        "paper": {"episodes": 200, "repetitions": 20, "seed": 0},
    },
    minutes={"quick": "1", "paper": "2"},
    measure=measure,
    parts=parts,
    verdict=verdict,
    body=body,
    draw=draw,
)


if __name__ == "__main__":
    sys.exit(run(EXPERIMENT))
