"""The states of an expert in its environment, and those that a bandit shows, over the best actions.

    python -m experiments state_distributions

The experts are those of `experiments.experts`, trained again.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from experiments import experts
from experiments.claims import Claim
from experiments.harness import Experiment
from experiments.interpretability import action_bar, draw_actions
from experiments.parts import by_environment
from experiments.reports import Report, bandit_of
from scb import plotting
from scb.analysis.components import ReplacedBandit, q_reward
from scb.analysis.optimal_actions import first_action, optimal_actions
from scb.analysis.planes import plane_for
from scb.analysis.states import bandit_states, follow
from scb.environments.synthetic import SyntheticBandit
from scb.files import packed, unpacked
from scb.keys import root_key, split_key
from scb.seeds import ILLUSTRATING
from scb.spaces import flat_bounds
from scb.statistics import Estimate, estimate

POINTS = 50  # of the grid of best actions, in either direction
CELLS = 20  # of the grid whose share of visited cells is the coverage
STATES = 2000
SEED = ILLUSTRATING[1_000]
BANDIT_COVERAGE, EXPERT_COVERAGE = "bandit's coverage", "expert's coverage"
OUTSIDE = "contexts off the plane"
BANDIT_ROUGHNESS, EXPERT_ROUGHNESS = "bandit's roughness", "expert's roughness"


def _examine(environment: str, plan: Mapping[str, Any]) -> dict[str, Any]:
    key_states, key_episodes, key_pick = split_key(root_key(SEED), 3)
    expert, env, env_params = experts.train(environment, plan["agents"], plan["selection_episodes"])
    bandit, digest = bandit_of(environment)
    space = env.action_space(env_params)
    contexts = bandit_states(bandit, key_states, STATES)
    episodes = follow(env, env_params, expert.policy(), key_episodes, plan["episodes"])
    visited = episodes.states()
    few = len(visited) < STATES
    visited = visited[np.asarray(jax.random.choice(key_pick, len(visited), (STATES,), replace=few))]
    low, high = flat_bounds(env.observation_space(env_params))
    plane = plane_for(
        environment,
        np.concatenate([contexts, visited]),
        None if visited.shape[1] <= 3 else np.asarray(plan["entries"][environment], float).tolist(),
        (np.asarray(low), np.asarray(high)),
    )
    _, _, nodes = plane.grid(POINTS)

    def best(rewarding: SyntheticBandit) -> list[str]:
        actions = jax.jit(jax.vmap(optimal_actions(rewarding, method="grid")))(jnp.asarray(nodes))
        # A map has one number a node: of several action dimensions the first.
        firsts = np.asarray(actions).reshape(POINTS * POINTS, -1)[:, 0]
        return packed(firsts.reshape(POINTS, POINTS))

    num_actions, bounds = first_action(space)
    return {
        "sha256": digest,
        "expert": round(float(episodes.returns().mean()), 2),
        "labels": list(plane.labels),
        "limits": [list(x) for x in plane.limits],
        "num_actions": num_actions,
        "bounds": None if bounds is None else list(bounds),
        "contexts": stored_points(plane.project(contexts), plane.limits),
        "visited": stored_points(plane.project(visited), plane.limits),
        "bandit_actions": best(bandit),
        "expert_actions": best(ReplacedBandit(bandit, q_reward(expert, space))),
    }


measure = by_environment(_examine)


def stored_points(points: np.ndarray, limits: Any) -> list[str]:
    """[N, 2] points as thousandths of the plane, 50 a line: four times smaller than a line each."""
    low, high = np.transpose(limits)
    thousandths = np.round((points - low) / (high - low) * 1000)
    return packed(thousandths.reshape(len(points) // 50, -1))


def points_of(lines: Sequence[str], limits: Any) -> np.ndarray:
    """[N, 2] what `stored_points` stored, to a thousandth of the plane."""
    low, high = np.transpose(limits)
    return np.asarray(low + unpacked(lines).reshape(-1, 2) / 1000 * (high - low))


def coverage(points: np.ndarray, limits: Any) -> float:
    """The share of a plane's `CELLS` x `CELLS` cells that the points visit."""
    counts, _, _ = np.histogram2d(points[:, 0], points[:, 1], CELLS, [list(x) for x in limits])
    return float(np.mean(counts > 0))


