"""Training in a Brax environment's bandit against training in the environment itself.

    python -m experiments brax_training

Learning curves of agents in bandits (ours and the published ones, each said) and of agents with the
paper's expert hyperparameters in the environments, the final returns, and the steps that the latter
need to match the former. Published bandits are read from --published DIRECTORY; without it ours are
measured alone. PPO's agents in environments are those of experiments.locomotion, where it has them at this length.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments import zoo_table
from experiments.claims import Claim, of_agents
from experiments.harness import Experiment, Preset
from experiments.parts import InParts, Part
from experiments.reports import Report, lost, rows_in
from experiments.zoo_table_page import BANDITS, PAPER, label, of_label, paper_return
from lpo.full_size import full_size
from scb import measurement, plotting
from scb.agents.spec import AgentSpec, bandit_agent, environment_agent
from scb.environments.registry import environment_spec
from scb.rows import pivot
from scb.seeds import REPORTING
from scb.statistics import DECIDING, estimate, median

OURS, PUBLISHED = BANDITS
LOOKS = {
    OURS: plotting.Look(plotting.BLUE),
    PUBLISHED: plotting.Look(plotting.PURPLE, "-."),
    "environment": plotting.Look(plotting.VERMILLION, "--"),
}
WORDS = {OURS: "our bandit", PUBLISHED: "the published bandit", "environment": "the environment"}
_PAPER_LINE = "the environment, in the paper (at the end)"
# Half of the hundred that two orders of magnitude are, for the paper says "roughly".
LEAST_TIMES = 50


@dataclass(frozen=True)
class Options(Preset):
    """A preset, and what it needs beside the library."""

    published: Path | None = None
    """folder with the published bandits' .npz files"""


def task(kind: str, environment: str, backend: str | None) -> str:
    """The name of a bandit in the report."""
    return f"{label(environment, backend)}, {kind}"


def parts(plan: Mapping[str, Any], report: dict[str, Any]) -> Iterator[Part]:
    """Learning curves: those in bandits, then those in environments."""
    bandits, _ = (report.setdefault(kind, {}) for kind in ("bandits", "environments"))
    published = plan["published"]

    def there(of: list[Any]) -> bool:
        return set(plan["bandit_algorithms"]) <= set(bandits.get(task(*of), ()))

    def kinds(environment: str) -> Iterable[str]:
        return zoo_table.bandits(environment, published and Path(published))

    left_out = [
        x for x in plan["bandits"] if x[0] == PUBLISHED and not there(x) and x[0] not in kinds(x[1])
    ]
    report["left_out"] = [task(*x) for x in left_out]
    for name in report["left_out"]:
        bandits.pop(name, None)  # a part of its algorithms can't be shown
    measured = [x for x in plan["bandits"] if x not in left_out]
    for kind, environment, backend in measured:
        for algorithm in plan["bandit_algorithms"]:
            curve = partial(_in_bandit, kind, environment, backend, plan, algorithm)
            yield Part(("bandits", task(kind, environment, backend), algorithm), curve)
    for environment, backend in dict.fromkeys((x[1], x[2]) for x in measured):
        for algorithm in plan["environment_steps"][environment]:
            curve = partial(_in_environment, environment, backend, plan, algorithm)
            yield Part(("environments", label(environment, backend), algorithm), curve)


measure = InParts(parts)


def _in_bandit(
    kind: str, environment: str, backend: str | None, plan: Mapping[str, Any], algorithm: str
) -> dict[str, Any]:
    published = Path(plan["published"]) if kind == PUBLISHED else None
    candidate = zoo_table.bandits(environment, published)[kind]
    spec = bandit_agent(algorithm, environment)
    name = task(kind, environment, backend)
    train_in = measurement.Place(name, candidate.bandit, candidate.bandit.default_params)
    judge_in = measurement.Place.named(environment, backend)
    curves = _curves(spec, train_in, judge_in, plan["bandit_agents"], plan)
    return {"sha256": candidate.sha256, **curves}


def _in_environment(
    environment: str, backend: str | None, plan: Mapping[str, Any], algorithm: str
) -> dict[str, Any]:
    steps = plan["environment_steps"][environment][algorithm]
    if algorithm == "ppo" and (known := known_of_ppo(environment, backend, steps)):
        return known
    spec = environment_agent(algorithm, environment).with_steps(steps)
    place = measurement.Place.named(environment, backend)
    return _curves(spec, place, place, plan["environment_agents"], plan)


