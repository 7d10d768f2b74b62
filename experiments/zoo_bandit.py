"""Puts discovered bandits into the zoo, with what they were measured to be worth.

    python -m experiments zoo_bandit runs/mine/Synthetic-Pendulum-v1.npz --table docs/data/zoo_table.json

Results are those of `experiments.zoo_table` for exactly these weights, else those that `scb discover`
measured at its end; nothing is edited by hand. A new bandit enters with what it has, `zoo_table`
measures the zoo, and the same command again fills the table's results in.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from experiments.harness import DATA, Experiment, Save
from experiments.reports import read
from scb.environments.zoo import bandit_metadata, load_bandit, save_bandit


def results_of(table: Mapping[str, Any], sha256: str, backend: str | None = None) -> dict[str, Any]:
    """{"PPO": {...}, ...} of the bandit with this checksum, in its physics; empty where the table has none."""
    results = {}
    for entry in table.get("entries", []):
        if (entry["sha256"], entry["bandit"], entry["backend"]) != (sha256, "ours", backend):
            continue
        result: dict[str, Any] = {
            "agents": entry["agents"],
            "episodes": entry["episodes"],
            "hyperparameters": "sampled from the paper's lists"
            if entry["backend"] is None
            else "fixed",
            "seed": entry["seed"],
            "sampled_actions": entry["sampled_actions"]["iqm"],
            "mode_actions": entry["mode_actions"]["iqm"],
        }
        if failed := max(entry[x]["failed"] for x in ("sampled_actions", "mode_actions")):
            result["failed"] = failed
        if entry["backend"] is not None:
            result["backend"] = entry["backend"]
        results[entry["algorithm"].upper()] = result
    return results


@dataclass(frozen=True)
class Options:
    """Which bandits, and from where to where."""

    bandits: tyro.conf.Positional[tuple[Path, ...]]
    """files that scb discover wrote"""
    table: Path | None = None
    """what they are worth, of zoo_table; docs/data/zoo_table.json where that is there"""
    folder: Path = Path("scb/zoo")


def measure(options: Options, report: dict[str, Any], save: Save) -> None:
    """Writes the entries."""
    usual = DATA / "zoo_table.json"
    table = read(options.table or usual, missing_is_new=options.table is None)
    for path in options.bandits:
        bandit = load_bandit(path)
        metadata = dict(bandit_metadata(str(path)))
        # The weights' bytes decide the checksum, so that it stays the same in every folder.
        backend = metadata["config"].get("backend")
        if measured := results_of(table, metadata["sha256"], backend):
            metadata["results"] = measured
            (seed,) = {result["seed"] for result in measured.values()}
            metadata["seeds"] = {**metadata["seeds"], "reporting": seed}
        weights = bandit.default_params.weights
        written = save_bandit(options.folder / path.name, bandit, weights, metadata)
        print(f"{written}: measured {', '.join(metadata['results']) or 'nothing yet'}")


EXPERIMENT = Experiment(
    "zoo_bandit", "Discovered bandits into the zoo", measure, options=Options, reports=False
)
