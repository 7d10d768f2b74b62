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

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from experiments import meta_training_cost
from experiments.harness import Experiment, Preset, Save
from experiments.lpo_on_bandits_page import claims, draw, facts
from experiments.reports import settled
from experiments.searches import machines, objective_of_run, read_log
from lpo.comparison import compare
from lpo.objectives import CLIPS, Objective, load_objective
from scb.agents.spec import AgentSpec, environment_agent
from scb.evolution import judgements
from scb.machine import machine_description
from scb.rows import Rows
from scb.seeds import reporting, validation
from scb.statistics import iqm

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
    comparison = compare(
        environment,
        [objective for group in lacking.values() for objective in group],
        seeds,
        spec=spec,
        points=15,
        rows=rows,
    )
    for name, group in lacking.items():
        for returns, kind in ((finals, "final"), (areas, "area")):
            returns.setdefault(name, []).extend(
                np.round(getattr(comparison.by_name[o.name], kind), 2).tolist() for o in group
            )
    for kind in ("finals", "areas"):
        table[kind] = {name: table[kind][name] for name in lacking}
    table["seeds"] = seeds
    table["protocol"] = (
        f"{environment}: {agents} agents an objective (and search), {comparison.curves[0].steps[-1]:,} steps, policy's "
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
