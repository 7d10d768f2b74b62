r"""What the drifts do to an update: PPO's clip, DPO's closed form and every learned one of the zoo.

    python -m experiments.understanding

writes docs/understanding.md, its figure and its numbers; all of its sentences are made from the
numbers. Learned drifts that were written down as formulas join it with what they earn:

    lpo distill lpo-pendulum --out runs/distill
    lpo evaluate --objectives ppo dpo lpo-pendulum runs/distill/closed_form.npz --seed 31000 --out runs/formula
    python -m experiments.understanding --formulas runs/distill/closed_form.npz \
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
from experiments.rendering import listed
from lpo import drift_figures
from lpo.drifts import ClosedFormDrift
from lpo.objectives import load_objective, zoo_names
from lpo.update_regions import REGIONS, analyze
from scb.errors import UserError
from scb.statistics import paired_difference

PROGRESS = (0.0, 0.5, 1.0)


def analyses(names: Sequence[str]) -> list[dict[str, Any]]:
    """The analyses of these objectives, temporal ones at every fraction of `PROGRESS`."""
    rows = []
    for objective in map(load_objective, names):
        temporal = objective.drift.temporal
        for fraction in PROGRESS if temporal else (0.5,):
            rows.append({**analyze(objective, fraction).as_dict(), "temporal": temporal})
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


def read_comparison(path: Path, formulas: Sequence[Mapping[str, Any]] = ()) -> dict[str, Any]:
    """What the page says of a comparison of `lpo evaluate`; formulas are compared with what they were fitted to."""
    try:
        whole = json.loads(path.read_text())
        curves = whole["curves"]
        first = curves[0]
        final = {c["objective"]: np.array(c["returns"])[:, -1] for c in curves}
        to_original = {
            f["name"]: {"of": f["of"]}
            | paired_difference(final[f["name"]], final[f["of"]]).as_dict()
            for f in formulas
            if f["name"] in final and f["of"] in final
        }
        return {
            "environment": first["environment"],
            "backend": first["backend"],
            "steps": first["steps"][-1],
            "seeds": first["seeds"],
            "episodes": first["episodes"],
            "mode_actions": first["mode_actions"],
            "policy_output_scale": first.get("policy_output_scale", 1.0),
            "reference": whole["reference"],
            "final_iqm": {c["objective"]: c["final_iqm"] for c in curves},
            "paired_differences": whole["paired_differences"],
            "to_original": to_original,
        }
    except (OSError, KeyError, IndexError, TypeError, ValueError) as error:
        raise UserError(
            f"{path} is no comparison ({error}): give a comparison.json of lpo evaluate."
        ) from error


def facts(report: Mapping[str, Any]) -> dict[str, Any]:
    """The table's rows, and what each says in words."""
    rows = [
        {
            "label": _label(row),
            "cells": [
                *(_percent(row["fractions"][name]) for name in REGIONS),
                *(_stop(row["stops"][sign]) for sign in ("+1", "-1")),
            ],
            "words": words(row),
        }
        for row in report["analyses"]
    ]
    names = list(dict.fromkeys(row["objective"] for row in report["analyses"]))
    regions = {name: meaning.replace("-0.05", "−0.05") for name, meaning in REGIONS.items()}
    return {"rows": rows, "names": names, "regions": regions}


def words(row: Mapping[str, Any]) -> str:
    """Two or three sentences about an analysis, out of its numbers alone."""
    fractions, beyond = row["fractions"], row["beyond"]
    positive, negative = (_fate(beyond[sign]) for sign in ("positive", "negative"))
    fate = (
        f"{positive}, whatever the advantage's sign"
        if positive == negative
        else f"{positive} for positive advantages; for negative ones it {negative}"
    )
    sentences = [f"Where PPO's clip stops an update, this one {fate}."]
    changed = {
        name: fractions[name]
        for name in ("cautious", "amplified", "hindered")
        if fractions[name] >= 0.005
    }
    inside = listed([f"{name} in {_percent(share)}" for name, share in changed.items()])
    sentences.append(
        f"Elsewhere it is {inside} of the grid, and leaves the gradient as it is in "
        f"{_percent(fractions['free'])}."
        if changed
        else f"Elsewhere, {_percent(fractions['free'])} of the grid, it leaves the gradient as it is."
    )
    stops = [
        f"at ratio {_stop(row['stops'][sign])} with an advantage of {shown}"
        if row["stops"][sign] is not None
        else f"nowhere {where} with an advantage of {shown}"
        for sign, shown, where in (("+1", "+1", "up to ratio 2"), ("-1", "−1", "down to ratio 0.5"))
    ]
    sentences.append(f"It stops {stops[0]}, and {stops[1]}.")
    if fractions["rolls back"] >= 0.005:
        sentences.append(
            f"In all, it turns round in {_percent(fractions['rolls back'])} of the grid."
        )
    return " ".join(sentences)


def _fate(shares: Mapping[str, float]) -> str:
    fates = [
        (shares["optimistic"], "goes on"),
        (shares["flat"], "stops"),
        (shares["rolls back"], "turns round"),
    ]
    shown = [(what, share) for share, what in fates if share >= 0.005]
    if len(shown) == 1:
        return f"{shown[0][0]} everywhere"
    return listed([f"{what} in {_percent(share)}" for what, share in shown])


def _label(row: Mapping[str, Any]) -> str:
    name = f"`{row['objective']}`"
    return f"{name} at {100 * row['progress']:g} % of training" if row["temporal"] else name


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %" if 0.0 < share < 0.1 else f"{100 * share:.0f} %"


def _stop(ratio: float | None) -> str:
    return "never" if ratio is None else f"{ratio:.2f}"


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
        report["comparisons"] = [read_comparison(path, formulas) for path in options.comparisons]
    report.setdefault("comparisons", [])
    save()


def draw(report: Mapping[str, Any]) -> Figure:
    """Drift and gradient of every objective."""
    names = dict.fromkeys(row["objective"] for row in report["analyses"])
    return drift_figures.drift_and_gradient([load_objective(name) for name in names], PROGRESS)


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


if __name__ == "__main__":
    raise SystemExit(EXPERIMENT.main())
