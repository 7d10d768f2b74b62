"""What the experiment `lpo_on_bandits` found: its claims, its costs, its tables and its figure."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter, StrMethodFormatter

from experiments.claims import OF_THE_WAY, Claim, of_searches, of_the_way
from experiments.locomotion_claims import MARGIN, paired
from experiments.rendering import on
from experiments.reports import Report
from experiments.searches import elsewhere, ran_on
from lpo import figures
from lpo.comparison import LearningCurves
from lpo.full_size import full_size
from lpo.objectives import Objective, load_objective
from scb import listing, plotting
from scb.environments.zoo import bandit_metadata
from scb.seeds import REPORTING
from scb.statistics import Estimate, estimate, pooled_estimate

SOURCES = ("bandit", "environment")
BANDIT, ENVIRONMENT = "LPO (bandit)", "LPO (environment)"
TWO_ORDERS = 100  # of magnitude
SIZES = ("population_size", "agents_per_candidate", "generations")
# Of the zoo: one search on the bandit, one on Pendulum.
HOPPER = {"ppo": "ppo", "dpo": "dpo", BANDIT: "lpo-pendulum", ENVIRONMENT: "lpo-pendulum-ee"}
LOOKS = {
    "bandit": plotting.Look(plotting.VERMILLION, "-", "o"),
    "environment": plotting.Look(plotting.PURPLE, "--", "D"),
}


def claims(report: Report) -> list[Claim]:
    """Cheaper to learn on the bandit, better than PPO on Pendulum, no worse for it, comparable on Hopper."""
    same = of_one_size(report)
    times = cheaper(report)
    steps = f"a candidate's agent takes {TWO_ORDERS} times fewer steps on the bandit; here {times:.1f} times"
    found = [Claim(steps, times >= TWO_ORDERS)]
    for place, table in report["evaluations"].items():
        finals, learned = table["finals"], (BANDIT, ENVIRONMENT)
        for name in learned:
            for what, kind in (
                ("ends higher", "finals"),
                ("learns faster (area under the curve)", "areas"),
            ):
                text = f"{place}: {name} {what} than PPO"
                found.append(Claim(text, _above(table[kind], name, "ppo"), places=1))
        text = f"{place}: {BANDIT} ends no lower than {ENVIRONMENT}, after searches of one size"
        alike = _above(finals, *learned) if same else None
        found.append(Claim(text, alike, 0.0, of_the_way("Pendulum-v1"), OF_THE_WAY, places=1))
    curves = on_hopper()
    margin = round(MARGIN * abs(float(curves["ppo"].final.mean())), 1)
    for name in (BANDIT, ENVIRONMENT):
        # Of one search each, which decides nothing.
        evidence = paired(curves[name], curves["ppo"], "final") if name in curves else None
        if callable(evidence):
            evidence = evidence().without_interval()
        text, reason = (
            f"Hopper: {name} ends no lower than PPO, on the same seeds",
            "a twentieth of PPO's mean return",
        )
        found.append(Claim(text, evidence, 0.0, margin, reason, places=0))
    return found


def on_hopper() -> dict[str, LearningCurves]:
    """{name of this figure: curves at full size}, as far as they were measured; PPO's are."""
    whole = full_size("hopper")
    assert whole is not None
    measured = whole.by_name
    return {name: measured[of] for name, of in HOPPER.items() if of in measured}


def _above(returns: Mapping[str, Any], name: str, other: str) -> Callable[..., Estimate] | Estimate:
    """How far an objective earns more than another; without an interval where searches are too few."""
    found = of_searches(returns[name], returns[other])
    once = any(len(returns[x]) == 1 for x in (name, other) if x in (BANDIT, ENVIRONMENT))
    return found().without_interval() if once and callable(found) else found


def of_one_size(report: Report) -> bool:
    """Whether searches on either had as many generations, candidates and agents."""
    plan = [search["settings"] for search in report["searches"].values()]
    return all(len({x[size] for x in plan}) == 1 for size in SIZES)


