"""SAC experts on classic control: the paper's table, with agents of this library.

python -m experiments.experts
"""

import sys
import time
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure

import scb
from experiments.page import CLASSIC_CONTROL, Experiment, Save, table, text
from experiments.page import main as run
from scb import plotting
from scb.agents.spec import environment_agent
from scb.analysis.components import SACExpert, train_sac_expert
from scb.environments.registry import environment_spec
from scb.evaluation import evaluate
from scb.keys import root_key
from scb.seeds import ILLUSTRATING, REPORTING
from scb.statistics import Estimate, estimate


def train(environment: str, number: int, episodes: int) -> tuple[SACExpert, Any, Any]:
    """(the best of `number` agents on `episodes` episodes, the environment, its parameters)."""

    env, env_params = scb.make(environment)
    key = root_key(ILLUSTRATING.start)
    return train_sac_expert(environment, env, env_params, key, number, episodes), env, env_params


def measure(plan: Mapping[str, Any], report: dict[str, Any], save: Save) -> None:
    """An environment at a time."""

    found = report.setdefault("environments", {})
    for environment in plan["environments"]:
        if environment in found:
            continue
        start = time.monotonic()
        expert, env, env_params = train(environment, plan["agents"], plan["selection_episodes"])
        seconds = time.monotonic() - start
        returns = jax.jit(
            lambda key, expert=expert, env=env, env_params=env_params: (
                evaluate(env, env_params, expert.policy(), key, plan["evaluations"]).returns
            )
        )(root_key(REPORTING.start))
        spec = environment_agent("sac", environment)
        found[environment] = {
            "returns": np.round(np.asarray(returns), 2).tolist(),
            "selection": round(expert.mean_return, 2),
            "steps": spec.steps,
            "episode_limit": spec.episode_limit,
            "setting": spec.source,
            "seconds": round(seconds, 1),
        }
        save()


def _earned(report: Mapping[str, Any]) -> dict[str, Estimate]:

    return {name: estimate(x["returns"]) for name, x in report["environments"].items()}


def _paper(environment: str) -> Estimate:
    """The paper's expert, of 200 evaluations."""
    expert = environment_spec(environment).reference()
    assert expert is not None, environment
    return Estimate(expert.value, expert.low, expert.high, 200)


def parts(report: Mapping[str, Any]) -> list[bool]:
    """Environment by environment: whether the interval reaches the paper's."""
    found = _earned(report).items()

    def low_end(name: str) -> float:
        paper = _paper(name)
        return paper.value if paper.low is None else paper.low

    return [(x.value if x.high is None else x.high) >= low_end(name) for name, x in found]


def verdict(report: Mapping[str, Any]) -> str:
    """Each environment's figure, and where it lies below the paper's interval."""
    found = _earned(report)
    below = [name for name, level in zip(found, parts(report), strict=True) if not level]
    listed = ", ".join(f"{name} {text(x, 1)}" for name, x in found.items())
    return f"{listed}; " + (
        f"below the paper's interval in {' and '.join(below)}, on its level or above elsewhere."
        if below
        else "on the paper's level or above it everywhere."
    )


def body(report: Mapping[str, Any]) -> list[str]:
    """How they were trained, and the table."""
    plan = report["plan"]
    rows = []
    for name, entry in report["environments"].items():
        paper = _paper(name)
        rows.append(
            [
                name,
                text(estimate(entry["returns"]), 1),
                text(paper, 1),
                str(entry["steps"]),
                "" if entry["episode_limit"] is None else str(entry["episode_limit"]),
                f"{entry['seconds']:.0f}",
                entry["setting"],
            ]
        )
    return [
        f"The best of {plan['agents']} SAC agents by {plan['selection_episodes']} episodes, then judged on "
        f"{plan['evaluations']} others: most likely actions, interquartile mean over episodes with its 95 % interval. "
        "Trained on the environment itself, the number of steps that the table says for each agent. *Limit* is that of "
        "the episodes in training where it is not the environment's own; judged are the environment's own episodes. "
        "Settings were found on other seeds.",
        "",
        *table(
            [
                "environment",
                "here",
                "the paper",
                "steps",
                "limit",
                "seconds, all agents",
                "setting",
            ],
            rows,
        ),
    ]


def draw(report: Mapping[str, Any]) -> Figure:
    """A panel an environment: ours with each evaluation a dot, and the paper's interval."""

    with plotting.figure_style():
        figure = Figure(figsize=(plotting.WIDTH, 1.1 * len(report["environments"]) + 0.6))
        panels = figure.subplots(len(report["environments"]), 1, squeeze=False)[:, 0]
        for axes, (name, entry) in zip(panels, report["environments"].items(), strict=True):
            returns = np.asarray(entry["returns"])
            plotting.estimate_row(axes, 0.0, returns, estimate(returns), plotting.BLUE)
            paper = _paper(name)
            plotting.estimate_row(axes, 1.0, np.empty(0), paper, plotting.VERMILLION)
            axes.set_yticks([0.0, 1.0], ["here", "the paper"])
            axes.set_ylim(1.6, -0.6)
            axes.set_title(name, fontsize=10)
        panels[-1].set_xlabel("return of an episode")
        plotting.figure_title(
            figure, "SAC experts: interquartile mean with its 95 % interval, each evaluation a dot"
        )
    return figure


EXPERIMENT = Experiment(
    name="experts",
    title="SAC experts on classic control",
    paper="table 1, appendix on replacing components",
    claim="a SAC agent trained on the environment is near-optimal in all of classic control: Acrobot \u221276.7, "
    "CartPole 500, MountainCar \u2212117.7, its continuous sibling 94.9, Pendulum \u2212137.4.",
    presets={
        "quick": {
            "environments": list(CLASSIC_CONTROL),
            "agents": 4,
            "selection_episodes": 50,
            "evaluations": 200,
        },
        "paper": {
            "environments": list(CLASSIC_CONTROL),
            "agents": 10,
            "selection_episodes": 200,
            "evaluations": 200,
        },
    },
    minutes={"quick": "5", "paper": "12"},
    measure=measure,
    parts=parts,
    verdict=verdict,
    body=body,
    draw=draw,
)


if __name__ == "__main__":
    sys.exit(run(EXPERIMENT))
