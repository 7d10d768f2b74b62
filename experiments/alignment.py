"""Which inner loop on a bandit ranks objectives as an environment does, and does the choice hold elsewhere.

    python -m experiments alignment

First the choice: the family of known drifts and learned ones of the zoo train agents on Pendulum-v1,
and in regimes of the Pendulum bandit that differ from the default in one thing each (reward noise,
contexts, iterations, epochs, minibatches, learning rate). The same with a small last layer of the
policy, on both sides. `--adversaries FILES` adds objectives that evolution found. Then the
confirmation, on seeds that chose nothing: the correlation of a few regimes with the outcome on other
environments, and on Pendulum for objectives that are not in the family, closed forms and the learned
ones of `--held-out FILES`. Regimes that --out holds already are kept, so the same command continues
an interrupted one.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments.harness import Experiment, Save, command_of
from lpo import figures
from lpo.alignment import (
    Regime,
    forget_programs,
    known_drifts,
    measure_alignment,
    other_drifts,
)
from lpo.fitness import LABELS
from lpo.objectives import Objective, load_objective, same_drift
from scb.environments.registry import environment_spec
from scb.errors import UserError
from scb.statistics import correlation_text, typeset

PENDULUM = "Synthetic-Pendulum-v1"
# One thing changed at a time.
VARIATIONS: list[dict[str, Any]] = [
    *({"reward_noise": x} for x in (0.0, 1.0, 2.0, 5.0, 10.0)),
    *({"contexts": x} for x in (50, 1000)),
    *({"iterations": x} for x in (5, 45)),
    *({"epochs": x} for x in (1, 4)),
    *({"minibatches": x} for x in (1, 4)),
    *({"learning_rate": x} for x in (3e-4, 3e-3)),
    # The paper's own inner loop: no noise, 20 batches of 500, a learning rate of 0.005.
    {"reward_noise": 0.0, "contexts": 500, "iterations": 20, "learning_rate": 5e-3},
]
FIRST_SEED = 500  # neither the seeds that meta-training sees nor those that report
CONFIRMATION_SEED = 700
# Steps in the environment: after PPO's own number every objective solves either task, and nothing is ranked.
CONFIRMATIONS = {"CartPole-v1": 10_000, "Acrobot-v1": 20_000}
CONFIRMED: list[dict[str, Any]] = [{"reward_noise": x} for x in (0.0, 5.0, 10.0)]
HELD_OUT = "Pendulum-v1, held out"
# Of the zoo's only those that owe this experiment nothing: the bandits of lpo-multi were chosen by what it said.
OF_THE_ZOO = ("lpo-pendulum", "lpo-pendulum-ee", "ta-lpo")

# What `lpo meta-train` judges candidates by.
FITNESS = "return, mode actions"
CHOICES = ("pendulum", "pendulum_small_last_layer")


def recommendation(report: Mapping[str, Any]) -> dict[str, Any]:
    """Correlations of the fitness that meta-training uses: each regime's over both choices, and the confirmations'."""
    stages = report["stages"]
    chosen = [
        [x["alignment"][FITNESS]["spearman"] or 0.0 for x in stages[name]["regimes"]]
        for name in CHOICES
        if name in stages
    ]
    if len(chosen) != len(CHOICES) or len({*map(len, chosen)}) != 1 or not chosen[0]:
        raise UserError(
            "the regimes to choose among are not all measured: the same command goes on."
        )
    names = [x["name"] for x in stages[CHOICES[0]]["regimes"]]
    confirmed = {}
    for name in stages.keys() - set(CHOICES):
        of_regime = {
            (x["bandit"], x["reward_noise"]): x["alignment"][FITNESS]["spearman"] or 0.0
            for x in stages[name]["regimes"]
        }
        own, noise = environment_spec(stages[name]["environment"]).bandit, Regime().reward_noise
        needed = {(own, noise), (own, 0.0), (PENDULUM, noise)}
        if not needed <= of_regime.keys():
            continue  # it was interrupted
        carried = None if own == PENDULUM else of_regime[PENDULUM, noise]
        confirmed[name] = (of_regime[own, noise], of_regime[own, 0.0], carried)
    return {
        "means": dict(zip(names, np.mean(chosen, axis=0).tolist(), strict=True)),
        "confirmed": {name: confirmed[name] for name in stages if name in confirmed},
        "fitness": FITNESS,
    }


def begun(report: Mapping[str, Any]) -> dict[str, Any]:
    """The stages that have a regime."""
    return {name: stage for name, stage in report["stages"].items() if stage["regimes"]}


def facts(report: Mapping[str, Any]) -> dict[str, Any]:
    """Every stage's table."""
    tables = {
        name: [
            [
                figures.regime_label(row, stage["environment"]),
                *(typeset(correlation_text(row["alignment"][f])) for f in LABELS),
            ]
            for row in stage["regimes"]
        ]
        for name, stage in begun(report).items()
    }
    return {
        **recommendation(report),
        "tables": tables,
        "fitnesses": list(LABELS),
        "files": {name: figure_name(name) for name in tables},
        "measured": next(iter(report["stages"].values()))["machine"],
    }


