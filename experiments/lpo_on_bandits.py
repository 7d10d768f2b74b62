"""The paper's figure of learned policy optimisation: learned on a bandit and on the environment, judged on two.

    python -m experiments lpo_on_bandits --preset quick

(i) Meta-training on the bandit and on Pendulum: what agents trained on Pendulum with the mean of the
search distribution earn, over generations. (ii) The same over environment steps and over wall-clock,
by a timing of both on one machine, whatever the searches ran on.
(iii) PPO on Pendulum with its clip, a tuned clip, DPO and the learned objectives, with either
initialisation of the policy. (iv) Hopper at full size, as `experiments.locomotion` measured it, with an objective of
the zoo for each of the two. Every search is a run folder under --runs and is
resumed; what --out holds already is not measured again, so the same command continues an interrupted
one. `--only-render` makes page and figure from --out.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter, StrMethodFormatter

from experiments import meta_training_cost
from experiments.claims import OF_THE_WAY, Claim, of_searches, of_the_way
from experiments.harness import Experiment, Preset, Report, Save, settled
from experiments.locomotion_claims import MARGIN, paired
from experiments.rendering import on
from experiments.searches import elsewhere, judgements, machines, objective_of_run, ran_on, read_log
from lpo import figures
from lpo.comparison import LearningCurves, compare
from lpo.full_size import full_size
from lpo.objectives import CLIPS, Objective, load_objective
from scb import listing, plotting
from scb.agents.spec import AgentSpec, environment_agent
from scb.environments.zoo import bandit_metadata
from scb.machine import machine_description
from scb.rows import Rows
from scb.seeds import REPORTING, reporting, validation
from scb.statistics import Estimate, estimate, iqm, pooled_estimate

SOURCES = ("bandit", "environment")
BANDIT, ENVIRONMENT = "LPO (bandit)", "LPO (environment)"
TWO_ORDERS = 100  # of magnitude
SIZES = ("population_size", "agents_per_candidate", "generations")
# Of the zoo: one search on the bandit, one on Pendulum.
HOPPER = {"ppo": "ppo", "dpo": "dpo", BANDIT: "lpo-pendulum", ENVIRONMENT: "lpo-pendulum-ee"}
SCALES = {"Flax's initialisation": 1.0, "small last layer": 0.01}


def search_curve(metrics: Sequence[Mapping[str, Any]], seconds: Sequence[float]) -> dict[str, Any]:
    """What a search's log says: the judged mean over generations (None where all its agents failed), steps and minutes.

    The time of a generation is the median of those that judged nothing: judging is no part of the
    search. The first, which compiles, is left out of it too.
    """
    of_a_judgement = ("mean/", "final_mean/")
    judged = [any(name.startswith(of_a_judgement) for name in line) for line in metrics]
    plain = [s for s, j in list(zip(seconds, judged, strict=True))[1:] if not j] or list(seconds)
    points = [(g, x.get("fitness_iqm")) for g, x in judgements(metrics)]
    return {
        "generations": [g for g, _ in points],
        "returns": [x for _, x in points],
        "steps_per_generation": {
            kind: metrics[0][f"steps/{kind}"] for kind in ("training", "evaluation", "total")
        },
        "seconds_per_generation": round(float(np.median(plain)), 3),
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
        text, reason = f"Hopper: {name} ends no lower than PPO", "a twentieth of PPO's mean return"
        found.append(Claim(text, evidence, 0.0, margin, reason, places=0))
    return found


def on_hopper() -> dict[str, LearningCurves]:
    """{name of this figure: curves at full size}, as far as they were measured; PPO's are."""
    whole = full_size("hopper")
    assert whole is not None
    measured = {curves.objective: curves for curves in whole.curves}
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
        "bill": bill(report),
        "elsewhere": elsewhere(
            (c for x in report["searches"].values() for c in x["curves"]), report
        ),
        "sizes": {name: _size(load_objective(HOPPER[name])) for name in (BANDIT, ENVIRONMENT)},
        "seed": REPORTING.start,
    }


def draw(report: Mapping[str, Any]) -> Figure:
    """(i) over generations, (ii) over steps and minutes; (iii) Pendulum; (iv) Hopper."""
    looks = {
        "bandit": plotting.Look(plotting.VERMILLION, "-", "o"),
        "environment": plotting.Look(plotting.PURPLE, "--", "D"),
    }
    figure = Figure(figsize=(12.0, 8.0))
    parts: Any = figure.subfigures(2, 1)
    top, bottom = parts
    panels: Any = top.subplots(1, 3, sharey=True)
    for source, search in report["searches"].items():
        curves, look = search["curves"], looks[source]
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
            plotting.estimate_curve(
                panel, x, found, look.color, look.linestyle, label, marker=look.marker
            )
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
    below = bottom.subplots(1, len(report["evaluations"]) + 1, squeeze=False)[0]
    for panel, letter, (name, table) in zip(
        below, "abc", report["evaluations"].items(), strict=False
    ):
        for position, (objective, finals) in enumerate(table["finals"].items()):
            color = plotting.VERMILLION if objective.startswith("LPO") else plotting.BLUE
            pooled = pooled_estimate(finals)
            plotting.estimate_row(panel, position, np.ravel(finals), pooled, color)
        panel.set_yticks(range(len(table["finals"])), list(table["finals"]))
        panel.invert_yaxis()
        panel.set_xlabel("final return")
        panel.set_title(f"(iii {letter}) {name}".replace(", ", ",\n", 1), fontsize=9)
    hopper = below[-1]
    for name, curves in on_hopper().items():
        own = {BANDIT: looks["bandit"], ENVIRONMENT: looks["environment"]}
        look = own[name] if name in own else figures.looks([name])[name]
        found = [estimate(column) for column in curves.returns.T]
        label = f"{name}, n = {len(curves.seeds)}"
        plotting.estimate_curve(hopper, curves.steps, found, look.color, look.linestyle, label)
    hopper.legend(fontsize=8)
    hopper.xaxis.set_major_formatter(EngFormatter(sep=""))
    hopper.set(xlabel="environment steps", ylabel="return")
    hopper.set_title("(iv) Hopper, generalized physics,\nobjectives of the zoo", fontsize=9)
    figure.suptitle(
        "Objectives learned on the bandit and on Pendulum: the searches, and what they are worth"
    )
    return figure


