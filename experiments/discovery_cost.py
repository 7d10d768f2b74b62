"""What discovering a bandit costs: those that ship, and searches from a warm start and from random weights.

    python -m experiments discovery_cost runs/warm-1 runs/random-1 ...

Reads run folders of `scb discover`, finished or not. How good the search is at a generation is the
mean return of the agents that judge its distribution's mean; it is drawn against minutes and against
environment steps, and tabled with what it took to reach the environment's target. Nothing is
computed anew, and runs that the report has already stay in it, unless a folder of the same name is given.
`--only-render` makes tables and figure from the JSON and from what the zoo says of itself.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from experiments.harness import Experiment, Save
from experiments.rendering import plain
from experiments.searches import each_once, machines, read_log
from experiments.zoo_table_page import TARGETS, label, of_label, rank
from scb import listing, plotting
from scb.environments.registry import environment_spec
from scb.environments.zoo import bandit_metadata, zoo_names
from scb.errors import UserError
from scb.evolution import judgements
from scb.runs import read_config

# How a run's line is drawn by its start.
STARTS: dict[str, dict[str, Any]] = {
    "warm": {"color": plotting.VERMILLION, "linestyle": "-", "marker": "o", "markersize": 3.5},
    "random": {"color": plotting.BLUE, "linestyle": "--", "marker": "s", "markersize": 3.5},
}
_ON_GPU = {"markerfacecolor": "white"}
_TARGET: dict[str, Any] = {"color": plotting.BLACK, "linewidth": 1.4, "linestyle": ":"}
# How a run's log names an algorithm's interquartile mean beside its mean.
_IQM = "_iqm"
# What makes two searches incomparable where it differs; shown in the JSON, and said on the page.
SETTINGS = (
    "population_size",
    "agents_per_candidate",
    "evaluation_episodes",
    "algorithms",
    "mode",
    "combine",
    "strategy",
    "sigma",
    "curriculum",
    "backend",
)


def collect(folders: Sequence[Path]) -> dict[str, Any]:
    """The report of run folders: every run's costs, points and when it reached the target.

    Returns:
      {"runs": [...], "left_out": [{"name", "why"}]}. A run's points are [generation, minutes,
      environment steps, mean return], the costs being those of all generations before, and of the
      warm start where it is recorded.

    Raises:
      UserError: a folder is no run, or no run is left.
    """
    if not folders:
        raise UserError("no folders: name those of runs of scb discover, such as runs/discover.")
    runs, left_out = [], []
    for folder in folders:
        outcome = _run(folder)
        if isinstance(outcome, str):
            left_out.append({"name": folder.resolve().name, "why": outcome})
        else:
            runs.append(outcome)
    if not runs:
        reasons = "; ".join(f"{x['name']}: {x['why']}" for x in left_out)
        raise UserError(f"no run starts warm or random and was judged once ({reasons}).")
    runs.sort(key=_place)
    return {"runs": runs, "left_out": left_out}


def _run(folder: Path) -> dict[str, Any] | str:
    """A run's part of the report, or why it has none."""
    config = read_config(folder).get("config")
    if config is None or "parameterization" not in config:
        return "no search for a bandit of this version started it"
    if config["start"]:
        return "it continues from another bandit"
    if config["parameterization"] != "I":
        return "it searches for no bandit but for a synthetic MDP"
    start = {"expert": "warm", "random": "random"}[config["init"]]
    environment, evolution = config["environment"], config["evolution"]
    rows, seconds = read_log(folder)
    warm = _warm_start(folder, environment)
    # Before every generation, and after the last.
    minutes = list(accumulate([x / 60 for x in seconds], initial=warm["minutes"] or 0.0))
    steps = [x + (warm["steps"] or 0) for x in (0, *(row["steps/total"] for row in rows))]
    judged = [(g, x) for g, x in judgements(rows) if _judged(x) is not None]
    points = [[g, round(minutes[g], 3), steps[g], _judged(x)] for g, x in judged]
    if not points:
        return "it has not been judged yet"
    target = TARGETS.get(environment)
    at_target = next((p for p in points if target is not None and p[3] >= target), None)
    settings = {name: config.get(name, evolution.get(name)) for name in SETTINGS}
    return {
        "name": folder.resolve().name,
        # Brax with its physics, without which its return says nothing.
        "environment": label(environment, config["backend"]),
        "start": start,
        "seed": evolution["seed"],
        "settings": {**settings, "algorithms": ",".join(config["algorithms"])},
        "generations": len(rows),
        "planned_generations": evolution["num_generations"],
        "minutes": round(minutes[-1], 3),
        "generation_seconds": round(float(np.median(seconds)), 3),
        "steps": {
            "warm_start": warm["steps"] if start == "warm" else 0,
            "training": rows[-1]["steps/training"],
            "evaluation": rows[-1]["steps/evaluation"],
            "total": steps[-1],
        },
        "warm_start_minutes": warm["minutes"] if start == "warm" else 0.0,
        "machines": machines(folder) or [x for x in [warm["machine"]] if x],
        "target": target,
        "reached": None
        if at_target is None
        else dict(zip(("generation", "minutes", "steps", "mean"), at_target, strict=True)),
        "algorithms": {
            name.removeprefix("fitness/"): value
            for name, value in judged[-1][1].items()
            if name.startswith("fitness/")
        },
        "statistic": "IQM" if any(f"mean/fitness{_IQM}" in row for row in rows) else "mean",
        "points": points,
    }


