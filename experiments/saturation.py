"""How agents of PPO act that learned from a bandit: within the actions' range, or beyond its ends, where errors vanish.

    python -m experiments saturation --published DIRECTORY

PPO's Gaussian has a mean of any size, and the environment clips the action. Agents train in a bandit; in states that
they visit in its environment, this takes the mean that each of them would act by, and asks how far agents are from
each other before and after the clip, and how many directions what they all do has.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from experiments.harness import Experiment, Report, finite, forget_other, packed, settled, unpacked
from experiments.parts import InParts, Part
from experiments.zoo_table import Candidate, bandits
from experiments.zoo_table_page import BANDITS
from scb import plotting
from scb.agents.spec import bandit_agent
from scb.aggregation import Learners
from scb.environments.registry import environment_spec
from scb.errors import at_least, one_of
from scb.importer import PUBLISHED_BANDITS
from scb.keys import named_key, root_key
from scb.measurement import Place
from scb.statistics import estimate

BACKEND = "generalized"
SEED = 1  # nothing is chosen by it
STATES = 2048
CLIPPING = {
    "apart": (plotting.VERMILLION, "what they would do"),
    "clipped": (plotting.BLUE, "after the clip at the ends of the range"),
}
OF_AGENTS = ("beyond", "apart", "clipped", "returns")  # what a report has of every agent


@dataclass(frozen=True)
class Options:
    """Which bandits, and how many agents."""

    environments: tuple[str, ...] = ("hopper", "walker2d", "halfcheetah")
    """of Brax"""
    published: Path | None = None
    """folder with the published bandits' .npz files"""
    agents: int = 24
    """of PPO in every bandit"""
    episodes: int = 2
    """of each agent"""

    def __post_init__(self) -> None:
        at_least(2, self, "agents")
        at_least(1, self, "episodes")
        for name in self.environments:
            one_of("environment of a published bandit", name, PUBLISHED_BANDITS.values())


def spread(means: np.ndarray) -> dict[str, Any]:
    """What [N, S, A] means of N agents in the same S states are like, in halves of the actions' range.

    Returns:
      beyond: [N] share of an agent's means that lie beyond the ends of the range.
      apart: [N] root mean square distance of its means to those of all, and `clipped`: of its actions.
      directions: of what all agents do, the mean of the clipped actions, how many the variance over states has
        (its participation ratio, (sum of eigenvalues)^2 / sum of their squares).
      diverged: agents whose means are no numbers, which are in none of these.
    """
    acts = np.isfinite(means).all(axis=(1, 2))
    means = means[acts]
    actions = np.clip(means, -1, 1)
    together = actions.mean(axis=0)
    variances = np.linalg.svd(together - together.mean(axis=0), compute_uv=False) ** 2
    return {
        "beyond": (np.abs(means) > 1).mean(axis=(1, 2)),
        "apart": np.sqrt(((means - means.mean(axis=0)) ** 2).mean(axis=(1, 2))),
        "clipped": np.sqrt(((actions - together) ** 2).mean(axis=(1, 2))),
        "diverged": int(np.sum(~acts)),
        "directions": round(float(variances.sum() ** 2 / (variances**2).sum()), 4),
    }


def measured(candidate: Candidate, options: Options) -> dict[str, Any]:
    """What agents earn, and how they act in states that they visit."""
    bandit, place = candidate.bandit, Place.named(candidate.environment, BACKEND)
    specs = {"ppo": bandit_agent("ppo", candidate.environment)}
    learners = Learners(bandit, specs, place, options.agents, options.episodes)
    weights, key = bandit.default_params.weights, named_key(root_key(SEED), "saturation")
    _, learned = learners(weights, key)
    visited = learners.visits(weights, learned).observation
    visited = jnp.reshape(visited, (-1, visited.shape[-1]))
    states = visited[jax.random.choice(named_key(key, "states"), len(visited), (STATES,))]
    agent, params = learners.agents["ppo"], bandit.params(weights)
    space = place.env.action_space(place.params)

    @jax.jit
    @jax.vmap
    def means(state: Any) -> jax.Array:
        return jax.vmap(lambda o: agent.choose(state, o, key, params, mode=True))(states)

    low, high = np.asarray(space.low), np.asarray(space.high)
    shares = (np.asarray(means(learned["ppo"].states)) - (low + high) / 2) / ((high - low) / 2)
    random = environment_spec(candidate.environment).random_return(BACKEND)
    returns, _ = finite(learned["ppo"].returns, random)
    found = {**spread(shares), "returns": returns}
    found |= {name: packed([found[name]])[0] for name in OF_AGENTS}
    said = {"bandit": candidate.kind, "sha256": candidate.sha256, "actions": shares.shape[-1]}
    return {**said, **found}


def parts(options: Options, report: dict[str, Any]) -> Iterator[Part]:
    """A bandit at a time; what the report holds of the same one is not measured again."""
    settled(report, size={"agents": options.agents, "episodes": options.episodes})
    for environment in options.environments:
        entry = report.setdefault("environments", {}).setdefault(environment, {})
        for kind, candidate in bandits(environment, options.published).items():
            forget_other(entry, kind, candidate.sha256)
            yield Part(("environments", environment, kind), partial(measured, candidate, options))


measure = InParts(parts)


def facts(report: Report) -> dict[str, Any]:
    """A row a bandit: estimates over its agents, and how far every agent is from all, before and after the clip."""
    rows = []
    for environment, entry in report["environments"].items():
        for kind in (kind for kind in BANDITS if kind in entry):
            of_agents = {name: unpacked([entry[kind][name]])[0] for name in OF_AGENTS}
            estimates = {name: estimate(values) for name, values in of_agents.items()}
            row = {"environment": environment, "kind": kind, **entry[kind], **estimates}
            rows.append({**row, "of_agents": of_agents})
    return {"rows": rows}


def draw(report: Mapping[str, Any]) -> Figure:
    """A row a bandit: how far agents are apart before the clip and after it, with a dot an agent."""
    rows = facts(report)["rows"]
    figure = Figure(figsize=(7, 0.55 * len(rows) + 1.5))
    axes = figure.subplots()
    for place, row in enumerate(rows):
        for of, (color, _) in CLIPPING.items():
            plotting.estimate_row(axes, place, row["of_agents"][of], row[of], color)
    axes.set_yticks(range(len(rows)), [f"{row['environment']}, {row['kind']}" for row in rows])
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_xlim(0, None)
    axes.set_xlabel("distance of an agent of PPO from all, in halves of the actions' range")
    plotting.figure_title(figure, "How far agents that learned in one bandit are apart")
    looks = {
        label: {"color": color, "marker": "o", "linestyle": ""}
        for color, label in CLIPPING.values()
    }
    plotting.legend_of(figure, looks, columns=2)
    return figure


EXPERIMENT = Experiment(
    "saturation",
    "How do PPO's agents act that learned from a bandit?",
    measure,
    draw,
    facts=facts,
    options=Options,
    keys=("environments", "size"),
)
