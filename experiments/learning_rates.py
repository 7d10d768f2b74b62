"""At which learning rates of PPO does an objective earn more than PPO's clip, and does it where each has its best rate?

    python -m experiments learning_rates

PPO has each environment's own setting but for the learning rate. For every objective apart agents on seeds that report
nothing choose the rate, and others are reported. What --out holds is not measured again: the same command goes on
where it was, and with other environments or objectives adds to it. Where choices fall on an end of the rates,
`--beyond` adds some to choose from.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from experiments.claims import FAILS, HOLDS, UNTESTED, Claim, Judged, judge, of_agents
from experiments.harness import Experiment, Keeping
from experiments.parts import InParts, Part
from experiments.reports import Report, lost, rows_in, same_objectives, settled
from experiments.robustness import learned_for, named
from lpo.comparison import compare, ppo_spec
from lpo.figures import looks
from lpo.objectives import REFERENCE, REFERENCES, check_names, learned_in, load_objective
from lpo.suite import suite
from scb import plotting
from scb.agents.spec import AgentSpec
from scb.environments.registry import environment_spec
from scb.errors import UserError, at_least
from scb.files import packed_row, unpacked_row
from scb.seeds import reporting, validation
from scb.statistics import Estimate, stratified_estimate

OFFSET = 15_000  # of the first seed, among those that report
LARGE, SMALL = 0.003, 0.0003  # a rate of at least, and of at most, so much
CHOOSING, REPORTED = "choosing", "reported"
CHOSEN = "each at the rate chosen for it"

Scores = dict[str, dict[str, dict[float, NDArray[np.floating]]]]
Rates = Mapping[str, Mapping[str, Sequence[float]]]


@dataclass(frozen=True)
class Options(Keeping):
    """What is trained, and where."""

    environments: tuple[str, ...] = suite("classic")
    """with a published expert, whose score is 1"""
    objectives: tuple[str, ...] = (*REFERENCES, "lpo-pendulum", "lpo-multi", "ta-lpo")
    """as `lpo evaluate` takes them; all are compared with PPO's clip"""
    rates: tuple[float, ...] = (0.0001, 0.0003, 0.001, 0.003, 0.01)
    """learning rates"""
    beyond: tuple[float, ...] = ()
    """others that may be chosen, and are in no comparison at large or small ones: for choices at an end of the rates"""
    agents: int = 20
    """that are reported, of each objective at each rate"""
    choosing: int = 10
    """others, that choose each objective's rate"""

    def __post_init__(self) -> None:
        at_least(2, self, "agents", "choosing")
        if not self.environments or not self.rates:
            raise UserError("no environments or no learning rates: give at least one of each.")
        for environment in self.environments:
            if environment_spec(environment).reference() is None:
                raise UserError(
                    f"nobody published an expert of {environment}, so there are no scores: choose another environment."
                )


def parts(options: Options, report: dict[str, Any]) -> Iterator[Part]:
    """The agents of one objective at one rate in one environment: those that choose, and those that are reported."""
    settled(report, agents=options.agents, choosing=options.choosing, rates=options.rates)
    if options.beyond:
        known = {*report.get("beyond", ()), *options.beyond} - {*options.rates}
        report["beyond"] = sorted(known)
    names = tuple(dict.fromkeys((*REFERENCES, *options.objectives)))
    loaded = [load_objective(name) for name in names]
    check_names(loaded)  # that nobody waits for a mistake
    same_objectives(report, loaded)
    seeds = {
        CHOOSING: validation(options.choosing),
        REPORTED: reporting(options.agents, offset=OFFSET),
    }
    specs = {
        (environment, rate): ppo_spec(environment, hyperparameters={"learning_rate": rate})
        for environment in options.environments
        for rate in dict.fromkeys((*options.rates, *options.beyond))
    }
    for (environment, rate), spec in specs.items():
        for name in names:
            places = tuple((role, name, str(rate)) for role in seeds)
            trained = partial(_trained, environment, name, spec, rate, seeds, options.rows)
            yield Part(("environments", environment), trained, places)


def _trained(
    environment: str,
    name: str,
    spec: AgentSpec,
    rate: float,
    seeds: Mapping[str, Sequence[int]],
    kept_in: Path | None,
) -> dict[str, Any]:
    objective = load_objective(name)
    (found,) = compare(
        environment,
        [objective],
        [seed for of_it in seeds.values() for seed in of_it],
        spec,
        points=1,
        rows=rows_in(kept_in, environment, name, str(rate)),
        tell=print,
    ).curves
    earned = dict(zip(found.seeds, found.final, strict=True))
    return {
        "own": float(ppo_spec(environment).hyperparameters.learning_rate),
        "steps": int(found.steps[-1]),
        "learned_on": {name: learned_in([objective])},
        "failed": {name: {str(rate): found.failed}},
        **{
            role: {name: {str(rate): packed_row([earned[seed] for seed in of_it])}}
            for role, of_it in seeds.items()
        },
    }