def _judged(found: Mapping[str, Any]) -> float | None:
    """The interquartile mean over the agents, which targets are stated in; the mean where none was logged."""
    return found.get(f"fitness{_IQM}", found["fitness"])


def _warm_start(folder: Path, environment: str) -> dict[str, Any]:
    """What expert, fit and refinement took, as the run's bandit says it; None where that is unknown."""

    def cost_in(name: str) -> dict[str, Any]:
        path = folder / f"{name}.json"
        return dict(json.loads(path.read_text()).get("cost", {})) if path.is_file() else {}

    names = ("warm_start", "refinement")
    cost = cost_in(environment_spec(environment).bandit)
    # Of a search that has not ended, what it starts from says it.
    stages = list(filter(None, (cost.get(name) or cost_in(name) for name in names)))

    def total(name: str) -> float | None:
        known: list[Any] = [stage.get(name) for stage in stages]
        return None if not known or None in known else sum(known)

    steps, seconds = total("environment_steps"), total("seconds")
    return {
        "steps": None if steps is None else int(steps),
        "minutes": None if seconds is None else seconds / 60,
        "machine": cost.get("machine"),
    }


def _place(run: Mapping[str, Any]) -> tuple[Any, ...]:
    environment = rank(of_label(run["environment"])[0])
    return (environment, list(STARTS).index(run["start"]), run["seed"], run["name"])


def facts(report: Mapping[str, Any]) -> dict[str, Any]:
    """What a reader must know about these runs: {environment: {setting: its values, where they differ}}, machines."""
    runs, differing = report["runs"], {}
    for environment in dict.fromkeys(run["environment"] for run in runs):
        settings = [run["settings"] for run in runs if run["environment"] == environment]
        of_each = {
            name: list(dict.fromkeys(_setting(x.get(name)) for x in settings)) for name in SETTINGS
        }
        differing[environment] = {name: x for name, x in of_each.items() if len(x) > 1}
    known = each_once(x for run in runs for x in run["machines"])
    return {
        "machines": sorted(known, key=partial(json.dumps, sort_keys=True)),
        "differing": differing,
        "shipped": shipped(),
        "starts": starts(runs),
        "speeds": speeds(runs),
        "end": _end,
    }


