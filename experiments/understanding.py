r"""What the drifts do to an update: PPO's clip, DPO's closed form and every learned one of the zoo.

    python -m experiments understanding

writes docs/understanding.md, its figure and its numbers; all of its sentences are made from the
numbers. Learned drifts that were written down as formulas join it with what they earn:

    lpo distill lpo-pendulum --out runs/distill
    lpo evaluate --objectives ppo dpo lpo-pendulum runs/distill/closed_form.npz --seed 31000 --out runs/formula
    python -m experiments understanding --formulas runs/distill/closed_form.npz \
        --comparisons runs/formula/comparison.json

What the file of numbers holds of formulas and comparisons is kept where they aren't given again.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments.harness import Experiment, Save
from lpo import drift_figures
from lpo.drifts import ClosedFormDrift
from lpo.objectives import load_apart, load_objective, zoo_names
from lpo.update_regions import REGIONS, analyze
from scb.errors import UserError
from scb.statistics import paired_difference

PROGRESS = (0.0, 0.5, 1.0)


def analyses(names: Sequence[str]) -> list[dict[str, Any]]:
    """The analyses of these objectives, temporal ones at every fraction of `PROGRESS`; "loads" is what loads one."""
    rows = []
    for name, objective in zip(names, load_apart(names), strict=True):
        said = {"temporal": objective.drift.temporal, "loads": name}
        for fraction in PROGRESS if objective.drift.temporal else (0.5,):
            rows.append({**analyze(objective, fraction).as_dict(), **said})
    return rows


def read_formula(path: Path) -> dict[str, Any]:
    """What the page says of a closed form, from its artefact."""
    objective = load_objective(path)
    if not isinstance(objective.drift, ClosedFormDrift):
        raise UserError(f"{path} is no formula: give what lpo distill wrote.")
    metadata = objective.metadata
    return {
        "name": objective.name,
        "of": metadata["config"].get("of"),
        "expression": objective.drift.expression,
        "base": objective.drift.base,
        "gate": objective.drift.gate,
        "r2": metadata["results"].get("r2"),
        "base_r2": metadata["results"].get("base_r2"),
        "certificate": metadata["certificate"],
        "command": metadata["command"],
        "cost": metadata["cost"],
    }


def read_comparison(path: Path) -> dict[str, Any]:
    """A comparison of `lpo evaluate`: how it was made, estimates by objective, and "final" {objective: [S] returns}."""
    try:
        whole = json.loads(path.read_text())
        curves, first = whole["curves"], whole["curves"][0]
        names = ("environment", "backend", "seeds", "episodes", "mode_actions")
        return {
            **{name: first[name] for name in names},
            "steps": first["steps"][-1],
            # Those of earlier versions say the one that could be other.
            "hyperparameters": first.get("hyperparameters", _of_earlier(first)),
            "reference": whole["reference"],
            "final_iqm": {c["objective"]: c["final_iqm"] for c in curves},
            "area_iqm": {c["objective"]: c["area_iqm"] for c in curves},
            "paired_differences": whole["paired_differences"],
            "final": {c["objective"]: np.array(c["returns"])[:, -1] for c in curves},
        }
    except (OSError, KeyError, IndexError, TypeError, ValueError) as error:
        raise UserError(
            f"{path} is no comparison ({error}): give a comparison.json of lpo evaluate."
        ) from error


def _of_earlier(curve: Mapping[str, Any]) -> dict[str, Any]:
    scale = curve.get("policy_output_scale", 1.0)
    return {} if scale == 1.0 else {"policy_output_scale": scale}


def compared(path: Path, formulas: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What the page says of a comparison; formulas are compared with what they were fitted to."""
    found = read_comparison(path)
    final = found.pop("final")
    del found["area_iqm"]
    to_original = {
        f["name"]: {"of": f["of"]} | paired_difference(final[f["name"]], final[f["of"]]).as_dict()
        for f in formulas
        if f["name"] in final and f["of"] in final
    }
    return {**found, "to_original": to_original}


def facts(report: Mapping[str, Any]) -> dict[str, Any]:
    """The objectives, and what their regions mean."""
    names = list(dict.fromkeys(row["objective"] for row in report["analyses"]))
    regions = {name: meaning.replace("-0.05", "−0.05") for name, meaning in REGIONS.items()}
    return {"names": names, "regions": regions}


@dataclass(frozen=True)
class Options:
    """What is analysed, and what of elsewhere joins it."""

    objectives: tuple[str, ...] = ()
    """ppo, dpo and the zoo if left out"""
    formulas: tuple[Path, ...] | None = None
    """of lpo distill"""
    comparisons: tuple[Path, ...] | None = None
    """of lpo evaluate"""


def measure(options: Options, report: dict[str, Any], save: Save) -> None:
    """The analyses anew; formulas and comparisons where they are given."""
    report["analyses"] = analyses(options.objectives or ["ppo", "dpo", *zoo_names()])
    if options.formulas is not None:
        report["formulas"] = [read_formula(path) for path in options.formulas]
    formulas = report.setdefault("formulas", [])
    if options.comparisons is not None:
        report["comparisons"] = [compared(path, formulas) for path in options.comparisons]
    report.setdefault("comparisons", [])
    save()


def draw(report: Mapping[str, Any]) -> Figure:
    """Drift and gradient of every objective."""
    names = list(dict.fromkeys(row["loads"] for row in report["analyses"]))
    return drift_figures.drift_and_gradient(load_apart(names), PROGRESS)


EXPERIMENT = Experiment(
    "understanding",
    "What the drifts do to an update",
    measure,
    facts=facts,
    draw=draw,
    options=Options,
    keys=("analyses",),
    dpi=100,  # half the usual: it is a tall figure of smooth maps, which compress badly
)
