"""What `lpo meta-train`, `distill` and `certify` do. Their docstrings are the command line's help."""

import shlex
import sys
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

import tyro

from lpo import search_figures
from lpo.certificate import certify
from lpo.distill import distill
from lpo.drifts import Drift, LearnedDrift, learned_drift
from lpo.formula_search import DistillConfig
from lpo.inner_loop import MetaTrainingConfig
from lpo.meta_training import (
    TEMPORAL_HORIZONS,
    VALIDATION_AGENTS,
    MetaTraining,
    learn_objective,
)
from lpo.objectives import Objective, load_objective, save_objective
from scb import plotting, processes
from scb.command_line import GENERATIONS, LongRun, SharedOutput, flag_names, flags, listed
from scb.console import console
from scb.errors import UserError
from scb.files import make_folder
from scb.machine import machine_description

_DISTILL = DistillConfig()


def _meta_training(
    population: int, generations: int, given: Mapping[str, str]
) -> MetaTrainingConfig:
    """A preset of meta-training."""
    names = {given[x] for x in ("environment", "tasks") if x in given}
    if len(names) > 1:
        raise UserError(
            f"the environment {given['environment']} and the tasks {given['tasks']} are both given: name all in "
            "the tasks."
        )
    tasks = listed(names.pop(), "tasks") if names else MetaTrainingConfig.tasks
    temporal = {"temporal": True} if "temporal" in given else {}
    drift = learned_drift(given.get("drift", LearnedDrift.name), **temporal)
    taken = {*drift.settings()}.intersection(flag_names(MetaTrain(), Drift))
    if taken:
        raise UserError(
            f"the drift {drift.family()} has a field {min(taken)}, and --{min(taken)} is something else here: give the "
            "field another name."
        )
    default = MetaTrainingConfig(
        tasks=tasks,
        drift=drift,
        horizons=TEMPORAL_HORIZONS if temporal else (),
        validation="validate" in given,
    )
    evolution = replace(
        default.evolution,
        population_size=population,
        num_generations=generations,
        # Returns of different tasks have different scales.
        combine="mean" if len(tasks) == 1 else "ranks",
    )
    if default.validation:
        evolution = replace(evolution, mean_evaluations=VALIDATION_AGENTS)
    return replace(default, evolution=evolution)


@dataclass(frozen=True, kw_only=True)
class MetaTrain(LongRun):
    """Learn an objective: evolve a drift on a bandit, or on an environment.

    A resumed search may have more --generations, or fewer than were asked for, to end early.

    Attributes:
      preset: quick (30 generations of 32) or paper (512 of 64); single flags override it.
      family: what is learned: network, mirror, or package.module:Class of one's own.
    """

    program = "lpo meta-train"
    presets = MappingProxyType(
        {"quick": partial(_meta_training, 32, 30), "paper": partial(_meta_training, 64, 512)}
    )
    deciding = ("tasks", "environment", "drift", "temporal", "validate")
    together = True

    config: Annotated[MetaTrainingConfig, tyro.conf.arg(name="inner loop")] = field(
        default_factory=MetaTrainingConfig
    )
    family: Annotated[str, tyro.conf.arg(name="drift")] = LearnedDrift.name
    output: SharedOutput = field(default_factory=lambda: SharedOutput(Path("runs/meta-train")))

    @classmethod
    def decided(cls, config: MetaTrainingConfig) -> dict[str, str]:
        temporal = {"temporal": ""} if config.drift.temporal else {}
        validate = {"validate": ""} if config.validation else {}
        return {
            "tasks": ",".join(config.tasks),
            "drift": config.drift.family(),
            **temporal,
            **validate,
        }

    def growing(self) -> Collection[str]:
        return GENERATIONS

    def inputs(self) -> dict[str, str]:
        return self.config.checksums()

    def run(self) -> None:
        objective = self.objective()
        if not processes.first():
            return
        folder = self.output.resume or self.output.out
        console().print(f"objective: {folder / 'objective.npz'}", soft_wrap=True)
        console().print(f"it {certify(objective.drift, objective.parameters)}")

    def objective(self) -> Objective:
        """What the run folder holds, or learns."""
        problem = MetaTraining(
            self.config
        )  # before the folder, which a mistake must not leave behind
        run = self.open()
        objective = learn_objective(problem, run, self.command)
        # A log that was lost is no reason to fail.
        if processes.first() and (metrics := run.metrics()):
            curve = search_figures.meta_training_curve(metrics, self.config)
            plotting.save(curve, run.folder / "figures" / "meta_training.png")
        return objective


def distill_command(
    objective: tyro.conf.Positional[str],
    config: Annotated[DistillConfig, tyro.conf.arg(name="")] = _DISTILL,
    out: Path = Path("runs/distill"),
) -> None:
    """Write a learned objective down as a formula: symbolic regression with gplearn (extra `distill`).

    Prints the formula, how well it fits the drift and its slope on points that the fit has not seen,
    and its certificate. --out/closed_form.npz is an objective like any other.

    Args:
      objective: a zoo name or path.npz.
      config: how the formula is looked for.
      out: folder for closed_form.npz and closed_form.json; must be new or empty.
    """
    loaded = load_objective(objective)
    # Before the search and not after it, which may take hours.
    make_folder(out)
    if any(out.iterdir()):
        raise UserError(f"{out} already exists and is not empty: choose another --out.")
    found = distill(loaded, config)
    words = [Path(objective).name, *flags(config, _DISTILL)]
    path, certificate = save_objective(
        out / "closed_form.npz",
        found.drift,
        found.parameters,
        {
            "config": {
                "distill": config,
                "of": loaded.name,
                "of_sha256": loaded.sha256 or None,
                "learned_on": loaded.learned_on,
                "homes": loaded.homes,
            },
            "seeds": {"distill": config.seed},
            "results": {"r2": found.r2, "base_r2": found.base_r2, "front": found.front},
            "cost": {"seconds": round(found.seconds, 1), "machine": machine_description()},
            # A file goes by its name: the folder it lay in is this machine's.
            "command": shlex.join(["lpo", "distill", *words]),
        },
    )
    print(f"expression: {found.drift.expression}")
    gate = f"gate({found.drift.gate:g}) * " if found.drift.gate else ""
    print(f"drift: relu({'' if found.drift.base == 'none' else 'base + '}{gate}expression - xi)")
    print("R² on unseen points: " + ", ".join(f"{k} {v:.3f}" for k, v in found.r2.items()))
    base = ", ".join(f"{k} {v:.3f}" for k, v in found.base_r2.items())
    print(f"R² of the base ({found.drift.base}) alone: {base}")
    print(f"it {certificate}")
    print(f"objective: {path}")


def certify_command(objective: tyro.conf.Positional[str]) -> None:
    """Check that an objective is a drift, and lets policies move: its conditions and its slope on a dense grid.

    Learned drifts and formulas meet the conditions of mirror learning by construction; of those look at
    slope and kink. Exits with 1 where a condition fails, or where the kink may hold a policy still.

    Args:
      objective: ppo, ppo-0.3, dpo, dpo-4-1.2, none, a zoo name, path.npz, or
        package.module:function of your own.
    """
    loaded = load_objective(objective)
    certificate = certify(loaded.drift, loaded.parameters)
    print(f"{loaded.name} {certificate}")
    if not certificate.holds or certificate.stalls:
        sys.exit(1)
