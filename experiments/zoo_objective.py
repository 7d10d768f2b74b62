"""Puts a learned objective into the zoo, with what it was measured to be worth.

    python -m experiments zoo_objective runs/mine/objective.npz lpo-pendulum --comparisons runs/eval/comparison.json

The comparisons are what `lpo evaluate --out` wrote for that objective; nothing is edited by hand.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import tyro

from experiments.harness import Experiment, Save
from experiments.understanding import read_comparison
from lpo.objectives import load_objective, run_name, save_objective
from scb.errors import UserError


def _short(name: str, file: Path, zoo_name: str) -> str:
    """What the zoo calls an objective of a comparison: this file's by its name in the zoo, a run's by its folder."""
    path = Path(name)
    # Files of one name go by their paths there.
    if name == run_name(file) or path.resolve() == file.resolve():
        return zoo_name
    return run_name(path) if path.suffix == ".npz" else name


@dataclass(frozen=True)
class Options:
    """Which objective, by what name, and what it was measured to be worth."""

    objective: tyro.conf.Positional[Path]
    name: tyro.conf.Positional[str]
    comparisons: tuple[Path, ...] = ()
    """comparison.json of lpo evaluate"""
    folder: Path = Path("lpo/zoo")


def measure(options: Options, report: dict[str, Any], save: Save) -> None:
    """Writes the entry."""
    objective = load_objective(options.objective)
    if not objective.drift.learned:
        raise UserError(f"{objective.name} is a closed form: the zoo holds learned objectives.")
    metadata: dict[str, Any] = dict(objective.metadata)
    results = dict(metadata["results"])
    short = partial(_short, file=options.objective, zoo_name=options.name)
    reporting_seeds = {}
    for path in options.comparisons:
        found = read_comparison(path)
        environment = found["environment"]
        for name, value in found["hyperparameters"].items():
            environment += f", {name} {value}"
        if environment in reporting_seeds:
            raise UserError(f"two of the comparisons are of {environment}: give one.")
        reporting_seeds[environment] = found["seeds"]
        by_objective = ("final_iqm", "area_iqm", "paired_differences")
        results[environment] = {
            name: found[name]
            for name in ("backend", "steps", "episodes", "mode_actions", "reference")
        } | {name: {short(k): x for k, x in found[name].items()} for name in by_objective}
    metadata["results"] = results
    metadata["seeds"] = {**metadata["seeds"], "reporting": reporting_seeds}
    path, certificate = save_objective(
        options.folder / f"{options.name}.npz", objective.drift, objective.parameters, metadata
    )
    print(f"{path}: {certificate}")


EXPERIMENT = Experiment(
    "zoo_objective", "A learned objective into the zoo", measure, options=Options, reports=False
)