def known_of_ppo(environment: str, backend: str | None, steps: int) -> dict[str, Any] | None:
    """The curves of PPO's agents that were trained for so long to compare objectives; None where there are none."""
    comparison = full_size(environment)
    if comparison is None:
        return None
    curves = comparison.curves[0]
    if (curves.objective, curves.backend, int(curves.steps[-1])) != ("ppo", backend, steps):
        return None
    return {"steps": curves.steps.tolist(), "returns": curves.returns.tolist()}


def _curves(
    spec: AgentSpec,
    train_in: measurement.Place,
    judge_in: measurement.Place,
    number: int,
    plan: Mapping[str, Any],
) -> dict[str, Any]:
    """{"steps": [P + 1], "returns": [N, P + 1], "failed"}: `number` agents, most likely actions."""
    agents = measurement.Agents.drawn_from(spec, REPORTING.start, number)
    size = {"points": plan["points"], "episodes": plan["episodes"]}
    kept = rows_in(plan.get("rows"), train_in.name, spec.algorithm)
    rows = measurement.measure(spec, train_in, judge_in, agents, **size, rows=kept)
    returns, failed = measurement.as_random(pivot(rows, "agent", "step"), judge_in)
    return {
        "steps": list(dict.fromkeys(row["step"] for row in rows)),
        "returns": np.round(returns, 1).tolist(),
        "failed": int(failed.any(axis=1).sum()),
    }


def finals(curves: Mapping[str, Any]) -> np.ndarray:
    """[N] returns at the end."""
    return np.asarray(curves["returns"])[:, -1]


def steps_to_match(curves: Mapping[str, Any], level: float) -> list[int | None]:
    """For each agent the steps of its first evaluation that reaches the level; None where it never does.

    What lies between two evaluations isn't seen: an agent may be there up to their distance earlier.
    """
    reached = np.asarray(curves["returns"]) >= level
    return [int(curves["steps"][int(np.argmax(row))]) if row.any() else None for row in reached]


def steps_without(curves: Mapping[str, Any], level: float) -> list[int]:
    """For each agent the steps of its last evaluation before the one that reaches the level: it took more."""
    reached = np.asarray(curves["returns"]) >= level
    steps = curves["steps"]
    return [
        int(steps[max(int(np.argmax(row)) - 1, 0)] if row.any() else steps[-1]) for row in reached
    ]


def _environment_of(name: str) -> str:
    return name.rsplit(", ", 1)[0]


def matches(report: Mapping[str, Any]) -> list[dict[str, Any]]:
    """For each bandit and algorithm that was trained in the environment too: who reaches the bandit's level, when.

    Medians of steps are (of the last evaluations without it, of the first that reach it). The level is uncertain, so
    those to the lower end of its interval are there too.
    """

    def medians(curves: Mapping[str, Any], level: float) -> tuple[float, float | None]:
        reached = [np.inf if x is None else x for x in steps_to_match(curves, level)]
        middle = float(np.median(reached))
        before = float(np.median(steps_without(curves, level)))
        return before, middle if np.isfinite(middle) else None

    rows = []
    for name, algorithms in report["bandits"].items():
        environment, backend = of_label(_environment_of(name))
        for algorithm, curves in report["environments"][_environment_of(name)].items():
            level = estimate(finals(algorithms[algorithm]))
            low = level.value if level.low is None else level.low
            steps = steps_to_match(curves, level.value)
            rows.append(
                {
                    "bandit": name,
                    "environment": environment,
                    "backend": backend,
                    "algorithm": algorithm,
                    "finals": finals(algorithms[algorithm]),
                    "level": level,
                    "bandit_steps": algorithms[algorithm]["steps"][-1],
                    "reached": sum(x is not None for x in steps),
                    "agents": len(steps),
                    "steps": medians(curves, level.value),
                    "without_low": steps_without(curves, low),
                    "steps_low": medians(curves, low),
                    "trained": curves["steps"][-1],
                }
            )
    return rows