def figure_name(stage: str) -> str:
    """The file name of a stage's heat map."""
    return f"alignment_{stage.replace(', ', '_').replace(' ', '_')}"


@dataclass(frozen=True)
class Options:
    """Who is ranked, and by how many agents."""

    agents: int = 16
    """agents of each objective"""
    adversaries: tuple[Path, ...] = ()
    """learned objectives' files"""
    held_out: tuple[Path, ...] = ()
    """files of objectives that confirm alone"""
    skip_confirmation: bool = False


def measure(options: Options, report: dict[str, Any], save: Save) -> None:
    """A stage at a time."""

    learned = [*OF_THE_ZOO, *map(str, options.adversaries)]
    family = [*known_drifts(), *map(load_objective, learned)]
    held_out = [*other_drifts(), *map(load_objective, options.held_out)]
    for objective in held_out:
        twins = [member.name for member in family if same_drift(objective, member)]
        if twins:
            raise UserError(
                f"{objective.name} is to be held out, and the family has it as {twins[0]}: leave it out of --held-out."
            )
    report["command"] = command_of("alignment", options)
    report.setdefault("stages", {})

    def stage(
        name: str,
        environment: str,
        role: str,
        regimes: list[Regime],
        seed: int,
        objectives: list[Objective] = family,
        **more: Any,
    ) -> None:
        def keep(measured: dict[str, Any]) -> None:
            report["stages"][name] = {"role": role, **measured}
            save()

        stored = report["stages"].get(name, {})
        measure_alignment(
            regimes,
            objectives,
            environment,
            list(range(seed, seed + options.agents)),
            **more,
            tell=lambda line: print(line, flush=True),
            done={k: v for k, v in stored.items() if k != "role"},
            keep=keep,
        )

    variations = [Regime(PENDULUM, **variation) for variation in VARIATIONS]
    stage("pendulum", "Pendulum-v1", "the choice", variations, FIRST_SEED)
    small = [replace(regime, policy_output_scale=0.01) for regime in variations]
    name, role = CHOICES[1], "the choice, last layer of the policy times 0.01"
    stage(name, "Pendulum-v1", role, small, FIRST_SEED, policy_output_scale=0.01)
    if not options.skip_confirmation:
        regimes = [Regime(PENDULUM, **variation) for variation in CONFIRMED]
        role = "the confirmation, objectives that are not in the family"
        stage(HELD_OUT, "Pendulum-v1", role, regimes, CONFIRMATION_SEED, held_out)
        for environment, steps in CONFIRMATIONS.items():
            regimes = [
                Regime(environment_spec(environment).bandit, **variation) for variation in CONFIRMED
            ]
            regimes.append(Regime(PENDULUM))
            forget_programs()
            role = "the confirmation"
            stage(environment, environment, role, regimes, CONFIRMATION_SEED, steps=steps)


def draw(report: Mapping[str, Any]) -> dict[str, Figure]:
    """A heat map a stage."""
    found = begun(report).items()
    return {figure_name(name): figures.alignment_heatmap(stage) for name, stage in found}


EXPERIMENT = Experiment(
    "alignment",
    "Which bandit regime ranks objectives as the environment does",
    measure,
    facts=facts,
    draw=draw,
    options=Options,
    keys=("stages",),
)
