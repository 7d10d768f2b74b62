"""How long a training an objective bears: on its bandit, from a quarter to eight times as long as where it was learned.

    python -m experiments horizons

Agents train on the Pendulum bandit as they do where objectives are learned, and are judged there, for as many batches
as the inner loop has and for fewer and more; the same agents with every objective, and with PPO's clip.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure

from experiments.claims import corrected
from experiments.harness import Experiment
from experiments.parts import InParts, Part
from experiments.reports import Report, forget_other, settled
from lpo import figures
from lpo.inner_loop import MetaTrainingConfig, TaskTraining
from lpo.objectives import REFERENCE, load_objective, zoo_names
from scb import plotting
from scb.environments.zoo import bandit_metadata
from scb.errors import UserError, at_least
from scb.files import packed_row, unpacked_row
from scb.keys import named_key, root_key
from scb.measurement import Place, as_random
from scb.statistics import Estimate, estimate

TASK = "Synthetic-Pendulum-v1"
SEED = 1  # nothing is chosen by it


@dataclass(frozen=True)
class Options:
    """Which objectives, and how long trainings."""

    objectives: tuple[str, ...] = ("dpo", *zoo_names())
    """beside PPO's clip"""
    horizons: tuple[float, ...] = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
    """lengths, in trainings of the search"""
    agents: int = 64
    """of each objective, for every length; 10 at least, for an interval"""

    def __post_init__(self) -> None:
        at_least(10, self, "agents")
        if not self.horizons or min(self.horizons) <= 0:
            raise UserError(f"the horizons are {self.horizons}: give positive numbers.")


def measured(name: str, options: Options) -> dict[str, Any]:
    """{horizon: what each agent earns}, in standard deviations of the bandit's reward, and whose weights these were."""
    objective = load_objective(name)
    config = MetaTrainingConfig(drift=objective.drift, horizons=options.horizons)
    task = TaskTraining(config, TASK)
    scale = float(task.env.reward_scale(task.env_params, named_key(root_key(SEED), "scale")))
    key = named_key(root_key(SEED), "horizons")
    earned = jax.jit(lambda of, horizon: task.fitness(of, key, options.agents, horizon))
    found, place = {}, Place.named(TASK)
    for horizon in options.horizons:
        returns, _ = as_random(np.asarray(earned(objective.parameters, horizon)), place)
        found[f"{horizon:g}"] = packed_row(returns / scale)
    digests = {"sha256": bandit_metadata(TASK)["sha256"], "objective_sha256": objective.sha256}
    return {**digests, "returns": found}


def parts(options: Options, report: dict[str, Any]) -> Iterator[Part]:
    """An objective at a time."""
    settled(report, agents=options.agents, horizons=list(options.horizons))
    entries = report.setdefault("objectives", {})
    # All of them before the first is measured.
    named = {name: load_objective(name) for name in (REFERENCE, *options.objectives)}
    bandit = bandit_metadata(TASK)["sha256"]
    for name in list(entries):  # also of what is not asked for, which is compared with what is
        forget_other(entries, name, bandit)
    for name, objective in named.items():
        forget_other(entries, name, objective.sha256, "objective_sha256")
        yield Part(("objectives", name), partial(measured, name, options))


measure = InParts(parts)


def leads(report: Report) -> dict[str, dict[str, Estimate]]:
    """{objective: {horizon: how much more its agents earn than with PPO's clip}}, corrected for all together."""
    returns = {
        name: {h: unpacked_row(line) for h, line in entry["returns"].items()}
        for name, entry in report["objectives"].items()
    }
    reference = returns.pop(REFERENCE)
    confidence = corrected(sum(map(len, returns.values())))
    return {
        name: {h: estimate(x - reference[h], np.mean, confidence) for h, x in of_it.items()}
        for name, of_it in returns.items()
    }


def facts(report: Report) -> dict[str, Any]:
    """The leads, and for which lengths each objective is shown ahead of the clip, or behind it."""
    found = leads(report)
    batches = TaskTraining(MetaTrainingConfig(), TASK).spec.config.num_iterations
    known = {name: load_objective(name) for name in found}
    learned = {
        name: o.metadata.get("config", {}).get("meta_training", {}).get("horizons") or [1.0]
        for name, o in known.items()
        if o.learned_on
    }
    sides = {
        name: {
            "ahead": [h for h, x in of_it.items() if x.side() > 0],
            "behind": [h for h, x in of_it.items() if x.side() < 0],
        }
        for name, of_it in found.items()
    }
    return {"leads": found, "sides": sides, "learned": learned, "batches": batches}


def draw(report: Mapping[str, Any]) -> Figure:
    """Each objective's lead over the clip against how long its agents trained."""
    figure = Figure(figsize=(7, 4))
    axes = figure.subplots()
    found = leads(report)
    looks = figures.looks(list(found))
    for name, of_it in found.items():
        lengths = [float(h) for h in of_it]
        plotting.estimate_curve(axes, lengths, list(of_it.values()), looks[name], name)
    axes.axhline(0, color=plotting.GREY, linewidth=1)
    axes.set_xscale("log", base=2)
    ticks = report["horizons"]
    axes.set_xticks(ticks, [f"{x:g}" for x in ticks])
    axes.set(xlabel="length of the training, in trainings of the search")
    axes.set_ylabel("more than with PPO's clip,\nin deviations of the reward")
    if found:
        axes.legend(fontsize=8)
    return figure


EXPERIMENT = Experiment(
    "horizons",
    "How long a training do learned objectives bear?",
    measure,
    draw,
    facts=facts,
    options=Options,
    keys=("objectives",),
)