def claims(report: Report) -> list[Claim]:
    """Row by row of `matches`: the environment takes 50 times the steps or more, for agents that locomote.

    The steps are those of an agent's last evaluation below the lower end of the bandit's level, after which it took
    more: neither the luck of the bandit's agents decides, nor how far evaluations are apart. An agent that never gets
    there counts with all steps of its training; where that was for less than 50 times, nothing is told.
    """
    found = []
    for row in matches(report):
        times = np.array(row["without_low"]) / row["bandit_steps"]
        told = (
            max(row["without_low"]) < row["trained"]
            or row["trained"] >= LEAST_TIMES * row["bandit_steps"]
        )
        name = f"{row['bandit']}, {row['algorithm'].upper()}"
        text = f"{name}: the environment takes {LEAST_TIMES} times the steps or more to the level's lower end"
        evidence = of_agents(partial(median, times), len(times)) if told else None
        found.append(Claim(text, evidence, LEAST_TIMES, places=0))
        standing = environment_spec(row["environment"]).standing_still(row["backend"])
        if standing is not None:
            text = f"{name}: agents from the bandit earn more than standing still"
            finals = of_agents(partial(estimate, row["finals"]), len(row["finals"]))
            found.append(Claim(text, finals, standing, places=0))
    return found


def facts(report: Report) -> dict[str, Any]:
    """Final returns, ours and the paper's, and steps to match."""
    rows = []
    for name, algorithms in report["bandits"].items():
        there = _environment_of(name)
        own, (environment, backend) = report["environments"][there], of_label(there)
        for algorithm, curves in algorithms.items():
            both = [x and {**x, "final": finals(x)} for x in (curves, own.get(algorithm))]
            stated = PAPER.get(environment, {}).get(algorithm)
            expert = paper_return(environment, algorithm, backend)
            rows.append((name, algorithm, *both, stated, expert))
    found = matches(report)
    told = [row for row in found if row["agents"] >= DECIDING]
    return {
        "finals": rows,
        "matches": found,
        "deciding": DECIDING,
        "ordered": sorted(told, key=lambda row: row["steps"][0]),
        "times": _times,
        "least_times": LEAST_TIMES,
        "short": sum(row["steps"][1] is None for row in found),
        "lost": lost(report),
    }


def _times(row: Mapping[str, Any], steps: tuple[float, float | None]) -> str:
    """The environment's steps, without the level and then with it, as a multiple of the bandit's."""
    without, reached = (x if x is None else round(x / row["bandit_steps"]) for x in steps)
    return f"more than {without}" if reached is None else f"{without} to {reached}"


def draw(report: Mapping[str, Any]) -> Figure:
    """A row an environment, a column an algorithm; steps on a logarithmic axis."""
    algorithms = list(next(iter(report["bandits"].values())))
    # {environment: {where its agents train: {algorithm: curves}}}
    places: dict[str, dict[str, Any]] = {}
    for name, curves in report["bandits"].items():
        environment = _environment_of(name)
        of_it = places.setdefault(environment, {"environment": report["environments"][environment]})
        of_it[name.rpartition(", ")[2]] = curves
    figure = Figure(figsize=(2.7 * len(algorithms), 2.4 * len(places) + 0.9))
    panels: Any = figure.subplots(
        len(places), len(algorithms), squeeze=False, sharey="row", sharex="col"
    )
    for row, (environment, found) in zip(panels, places.items(), strict=True):
        place_name, backend = of_label(environment)
        for axes, algorithm in zip(row, algorithms, strict=True):
            for place, look in LOOKS.items():
                if (curve := found.get(place, {}).get(algorithm)) is None:
                    continue
                # A logarithmic axis has no zero: the untrained agent is left out.
                shown = np.asarray(curve["steps"]) > 0
                steps = np.asarray(curve["steps"])[shown]
                estimates = [estimate(x) for x in np.transpose(curve["returns"])[shown]]
                plotting.estimate_curve(axes, steps, estimates, look)
            paper = paper_return(place_name, algorithm, backend)
            if algorithm not in found["environment"] and paper:
                axes.axhline(paper, color=plotting.GREY, linestyle=":")
            axes.set_xscale("log")
        row[0].set_ylabel(f"return on\n{environment}")
    for axes, algorithm in zip(panels[0], algorithms, strict=True):
        axes.set_title(algorithm.upper())
    for axes in panels[-1]:
        axes.set_xlabel("training steps")
    legend = {WORDS[place]: look for place, look in LOOKS.items()}
    legend[_PAPER_LINE] = plotting.Look(plotting.GREY, ":")
    plotting.legend_of(figure, legend, 4)
    plotting.figure_title(figure, "Agents by where they trained: interquartile mean, 95 % interval")
    return figure


EXPERIMENT = Experiment.of_the_paper(
    "brax_training", measure, draw, claims, facts=facts, options=Options
)
