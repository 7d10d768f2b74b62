"""Training in a Brax environment's bandit against training in the environment itself.

    python -m experiments.brax_training

Learning curves of agents in bandits (ours and the published ones, each said) and of agents with the
paper's expert hyperparameters in the environments, the final returns, and the steps that the latter
need to match the former. Published bandits are read from ../shared/published_scbs where that is, or
from the folder in the variable SCB_PUBLISHED; without them ours are measured alone.
"""

import os
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import scb
from experiments import zoo_table, zoo_table_page
from experiments.page import Experiment, Save, table, text
from experiments.page import main as run
from scb import plotting
from scb.agents.spec import bandit_agent, environment_agent
from scb.environments.registry import environment_spec
from scb.environments.zoo import bandit_metadata, open_bandit
from scb.evolution import map_population
from scb.importer import PUBLISHED_BANDITS, published_bandit
from scb.keys import root_key, split_key
from scb.seeds import REPORTING
from scb.statistics import estimate

OURS, PUBLISHED = "ours", "published"
# Whose experts and published bandits the paper has; `zoo_table_page.PAPER` says what these bandits are worth.
PAPER = ("hopper", "walker2d", "swimmer", "halfcheetah", "humanoidstandup")
ROUGHLY = 50  # times as many steps are roughly two orders of magnitude


def published_folder() -> Path | None:
    """Where the published bandits' arrays are; None where they are not."""
    folder = Path(os.environ.get("SCB_PUBLISHED", "../shared/published_scbs"))
    return folder if folder.is_dir() else None


def place(environment: str, backend: str | None) -> str:
    """The name of an environment in the report."""
    return environment if backend is None else f"{environment} ({backend})"


def task(kind: str, environment: str, backend: str | None) -> str:
    """The name of a bandit in the report."""
    return f"{place(environment, backend)}, {kind}"


def measure(plan: Mapping[str, Any], report: dict[str, Any], save: Save) -> None:
    """A learning curve at a time: those in bandits, then those in environments."""
    bandits = report.setdefault("bandits", {})
    environments = report.setdefault("environments", {})
    at_hand = published_folder() is not None

    def there(of: list[Any]) -> bool:
        return set(plan["bandit_algorithms"]) <= set(bandits.get(task(*of), ()))

    left_out = [x for x in plan["bandits"] if x[0] == PUBLISHED and not at_hand and not there(x)]
    report["left_out"] = [task(*x) for x in left_out]
    for name in report["left_out"]:
        bandits.pop(name, None)  # a part of its algorithms can't be shown
    measured = [x for x in plan["bandits"] if x not in left_out]
    for kind, environment, backend in measured:
        entry = bandits.setdefault(task(kind, environment, backend), {})
        for algorithm in plan["bandit_algorithms"]:
            if algorithm not in entry:
                entry[algorithm] = _in_bandit(kind, environment, backend, algorithm, plan)
                save()
    for _, environment, backend in measured:
        entry = environments.setdefault(place(environment, backend), {})
        for algorithm in plan["environment_algorithms"]:
            if algorithm not in entry:
                entry[algorithm] = _in_environment(environment, backend, algorithm, plan)
                save()


def _in_bandit(
    kind: str, environment: str, backend: str | None, algorithm: str, plan: Mapping[str, Any]
) -> dict[str, Any]:

    env, env_params = scb.make(environment, backend)
    if kind == OURS:
        bandit = open_bandit(environment_spec(environment).bandit)
        digest = bandit_metadata(bandit.name)["sha256"]
    else:
        (name,) = (n for n, home in PUBLISHED_BANDITS.items() if home == environment)
        folder = published_folder()
        assert folder is not None
        bandit = published_bandit(folder / f"{name}.npz")
        digest = zoo_table.arrays_digest(folder / f"{name}.npz")
    spec = bandit_agent(algorithm, environment)
    curves = _curves(
        spec.agent(bandit),
        spec.hyperparameters,
        bandit.default_params,
        env,
        env_params,
        plan["bandit_agents"],
        plan,
    )
    return {"sha256": digest, **curves}


