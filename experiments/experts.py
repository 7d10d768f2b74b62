"""SAC experts on classic control: the paper's table, with agents of this library.

python -m experiments experts
"""

import time
from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure

import scb
from experiments.claims import Claim, of_the_way
from experiments.harness import Experiment
from experiments.parts import by_environment
from experiments.reports import Report
from scb import plotting
from scb.agents.spec import environment_agent
from scb.analysis.components import SACExpert, train_sac_expert
from scb.environments.registry import environment_spec
from scb.environments.spec import Reference
from scb.evaluation import evaluate
from scb.keys import root_key
from scb.seeds import ILLUSTRATING, REPORTING
from scb.statistics import Estimate, estimate

# Of the way from random actions to the paper's expert.
MARGIN = 0.05
REASON = "near-optimal is not equal: a twentieth of the way from random actions to the expert"


def train(environment: str, number: int, episodes: int) -> tuple[SACExpert, Any, Any]:
    """(the best of `number` agents on `episodes` episodes, the environment, its parameters)."""
    env, env_params = scb.make(environment)
    key = root_key(ILLUSTRATING.start)
    return train_sac_expert(environment, env, env_params, key, number, episodes), env, env_params


def _trained(environment: str, plan: Mapping[str, Any]) -> dict[str, Any]:
    start = time.monotonic()
    expert, env, env_params = train(environment, plan["agents"], plan["selection_episodes"])
    seconds = time.monotonic() - start
    returns = jax.jit(
        lambda key: evaluate(env, env_params, expert.policy(), key, plan["evaluations"]).returns
    )(root_key(REPORTING.start))
    spec = environment_agent("sac", environment)
    return {
        "returns": np.round(np.asarray(returns), 2).tolist(),
        "selection": round(expert.mean_return, 2),
        "steps": spec.steps,
        "episode_limit": spec.episode_limit,
        "setting": spec.source,
        "seconds": round(seconds, 1),
    }


measure = by_environment(_trained)


def paper(environment: str) -> Reference:
    """The paper's expert."""
    found = environment_spec(environment).reference()
    assert found is not None
    return found


def claims(report: Report) -> list[Claim]:
    """Environment by environment: the paper's return, or next to it."""
    found = []
    for name, entry in report["environments"].items():
        expert = paper(name).value
        margin = of_the_way(name, MARGIN)
        evidence = partial(estimate, entry["returns"])
        text = f"{name}: no worse than the paper's expert"
        found.append(Claim(text, evidence, expert, margin, REASON, places=1))
    return found


def facts(report: Report) -> dict[str, Any]:
    """The paper's estimates."""
    return {"paper": {name: asdict(paper(name)) for name in report["environments"]}}


def draw(report: Mapping[str, Any]) -> Figure:
    """A panel an environment: ours with each evaluation a dot, and the paper's interval."""
    figure = Figure(figsize=(plotting.WIDTH, 1.1 * len(report["environments"]) + 0.6))
    panels = figure.subplots(len(report["environments"]), 1, squeeze=False)[:, 0]
    for axes, (name, entry) in zip(panels, report["environments"].items(), strict=True):
        returns = np.asarray(entry["returns"])
        plotting.estimate_row(axes, 0.0, returns, estimate(returns), plotting.BLUE)
        expert = paper(name)
        published = Estimate(expert.value, expert.low, expert.high, 200)
        plotting.estimate_row(axes, 1.0, np.empty(0), published, plotting.VERMILLION)
        axes.set_yticks([0.0, 1.0], ["here", "the paper"])
        axes.set_ylim(1.6, -0.6)
        axes.set_title(name, fontsize=10)
    panels[-1].set_xlabel("return of an episode")
    plotting.figure_title(
        figure, "SAC experts: interquartile mean with its 95 % interval, each evaluation a dot"
    )
    return figure


EXPERIMENT = Experiment.of_the_paper("experts", measure, draw, claims, facts=facts)
