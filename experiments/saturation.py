"""How agents of PPO act that learned from a bandit: within the actions' range, or beyond its ends, where errors vanish.

    python -m experiments.saturation --published DIRECTORY

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

from experiments.harness import Experiment, Report, finite, packed, settled, unpacked
from experiments.parts import InParts, Part
from experiments.zoo_table import Candidate, candidates
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


def bandits(environment: str, published: Path | None) -> dict[str, Candidate]:
    """{kind: the bandit of this environment}, of the kinds that there are."""
    return {x.kind: x for x in candidates(None, published) if x.environment == environment}


def spread(means: np.ndarray) -> dict[str, float]:
    """What [N, S, A] means of N agents in the same S states are like, in halves of the actions' range.

    Returns:
      beyond: share of them that lie beyond the ends of the range.
      apart: root mean square distance of an agent's mean to that of all, and `clipped`: of the actions.
      directions: of what all agents do, the mean of the clipped actions, how many the variance over states has
        (its participation ratio, (sum of eigenvalues)^2 / sum of their squares).
    """
    actions = np.clip(means, -1, 1)
    together = actions.mean(axis=0)
    variances = np.linalg.svd(together - together.mean(axis=0), compute_uv=False) ** 2
    return {
        "beyond": float((np.abs(means) > 1).mean()),
        "apart": float(np.sqrt(((means - means.mean(axis=0)) ** 2).mean())),
        "clipped": float(np.sqrt(((actions - together) ** 2).mean())),
        "directions": float(variances.sum() ** 2 / (variances**2).sum()),
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
    found = {name: round(value, 4) for name, value in spread(shares).items()}
    random = environment_spec(candidate.environment).random_return(BACKEND)
    returns, _ = finite(learned["ppo"].returns, random)
    said = {"bandit": candidate.kind, "sha256": candidate.sha256, "actions": shares.shape[-1]}
    return {**said, **found, "returns": packed([returns])[0]}


def parts(options: Options, report: dict[str, Any]) -> Iterator[Part]:
    """A bandit at a time; what the report holds of the same one is not measured again."""
    settled(report, size={"agents": options.agents, "episodes": options.episodes})
    for environment in options.environments:
        entry = report.setdefault("environments", {}).setdefault(environment, {})
        for kind, candidate in bandits(environment, options.published).items():
            if entry.get(kind, {}).get("sha256") != candidate.sha256:
                entry.pop(kind, None)
            yield Part(("environments", environment, kind), partial(measured, candidate, options))


measure = InParts(parts)


def facts(report: Report) -> dict[str, Any]:
    """A row a bandit."""
    return {
        "rows": [
            {
                "environment": environment,
                "kind": kind,
                **entry[kind],
                "earned": estimate(unpacked([entry[kind]["returns"]])[0]),
            }
            for environment, entry in report["environments"].items()
            for kind in BANDITS
            if kind in entry
        ]
    }


def draw(report: Mapping[str, Any]) -> Figure:
    """A row a bandit: how far agents are apart before the clip and after it."""
    rows = facts(report)["rows"]
    figure = Figure(figsize=(7, 0.5 * len(rows) + 1.3))
    axes = figure.subplots()
    for place, row in enumerate(rows):
        axes.plot([row["clipped"], row["apart"]], [place, place], color=plotting.GREY, zorder=1)
        axes.plot(
            row["apart"],
            place,
            "o",
            color=plotting.VERMILLION,
            label="" if place else "before the clip",
        )
        axes.plot(
            row["clipped"], place, "o", color=plotting.BLUE, label="" if place else "after it"
        )
        axes.annotate(
            f"{100 * row['beyond']:.0f} % beyond the ends",
            (row["apart"], place),
            xytext=(8, 0),
            textcoords="offset points",
            va="center",
            fontsize=8,
        )
    axes.set_yticks(range(len(rows)), [f"{row['environment']}, {row['kind']}" for row in rows])
    axes.invert_yaxis()
    axes.set_xlim(0, max(row["apart"] for row in rows) * 1.35)
    axes.set_xlabel("PPO's agents apart from each other, in halves of the actions' range")
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, frameon=False)
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


if __name__ == "__main__":
    raise SystemExit(EXPERIMENT.main())
