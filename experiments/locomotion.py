"""Does an objective carry over to locomotion? PPO's setting of the paper and its full number of steps, on Brax.

    python -m experiments locomotion --environments hopper --seeds 10

Physics is `generalized`, on which agents hop: 5.24 million steps, minutes an agent. A few agents of every objective
are trained at a time, and --out is saved after each few: the same command goes on where it was, and with more
`--seeds` or `--objectives` adds to it. With `--tuning-agents` a clip is chosen for each environment first, by agents
that report nothing, and compared like the others. (As jobs, the same command once more trains it.) With `--rates` as
many agents that report nothing are trained at other learning rates too; with `--learning-rate` those that report are,
and stand apart as "hopper at 0.0005"; with `--annealed` these rates fall to zero.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments.claims import HOLDS
from experiments.harness import Experiment, Keeping
from experiments.locomotion_claims import (
    ASKED,
    STATED,
    claims,
    confirmed,
    leading,
    since,
    summary,
)
from experiments.locomotion_rates import (
    at_rates,
    beside_papers,
    label,
    leads_at_rates,
    named,
    swept,
    tuned,
)
from experiments.parts import InParts, Keys, Part, file_name
from experiments.reports import Report, rows_in, same_objectives
from lpo import figures
from lpo.comparison import Comparison, LearningCurves, changed, compare, ppo_spec
from lpo.full_size import comparisons
from lpo.objectives import CLIPS, REFERENCE, learned_in, load_objective, zoo_names
from scb.agents.spec import AgentSpec
from scb.agents.values import check_value
from scb.errors import at_least, unused
from scb.files import packed, plain
from scb.seeds import reporting, validation
from scb.statistics import DECIDING


@dataclass(frozen=True)
class Options(Keeping):
    """What is trained, and where."""

    environments: tuple[str, ...] = ("hopper",)
    """of Brax"""
    objectives: tuple[str, ...] = (
        REFERENCE,
        "dpo",
        "lpo-pendulum",
        "lpo-multi",
        "lpo-pendulum-ee",
        "ta-lpo",
    )
    """as `lpo evaluate` takes them; all are compared with PPO's clip"""
    seeds: int = 10
    """agents of each"""
    together: int = 2
    """agents that are trained side by side, and saved when all of them have ended"""
    tuning_agents: int = 0
    """of each of some clips, on seeds that report nothing: the best clip is compared as well"""
    validated: tuple[str, ...] = ()
    """objectives that are trained on those seeds as well, for a bandit's ranking to be held against"""
    rates: tuple[float, ...] = ()
    """learning rates at which the objectives are trained on those seeds as well"""
    learning_rate: float | None = None
    """of the agents that report; None for the environment's own"""
    annealed: bool = False
    """whether that one, and those of --rates, fall linearly to zero over the training"""

    def setting(self, learning_rate: float | None) -> dict[str, Any]:
        """What of PPO's hyperparameters is other than the environment's."""
        if learning_rate is None:
            return {}
        falling = {"anneal_learning_rate": True} if self.annealed else {}
        return {"learning_rate": learning_rate, **falling}

    def __post_init__(self) -> None:
        at_least(1, self, "seeds", "together")
        at_least(0, self, "tuning_agents")
        if self.learning_rate is not None:
            unused(
                self,
                "a clip is chosen at the environment's own learning rate alone",
                ("tuning_agents",),
                "leave learning_rate out",
            )
        if not self.tuning_agents:
            unused(
                self,
                "no agents are trained on seeds that report nothing",
                ("validated", "rates"),
                "give tuning_agents",
            )
        if self.learning_rate is None and not self.rates:
            unused(
                self,
                "the environment's own learning rate stays as it is",
                ("annealed",),
                "give learning_rate or rates",
            )


def parts(options: Options, report: dict[str, Any]) -> Iterator[Part]:
    """The choice of a clip, then a few seeds of every objective at a time: all have as many wherever it ends."""
    objectives = tuple(dict.fromkeys((REFERENCE, *options.objectives)))
    # That nobody waits for a name that is none, or for a rate.
    same_objectives(report, map(load_objective, (*objectives, *options.validated)))
    given = options.setting(options.learning_rate)
    for rate in (*options.rates, options.learning_rate):
        if rate is not None:
            check_value("learning_rate", rate)
    for environment in options.environments:
        names = objectives
        if options.tuning_agents:
            seeds = validation(options.tuning_agents)
            judged = tuple(dict.fromkeys((*CLIPS, *options.validated)))
            yield from _of(environment, judged, seeds, options, report, ("sweep",))
            for rate in options.rates:
                at_rate = partial(_of, environment, objectives, seeds, options, report)
                setting = options.setting(rate)
                yield from at_rate(("rates", label(setting)), setting)
            best = tuned(swept(report.get("environments", {}).get(environment, {})))
            names = (*names, best) if best and best not in names else names
        yield from _of(
            environment,
            names,
            reporting(options.seeds),
            options,
            report,
            ("agents",),
            given,
            named(environment, given),
        )


def _of(
    environment: str,
    objectives: Sequence[str],
    seeds: Sequence[int],
    options: Options,
    report: Report,
    place: Keys,
    hyperparameters: Mapping[str, Any] = MappingProxyType({}),
    entry: str | None = None,
) -> Iterator[Part]:
    spec = ppo_spec(environment, hyperparameters=hyperparameters)
    path = ("environments", entry or environment)
    for start in range(0, len(seeds), options.together):
        for name in objectives:
            few: dict[Keys, int] = {
                (*place, name, str(s)): s for s in seeds[start : start + options.together]
            }
            trained = partial(_trained, path[1], environment, name, options.rows, place, spec)
            yield Part.lacking(report, path, few, trained)


