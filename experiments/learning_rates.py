"""At which learning rates of PPO does an objective matter, and does tuning the rate do as much as a learned objective?

    python -m experiments learning_rates

PPO has each environment's own setting but for the learning rate. For every objective apart agents on seeds that report
nothing choose the rate, and others are reported. What --out holds is not measured again: the same command goes on
where it was, and with other environments, objectives or rates adds to it.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from experiments.claims import Claim
from experiments.harness import Experiment, Report, packed, settled, unpacked
from experiments.parts import InParts, Keys, Part
from lpo.comparison import compare, ppo_spec
from lpo.figures import looks
from lpo.objectives import learned_in, load_objective
from lpo.suite import suite
from scb import plotting
from scb.environments.registry import environment_spec
from scb.errors import UserError, at_least
from scb.rows import Rows
from scb.seeds import reporting, validation
from scb.statistics import Estimate, estimate, normalized_score, stratified_estimate

REFERENCE = "ppo"
REFERENCES = (REFERENCE, "dpo")
FIRST = 15_000  # of the seeds that report
LARGE, SMALL = 0.003, 0.0003  # from the one on, and up to the other
CHOOSING, REPORTED = "choosing", "reported"


@dataclass(frozen=True)
class Options:
    """What is trained, and where."""

    environments: tuple[str, ...] = suite("classic")
    """with a published expert, whose score is 1"""
    objectives: tuple[str, ...] = (*REFERENCES, "lpo-pendulum", "lpo-multi", "ta-lpo")
    """as `lpo evaluate` takes them; all are compared with PPO's clip"""
    rates: tuple[float, ...] = (0.0001, 0.0003, 0.001, 0.003, 0.01)
    """learning rates"""
    agents: int = 20
    """that are reported, of each objective at each rate"""
    choosing: int = 10
    """others, that choose each objective's rate"""
    runs: Path = Path("runs/learning_rates")
    """for agents until they are saved"""

    def __post_init__(self) -> None:
        at_least(2, self, "agents", "choosing")
        for environment in self.environments:
            if environment_spec(environment).reference() is None:
                raise UserError(
                    f"nobody published an expert of {environment}, so there are no scores: choose another environment."
                )


def parts(options: Options, report: dict[str, Any]) -> Iterator[Part]:
    """The agents of one objective at one rate in one environment, first those that choose."""
    settled(report, agents=options.agents, choosing=options.choosing)
    names = tuple(dict.fromkeys((REFERENCE, *options.objectives)))
    for name in names:
        load_objective(name)  # that nobody waits for a name that is none
    seeds = {
        CHOOSING: validation(options.choosing),
        REPORTED: reporting(options.agents, offset=FIRST),
    }
    for environment in options.environments:
        for rate in options.rates:
            for name in names:
                path: Keys = ("environments", environment)
                keys = tuple((role, name, f"{rate:g}") for role in seeds)
                yield Part(
                    path, partial(_trained, environment, name, rate, seeds, options.runs), keys
                )


def _trained(
    environment: str, name: str, rate: float, seeds: Mapping[str, Sequence[int]], runs: Path
) -> dict[str, Any]:
    objective = load_objective(name)
    safe = re.sub(r"[^\w.-]", "_", f"{name}-{rate:g}")
    (found,) = compare(
        environment,
        [objective],
        [seed for of_it in seeds.values() for seed in of_it],
        ppo_spec(environment, hyperparameters={"learning_rate": rate}),
        points=1,
        rows=Rows(runs / environment / f"{safe}.rows.jsonl"),
        tell=print,
    ).curves
    earned = dict(zip(found.seeds, found.final, strict=True))
    return {
        "random": environment_spec(environment).random_return(),
        "own": float(ppo_spec(environment).hyperparameters.learning_rate),
        "steps": int(found.steps[-1]),
        "learned_on": {name: learned_in([objective])},
        "failed": {name: {f"{rate:g}": found.failed}},
        **{
            role: {name: {f"{rate:g}": packed([[earned[seed] for seed in of_it]])[0]}}
            for role, of_it in seeds.items()
        },
    }


Scores = dict[str, dict[str, dict[float, NDArray[np.floating]]]]


def scores(report: Report, role: str = REPORTED) -> Scores:
    """{environment: {objective: {rate: [agents]}}}, 0 for random actions and 1 for a published expert.

    Only rates that all objectives of an environment have.
    """
    found: Scores = {}
    for environment, entry in report["environments"].items():
        expert = environment_spec(environment).reference_return()
        returns = entry[role]
        shared = set.intersection(*(set(of_it) for of_it in returns.values()))
        found[environment] = {
            name: {
                float(rate): normalized_score(unpacked([of_it[rate]])[0], entry["random"], expert)
                for rate in sorted(shared, key=float)
            }
            for name, of_it in returns.items()
        }
    return found


def chosen(report: Report) -> dict[str, dict[str, float]]:
    """{environment: {objective: the rate with the highest mean score of the agents that choose}}."""
    return {
        environment: {
            name: max(of_it, key=lambda rate: float(of_it[rate].mean()))
            for name, of_it in objectives.items()
        }
        for environment, objectives in scores(report, CHOOSING).items()
    }


