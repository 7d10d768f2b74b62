"""What the bandits of classic control say about their environments: best actions, and what the reward depends on.

    python -m experiments interpretability

`scb explain NAME` shows the same of any bandit.
"""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.claims import Claim
from experiments.harness import CLASSIC_CONTROL, Experiment
from experiments.parts import InParts, Part
from experiments.reports import Report, bandit_of
from scb import plotting
from scb.analysis import figures
from scb.analysis.explain import explain
from scb.analysis.importance import reward_variance
from scb.analysis.planes import Plane
from scb.analysis.states import bandit_states
from scb.files import packed, unpacked
from scb.keys import root_key, split_key
from scb.measurement import Place
from scb.statistics import Estimate, estimate

# What the actions of each are, and what discrete ones are called.
ACTIONS: dict[str, tuple[str, tuple[str, ...]]] = {
    "Acrobot-v1": ("torque on joint 2", ("\u22121", "0", "1")),
    "CartPole-v1": ("push", ("left", "right")),
    "MountainCar-v0": ("push", ("left", "none", "right")),
    "MountainCarContinuous-v0": ("force (of its maximum)", ()),
    "Pendulum-v1": ("torque (N m)", ()),
}
POINTS = 60  # of the grid of best actions, in either direction
# An entry that causes less than this share of the reward's variance is one that it hardly depends on.
HARDLY = 0.1
# Of the plane, what is never and what often; and of the force, what is none.
NEVER, OFTEN, NOTHING = 0.01, 0.1, 0.1


def parts(plan: Mapping[str, Any], report: dict[str, Any]) -> Iterator[Part]:
    """Environments."""
    for name in CLASSIC_CONTROL:
        yield Part(("environments", name), partial(_examine, name, plan))


measure = InParts(parts)


def _examine(name: str, plan: Mapping[str, Any]) -> dict[str, Any]:
    bandit, digest = bandit_of(name)
    numbers, drawn = explain(bandit, Place.named(name), plan["episodes"], plan["seed"])
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
        "sha256": digest,
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
    return float(np.mean(np.abs(actions) < NOTHING))


def claims(report: Report) -> list[Claim]:
    """Of Acrobot's angles, CartPole's position and angle, and either mountain car."""
    environments = report["environments"]

    def shares(environment: str, kind: str) -> list[dict[str, Any]]:
        return [x for name, x in environments[environment]["importance"].items() if kind in name]

    def extreme(kind: str, pick: Callable[..., float]) -> list[float]:
        found = shares("Acrobot-v1", kind)
        return [float(pick(x[end] for x in found)) for end in ("value", "low", "high")]

    # The widest interval that those of the entries allow.
    speed, angle = extreme("velocity", min), extreme("angle", max)
    more = Estimate(speed[0] - angle[0], speed[1] - angle[2], speed[2] - angle[1], 0)
    found = [
        Claim(
            "each of Acrobot's angular velocities causes more of the reward's variance than any entry of its angles",
            more,
        )
    ]
    for kind in ("position", "angle"):
        (x,) = shares("CartPole-v1", f"{kind} (")
        # Of the share, negated: it must lie below.
        share = Estimate(-x["value"], -x["high"], -x["low"], x["n"])
        found.append(
            Claim(
                f"CartPole's {kind} causes less than {HARDLY:.0%} (the share, negated)",
                share,
                -HARDLY,
                places=3,
            )
        )
    never = nothing_done(environments["MountainCar-v0"]) < NEVER
    often = nothing_done(environments["MountainCarContinuous-v0"]) > OFTEN
    return [
        *found,
        Claim(f"MountainCar's bandit does nothing in less than {NEVER:.0%} of the plane", never),
        Claim(
            f"its continuous sibling's does, with less than {NOTHING:.0%} of the force, in more than {OFTEN:.0%}",
            often,
        ),
    ]


def facts(report: Report) -> dict[str, Any]:
    """What the claims are about, in numbers."""
    found = report["environments"]
    shares = {
        name: {k: x["value"] for k, x in e["importance"].items()} for name, e in found.items()
    }
    acrobot, cart = shares["Acrobot-v1"], shares["CartPole-v1"]
    return {
        "most": max(
            ((name, x) for name, x in acrobot.items() if "velocity" in name), key=lambda x: x[1]
        ),
        "angles": max(x for name, x in acrobot.items() if "angle" in name),
        "speeds": min(x for name, x in acrobot.items() if "velocity" in name),
        "position": cart["position (m)"],
        "angle": cart["angle (rad)"],
        "idle": [nothing_done(found[x]) for x in ("MountainCar-v0", "MountainCarContinuous-v0")],
    }


def draw_actions(axes: Axes, entry: Mapping[str, Any], actions: str) -> tuple[Plane, Any]:
    """Best actions of a report over their plane, and what their colour bar is made from."""
    limits: Any = tuple(map(tuple, entry["limits"]))
    # Whatever a report holds is in the plane already.
    plane = Plane(tuple(entry["labels"]), limits, lambda x: x, lambda x: x)
    space = entry["num_actions"], entry["bounds"]
    return plane, figures.action_grid(axes, plane, unpacked(entry[actions]), *space)


def action_bar(figure: Figure, axes: Axes, drawn: Any, environment: str) -> None:
    """The colour bar beside a map of best actions."""
    bar, (action, names) = figure.colorbar(drawn, ax=axes, aspect=30), ACTIONS[environment]
    bar.set_label(f"best action: {action}", fontsize=8)
    if names:
        bar.set_ticks(range(len(names)), labels=names)


def draw(report: Mapping[str, Any]) -> Figure:
    """Best actions on the left, importance on the right, a row an environment."""
    rows = len(report["environments"])
    figure = Figure(figsize=(plotting.WIDTH, 0.6 + 2.7 * rows))
    panels: Any = figure.subplots(rows, 2, squeeze=False)
    for (left, right), (name, found) in zip(panels, report["environments"].items(), strict=True):
        plane, drawn = draw_actions(left, found, "actions")
        action_bar(figure, left, drawn, name)
        figures.draw_trajectory(left, plane, unpacked(found["episode"]))
        left.set_title(name, fontsize=10)
        shares = [x["value"] for x in found["importance"].values()]
        intervals = [(x["low"], x["high"]) for x in found["importance"].values()]
        figures.importance_bars(right, list(found["importance"]), shares, intervals=intervals)
        right.tick_params(labelsize=8)
    plotting.figure_title(
        figure,
        "The bandits' best actions, with an episode in the environment (\u00d7 its end), and what their "
        "rewards depend on (95 % intervals)",
    )
    return figure


EXPERIMENT = Experiment.of_the_paper("interpretability", measure, draw, claims, facts=facts)
