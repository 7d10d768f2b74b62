"""What is asked of objectives on locomotion, and what became of the claims that were stated first."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from experiments.claims import FAILS, HOLDS, Claim, Judged, corrected, judge, of_agents
from experiments.reports import Report
from lpo.comparison import LearningCurves
from lpo.full_size import Confirmation, as_comparison, comparisons, looked_at, with_pairs
from lpo.objectives import REFERENCE
from scb.statistics import DECIDING, Estimate, paired_difference

MARGIN = 0.05  # of what the reference earns: what is not worse by more is as good


@dataclass(frozen=True)
class Asked:
    """What may be asked of an objective: `words` with a place for the reference, the measure that decides, a margin."""

    words: str
    measure: str
    margin: float = 0.0

    def beside(self, reference: str = REFERENCE, where: str = "") -> str:
        """In words, beside that reference, whose agents may have been trained elsewhere."""
        return self.words.format(_called(reference) + (f" on {where}" if where else ""))


# What is asked of every objective.
ASKED = {
    "final": Asked("ends no lower than {}", "final", MARGIN),
    "late": Asked("earns no less over the last quarter than {}", "late", MARGIN),
    "early": Asked("earns more over the first half than {}", "early"),
    "area": Asked("earns more over the training than {}", "area"),
}
# And what is asked only of the one for which it was stated.
STATED = {**ASKED, "late lead": Asked("earns more over the last quarter than {}", "late")}


def paired(
    curves: LearningCurves, reference: LearningCurves, of: str
) -> Callable[..., Estimate] | Estimate | None:
    """How much more agents of the same seeds earn, by one of `STATED`; no interval where there are few."""
    ours, theirs = curves.paired(reference, STATED[of].measure)
    return of_agents(partial(paired_difference, ours, theirs), len(ours)) if len(ours) else None


def claims(report: Report) -> list[Claim]:
    """Of every objective but the reference, by each of `ASKED`."""
    found = []
    for environment, comparison in comparisons(report).items():
        curves = comparison.by_name
        reference = curves.pop(REFERENCE)
        for of_it in curves.values():
            found += [_claim(environment, of_it, reference, of) for of in ASKED]
    return found


def confirmed(report: Report) -> list[tuple[Confirmation, int, Judged | None]]:
    """Of every confirmation: how many of its pairs of agents there are, and once all are, what became of it."""
    found: list[tuple[Confirmation, int, Judged | None]] = []
    for asked, seeds in with_pairs(report):
        judged = None
        if len(seeds) == len(asked.seeds):
            reference, ours = (
                _curves(report["environments"], *of_it, seeds) for of_it in asked.both
            )
            (judged,) = judge(
                [_claim(asked.environment, ours, reference, asked.of, asked.reference_in)]
            )
        found.append((asked, len(seeds), judged))
    return found


@dataclass(frozen=True)
class Shown:
    """What is shown of an objective, in words such as "ends no lower than PPO".

    Attributes:
      entry, objective: whose it is.
      stated: what was stated first, and confirmed.
      pooled: what all pairs together show beside that; nothing that new pairs were to confirm, and did not.
      refuted: what all pairs together show not to be so.
    """

    entry: str
    objective: str
    stated: list[str]
    pooled: list[str]
    refuted: list[str]


def summary(decided: Sequence[Judged], judged: Sequence[Judged]) -> list[Shown]:
    """Of every objective of which anything is: by claims that were stated first, and by those that are asked of all."""
    held = {x.claim.text for x in decided if x.outcome == HOLDS}
    # Who earns more earns no less.
    known = {x.claim.text for x in decided} | {
        x.replace("earns more", "earns no less") for x in held
    }
    new = [x for x in judged if x.claim.text not in known]

    def words(
        entry: str, objective: str, outcomes: Sequence[Judged], outcome: str = HOLDS
    ) -> list[str]:
        texts = [
            x.claim.text
            for x in outcomes
            if x.claim.of == (entry, objective) and x.outcome == outcome
        ]
        return [text.removeprefix(f"{entry}: {objective} ") for text in texts]

    rows = [
        Shown(
            entry,
            name,
            words(entry, name, decided),
            words(entry, name, new),
            words(entry, name, judged, FAILS),
        )
        for entry, name in dict.fromkeys(x.claim.of for x in (*judged, *decided))
    ]
    return [row for row in rows if row.stated or row.pooled or row.refuted]


def since(report: Report, asked: Confirmation) -> tuple[list[int], Estimate] | None:
    """(seeds, difference) of the pairs that were trained after those of a confirmation; None where they are few."""
    entries, last = looked_at(report), max(asked.seeds)
    later = [
        {s for s in entries.get(entry, {}).get("agents", {}).get(name, {}) if int(s) > last}
        for entry, name in asked.both
    ]
    shared = sorted(set.intersection(*later), key=int)
    if len(shared) < DECIDING:
        return None
    reference, ours = (_curves(entries, *of_it, shared) for of_it in asked.both)
    found = paired(ours, reference, asked.of)
    assert callable(found)
    return [int(seed) for seed in shared], found()


def _curves(
    entries: Mapping[str, Any], entry: str, objective: str, seeds: Sequence[str]
) -> LearningCurves:
    """Of these seeds alone."""
    agents = entries[entry]["agents"][objective]
    (curves,) = as_comparison(
        entry, entries[entry], {objective: {seed: agents[seed] for seed in seeds}}
    ).curves
    return curves


def leading(curves: Sequence[LearningCurves]) -> tuple[int, dict[str, dict[str, list[int]]]]:
    """Where objectives are apart from the first one along the training.

    Returns:
      (number of differences, {"ahead" or "behind": {objective: steps}}): of the points whose interval lies on one side
      of 0, corrected for that number.
    """
    reference, *others = curves
    number = len(others) * int(np.count_nonzero(reference.steps))
    found: dict[str, dict[str, list[int]]] = {"ahead": {}, "behind": {}}
    for curve in others:
        ours, theirs = curve.paired(reference, "returns")
        for steps, one, other in zip(reference.steps, ours.T, theirs.T, strict=True):
            if not steps:
                continue
            if side := paired_difference(one, other, corrected(number)).side():
                where = found["ahead" if side > 0 else "behind"]
                where.setdefault(curve.objective, []).append(int(steps))
    return number, found


def _claim(
    entry: str, curves: LearningCurves, reference: LearningCurves, of: str, where: str = ""
) -> Claim:
    asked, evidence = STATED[of], paired(curves, reference, of)
    text = f"{entry}: {curves.objective} {asked.beside(reference.objective, where)}"
    if not asked.margin:
        return Claim(text, evidence, places=0, of=(entry, curves.objective))
    margin = float(f"{asked.margin * abs(float(getattr(reference, asked.measure).mean())):.4g}")
    reason = f"a twentieth of what {_called(reference.objective)} earns"
    return Claim(text, evidence, 0.0, margin, reason, 0, (entry, curves.objective))


def _called(reference: str) -> str:
    return "PPO" if reference == REFERENCE else reference
