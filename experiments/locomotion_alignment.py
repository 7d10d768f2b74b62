"""Which bandit ranks objectives as an environment of Brax does, at the paper's full number of steps?

    python -m experiments locomotion_alignment

What agents earn in the environment is known from agents of `python -m experiments locomotion --tuning-agents 4
--validated NAMES`, on seeds that report nothing. Here each of the objectives trains agents in a few regimes of bandits;
Spearman's correlation between what they earn there and in the environment says how well a regime ranks them. With
agents of further objectives in the environment the same command measures those in the bandits too. And each trains
agents in the environments of a suite, of `--others`: how well one environment ranks objectives as another does is what
a bandit can be held to.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from experiments.alignment import CONFIRMATION_SEED
from experiments.harness import Experiment
from experiments.parts import InParts, Keys, Part
from experiments.reports import Report, forget_other, same_objectives, settled
from lpo.alignment import Alignment, Regime, alignment, regime_fitness
from lpo.comparison import LearningCurves, compare, ppo_spec
from lpo.fitness import FITNESSES, LABELS
from lpo.full_size import full_size, validated
from lpo.objectives import load_objective
from lpo.suite import suite
from scb import plotting
from scb.environments.registry import environment_spec
from scb.environments.zoo import bandit_metadata
from scb.errors import UserError, at_least
from scb.files import packed, unpacked_row
from scb.statistics import DECIDING, correlation_text, halves_agree, iqm, typeset

PENDULUM, CARTPOLE = "Pendulum-v1", "CartPole-v1"
FIRST_SEED = CONFIRMATION_SEED  # on which no regime was chosen
# One thing changed at a time; what is not said is the default's of a search for an objective.
REGIMES: dict[str, dict[str, Any]] = {
    "its own": {},
    "its own, noise of 2": {"reward_noise": 2.0},
    "its own, without noise": {"reward_noise": 0.0},
    "its own, a tenth of the batches": {"iterations": 1 / 10},  # a share of the environment's own
    "Pendulum's": {"bandit": environment_spec(PENDULUM).bandit},
    "Pendulum's, without noise": {
        "bandit": environment_spec(PENDULUM).bandit,
        "reward_noise": 0.0,
    },
    "CartPole's": {"bandit": environment_spec(CARTPOLE).bandit},
    "CartPole's, without noise": {
        "bandit": environment_spec(CARTPOLE).bandit,
        "reward_noise": 0.0,
    },
}
# Of the agents in the environment; their end is a moment, and these are levels.
OUTCOMES = {"area": "over the training", "late": "over the last quarter"}
REPORTED = "reported"
TOGETHER = "the mean score in all of them"
BANDITS, ENVIRONMENTS = "objectives in a bandit, by their return", "objectives in an environment"
KINDS = {BANDITS: plotting.BLUE, ENVIRONMENTS: plotting.VERMILLION}
FITNESS = FITNESSES["return"].label  # what a search for an objective judges candidates by


@dataclass(frozen=True)
class Options:
    """Where, and how many agents train in a bandit."""

    environments: tuple[str, ...] = ("hopper",)
    """of Brax, with agents that report nothing"""
    agents: int = 8
    """in every regime, of each objective"""
    others: tuple[str, ...] = suite("classic")
    """environments whose own ranking is held against it as well, with PPO as they have it"""

    def __post_init__(self) -> None:
        at_least(2, self, "agents")  # a single one has no interval
        for name in self.others:
            if environment_spec(name).synthetic:
                raise UserError(f"{name} is synthetic: give environments, such as Pendulum-v1.")
            environment_spec(name).reference_return()  # which scores are made with


def regime(environment: str, name: str) -> Regime:
    """One of `REGIMES`, for an environment."""
    own: dict[str, Any] = {"bandit": environment_spec(environment).bandit}
    other = dict(REGIMES[name])
    if "iterations" in other:
        other["iterations"] = round(
            other["iterations"] * ppo_spec(environment).config.num_iterations
        )
    return Regime(**(own | other))


def parts(options: Options, report: dict[str, Any]) -> Iterator[Part]:
    """A regime at a time, with the objectives that it lacks."""
    settled(report, agents=options.agents, first_seed=FIRST_SEED)
    for environment in options.environments:
        objectives = validated(environment)
        if len(objectives) < 3:
            raise UserError(
                f"on {environment} {len(objectives)} objectives have agents that report nothing, and fewer than 3 rank "
                f"nothing: python -m experiments locomotion --environments {environment} --tuning-agents 4 trains some."
            )
        same_objectives(report, map(load_objective, objectives))
        for name in REGIMES:
            of_it = regime(environment, name)
            digest = bandit_metadata(of_it.bandit)["sha256"]
            path = ("environments", environment, name)
            forget_other(report.get("environments", {}).get(environment, {}), name, digest)
            places: dict[Keys, str] = {
                ("fitness", objective): objective for objective in objectives
            }
            yield Part.lacking(report, path, places, partial(_trained, of_it, digest, options))

    names = list(dict.fromkeys(n for e in options.environments for n in validated(e)))
    for other in options.others:
        at = ("others", other)
        those: dict[Keys, str] = {(name,): name for name in names}
        yield Part.lacking(report, at, those, partial(_trained_in, other, options))


def _trained_in(environment: str, options: Options, names: list[str]) -> dict[str, Any]:
    seeds = range(FIRST_SEED, FIRST_SEED + options.agents)
    return {
        curve.objective: dict(
            zip(OUTCOMES, packed(getattr(curve, of) for of in OUTCOMES), strict=True)
        )
        for curve in compare(environment, names, seeds).curves
    }


def _trained(of_it: Regime, digest: str, options: Options, names: list[str]) -> dict[str, Any]:
    seeds = list(range(FIRST_SEED, FIRST_SEED + options.agents))
    found = regime_fitness(of_it, [load_objective(name) for name in names], seeds)
    return {
        "sha256": digest,
        "fitness": {
            name: dict(zip(LABELS, packed(found[name][label] for label in LABELS), strict=True))
            for name in names
        },
    }


def fitness(
    entry: Mapping[str, Any], label: str, names: Iterable[str]
) -> dict[str, NDArray[np.floating]]:
    """{objective: [S]} what agents of these earned in a regime."""
    return {name: unpacked_row(entry["fitness"][name][label]) for name in names}


def ranked(environment: str, regimes: Mapping[str, Any]) -> dict[str, LearningCurves]:
    """{objective: its agents in the environment} of those that every regime has."""
    return {
        name: curve
        for name, curve in validated(environment).items()
        if all(name in entry["fitness"] for entry in regimes.values())
    }


def aligned(report: Report) -> dict[str, dict[str, dict[str, dict[str, Alignment]]]]:
    """{environment: {outcome: {regime: {fitness: alignment}}}} over the objectives that all have, three at least."""
    found: dict[str, Any] = {}
    for environment, regimes in report["environments"].items():
        curves = ranked(environment, regimes)
        if len(curves) < 3:
            continue
        in_bandits = {
            name: {label: fitness(entry, label, curves) for label in LABELS}
            for name, entry in regimes.items()
        }
        for outcome in OUTCOMES:
            earned = {name: getattr(curve, outcome) for name, curve in curves.items()}
            found.setdefault(environment, {})[outcome] = {
                name: {label: alignment(of_it, earned) for label, of_it in of_labels.items()}
                for name, of_labels in in_bandits.items()
            }
    return found


def ranked_elsewhere(report: Report) -> dict[str, dict[str, dict[str, Alignment]]]:
    """{environment: {other: {outcome: alignment}}}, the outcome that of both, and of all others their mean score.

    `REPORTED` is "area" by the environment's agents that report, of the objectives that have some.
    """
    found: dict[str, Any] = {}
    for environment, regimes in report["environments"].items():
        curves = _everywhere(report, ranked(environment, regimes))
        if len(curves) < 3 or not (others := report.get("others")):
            continue
        earned: dict[str, Any] = {
            other: {of: {name: unpacked_row(of_it[name][of]) for name in curves} for of in OUTCOMES}
            for other, of_it in others.items()
        }
        earned[TOGETHER] = {
            of: {
                name: np.mean(
                    [environment_spec(other).score(earned[other][of][name]) for other in others],
                    axis=0,
                )
                for name in curves
            }
            for of in OUTCOMES
        }
        judged = [(of, of, curves) for of in OUTCOMES]
        if len(reported := reporting_there(report, environment)) >= 3:
            judged.append((REPORTED, "area", reported))
        found[environment] = {
            other: {
                column: alignment(
                    {name: of_it[of][name] for name in those},
                    {name: getattr(curve, of) for name, curve in those.items()},
                )
                for column, of, those in judged
            }
            for other, of_it in earned.items()
        }
    return found


def reporting_there(report: Report, environment: str) -> dict[str, LearningCurves]:
    """{objective: its agents that report in an environment} of those that were trained in all others as well."""
    whole = full_size(environment)
    known = ranked(environment, report["environments"][environment])
    curves = {curve.objective: curve for curve in whole.curves} if whole else {}
    return _everywhere(report, {name: curve for name, curve in curves.items() if name in known})


def _everywhere(report: Report, curves: Mapping[str, LearningCurves]) -> dict[str, LearningCurves]:
    others = report.get("others", {}).values()
    return {name: curve for name, curve in curves.items() if all(name in x for x in others)}


def facts(report: Report) -> dict[str, Any]:
    """{environment: what its section says} of those that regimes were measured for."""
    elsewhere = ranked_elsewhere(report)
    return {
        "found": {
            environment: _section(report, environment, of, elsewhere.get(environment, {}))
            for environment, of in aligned(report).items()
            if of["area"]
        },
        "attainable": attainable,
        "deciding": DECIDING,
        "labels": LABELS,
        "judged_by": FITNESS,
        "outcomes": OUTCOMES,
    }


def _section(
    report: Report,
    environment: str,
    found: Mapping[str, Mapping[str, Mapping[str, Alignment]]],
    others: Mapping[str, Mapping[str, Alignment]],
) -> dict[str, Any]:
    """The correlations as tables, the best regime, those shown to rank, what objectives earn in the environment."""
    regimes = report["environments"][environment]
    curves, number = ranked(environment, regimes), len(reporting_there(report, environment))
    words = {**OUTCOMES, REPORTED: f"over the training, {number} objectives, agents that report"}
    # By what a search judges candidates by, against the whole training.
    pairs = [(name, row[FITNESS]) for name, row in found["area"].items()]
    pairs.sort(key=lambda pair: pair[1].spearman or 0.0, reverse=True)
    return {
        "tables": {
            outcome: {name: [_text(x) for x in row.values()] for name, row in rows.items()}
            for outcome, rows in found.items()
        },
        "best": (pairs[0][0], _text(pairs[0][1])),
        "shown": [name for name, x in pairs if x.shown],
        "missing": [name for name in REGIMES if name not in regimes],
        "earned": {
            name: {of: float(iqm(getattr(curve, of))) for of in OUTCOMES} | {"n": len(curve.seeds)}
            for name, curve in curves.items()
        },
        "fewest": min(len(curve.seeds) for curve in curves.values()),
        "agree": {outcome: _agree(curves, outcome) for outcome in OUTCOMES},
        "elsewhere": {name: [_text(x) for x in of_it.values()] for name, of_it in others.items()},
        "elsewhere_shown": [name for name, of_it in others.items() if of_it["area"].shown],
        "columns": [words[column] for column in others.get(TOGETHER, ())],
    }


def _agree(curves: Mapping[str, LearningCurves], outcome: str) -> float | None:
    """How far halves of the environment's own agents rank the objectives alike; None where they are too few."""
    number = min(len(curve.seeds) for curve in curves.values())
    if number < 2:
        return None
    return halves_agree([getattr(curve, outcome)[:number] for curve in curves.values()])