def starts(runs: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Of every environment with a target and runs of both starts, the first of each to reach it, by total steps.

    Returns:
      [{"environment", "target", "warm", "random": the run or None, "tried": {start: how many there are},
      "longest": the random run of most steps, "whole": whether it was not stopped before its end, "times": the random
      run's steps to the target (where it gets there; else all that the longest took) over those of the warm one}].
    """
    found = []
    for environment in dict.fromkeys(run["environment"] for run in runs):
        of_each = {
            start: [r for r in runs if (r["environment"], r["start"]) == (environment, start)]
            for start in STARTS
        }
        if not all(of_each.values()) or of_each["random"][0]["target"] is None:
            continue
        first = {
            start: min(
                (r for r in of_it if r["reached"]),
                key=lambda r: r["reached"]["steps"],
                default=None,
            )
            for start, of_it in of_each.items()
        }
        longest = max(of_each["random"], key=lambda r: r["steps"]["total"])
        slow, fast = first["random"], first["warm"]
        took = slow["reached"]["steps"] if slow else longest["steps"]["total"]
        found.append(
            {
                "environment": environment,
                "target": longest["target"],
                "longest": longest,
                "tried": {start: len(of_it) for start, of_it in of_each.items()},
                "whole": longest["planned_generations"] in (None, longest["generations"]),
                "times": took / fast["reached"]["steps"]
                if fast and fast["reached"]["steps"]
                else None,
                **first,
            }
        )
    return found


# What a generation's time depends on, but for the machine.
_SIZE = ("population_size", "agents_per_candidate", "evaluation_episodes", "algorithms", "mode")


def speeds(runs: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Searches of one size, on one GPU and on CPUs: how long a generation takes.

    Returns:
      [{"environment", "settings", "gpu", "cpu": a run}], the first run of each that is as large as the other.
    """
    found: dict[str, dict[str, Any]] = {}
    for run in runs:
        if run.get("generation_seconds") is None or len(run["machines"]) != 1:
            continue
        size = [run["environment"], *(run["settings"][name] for name in _SIZE)]
        nothing = {"environment": run["environment"], "settings": run["settings"]}
        found.setdefault(json.dumps(size), nothing).setdefault(
            "gpu" if _on_gpu(run) else "cpu", run
        )
    return [pair for pair in found.values() if "gpu" in pair and "cpu" in pair]


def _on_gpu(run: Mapping[str, Any]) -> bool:
    return any(x["accelerator"] != "none" for x in run["machines"])


def shipped() -> list[dict[str, Any]]:
    """A row a bandit of the zoo: its expert's return, steps, minutes, cores, and whether those lack the expert's."""
    rows = []
    for name in sorted(zoo_names(), key=lambda x: rank(environment_spec(x).evaluation_environment)):
        metadata = bandit_metadata(name)
        warm_start = listing.warm_start_cost(metadata)
        rows.append(
            {
                **listing.entry(name),
                "expert": warm_start["expert_return"],
                "cores": metadata["cost"]["machine"]["cores"],
                "in_part": "seconds" not in warm_start,
            }
        )
    return rows


def _setting(value: Any) -> str:
    return "the default" if value is None else str(value)


def _end(run: Mapping[str, Any]) -> str:
    """The last mean, and by algorithm the interquartile means where the run logs them, else the means."""
    end, logged = plain(run["points"][-1][3]), run["algorithms"]
    iqms = {name.removesuffix(_IQM): x for name, x in logged.items() if name.endswith(_IQM)}
    shown = iqms or logged
    if not iqms and len(logged) < 2:
        return end
    each = ", ".join(f"{name.upper()} {plain(x)}" for name, x in shown.items())
    return f"{end} ({'IQM: ' if iqms else ''}{each})"


def figure(report: Mapping[str, Any]) -> Figure:
    """A row an environment with a target: the mean's return against minutes (left) and environment steps."""
    runs = [run for run in report["runs"] if run["target"] is not None]
    environments = list(dict.fromkeys(run["environment"] for run in runs))
    drawn = Figure(figsize=(plotting.WIDTH, 2.4 * len(environments) + 1.2))
    if not environments:
        return drawn
    grid = drawn.subplots(len(environments), 2, sharey="row", squeeze=False)
    columns: Any = (
        (1, "minutes", (1, 2, 5), "{x:g}"),  # which span few decades
        (2, "environment steps (training + evaluation)", (1,), EngFormatter(sep="")),
    )
    for row, environment in zip(grid, environments, strict=True):
        of_it = [run for run in runs if run["environment"] == environment]
        for axes, (column, xlabel, ticked, formatter) in zip(row, columns, strict=True):
            for run in of_it:
                x, y = ([point[i] for point in run["points"]] for i in (column, 3))
                look = STARTS[run["start"]] | (_ON_GPU if _on_gpu(run) else {})
                axes.plot(x, y, **look, linewidth=1.1)
            axes.axhline(of_it[0]["target"], **_TARGET)
            axes.margins(x=0.03, y=0.08)
            # A start costs little beside a search from random weights; and what begins at zero has a place too.
            spent = [point[column] for run in of_it for point in run["points"]]
            least = min((x for x in spent if x > 0), default=1.0)
            axes.set_xscale("symlog", linthresh=least)
            axes.set_xlim(left=0.0)
            decades = 10.0 ** np.arange(math.floor(math.log10(least)), math.log10(max(spent)))
            ticks = np.outer(decades, ticked).ravel()
            axes.set_xticks([0, *ticks[(ticks >= least) & (ticks <= max(spent))]])
            axes.minorticks_off()
            axes.xaxis.set_major_formatter(formatter)
            axes.set_xlabel(xlabel)
        statistics = " or ".join(dict.fromkeys(run["statistic"] for run in of_it))
        row[0].set(title=environment, ylabel=f"return ({statistics})")
    shown = {}
    for start, look in STARTS.items():
        for on_gpu in (False, True):
            number = sum(run["start"] == start and _on_gpu(run) == on_gpu for run in runs)
            where, more = (" on a GPU", _ON_GPU) if on_gpu else ("", {})
            if number:
                name = f"{start} start{where} ({number} run{'s' if number > 1 else ''})"
                shown[name] = look | more
    shown["target"] = _TARGET
    plotting.figure_title(
        drawn, "Discovery of a bandit: return of agents trained in the search's mean"
    )
    plotting.legend_of(drawn, shown, columns=3)
    return drawn


@dataclass(frozen=True)
class Options:
    """What is read."""

    folders: tyro.conf.Positional[tuple[Path, ...]] = ()
    """run folders of scb discover"""


def measure(options: Options, report: dict[str, Any], save: Save) -> None:
    """The runs of these folders, beside those that the report has of others."""
    names = [folder.resolve().name for folder in options.folders]
    if twice := [name for name in names if names.count(name) > 1]:
        raise UserError(
            f"two of the folders are called {twice[0]}, by which runs are known here: rename one."
        )
    earlier = {run["name"]: run for run in report.get("runs", ())}
    found = collect(options.folders)
    runs = earlier | {run["name"]: run for run in found["runs"]}
    report |= {"runs": sorted(runs.values(), key=_place), "left_out": found["left_out"]}
    for left in report["left_out"]:
        print(f"left out: {left['name']}, since {left['why']}")
    save()


EXPERIMENT = Experiment(
    "discovery_cost",
    "What discovering a bandit costs",
    measure,
    facts=facts,
    draw=figure,
    options=Options,
    keys=("runs",),
)
