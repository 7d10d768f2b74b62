"""PPO's clip and learning rate on locomotion: what agents that report nothing say, and those at another rate."""

from collections.abc import Mapping
from typing import Any

from experiments.locomotion_claims import paired
from experiments.reports import Report
from lpo.comparison import Comparison, ppo_spec
from lpo.full_size import as_comparison
from lpo.objectives import CLIPS, REFERENCE
from scb.statistics import DECIDING, Estimate, iqm

ANNEALED = "annealed"


def label(setting: Mapping[str, Any]) -> str:
    """What it is called, such as "0.001" or "0.001, annealed"."""
    return f"{setting['learning_rate']}" + (f", {ANNEALED}" if len(setting) > 1 else "")


def named(environment: str, setting: Mapping[str, Any]) -> str:
    """The entry of what reports there: "hopper", "hopper at 0.001", "hopper at 0.001, annealed"."""
    own = {"learning_rate": float(ppo_spec(environment).hyperparameters.learning_rate)}
    return environment if setting in ({}, own) else f"{environment} at {label(setting)}"


def swept(entry: Report) -> dict[str, float]:
    """{clip: what it earns over the last quarter of the training}, as soon as all have as many agents."""
    found = entry.get("sweep", {})
    numbers = {len(found.get(clip, ())) for clip in CLIPS}
    if len(numbers) > 1 or numbers == {0}:
        return {}
    curves = as_comparison("", entry, {clip: found[clip] for clip in CLIPS}).curves
    return {curve.objective: float(iqm(curve.late)) for curve in curves}


def at_rates(environment: str, entry: Report) -> dict[str, dict[str, tuple[float, float, int]]]:
    """{learning rate: {objective: (over the training, over the last quarter, agents)}} of those that report nothing."""
    if not (rates := entry.get("rates")):
        return {}
    own = str(float(ppo_spec(environment).hyperparameters.learning_rate))
    there = {name for of_it in rates.values() for name in of_it}
    found = {own: {k: x for k, x in entry.get("sweep", {}).items() if k in there}, **rates}
    return {
        rate: {
            curve.objective: (float(iqm(curve.area)), float(iqm(curve.late)), len(curve.seeds))
            for curve in as_comparison(environment, entry, found[rate]).curves
        }
        for rate in sorted(found, key=lambda rate: (float(rate.partition(",")[0]), rate))
    }


def leads_at_rates(
    environment: str, entry: Report
) -> list[tuple[str, str, int, Estimate, Estimate]]:
    """Of objectives with enough agents at another rate: (rate, name, pairs, more than PPO over the training, late).

    Where the rate falls in others, they are beside PPO with it too, as "0.001 beside PPO at 0.001, annealed".
    """
    found = []
    rates = entry.get("rates", {})
    for rate, agents in rates.items():
        falling = f"{rate}, {ANNEALED}"
        for other in (rate, falling) if falling in rates else (rate,):
            if REFERENCE not in rates[other]:
                continue
            where = rate if other == rate else f"{rate} beside PPO at {other}"
            (reference,) = as_comparison(
                environment, entry, {REFERENCE: rates[other][REFERENCE]}
            ).curves
            ours = as_comparison(environment, entry, agents).curves
            comparison = Comparison(
                [reference, *(x for x in ours if other != rate or x.objective != REFERENCE)]
            )
            area, late = (comparison.differences(of) for of in ("area", "late"))
            enough = {name: x.n for name, x in area.items() if x.n >= DECIDING}
            found += [(where, name, n, area[name], late[name]) for name, n in enough.items()]
    return found


def tuned(sweep: Mapping[str, float]) -> str | None:
    """The clip that earns most; None where not all have been measured."""
    return max(sweep, key=lambda clip: sweep[clip]) if sweep else None


def beside_papers(
    shown: Mapping[str, Comparison],
) -> list[tuple[str, str, dict[str, Estimate]]]:
    """(entry, objective, {measure: difference}) of agents at other learning rates and PPO's clip at the paper's.

    Beside a clip that its learning rate makes worse, a lead is less than it seems.
    """
    found = []
    for name, comparison in shown.items():
        usual = shown.get(comparison.curves[0].environment)
        if usual is None or usual is comparison:
            continue
        for curves in comparison.curves:
            measured = {of: paired(curves, usual.curves[0], of) for of in ("final", "late", "area")}
            if apart := {of: x() for of, x in measured.items() if callable(x)}:
                found.append((name, curves.objective, apart))
    return found