def _in_environment(
    environment: str, backend: str | None, algorithm: str, plan: Mapping[str, Any]
) -> dict[str, Any]:

    env, env_params = scb.make(environment, backend)
    spec = environment_agent(algorithm, environment).with_steps(plan["environment_steps"])
    return _curves(
        spec.agent(env),
        spec.hyperparameters,
        spec.training_params(env_params),
        env,
        env_params,
        plan["environment_agents"],
        plan,
    )


def _curves(
    agent: Any,
    hyperparameters: Any,
    trained_in: Any,
    env: Any,
    env_params: Any,
    number: int,
    plan: Mapping[str, Any],
) -> dict[str, Any]:
    """{"steps": [P + 1], "returns": [N, P + 1], "seconds"}: `number` agents, most likely actions."""

    every, iterations = evaluation_steps(agent.config.num_iterations, plan["points"])
    # Evaluations are evenly spaced, for which a few iterations may be added at the end.
    steps = agent.config.steps_after(iterations)
    agent = replace(agent, config=replace(agent.config, total_steps=steps))

    def evaluation(state: Any, key: Any) -> Any:
        episodes = agent.evaluate(state, key, plan["episodes"], env, env_params, mode=True)
        return episodes.returns.mean()

    def train(key: Any) -> Any:
        return agent.train_with_evaluations(key, hyperparameters, trained_in, evaluation, every)[1]

    start = time.monotonic()
    keys = split_key(root_key(REPORTING.start), number)
    returns = np.asarray(map_population(train, number, (0,))(keys))
    seconds = time.monotonic() - start
    # What is no number counts as the agent before its training.
    usable = np.isfinite(returns)
    return {
        "steps": [agent.config.steps_after(n) for n in range(0, iterations + 1, every)],
        "returns": np.round(np.where(usable, returns, returns[:, :1]), 1).tolist(),
        "failed": int((~usable).any(axis=1).sum()),
        "seconds": round(seconds, 1),
    }


