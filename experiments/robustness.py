"""What is an objective worth to somebody who does not tune? PPO with drawn hyperparameters, all objectives' the same.

    python -m experiments robustness
    python -m experiments robustness --environments Asterix-MinAtar --objectives ppo dpo lpo-multi
    python -m experiments robustness --validation --objectives ppo dpo OBJECTIVE.npz --out runs/validation.json

Learning rate, discount, GAE's lambda, entropy, initialisation, epochs and minibatches are drawn from the paper's lists
and usual public defaults (plans/robustness.toml), once for all objectives, so that these are compared in pairs.
`ppo-drawn` is PPO's clip drawn as well. What --out holds is not measured again: the same command goes on where it
was, and with other environments or objectives adds to it.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from experiments.claims import TENTH, Claim, Judged, judge, of_agents
from experiments.harness import Experiment, Keeping, plan_of
from experiments.parts import InParts, Keys, Part
from experiments.reports import Report, finite, rows_in, same_objectives, settled
from lpo.comparison import ppo_spec
from lpo.objectives import REFERENCE, Objective, check_names, learned_in, load_objective
from lpo.suite import suite
from scb.agents.spec import AgentSpec
from scb.environments.registry import environment_spec
from scb.errors import UserError, at_least, unused
from scb.files import packed_row, unpacked_row
from scb.measurement import Agents, Place, measure
from scb.plotting import BLUE, VERMILLION, estimate_row, figure_title, name_rows
from scb.seeds import REPORTING, VALIDATING
from scb.statistics import Estimate, Statistic, normalized_score, stratified_estimate, worst_decile

_PLAN = plan_of("robustness")
STATED = _PLAN["confirmation"]
DRAWN = "ppo-drawn"
REFERENCES = (REFERENCE, DRAWN, "dpo")
FIRST_SEED = REPORTING[12_000]
FIRST_TO_CONFIRM = REPORTING[13_000]
FIRST_TO_CHOOSE = VALIDATING[1000]
STATISTICS: dict[str, Statistic] = {"mean": np.mean, "worst decile": worst_decile}
# Every environment is given the same draws, of seeds and of what they draw.
over_environments = partial(stratified_estimate, shared=True)


@dataclass(frozen=True)
class Options(Keeping):
    """What is trained, and where."""

    environments: tuple[str, ...] = suite("classic")
    """any that PPO trains in"""
    objectives: tuple[str, ...] = (
        *REFERENCES,
        "lpo-pendulum",
        "lpo-multi",
        "lpo-pendulum-ee",
        "lpo-cartpole-ee",
        "ta-lpo",
    )
    """as `lpo evaluate` takes them, and ppo-drawn; a file's name is the objective's"""
    draws: int = 17
    """of hyperparameters for each setting of epochs and minibatches, of which an environment has three"""
    validation: bool = False
    """on seeds that report nothing, to choose among objectives; in a report of its own (--out)"""
    confirmation: bool = False
    """instead, what was stated first (plans/robustness.toml), on further seeds that report"""

    def __post_init__(self) -> None:
        at_least(2, self, "draws")
        if not self.environments:
            raise UserError("no environments: give at least one.")
        if self.validation and self.confirmation:
            raise UserError(
                "seeds either choose or confirm: leave out --validation or --confirmation."
            )
        if self.confirmation:
            stated = ("environments", "objectives", "draws")
            because = "what is confirmed was stated before"
            unused(self, because, stated, "leave out --confirmation")

    @property
    def asked(self) -> "Options":
        """What is to be measured."""
        if not self.confirmation:
            return self
        return replace(
            self,
            environments=tuple(STATED["environments"]),
            objectives=(*STATED["more_than"], STATED["objective"]),
            draws=STATED["draws"],
            confirmation=False,
        )

    @property
    def first_seed(self) -> int:
        """Of the first setting."""
        if self.confirmation:
            return FIRST_TO_CONFIRM
        return FIRST_TO_CHOOSE if self.validation else FIRST_SEED


def parts(options: Options, report: dict[str, Any]) -> Iterator[Part]:
    """One setting of one environment with one objective at a time."""
    path: Keys = ()
    if options.confirmation:
        check_stated(load_objective(STATED["objective"]))
        path, report = ("confirmation",), report.setdefault("confirmation", {})
    options, first = options.asked, options.first_seed
    # Draws of more are others, of which intervals could not take the same in every environment.
    settled(report, first_seed=first, lists=_PLAN["lists"], draws=options.draws)
    # Without PPO's clip there is nothing to compare with.
    names = dict.fromkeys([REFERENCE, *options.objectives])
    loaded = [None if x == DRAWN else load_objective(x) for x in names]
    check_names([x for x in loaded if x])
    learned_in([x for x in loaded if x])  # before the first waits, and not after
    same_objectives(report, [x for x in loaded if x])
    objectives = {DRAWN if x is None else x.name: x for x in loaded}
    for environment in options.environments:
        for i, (words, setting) in enumerate(settings_of(environment).items()):
            key = f"{options.draws} of {words}"
            spec = replace(ppo_spec(environment).with_values(**setting), lists=_PLAN["lists"])
            drawn = Agents.drawn_from(spec, first + i, options.draws)
            for name, objective in objectives.items():
                place = (environment, name, key)
                trained = partial(_trained, *place, objective, spec, drawn, options.rows)
                there = (*path, "environments", environment)
                yield Part(there, trained, (("returns", name, key),))


def settings_of(environment: str) -> dict[str, dict[str, Any]]:
    """{in words: epochs and minibatches}, of which the first has the first seed."""
    settings = _PLAN["settings"]
    of_family = settings.get(environment_spec(environment).family, settings["classic"])
    return {
        ", ".join(f"{name} {x}" for name, x in setting.items()): setting for setting in of_family
    }


def in_order(environment: str, keys: Iterable[str]) -> list[str]:
    """Keys of a report, such as "17 of num_epochs 4, num_minibatches 8", by the seeds of their settings."""
    order = {words: i for i, words in enumerate(settings_of(environment))}
    return sorted(keys, key=lambda key: order.get(key.partition(" of ")[2], len(order)))


def _trained(
    environment: str,
    name: str,
    key: str,
    objective: Objective | None,
    spec: AgentSpec,
    drawn: Agents,
    kept_in: Path | None,
) -> dict[str, Any]:
    """What agents of one setting earn at the end of their training."""
    kept = rows_in(kept_in, environment, name, key)
    objectives = () if objective is None else (objective,)
    place = Place.named(environment)
    rows = measure(spec, place, agents=drawn, objectives=objectives, rows=kept)
    earned, failed = finite([row["return"] for row in rows], place)
    print(f"{environment}, {name}, {key}: {np.mean(earned):.4g}", flush=True)
    return {
        "returns": {name: {key: packed_row(earned)}},
        "failed": {name: {key: failed}},
        "draws": {
            key: {x: packed_row(np.asarray(getattr(drawn.hyperparameters, x))) for x in drawn.drawn}
        },
        "learned_on": {name: learned_in(objectives)},
    }


Scores = dict[str, dict[str, NDArray[np.floating]]]  # {environment: {objective: [draws]}}


def scores(report: Report) -> Scores:
    """Of what has as many draws as PPO's clip: 0 for random actions, 1 for a published expert.

    Where nobody published one, 1 is what a twentieth of all agents here earn more than; where that is no more than
    random actions earn, there are none.
    """
    found = {}
    for environment, entry in report["environments"].items():
        # In the order of their seeds, whatever ended first: draws are the same in all environments by it.
        settings = in_order(environment, entry["returns"].get(REFERENCE, ()))
        returns = {
            name: np.concatenate([unpacked_row(lines[key]) for key in settings])
            for name, lines in entry["returns"].items()
            if settings and all(key in lines for key in settings)
        }
        if returns:
            every = np.concatenate(list(returns.values()))
            spec = environment_spec(environment)
            published = spec.reference()
            random = spec.random_return()
            best = np.percentile(every, 95) if published is None else published.value
            if best <= random:
                continue  # nothing was learned there, of which a score could be a share
            found[environment] = {
                name: normalized_score(x, random, best) for name, x in returns.items()
            }
    return found


def groups(
    scored: Scores, name: str, other: str
) -> tuple[list[NDArray[np.floating]], list[NDArray[np.floating]]]:
    """[draws] of two objectives in every environment that has both."""
    shared = [(x[name], x[other]) for x in scored.values() if name in x and other in x]
    return [a for a, _ in shared], [b for _, b in shared]


def claims(report: Report) -> list[Claim]:
    """Of every learned objective, where it was not learned: above PPO's clip and DPO in mean and worst decile."""
    found, scored = [], scores(report)
    for name in named(scored):
        if name in REFERENCES:
            continue
        unseen = without_homes(report, scored, name)
        for other in (REFERENCE, "dpo"):
            ours, theirs = groups(unseen, name, other)
            if not ours:
                continue
            for what, statistic in STATISTICS.items():
                better = partial(over_environments, ours, theirs, statistic=statistic)
                evidence = of_agents(better, min(map(len, ours)))
                found.append(Claim(f"{name}: a higher {what} than {other}", evidence))
    return found


