"""How agents of PPO err that learned from a bandit: alike or each in its own way, and where the clip takes errors away.

    python -m experiments saturation --published DIRECTORY

Agents train in a bandit, and act in its environment: each for itself, then all as one, by the mean of their actions,
which has what they err alike in and next to nothing of what is one agent's own; and the bandit's best action. PPO's
Gaussian has a mean of any size, and the environment clips the action: in states that the agents visit, this takes the
mean that each would act by, and asks how far agents are from each other before and after the clip, and how many
directions what they all do has.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from experiments.harness import Experiment
from experiments.parts import InParts, Part
from experiments.reports import Report, finite, forget_other, settled
from experiments.zoo_table import Candidate, bandits
from experiments.zoo_table_page import BANDITS
from scb import plotting
from scb.agents.agent import Agent
from scb.agents.spec import bandit_agent
from scb.aggregation import Learners
from scb.analysis.optimal_actions import optimal_policy
from scb.errors import at_least, one_of
from scb.evaluation import evaluate
from scb.files import packed_row, unpacked_row
from scb.importer import PUBLISHED_BANDITS
from scb.keys import named_key, root_key
from scb.measurement import Place
from scb.statistics import Estimate, estimate

SEED = 1  # nothing is chosen by it
STATES = 2048
EPISODES = 24  # of all agents as one, and of the bandit's best action
ACTING = {
    "returns": (plotting.BLUE, "each agent"),
    "together": (plotting.ORANGE, "all as one"),
    "best": (plotting.BLACK, "the bandit's best action"),
}
CLIPPING = {
    "apart": (plotting.VERMILLION, "what they would do"),
    "clipped": (plotting.GREEN, "after the clip at the ends of the range"),
}
OF_AGENTS = ("beyond", "apart", "clipped", "returns")  # what a report has of every agent
OF_EPISODES = ("together", "best")  # and of every episode


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


def earned_together(
    agent: Agent, states: Any, candidate: Candidate, place: Place, key: jax.Array
) -> dict[str, np.ndarray]:
    """[EPISODES] what agents of these states earn by the mean of their actions, and a bandit's best action."""
    params = candidate.bandit.default_params

    def all_as_one(observation: jax.Array, key: jax.Array) -> jax.Array:
        def act(state: Any) -> jax.Array:
            return agent.act(state, observation, key, params, mode=True)

        return jax.vmap(act)(states).mean(axis=0)

    policies = {"together": all_as_one, "best": optimal_policy(candidate.bandit)}
    return {
        name: np.asarray(
            evaluate(place.env, place.params, policy, named_key(key, name), EPISODES).returns
        )
        for name, policy in policies.items()
    }


def measured(candidate: Candidate, options: Options) -> dict[str, Any]:
    """What agents earn, and how they act in states that they visit."""
    bandit, place = candidate.bandit, Place.named(candidate.environment)
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
    returns, _ = finite(learned["ppo"].returns, place)
    acting = jax.tree.map(lambda x: x[~learned["ppo"].failed], learned["ppo"].states)
    found = {
        **spread(shares),
        **earned_together(agent, acting, candidate, place, key),
        "returns": returns,
    }
    found |= {name: packed_row(found[name]) for name in (*OF_AGENTS, *OF_EPISODES)}
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


def way(each: Estimate, together: Estimate, best: Estimate) -> Estimate | None:
    """How much of the way from what each earns to what the best action earns all come as one; past it above 1.

    The interval is the widest that the ends of the three give. None where the best action is not above each by more
    than their intervals.
    """
    three = [
        (x.low, x.high) for x in (each, together, best) if x.low is not None and x.high is not None
    ]
    if len(three) < 3 or three[2][0] <= three[0][1]:
        return None

    def share(each: float, together: float, best: float) -> float:
        return (together - each) / (best - each)

    ends = [share(*at) for at in product(*three)]
    return Estimate(share(each.value, together.value, best.value), min(ends), max(ends), each.n)


def facts(report: Report) -> dict[str, Any]:
    """A row a bandit: estimates over its agents or over episodes, of what they earn and of how far they are apart."""
    rows = []
    for environment, entry in report["environments"].items():
        for kind in (kind for kind in BANDITS if kind in entry):
            measured = (*OF_AGENTS, *OF_EPISODES)
            dots = {name: unpacked_row(entry[kind][name]) for name in measured}
            estimates = {name: estimate(values) for name, values in dots.items()}
            label = {"environment": environment, "kind": kind, "label": f"{environment}, {kind}"}
            come = way(*(estimates[name] for name in ACTING))
            rows.append({**label, **entry[kind], **estimates, "way": come, "dots": dots})
    left = [row["clipped"].value / row["apart"].value for row in rows]
    return {"rows": rows, "takes_most": rows[int(np.argmin(left))]["label"]}


def draw(report: Mapping[str, Any]) -> Figure:
    """A row a bandit: what its agents earn, together too, and how far apart they are; a dot an agent or an episode."""
    rows = facts(report)["rows"]
    figure = Figure(figsize=(plotting.WIDTH, 0.7 * len(rows) + 1.8))
    earned, apart = figure.subplots(1, 2)
    for axes, shown in ((earned, ACTING), (apart, CLIPPING)):
        for place, row in enumerate(rows):
            for shift, (of, (color, _)) in enumerate(shown.items()):
                at = place + (shift - (len(shown) - 1) / 2) * 0.22
                plotting.estimate_row(axes, at, row["dots"][of], row[of], color)
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.set_xlim(0, None)
    earned.set_yticks(range(len(rows)), [row["label"] for row in rows])
    apart.set_yticks(range(len(rows)), [])
    earned.set_xlabel("return in the environment")
    apart.set_xlabel("distance of an agent from all, in half ranges")
    looks = {
        label: {"color": color, "marker": "o", "linestyle": ""}
        for color, label in (ACTING | CLIPPING).values()
    }
    plotting.legend_of(figure, looks, columns=len(ACTING))
    plotting.figure_title(
        figure, "PPO's agents that learned in one bandit: errors alike, and each one's own"
    )
    return figure


EXPERIMENT = Experiment(
    "saturation",
    "How do PPO's agents err that learned from a bandit of Brax?",
    measure,
    draw,
    facts=facts,
    options=Options,
    keys=("environments", "size"),
)