def evaluation_steps(iterations: int, points: int) -> tuple[int, int]:
    """(iterations between evaluations, iterations in all): at most `points` evaluations after the first."""
    every = -(-iterations // points)
    return every, -(-iterations // every) * every


def finals(curves: Mapping[str, Any]) -> np.ndarray:
    """[N] returns at the end."""
    return np.asarray(curves["returns"])[:, -1]


def steps_to_match(curves: Mapping[str, Any], level: float) -> list[int | None]:
    """For each agent the steps of its first evaluation that reaches the level; None where it never does.

    What lies between two evaluations isn't seen: an agent may be there up to their distance earlier.
    """
    reached = np.asarray(curves["returns"]) >= level
    return [int(curves["steps"][int(np.argmax(row))]) if row.any() else None for row in reached]


def _environment_of(name: str) -> str:
    return name.rsplit(", ", 1)[0]


def matches(report: Mapping[str, Any]) -> list[dict[str, Any]]:
    """For each bandit and algorithm that was trained in the environment too: who reaches the bandit's level, when.

    The level is uncertain, so the median number of steps to the lower end of its interval is there too.
    """

    def median(steps: Sequence[int | None]) -> float | None:
        middle = float(np.median([np.inf if x is None else x for x in steps]))
        return middle if np.isfinite(middle) else None

    rows = []
    for name, algorithms in report["bandits"].items():
        for algorithm, curves in report["environments"][_environment_of(name)].items():
            level = estimate(finals(algorithms[algorithm]))
            steps = steps_to_match(curves, level.value)
            low = level.value if level.low is None else level.low
            rows.append(
                {
                    "bandit": name,
                    "algorithm": algorithm,
                    "level": level,
                    "bandit_steps": algorithms[algorithm]["steps"][-1],
                    "reached": sum(x is not None for x in steps),
                    "agents": len(steps),
                    "steps": median(steps),
                    "steps_low": median(steps_to_match(curves, low)),
                    "trained": curves["steps"][-1],
                    "spacing": curves["steps"][1] - curves["steps"][0],
                }
            )
    return rows


def parts(report: Mapping[str, Any]) -> list[bool | None]:
    """Row by row of `matches`: whether the environment takes 50 times the steps or more, roughly two orders.

    To the lower end of the bandit's level, so that the luck of its agents does not decide. None where the
    environment was trained for less and its agents did not get there.
    """
    found: list[bool | None] = []
    for row in matches(report):
        times = (row["steps_low"] or row["trained"]) / row["bandit_steps"]
        found.append(None if row["steps_low"] is None and times < ROUGHLY else times >= ROUGHLY)
    return found


def _times(row: Mapping[str, Any], steps: float | None) -> str:
    """How many times the bandit's steps."""
    if steps is None:
        return f"more than {row['trained'] / row['bandit_steps']:.0f}"
    return f"{steps / row['bandit_steps']:.0f}"


def verdict(report: Mapping[str, Any]) -> str:
    """How many times as many steps the environment takes; the median counts agents that never get there."""
    told = []
    for row in matches(report):
        most = row["trained"] / row["bandit_steps"]
        said = (
            f"{row['bandit']}, {row['algorithm'].upper()}: {row['reached']} of {row['agents']} agents reach the "
            f"bandit's {text(row['level'])}, "
        )
        said += (
            f"in the median not within {row['trained']} steps, {_times(row, None)} times the bandit's"
            if row["steps"] is None
            else f"by {row['steps']:.0f} steps in the median (evaluations are {row['spacing']} apart), "
            f"{_times(row, row['steps'])} times the bandit's"
        )
        if row["steps_low"] != row["steps"]:
            said += f" ({_times(row, row['steps_low'])} to the lower end)"
        if most < 100:
            said += (
                f" (trained up to {most:.0f} times as long: two orders of magnitude are not tested)"
            )
        told.append(said)
    return "; ".join(told).replace("-", "\u2212") + "."


def body(report: Mapping[str, Any]) -> list[str]:
    """How it was measured, final returns beside the paper's, steps to match."""
    plan = report["plan"]
    rows = []
    for name, algorithms in report["bandits"].items():
        environment = name.split(" ")[0]
        own = report["environments"][_environment_of(name)]
        for algorithm, curves in algorithms.items():
            paper = environment_spec(environment).reference(None, algorithm)
            rows.append(
                [
                    name,
                    algorithm.upper(),
                    text(estimate(finals(curves))),
                    text(estimate(finals(own[algorithm]))) if algorithm in own else "",
                    "" if paper is None else f"{zoo_table_page.PAPER[environment][algorithm]:.0f}",
                    "" if paper is None else f"{paper.value:.0f}",
                    f"{curves['seconds'] / len(curves['returns']):.1f}",
                    f"{own[algorithm]['seconds'] / len(own[algorithm]['returns']):.0f}"
                    if algorithm in own
                    else "",
                ]
            )
    matched = [
        [
            row["bandit"],
            row["algorithm"].upper(),
            text(row["level"]),
            f"{row['reached']} of {row['agents']}",
            f"more than {row['trained']}" if row["steps"] is None else f"{row['steps']:.0f}",
            str(row["spacing"]),
            _times(row, row["steps"]),
            _times(row, row["steps_low"]),
        ]
        for row in matches(report)
    ]
    of_all = [report["bandits"], report["environments"]]
    failed = sum(x.get("failed", 0) for by in of_all for y in by.values() for x in y.values())
    return [
        f"In bandits: {plan['bandit_agents']} agents of each algorithm with the paper's fixed inner-loop "
        f"hyperparameters, 10 000 steps. In environments: {plan['environment_agents']} agents of "
        f"{', '.join(x.upper() for x in plan['environment_algorithms'])} with the paper's expert hyperparameters, "
        f"about {plan['environment_steps']} steps (the paper: 5 242 880). {plan['episodes']} episodes of most likely "
        "actions at each point; reporting seed 10 000; interquartile means with 95 % intervals. *Ours* was found "
        "here, on `spring` physics; *published* bandits are those that the paper's authors released, under our "
        "agents. The paper's figures are for `generalized`. Seconds are wall-clock of an agent with its evaluations "
        "and the compilation, shared over the agents."
        + (
            f" Left out, since SCB_PUBLISHED names no folder that holds them: {'; '.join(report['left_out'])}."
            if report["left_out"]
            else ""
        )
        + (
            f" Agents with returns that are no number, counted as untrained: {failed}."
            if failed
            else ""
        ),
        "",
        *table(
            [
                "bandit",
                "algorithm",
                "in the bandit",
                "in the environment",
                "paper, bandit",
                "paper, environment",
                "seconds, bandit",
                "seconds, environment",
            ],
            rows,
        ),
        "",
        "Steps in the environment until an agent's evaluation reaches what the bandit's agents earn; it may have been "
        "there as much earlier as evaluations are apart:",
        "",
        *table(
            [
                "bandit",
                "algorithm",
                "level",
                "agents that reach it",
                "steps (median)",
                "evaluations apart",
                "times the bandit's",
                "to the level's lower end",
            ],
            matched,
        ),
    ]


def draw(report: Mapping[str, Any]) -> Figure:
    """A row a bandit, a column an algorithm; steps on a logarithmic axis."""

    algorithms = list(next(iter(report["bandits"].values())))
    with plotting.figure_style():
        figure = Figure(figsize=(3.1 * len(algorithms), 2.9 * len(report["bandits"]) + 0.4))
        panels: Any = figure.subplots(
            len(report["bandits"]), len(algorithms), squeeze=False, sharey="row"
        )
        for row, (name, curves) in zip(panels, report["bandits"].items(), strict=True):
            own = report["environments"][_environment_of(name)]
            for axes, algorithm in zip(row, algorithms, strict=True):
                for found, color, style in (
                    (curves[algorithm], plotting.BLUE, "-"),
                    (own.get(algorithm), plotting.VERMILLION, "--"),
                ):
                    if found is None:
                        continue
                    # A logarithmic axis has no zero: the untrained agent is left out.
                    shown = np.asarray(found["steps"]) > 0
                    steps = np.asarray(found["steps"])[shown]
                    estimates = [estimate(x) for x in np.transpose(found["returns"])[shown]]
                    plotting.estimate_curve(axes, steps, estimates, color, style)
                paper = environment_spec(name.split(" ")[0]).reference(None, algorithm)
                # The paper's physics.
                if algorithm not in own and paper is not None and "(generalized)" in name:
                    axes.axhline(paper.value, color=plotting.GREY, linestyle=":")
                axes.set_xscale("log")
                axes.set_title(f"{name}\n{algorithm.upper()}", fontsize=9)
                axes.set_xlabel("training steps")
            row[0].set_ylabel("return in the environment")
        handles: list[Any] = [
            panels[0, 0].plot([], [], color=color, linestyle=style)[0]
            for color, style in (
                (plotting.BLUE, "-"),
                (plotting.VERMILLION, "--"),
                (plotting.GREY, ":"),
            )
        ]
        labels = ["trained in the bandit", "trained in the environment", "the paper, environment"]
        plotting.legend_below(figure, (handles, labels), columns=3)
        plotting.figure_title(figure, "Interquartile mean over agents with its 95 % interval")
    return figure


EXPERIMENT = Experiment(
    name="brax_training",
    title="Training in a Brax bandit and in the environment itself",
    paper="figures 5, 15 and 16, table 2",
    claim="agents take 10 000 steps in a bandit to learn locomotion for which training in the environment takes "
    "millions: it is roughly two orders of magnitude slower.",
    presets={
        "quick": {
            "bandits": [[OURS, "hopper", "spring"], [PUBLISHED, "hopper", "generalized"]],
            "bandit_algorithms": ["ppo", "sac", "ddpg", "td3"],
            "bandit_agents": 20,
            "environment_algorithms": ["ppo", "sac"],
            "environment_agents": 4,
            "environment_steps": 1_000_000,
            "episodes": 5,
            "points": 10,
        },
        "paper": {
            "bandits": [
                [OURS, "hopper", "spring"],
                *([PUBLISHED, name, "generalized"] for name in PAPER),
            ],
            "bandit_algorithms": ["ppo", "sac", "ddpg", "td3"],
            "bandit_agents": 20,
            "environment_algorithms": ["ppo", "sac", "ddpg", "td3"],
            "environment_agents": 5,
            "environment_steps": 5 * 2**20,
            "episodes": 50,
            "points": 20,
        },
    },
    minutes={"quick": "45", "paper": "days; for a GPU"},
    measure=measure,
    parts=parts,
    verdict=verdict,
    body=body,
    draw=draw,
    needs="needs for the published bandits their arrays, beside the checkout or in SCB_PUBLISHED",
)


if __name__ == "__main__":
    sys.exit(run(EXPERIMENT))