def check_stated(objective: Objective) -> None:
    """Raises a UserError where an objective of the stated name is not the one that was meant."""
    if objective.sha256 != STATED["objective_sha256"]:
        raise UserError(
            f"{objective.name} is not the objective that was stated: take the file whose checksum "
            "plans/robustness.toml has."
        )


def confirmed(report: Report) -> list[Judged]:
    """What becomes of the claims that were stated first; empty until all of their agents are there."""
    scored = scores(report.get("confirmation", {"environments": {}}))
    asked = (*STATED["more_than"], STATED["objective"])
    for place in STATED["environments"]:
        of_it = scored.get(place, {})
        if any(name not in of_it or of_it[name].size != _stated_draws() for name in asked):
            return []
    both = {other: groups(scored, STATED["objective"], other) for other in STATED["more_than"]}
    return judge(
        [
            Claim(
                f"{STATED['objective']}: a higher mean than {other}",
                partial(over_environments, *pair, statistic=np.mean),
            )
            for other, pair in both.items()
        ]
    )


def _stated_draws() -> int:
    """Of each objective in each task."""
    return int(STATED["draws"]) * len(_PLAN["settings"]["classic"])


def without_homes(report: Report, scored: Scores, objective: str) -> Scores:
    """The scores of the environments that an objective was not learned for."""
    homes = learned_for(report, objective)
    return {place: x for place, x in scored.items() if place not in homes}