def claims(report: Report) -> list[Claim]:
    """Of every objective but PPO's clip: more at large rates, at small ones, and each at its best.

    Environments that it was learned for are apart.
    """
    scored, best = scores(report), chosen(report)
    found = []
    for name in dict.fromkeys(name for of_it in scored.values() for name in of_it):
        if name == REFERENCE:
            continue
        homes = {
            home
            for entry in report["environments"].values()
            for home in entry["learned_on"].get(name, ())
        }
        unseen = [place for place, of_it in scored.items() if name in of_it and place not in homes]
        for words, wanted in _ranges(scored).items():
            text = f"{name} earns more than {REFERENCE} at {words}"
            found.append(Claim(text, _more(scored, unseen, name, REFERENCE, wanted)))
        for other in REFERENCES if name not in REFERENCES else (REFERENCE,):
            text = f"{name} earns more than {other}, each at its best rate"
            found.append(Claim(text, _more(scored, unseen, name, other, best)))
            for home in sorted(homes & scored.keys()):
                found.append(Claim(f"{home}: {text}", _more(scored, [home], name, other, best)))
    return found


Rates = Mapping[str, Mapping[str, Sequence[float] | float]]


def _ranges(scored: Scores) -> dict[str, Rates]:
    """{in words: {environment: {objective: rates}}}."""
    asked = {
        f"rates of {LARGE:g} and more": lambda rate: rate >= LARGE,
        f"rates of {SMALL:g} and less": lambda rate: rate <= SMALL,
    }
    return {
        words: {
            place: {
                name: [rate for rate in of_it if is_asked(rate)] for name, of_it in found.items()
            }
            for place, found in scored.items()
        }
        for words, is_asked in asked.items()
    }


def _more(scored: Scores, places: Sequence[str], name: str, other: str, rates: Rates) -> Any:
    """The difference of mean scores over environments, between agents of the same seeds; None where there are none."""

    def groups(of: str) -> list[NDArray[np.floating]]:
        return [
            np.mean([scored[place][of][rate] for rate in np.atleast_1d(rates[place][of])], axis=0)
            for place in places
        ]

    if not places or not all(np.size(rates[place][of]) for place in places for of in (name, other)):
        return None
    return partial(stratified_estimate, groups(name), groups(other), statistic=np.mean)


def facts(report: Report) -> dict[str, Any]:
    """A row for each objective: its best rate in each environment, and what it earns there and over all."""
    scored, best = scores(report), chosen(report)
    names = list(dict.fromkeys(name for of_it in scored.values() for name in of_it))
    rows = [
        {
            "name": name,
            "best": {place: best[place][name] for place in scored if name in best[place]},
            "in": {
                place: float(scored[place][name][best[place][name]].mean())
                for place in scored
                if name in scored[place]
            },
            "mean": stratified_estimate(
                [
                    of_it[name][best[place][name]]
                    for place, of_it in scored.items()
                    if name in of_it
                ],
                statistic=np.mean,
            ),
        }
        for name in names
    ]
    return {
        "rows": rows,
        "own": {place: entry["own"] for place, entry in report["environments"].items()},
        "steps": {place: entry["steps"] for place, entry in report["environments"].items()},
        "failed": sum(
            number
            for entry in report["environments"].values()
            for of_it in entry["failed"].values()
            for number in of_it.values()
        ),
        "seeds": (reporting(1, offset=FIRST)[0], validation()[0]),
    }


def draw(report: Mapping[str, Any]) -> Figure:
    """Scores against the learning rate: over all environments, then in each."""
    scored = scores(report)
    style = looks(list(dict.fromkeys(name for of_it in scored.values() for name in of_it)))
    figure = Figure(figsize=(plotting.WIDTH, 2.7 * -(-(len(scored) + 1) // 3)))
    panels = iter(figure.subplots(-(-(len(scored) + 1) // 3), 3, squeeze=False).flat)
    for title, places in {"all of them": list(scored), **{p: [p] for p in scored}}.items():
        axes = next(panels)
        for name, look in style.items():
            if not all(name in scored[place] for place in places):
                continue
            rates = sorted(set.intersection(*(set(scored[place][name]) for place in places)))
            found = [_mean([scored[place][name][rate] for place in places]) for rate in rates]
            plotting.estimate_curve(
                axes, rates, found, look.color, look.linestyle, name, look.marker
            )
        axes.set(title=title, xscale="log", xlabel="learning rate", ylabel="score")
    for unused in panels:
        unused.set_visible(False)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    plotting.legend_below(figure, (handles, labels), len(labels))
    return figure


def _mean(groups: list[NDArray[np.floating]]) -> Estimate:
    if len(groups) == 1:
        return estimate(groups[0], np.mean)
    return stratified_estimate(groups, statistic=np.mean)


EXPERIMENT = Experiment(
    "learning_rates",
    "At which learning rates does an objective matter?",
    InParts(parts),
    draw=draw,
    claims=claims,
    facts=facts,
    options=Options,
    keys=("environments",),
)