def cheaper(report: Report) -> float:
    """How many times the steps of a candidate's agent are fewer on the bandit."""
    steps = []
    for source in SOURCES:
        search = report["searches"][source]
        settings = search["settings"]
        agents = settings["population_size"] * settings["agents_per_candidate"]
        steps.append(search["curves"][0]["steps_per_generation"]["total"] / agents)
    return float(steps[1] / steps[0])


def timed(report: Report, source: str) -> float:
    """Seconds of a generation of this size, by its steps, from the timing of both in turn on one machine."""
    timing, curves = report["timing"], report["searches"][source]["curves"]
    steps = timing[source]["steps_per_candidate"] * timing["population_size"]
    times = curves[0]["steps_per_generation"]["total"] / steps
    return float(timing[source]["seconds_per_generation"] * times)


def bill(report: Report) -> dict[str, Any]:
    """What the bandit and a search on either took, and how many searches it takes until the bandit has paid for itself.

    Returns:
      {"found": the bandit's line of `scb list`, "machine": where that was, "search": {"bandit", "environment":
      {"steps", "minutes"}}, "searches": {"steps" of bandit and Pendulum together, "minutes": how many, None where one
      on the bandit saves nothing}}.
    """
    bandit = listing.entry("Synthetic-Pendulum-v1")
    taken = {}
    for source in SOURCES:
        search = report["searches"][source]
        generations = search["settings"]["generations"]
        taken[source] = {
            "steps": search["curves"][0]["steps_per_generation"]["total"] * generations,
            "minutes": timed(report, source) * generations / 60,
        }
    spent = {
        "steps": bandit["environment_steps"] + bandit["bandit_steps"],
        "minutes": bandit["minutes"],
    }
    saved = {x: taken["environment"][x] - taken["bandit"][x] for x in spent}
    searches = {x: math.ceil(spent[x] / saved[x]) if saved[x] > 0 else None for x in spent}
    machine = bandit_metadata("Synthetic-Pendulum-v1")["cost"]["machine"]
    return {"found": bandit, "machine": machine, "search": taken, "searches": searches}


def _size(objective: Objective) -> dict[str, int]:
    """{"candidates", "agents" of each, "generations"} of the search for an objective of the zoo."""
    config = objective.metadata["config"]["meta_training"]
    return {
        "candidates": config["evolution"]["population_size"],
        "agents": config["agents_per_candidate"],
        "generations": config["evolution"]["num_generations"],
    }


def facts(report: Report) -> dict[str, Any]:
    """What a search costs, and the tables' estimates."""
    searches = {
        source: {
            **search,
            "per": search["curves"][0]["steps_per_generation"],
            "second": float(np.median([c["seconds_per_generation"] for c in search["curves"]])),
            "machines": ran_on(search["curves"], report),
            "timed": timed(report, source),
        }
        for source, search in report["searches"].items()
    }
    of_all = {
        source: x["per"]["total"] * x["settings"]["generations"] + x["steps_to_judge"]
        for source, x in searches.items()
    }
    tables = {}
    for place, table in report["evaluations"].items():
        kinds = (table["finals"], table["areas"])
        tables[place] = {
            "earned": {o: [pooled_estimate(x[o]) for x in kinds] for o in kinds[0]},
            "against": {
                o: [x() if callable(x := _above(k, BANDIT, o)) else x for k in kinds]
                for o in kinds[0]
                if o != BANDIT
            },
        }
    return {
        "searches": searches,
        "tables": tables,
        "hopper": on_hopper(),
        "zoo": HOPPER,
        "bandit": BANDIT,
        "environment": ENVIRONMENT,
        "same_size": of_one_size(report),
        "times": cheaper(report),
        "times_judged": of_all["environment"] / of_all["bandit"],
        "bill": bill(report),
        "elsewhere": elsewhere(
            (c for x in report["searches"].values() for c in x["curves"]), report
        ),
        "sizes": {name: _size(load_objective(HOPPER[name])) for name in (BANDIT, ENVIRONMENT)},
        "seed": REPORTING.start,
    }