def named(scored: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The objectives of {environment: {objective: ...}}."""
    return list(dict.fromkeys(name for x in scored.values() for name in x))


def learned_for(report: Report, objective: str) -> list[str]:
    """The environments that an objective was learned for, by the entries of a report's environments."""
    return sorted(
        {
            place
            for entry in report["environments"].values()
            for place in entry["learned_on"].get(objective, ())
        }
    )


def facts(report: Report) -> dict[str, Any]:
    """A row for each objective, over all environments and in each; the same of what was stated first."""
    found: dict[str, Any] = {"rows": table(report), "places": list(scores(report)), "tenth": TENTH}
    stated = confirmed(report)
    if not stated:
        return {**found, "stated": None}
    of_it = report["confirmation"]
    scored = scores(of_it)
    rows = {"rows": table(of_it), "places": list(scored), "seed": of_it["first_seed"]}
    leads = {
        other: over_environments(*groups(scored, other, REFERENCE), statistic=np.mean)
        for other in STATED["more_than"]
        if other != REFERENCE
    }
    tasks = {other: by_task(scored, STATED["objective"], other) for other in STATED["more_than"]}
    each = {"leads": leads, "tasks": tasks, "draws": _stated_draws()}
    return {**found, "stated": {**STATED, "claims": stated, **rows, **each}}


def by_task(scored: Scores, name: str, other: str) -> dict[str, dict[str, Estimate]]:
    """{"in it" or "in the others": {environment: how much higher one objective's mean is}}, each for itself."""
    mean = partial(over_environments, statistic=np.mean)
    alone = {place: {place: scored[place]} for place in scored}
    others = {x: {place: of_it for place, of_it in scored.items() if place != x} for x in scored}
    return {
        words: {place: mean(*groups(of_it, name, other)) for place, of_it in sets.items()}
        for words, sets in (("in it", alone), ("in the others", others))
    }


def table(report: Report) -> list[dict[str, Any]]:
    """A row for each objective, over all environments and in each."""
    rows, scored = [], scores(report)
    for name in named(scored):
        ours, _ = groups(scored, name, REFERENCE)
        # As where claims are made.
        unseen = groups(without_homes(report, scored, name), name, REFERENCE)
        above = [(a > b) + (a == b) / 2 for a, b in zip(*unseen, strict=True)]
        failing = [(a < TENTH).astype(float) for a in ours]
        rows.append(
            {
                "name": name,
                **{
                    what: over_environments(ours, statistic=statistic)
                    for what, statistic in STATISTICS.items()
                },
                "fails": over_environments(failing, statistic=np.mean),
                "improves": None
                if name == REFERENCE or not above
                else over_environments(above, statistic=np.mean),
                "in": {e: x[name].mean() for e, x in scored.items() if name in x},
                "agents": sum(x.size for x in ours),
                "broken": sum(
                    sum(entry["failed"].get(name, {}).values())
                    for entry in report["environments"].values()
                ),
            }
        )
    return rows


def draw(report: Mapping[str, Any]) -> Figure:
    """One panel a statistic, one line an objective."""
    rows = table(report)
    panels = {
        "mean": "mean score",
        "worst decile": "worst decile of the scores",
        "fails": f"share of agents that fail (score below {TENTH:g})",
    }
    figure = Figure(figsize=(11.0, 1.4 + 0.34 * len(rows)))
    for axes, (what, label) in zip(
        figure.subplots(1, len(panels), sharey=True), panels.items(), strict=True
    ):
        for position, row in enumerate(rows):
            color = BLUE if row["name"] in REFERENCES else VERMILLION
            estimate_row(axes, position, np.array([]), row[what], color)
        axes.set(xlabel=label)
    name_rows(axes, [row["name"] for row in rows])
    figure_title(
        figure, "PPO with drawn hyperparameters: scores of all environments, 95 % intervals"
    )
    return figure


EXPERIMENT = Experiment(
    "robustness",
    "What is an objective worth to somebody who does not tune?",
    InParts(parts),
    claims=claims,
    facts=facts,
    draw=draw,
    options=Options,
    keys=("environments",),
)