measure = InParts(parts)


def _trained(
    entry: str,
    environment: str,
    objective: str,
    kept_in: Path | None,
    place: Keys,
    spec: AgentSpec,
    seeds: list[int],
) -> dict[str, Any]:
    rows = rows_in(kept_in, entry, objective, *place[1:], str(seeds[0]))
    (found,) = compare(
        environment,
        [load_objective(objective)],
        seeds,
        spec,
        diagnose=True,
        rows=rows,
        tell=print,
    ).curves
    agents: dict[str, Any] = {objective: kept(found)}
    for key in reversed(place):
        agents = {key: agents}
    other = {"environment": environment, "hyperparameters": changed(spec, environment)}
    return {
        **(other if entry != environment else {}),
        "backend": found.backend,
        "steps": found.steps.tolist(),
        "episodes": found.episodes,
        **agents,
    }


def kept(curves: LearningCurves) -> dict[str, dict[str, Any]]:
    """{seed: what is kept of an agent}."""
    assert curves.lengths is not None and curves.speeds is not None
    columns = {
        "returns": packed(curves.returns),
        "length": map(plain, curves.lengths[:, -1]),
        "speed": map(plain, curves.speeds[:, -1]),
        **{name: packed(values) for name, values in (curves.diagnosis or {}).items()},
    }
    agents = zip(*columns.values(), strict=True)
    return {
        str(seed): dict(zip(columns, agent, strict=True))
        for seed, agent in zip(curves.seeds, agents, strict=True)
    }


def facts(report: Report) -> dict[str, Any]:
    """The curves by environment."""
    shown, found = comparisons(report), confirmed(report)
    decided = [judged for _, _, judged in found if judged]
    return {
        "comparisons": shown,
        "figures": {name: figure_of(name) for name in shown},
        "deciding": DECIDING,
        "learned_here": _learned_here(shown),
        "confirmations": [
            (
                asked,
                STATED[asked.of].beside(asked.reference, asked.reference_in),
                pairs,
                judged,
                judged and since(report, asked),
            )
            for asked, pairs, judged in found
        ],
        # What all pairs together may show, and those that were trained to confirm it do not.
        "unconfirmed": {x.claim.text for x in decided if x.outcome != HOLDS},
        "asked": {of: asked.beside() for of, asked in ASKED.items()},
        "summary": partial(summary, decided),
        "sweeps": {
            name: (sweep, len(entry["sweep"][REFERENCE]), tuned(sweep))
            for name, entry in report["environments"].items()
            if (sweep := swept(entry))
        },
        "beside_papers": beside_papers(shown),
        "at_rates": _told(at_rates, report),
        "leads_at_rates": _told(leads_at_rates, report),
        "led": {
            name: leading(curves)
            for name, comparison in shown.items()
            if (curves := _comparable(comparison))
        },
        "diagnosed": {
            name: {curve.objective: width(curve) for curve in curves}
            for name, comparison in shown.items()
            if (curves := _diagnosed(comparison))
        },
    }


def _told(of: Callable[[str, Report], Any], report: Report) -> dict[str, Any]:
    """What it says of each entry, where that is anything."""
    return {name: x for name, entry in report["environments"].items() if (x := of(name, entry))}


def draw(report: Mapping[str, Any]) -> dict[str, Figure]:
    """Learning curves of each environment, leads over PPO, and what an iteration does to the policy, where known."""
    drawn = {}
    for name, comparison in comparisons(report).items():
        figure = figure_of(name)
        drawn[figure] = figures.learning_curves(comparison.curves)
        if curves := _comparable(comparison):
            drawn[f"{figure}_leads"] = figures.leads(curves)
        if curves := _diagnosed(comparison):
            drawn[f"{figure}_updates"] = figures.diagnosis(curves)
    return drawn


def figure_of(name: str) -> str:
    """The figure of an entry's curves; those of leads and updates have this before them."""
    return "locomotion_" + file_name(name)


def _learned_here(shown: Mapping[str, Comparison]) -> list[str]:
    """Objectives of the zoo among these that were learned for one of these environments."""
    curves = [curve for comparison in shown.values() for curve in comparison.curves]
    names, here = {x.objective for x in curves}, {x.environment for x in curves}
    return [
        name
        for name in zoo_names()
        if name in names and here & {*learned_in([load_objective(name)])}
    ]


def width(curves: LearningCurves) -> float:
    """The last standard deviation of a Gaussian policy: the geometric mean over joints and diagnosed agents."""
    entropy = np.nanmean((curves.diagnosis or {})["entropy"], axis=0)
    # A Gaussian starts with a deviation of 1 in each joint, which says how many there are.
    of_one = 0.5 * math.log(2 * math.pi * math.e)
    joints = round(entropy[0] / of_one)
    return math.exp(entropy[-1] / joints - of_one)


def _comparable(comparison: Comparison) -> list[LearningCurves]:
    """PPO's clip, and objectives with enough agents on its seeds; none where there is no such objective."""
    reference, *others = comparison.curves
    enough = [x for x in others if len(x.paired(reference)[0]) >= DECIDING]
    return [reference, *enough] if enough else []


def _diagnosed(comparison: Comparison) -> list[LearningCurves]:
    return [curve for curve in comparison.curves if curve.diagnosed]


EXPERIMENT = Experiment(
    "locomotion",
    "Do learned objectives carry over to locomotion?",
    measure,
    draw=draw,
    claims=claims,
    facts=facts,
    further=("locomotion_elsewhere", "locomotion_updates"),
    options=Options,
    keys=("environments",),
    out=Path("lpo/measured/locomotion.json"),
)