def draw(report: Mapping[str, Any]) -> Figure:
    """(i) over generations, (ii) over steps and minutes; (iii) Pendulum; (iv) Hopper."""
    figure = Figure(figsize=(12.0, 8.0))
    parts: Any = figure.subfigures(2, 1)
    top, bottom = parts
    _draw_searches(top.subplots(1, 3, sharey=True), report)
    below = bottom.subplots(1, len(report["evaluations"]) + 1, squeeze=False)[0]
    for panel, letter, (name, table) in zip(
        below, "abc", report["evaluations"].items(), strict=False
    ):
        _draw_finals(panel, table["finals"])
        panel.set_title(f"(iii {letter}) {name}".replace(", ", ",\n", 1), fontsize=9)
    _draw_hopper(below[-1])
    figure.suptitle(
        "Objectives learned on the bandit and on Pendulum: the searches, and what they are worth"
    )
    return figure


def _draw_searches(panels: Any, report: Mapping[str, Any]) -> None:
    """What agents trained with the searches' means earn over generations, steps and minutes: three panels."""
    for source, search in report["searches"].items():
        curves, look = search["curves"], LOOKS[source]
        name = f"on the {source} ({len(curves)} searches)"
        per = curves[0]["steps_per_generation"]
        minutes = timed(report, source) / 60
        generations = np.asarray(curves[0]["generations"], float)
        returns = plotting.over_searches([c["returns"] for c in curves])
        # No step is taken and no time passes before generation 0, which a logarithm cannot show.
        for panel, first, each, label in (
            (panels[0], 0, 1.0, name),
            (panels[1], 1, per["total"], f"{source}: total"),
            (panels[2], 1, minutes, name),
        ):
            x, found = generations[first:] * each, returns[first:]
            plotting.estimate_curve(panel, x, found, look, label)
        # Training takes nearly all.
        panels[1].plot(
            generations[1:] * per["evaluation"],
            [x.value for x in returns[1:]],
            linestyle=":",
            color=look.color,
            label=f"{source}: evaluation alone",
        )
    titles = ("(i) over generations", "(ii a) over environment steps", "(ii b) over wall-clock")
    timed_on = f"minutes of the search (timed on {on([report['timing']['machine']])})"
    labels = ("generation", "environment steps of the search", timed_on)
    for panel, title, label in zip(panels, titles, labels, strict=True):
        panel.set(title=title, xlabel=label)
        panel.legend(fontsize=8)
    for panel in panels[1:]:
        panel.set_xscale("log")
        panel.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        panel.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        panel.xaxis.set_minor_formatter(NullFormatter())
    panels[1].xaxis.set_major_locator(LogLocator())
    panels[1].xaxis.set_major_formatter(EngFormatter(sep=""))
    panels[0].set_ylabel("return on Pendulum of agents\ntrained with the search's mean")


def _draw_finals(panel: Any, finals: Mapping[str, Any]) -> None:
    """A row for each objective's final returns."""
    for position, (objective, returns) in enumerate(finals.items()):
        color = plotting.VERMILLION if objective.startswith("LPO") else plotting.BLUE
        pooled = pooled_estimate(returns)
        plotting.estimate_row(panel, position, np.ravel(returns), pooled, color)
    plotting.name_rows(panel, finals)
    panel.set_xlabel("final return")


def _draw_hopper(panel: Any) -> None:
    """Learning curves at full size."""
    own = {BANDIT: LOOKS["bandit"], ENVIRONMENT: LOOKS["environment"]}
    for name, curves in on_hopper().items():
        look = own[name] if name in own else figures.looks([name])[name]
        found = [estimate(column) for column in curves.returns.T]
        label = f"{name}, n = {len(curves.seeds)}"
        plotting.estimate_curve(panel, curves.steps, found, replace(look, marker=""), label)
    panel.legend(fontsize=8)
    panel.xaxis.set_major_formatter(EngFormatter(sep=""))
    panel.set(xlabel="environment steps", ylabel="return")
    panel.set_title("(iv) Hopper, generalized physics,\nobjectives of the zoo", fontsize=9)
