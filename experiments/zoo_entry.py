"""Puts a learned objective into the zoo, with what it was measured to be worth.

    python -m experiments.zoo_entry runs/mine/objective.npz lpo-pendulum --comparisons runs/eval/comparison.json

The comparisons are what `lpo evaluate --out` wrote for that objective; nothing is edited by hand.
"""

import argparse
import json
import sys
from functools import partial
from pathlib import Path
from typing import Any

from experiments.harness import exit_status, run_name
from lpo.objectives import load_objective, save_objective
from scb.errors import UserError


def _short(name: str, file: Path, zoo_name: str) -> str:
    """What a comparison calls an objective: this file's by its name in the zoo, a run's by its folder."""
    path = Path(name)
    if path.suffix != ".npz":
        return name
    if path.resolve() == file.resolve():
        return zoo_name
    return run_name(path)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("objective", type=Path)
    parser.add_argument("name")
    parser.add_argument("--comparisons", type=Path, nargs="*", default=[])
    parser.add_argument("--folder", type=Path, default=Path("lpo/zoo"))
    arguments = parser.parse_args()

    objective = load_objective(arguments.objective)
    if not objective.drift.learned:
        raise UserError(f"{objective.name} is a closed form: the zoo holds learned objectives.")
    metadata: dict[str, Any] = dict(objective.metadata)
    results = dict(metadata["results"])
    short = partial(_short, file=arguments.objective, zoo_name=arguments.name)
    reporting_seeds = {}
    for path in arguments.comparisons:
        comparison = json.loads(path.read_text())
        curves = comparison["curves"]
        environment = curves[0]["environment"]
        scale = curves[0].get("policy_output_scale", 1.0)
        if scale != 1.0:
            environment += f", policy_output_scale {scale:g}"
        reporting_seeds[environment] = curves[0]["seeds"]
        results[environment] = {
            "backend": curves[0]["backend"],
            "steps": curves[0]["steps"][-1],
            "episodes": curves[0]["episodes"],
            "mode_actions": curves[0]["mode_actions"],
            "final_iqm": {short(c["objective"]): c["final_iqm"] for c in curves},
            "area_iqm": {short(c["objective"]): c["area_iqm"] for c in curves},
            "reference": comparison["reference"],
            "paired_differences": {
                short(name): x for name, x in comparison["paired_differences"].items()
            },
        }
    metadata["results"] = results
    metadata["seeds"] = {**metadata["seeds"], "reporting": reporting_seeds}
    for own in ("schema_version", "name", "versions", "sha256", "kind", "certificate"):
        metadata.pop(own, None)
    path, certificate = save_objective(
        arguments.folder / f"{arguments.name}.npz", objective.drift, objective.parameters, metadata
    )
    print(f"{path}: {certificate}")
    return 0


if __name__ == "__main__":
    sys.exit(exit_status("zoo_entry", main))