def scores(report: Report, role: str = REPORTED) -> Scores:
    """{environment: {objective: {rate: [agents]}}}, 0 for random actions and 1 for a published expert."""
    return {
        environment: {
            name: {
                float(rate): environment_spec(environment).score(unpacked_row(of_it[rate]))
                for rate in sorted(of_it, key=float)
            }
            for name, of_it in entry[role].items()
        }
        for environment, entry in report["environments"].items()
    }


def chosen(report: Report) -> dict[str, dict[str, list[float]]]:
    """{environment: {objective: [the rate with the highest mean score of the agents that choose]}}.

    Of equal ones the smallest.
    """
    return {
        environment: {
            name: [max(of_it, key=lambda rate: float(of_it[rate].mean()))]
            for name, of_it in objectives.items()
        }
        for environment, objectives in scores(report, CHOOSING).items()
    }


def _asked(report: Report) -> dict[str, Rates]:
    """{in words: {environment: {objective: rates}}}: where objectives are compared."""
    scored = scores(report)

    def those(wanted: Callable[[float], bool]) -> Rates:
        # The same for all objectives.
        asked = set(filter(wanted, report["rates"]))
        return {
            place: dict.fromkeys(of_it, sorted(asked.intersection(*of_it.values())))
            for place, of_it in scored.items()
        }

    return {
        f"at rates of {LARGE} and more": those(lambda rate: rate >= LARGE),
        f"at rates of {SMALL} and less": those(lambda rate: rate <= SMALL),
        CHOSEN: chosen(report),
    }


@dataclass(frozen=True)
class Compared:
    """What a claim that an objective earns more than another is about.

    Attributes:
      name, other: of both.
      who: the first in words, with the environment where that is one which it was learned for.
      words: at which rates.
      places: the environments.
      rates: {environment: {objective: rates}} in each.
    """

    name: str
    other: str
    who: str
    words: str
    places: Sequence[str]
    rates: Rates


def claims(report: Report) -> list[Claim]:
    """Of what is `Compared`, over the environments that an objective was not learned for.

    Every objective is compared with PPO's clip. Where each has the rate chosen for it, learned ones are compared with
    DPO too, and also in each environment that they were learned for.
    """
    scored, found = scores(report), []
    for words, rates in _asked(report).items():
        for name in named(scored):
            homes = learned_for(report, name)
            at_best = words == CHOSEN
            for other in REFERENCES if at_best and name not in REFERENCES else (REFERENCE,):
                both = [place for place, of_it in scored.items() if {name, other} <= of_it.keys()]
                text = f"{name} earns more than {other}, {words}"
                unseen = [place for place in both if place not in homes]
                several = f"{len(unseen)} environment{'s' * (len(unseen) > 1)}"
                sets = {f"over {several}": (name, unseen)} if unseen else {}
                sets |= {
                    f"on {place}": (f"{name} on {place}", [place])
                    for place in both
                    if at_best and place in homes
                }
                for where, (who, places) in sets.items() if name != other else ():
                    evidence = _more(scored, places, name, other, rates)
                    of_it = Compared(name, other, who, words, places, rates)
                    found.append(Claim(f"{text}, {where}", evidence, of=of_it))
    return found


def _more(
    scored: Scores, places: Sequence[str], name: str, other: str, rates: Rates
) -> Callable[..., Estimate] | Estimate | None:
    """The difference of mean scores over environments, between agents of the same seeds; None without such rates."""

    def groups(of: str) -> list[NDArray[np.floating]]:
        return [
            np.mean([scored[place][of][rate] for rate in rates[place][of]], axis=0)
            for place in places
        ]

    if not all(rates[place][of] for place in places for of in (name, other)):
        return None
    ours, theirs = groups(name), groups(other)
    more = partial(stratified_estimate, ours, theirs, statistic=np.mean)
    return of_agents(more, min(map(len, ours)))


def without_one(
    judged: Sequence[Judged], scored: Scores
) -> list[tuple[Judged, dict[str, Estimate]]]:
    """What is decided over several environments, and the difference without each of them; each for itself.

    One of them may be all that a mean shows.
    """
    found = []
    for x in judged:
        of: Compared = x.claim.of
        if x.outcome in (HOLDS, FAILS) and len(of.places) > 1:
            less = {
                place: _more(
                    scored, [y for y in of.places if y != place], of.name, of.other, of.rates
                )
                for place in of.places
            }
            found.append((x, {place: y() for place, y in less.items() if callable(y)}))
    return found