def _text(found: Alignment) -> str:
    return typeset(correlation_text(asdict(found)))


def draw(report: Mapping[str, Any]) -> dict[str, Figure]:
    """Of each environment the correlation with each regime and other environment, a panel an outcome."""
    drawn, elsewhere = {}, ranked_elsewhere(report)
    for environment, found in aligned(report).items():
        figure = Figure(
            figsize=(plotting.WIDTH, 0.3 * (len(REGIMES) + len(report.get("others", {}))) + 1.8)
        )
        panels: Any = figure.subplots(1, len(OUTCOMES), sharex=True, sharey=True)
        curves = ranked(environment, report["environments"][environment])
        for axes, (outcome, words) in zip(panels, OUTCOMES.items(), strict=True):
            rows = [
                (f"bandit: {name}", row[FITNESS], BANDITS) for name, row in found[outcome].items()
            ]
            rows += [
                (name, of_it[outcome], ENVIRONMENTS)
                for name, of_it in elsewhere.get(environment, {}).items()
            ]
            for position, (_, cell, kind) in enumerate(rows):
                if cell.spearman is None:
                    axes.text(0.0, position, "all alike", ha="center", va="center", fontsize=8)
                    continue
                color = KINDS[kind]
                axes.plot([cell.spearman], [position], "o", color=color)
                if cell.low is not None:
                    axes.hlines(position, cell.low, cell.high, color=color)
            if (agree := _agree(curves, outcome)) is not None and agree > 0:
                axes.axvline(attainable(agree), color=plotting.GREY, linestyle=":")
            axes.axvline(0.0, color=plotting.GREY, linewidth=0.8)
            plotting.name_rows(axes, [name for name, *_ in rows])
            axes.set_xlim(-1.0, 1.0)
            axes.set_xticks([-0.5, 0.0, 0.5])
            axes.set_xlabel("rank correlation (95 % intervals)")
            axes.set_title(words, fontsize=10)
        kinds = {name: {"color": x, "marker": "o"} for name, x in KINDS.items()}
        line = {"color": plotting.GREY, "linestyle": ":"}
        plotting.legend_of(figure, {**kinds, "attainable with these agents": line}, 3)
        plotting.figure_title(figure, f"How objectives are ranked, against how {environment} does")
        drawn[f"locomotion_alignment_{environment}"] = figure
    return drawn


def attainable(agree: float) -> float:
    """The correlation of what ranks as all agents would, without scatter of its own, where halves of them agree so.

    The root of what all would agree with as many others (Spearman and Brown).
    """
    return float(np.sqrt(2 * agree / (1 + agree)))


EXPERIMENT = Experiment(
    "locomotion_alignment",
    "Which bandit ranks objectives as Hopper does?",
    InParts(parts),
    facts=facts,
    draw=draw,
    options=Options,
    keys=("environments",),
)
