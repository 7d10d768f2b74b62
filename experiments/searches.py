"""Discoveries that experiments compare: each in a run folder of its own, so that a killed one goes on."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scb.discovery import BanditDiscovery, DiscoveryConfig
    from scb.evolution import Outcome


def search(config: "DiscoveryConfig", folder: str | Path) -> "tuple[BanditDiscovery, Outcome]":
    """A discovery in this run folder, resumed where it was begun; nothing is computed where it has ended."""
    from scb.discovery import discover
    from scb.evolution import config_dict
    from scb.runs import Run

    folder = Path(folder)
    run = Run.open(folder, config_dict(config), resume=(folder / "config.json").exists())
    try:
        return discover(config, run)
    finally:
        run.close()


def curve(metrics: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """What a search distribution's mean was worth over the generations, from a run's log.

    Returns:
      {"generation", "fitness" (interquartile mean over agents; None where one failed), "failed" (mean number of
      candidates without a finite fitness since the last judgement)}.
    """
    generations: list[int] = []
    fitness: list[float | None] = []
    failed: list[float] = []
    since: list[int] = []
    for line in metrics:
        if "mean/fitness" in line:
            generations.append(line["generation"])
            fitness.append(_rounded(line.get("mean/fitness_iqm")))
            failed.append(round(sum(since) / len(since), 3) if since else 0.0)
            since = []
        since.append(line["failed"])
        if "final_mean/fitness" in line:
            generations.append(line["generation"] + 1)
            fitness.append(_rounded(line.get("final_mean/fitness_iqm")))
            failed.append(round(sum(since) / len(since), 3))
    return {"generation": generations, "fitness": fitness, "failed": failed}


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(float(value), 2)