def roughness(actions: np.ndarray, num_actions: int | None, bounds: Any) -> float:
    """How much the best action changes from a cell of the grid to the next: the mean over neighbours.

    Discrete actions: the share of neighbours that differ; continuous: their distance, in units of the range.
    """
    changes = [np.diff(actions, axis=axis).ravel() for axis in (0, 1)]
    steps = np.abs(np.concatenate(changes))
    return float(np.mean(steps > 0 if num_actions else steps / (bounds[1] - bounds[0])))


def outside(points: np.ndarray, limits: Any) -> float:
    """The share of the points that lie off the plane, where no state of the environment is."""
    low, high = np.transpose(limits)
    return float(np.mean(np.any((points < low) | (points > high), axis=1)))


def summary(entry: Mapping[str, Any]) -> dict[str, float]:
    """Coverage of both distributions, contexts off the plane, and roughness of both best actions."""
    shape, limits = (entry["num_actions"], entry["bounds"]), entry["limits"]
    contexts, visited = (points_of(entry[name], limits) for name in ("contexts", "visited"))
    return {
        BANDIT_COVERAGE: coverage(contexts, limits),
        EXPERT_COVERAGE: coverage(visited, limits),
        OUTSIDE: outside(contexts, limits),
        BANDIT_ROUGHNESS: roughness(unpacked(entry["bandit_actions"]), *shape),
        EXPERT_ROUGHNESS: roughness(unpacked(entry["expert_actions"]), *shape),
    }


def claims(report: Report) -> list[Claim]:
    """The contexts cover more, and the actions are smoother.

    An environment has one bandit and one expert here, so environments are what the intervals draw.
    """
    found = [summary(x) for x in report["environments"].values()]

    def mean(of: str, minus: str) -> partial[Estimate]:
        return partial(estimate, [x[of] - x[minus] for x in found], statistic=np.mean)

    return [
        Claim(
            "contexts cover more of the plane than the expert's states, mean over environments",
            mean(BANDIT_COVERAGE, EXPERT_COVERAGE),
        ),
        Claim(
            "the bandit's best actions change less than the expert's, mean over environments",
            mean(EXPERT_ROUGHNESS, BANDIT_ROUGHNESS),
            places=3,
        ),
    ]


def facts(report: Report) -> dict[str, Any]:
    """The numbers of every environment."""
    found = {name: summary(x) for name, x in report["environments"].items()}
    wider = sum(x[BANDIT_COVERAGE] > x[EXPERT_COVERAGE] for x in found.values())
    smoother = sum(x[BANDIT_ROUGHNESS] < x[EXPERT_ROUGHNESS] for x in found.values())
    return {"found": found, "states": STATES, "wider": wider, "smoother": smoother}


def draw(report: Mapping[str, Any]) -> Figure:
    """A row an environment: the expert on the left, the bandit on the right."""
    rows = len(report["environments"])
    figure = Figure(figsize=(plotting.WIDTH, 0.6 + 2.7 * rows))
    panels: Any = figure.subplots(rows, 2, squeeze=False)
    for (left, right), (name, entry) in zip(panels, report["environments"].items(), strict=True):
        for axes, states, actions, whose in (
            (left, "visited", "expert_actions", "expert"),
            (right, "contexts", "bandit_actions", "bandit"),
        ):
            _, drawn = draw_actions(axes, entry, actions)
            points = points_of(entry[states], entry["limits"])
            # A white edge, for black is hard to see on the dark ends of the background.
            axes.scatter(*points.T, s=6, color=plotting.BLACK, edgecolors="white", linewidths=0.3)
            axes.set_title(f"{name}: {whose}", fontsize=9)
        action_bar(figure, right, drawn, name)
    plotting.figure_title(
        figure,
        f"{STATES} states of an expert in the environment and of the bandit, over the best actions",
    )
    return figure


EXPERIMENT = Experiment.of_the_paper("state_distributions", measure, draw, claims, facts=facts)