def at_the_ends(report: Report) -> dict[tuple[str, float], list[str]]:
    """{(environment, rate): objectives} whose chosen rate is the smallest or the largest of those that were tried."""
    scored, found = scores(report, CHOOSING), dict[tuple[str, float], list[str]]()
    for place, objectives in chosen(report).items():
        for name, (rate,) in objectives.items():
            if rate in (min(scored[place][name]), max(scored[place][name])):
                found.setdefault((place, rate), []).append(name)
    return found


def at_home(report: Report) -> dict[tuple[str, str], dict[float, Estimate]]:
    """{(objective, environment that it was learned for): {rate: how much more it earns there than PPO's clip}}."""
    scored = scores(report)
    return {
        (name, place): {
            rate: stratified_estimate([x], [scored[place][REFERENCE][rate]], statistic=np.mean)
            for rate, x in scored[place][name].items()
            if rate in scored[place][REFERENCE]
        }
        for name in named(scored)
        for place in learned_for(report, name)
        if name in scored.get(place, {})
    }


def facts(report: Report) -> dict[str, Any]:
    """What is shown, in words; and a row for each objective: its rate in each environment, and what it earns there."""
    scored, best = scores(report), chosen(report)
    entries = report["environments"]
    rows = []
    for name in named(scored):
        at_best = {
            place: of_it[name][best[place][name][0]]
            for place, of_it in scored.items()
            if name in of_it
        }
        rows.append(
            {
                "name": name,
                "learned_for": learned_for(report, name),
                "best": {place: best[place][name][0] for place in at_best},
                "in": {place: float(x.mean()) for place, x in at_best.items()},
                # Over fewer it were no mean of the same.
                "mean": stratified_estimate(list(at_best.values()), statistic=np.mean)
                if len(at_best) == len(scored)
                else None,
            }
        )
    judged = judge(claims(report))
    less = without_one(judged, scored)
    return {
        "rows": rows,
        "at_home": at_home(report),
        "without_one": less,
        "leaning": {
            f"{x.claim.of.name} over {x.claim.of.other}, {x.claim.of.words}": on
            for x, without in less
            if x.outcome == HOLDS
            and (on := [place for place, lead in without.items() if lead.side() <= 0])
        },
        "at_the_ends": at_the_ends(report),
        "more": _shown(judged, HOLDS),
        "less": {where: names for where, names in _shown(judged, FAILS).items() if names},
        "tried": sorted({*report["rates"], *report.get("beyond", ())}),
        "beyond": report.get("beyond", []),
        "own": {place: entry["own"] for place, entry in entries.items()},
        "steps": {place: entry["steps"] for place, entry in entries.items()},
        "failed": lost(entries),
        "seeds": (reporting(1, offset=OFFSET)[0], validation()[0]),
    }


def _shown(judged: Sequence[Judged], outcome: str) -> dict[str, list[str]]:
    """{at which rates, in words: objectives} of the comparisons with PPO's clip that end so."""
    found: dict[str, list[str]] = {x.claim.of.words: [] for x in judged if x.outcome != UNTESTED}
    for x in judged:
        if x.claim.of.other == REFERENCE and x.outcome == outcome:
            found[x.claim.of.words].append(x.claim.of.who)
    return found


def draw(report: Mapping[str, Any]) -> Figure:
    """Scores against the learning rate: over all environments, then in each."""
    scored = scores(report)
    style = looks(named(scored))
    shown = {"all of them": list(scored), **{place: [place] for place in scored}}
    figure = Figure(figsize=(plotting.WIDTH, 2.7 * -(-len(shown) // 3)))
    axes_of = plotting.panels(figure, len(shown), columns=3)
    for axes, (title, places) in zip(axes_of, shown.items(), strict=True):
        for name, look in style.items():
            if not all(name in scored[place] for place in places):
                continue
            rates = sorted(set.intersection(*(set(scored[place][name]) for place in places)))
            found = [
                stratified_estimate(
                    [scored[place][name][rate] for place in places], statistic=np.mean
                )
                for rate in rates
            ]
            plotting.estimate_curve(axes, rates, found, look)
        axes.set(title=title, xscale="log", xlabel="learning rate", ylabel="score")
    plotting.legend_of(figure, style, len(style))
    return figure


EXPERIMENT = Experiment(
    "learning_rates",
    "At which learning rates does an objective earn more?",
    InParts(parts),
    draw=draw,
    claims=claims,
    facts=facts,
    options=Options,
    keys=("environments",),
)