def measure(plan: Mapping[str, Any], report: dict[str, Any], save: Save) -> None:
    """A timing while nothing else runs, searches, then agents trained with what they found."""
    if "timing" not in report:
        timing: dict[str, Any] = {}
        meta_training_cost.measure(meta_training_cost.Options(**plan["timing"]), timing, save)
        report["timing"] = {**timing, "machine": machine_description()}
        save()
    runs = Path(plan["runs"]) / report["preset"]
    found = report.setdefault("searches", {})
    evaluations = report.setdefault("evaluations", {})

    @cache
    def learned(source: str, seed: int) -> Objective:
        """A search's objective, loaded or searched for when it is asked for."""
        settings = {"seed": seed, **plan["searches"][source]["settings"]}
        objective = objective_of_run(settings, runs / f"{source}-{seed}")
        return replace(objective, name=f"LPO ({source}) {seed}")

    groups: dict[str, list[Callable[[], Objective]]] = {}
    for source, search in plan["searches"].items():
        seeds = range(search["seeds"])
        groups[f"LPO ({source})"] = [partial(learned, source, seed) for seed in seeds]
        entry = found.setdefault(source, {"curves": []})
        settled(entry, settings=search["settings"])
        for seed in seeds[len(entry["curves"]) :]:
            cost = learned(source, seed).metadata["cost"]
            judging = "environment_steps_judgements"
            entry["steps_to_judge"] = sum(n for name, n in cost.items() if name.startswith(judging))
            folder = runs / f"{source}-{seed}"
            curve = search_curve(*read_log(folder))
            entry["curves"].append({**curve, "machines": machines(folder)})
            save()

    def kept(title: str) -> Rows:
        """An agent that was trained is not trained again, in whatever part of a table a run is killed."""
        return Rows(runs / f"{title}.rows.jsonl")

    for label, scale in SCALES.items():
        title = f"Pendulum, {label}"
        table, rows = evaluations.setdefault(title, {}), kept(title)
        spec = environment_agent("ppo", "Pendulum-v1").with_values(policy_output_scale=scale)
        if "tuned" not in table:
            table |= _tuned_clip(spec, plan["tuning_agents"], kept(f"{title}, tuning"))
        _judge(table, "Pendulum-v1", table["tuned"], groups, plan["agents"], spec, rows)
        save()


def _tuned_clip(spec: AgentSpec, agents: int, rows: Rows) -> dict[str, Any]:
    """{"tuned": the best of CLIPS on agents that report nothing, "sweep": what each earned}."""
    curves = compare(
        "Pendulum-v1",
        [load_objective(clip) for clip in CLIPS],
        validation(agents),
        spec=spec,
        points=1,
        rows=rows,
    ).curves
    sweep = {c.objective: float(iqm(c.final)) for c in curves}
    return {"tuned": max(sweep, key=lambda clip: sweep[clip]), "sweep": sweep}


def _judge(
    table: dict[str, Any],
    environment: str,
    tuned: str,
    groups: Mapping[str, Sequence[Callable[[], Objective]]],
    agents: int,
    spec: AgentSpec,
    rows: Rows,
) -> None:
    """Trains agents with PPO, the tuned clip, DPO and searches that the table lacks, and adds them to it."""
    finals, areas = table.setdefault("finals", {}), table.setdefault("areas", {})
    closed_forms = ("ppo", tuned, "dpo")
    lacking = {name: [] if name in finals else [load_objective(name)] for name in closed_forms}
    lacking |= {
        name: [learned() for learned in group[len(finals.get(name, ())) :]]
        for name, group in groups.items()
    }
    if not any(lacking.values()):
        return
    seeds = reporting(agents)
    curves = compare(
        environment,
        [objective for group in lacking.values() for objective in group],
        seeds,
        spec=spec,
        points=15,
        rows=rows,
    ).curves
    of = {curve.objective: curve for curve in curves}
    for name, group in lacking.items():
        for returns, kind in ((finals, "final"), (areas, "area")):
            returns.setdefault(name, []).extend(
                np.round(getattr(of[o.name], kind), 2).tolist() for o in group
            )
    for kind in ("finals", "areas"):
        table[kind] = {name: table[kind][name] for name in lacking}
    table["seeds"] = seeds
    table["protocol"] = (
        f"{environment}: {agents} agents an objective (and search), {curves[0].steps[-1]:,} steps, policy's "
        f"last layer times {spec.hyperparameters.policy_output_scale:g} at initialisation."
    )


@dataclass(frozen=True)
class Options(Preset):
    """A preset, and where its searches are kept."""

    runs: Path = Path("runs/lpo_on_bandits")
    """for the run folders"""


EXPERIMENT = Experiment.of_the_paper(
    "lpo_on_bandits",
    measure,
    draw,
    claims,
    facts=facts,
    options=Options,
    keys=("preset", "timing", "searches", "evaluations"),
)
