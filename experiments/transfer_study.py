"""What makes an objective carry over from a bandit: every lever of the meta-training, one at a time.

    python -m experiments.transfer_study

Each variation changes one setting of `lpo meta-train`, learns an objective with it, and trains PPO
with what it learned: on Pendulum, with Flax's initialisation of the policy and with a small last layer,
and on Hopper, which no choice ever looked at. Searches are run folders under --runs and are resumed;
what --out holds already is not measured again, so the same command continues an interrupted study.
`--variations` names some of them, and `--meta-seeds` further searches of these; `--only-render` makes
page and figure from --out.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from experiments.harness import exit_status, read
from experiments.rendering import text
from lpo.comparison import compare
from lpo.learning import command_of, objective_of_run
from lpo.objectives import load_objective
from scb import plotting
from scb.agents.spec import environment_agent
from scb.artefacts import machine_description, package_versions
from scb.cli import configure_jax
from scb.errors import UserError
from scb.plotting import BLUE, GREY, VERMILLION, estimate_row, figure_style
from scb.runs import write_json
from scb.statistics import estimate, paired_difference

# Flags of `lpo meta-train`. The first is what the others differ from in one thing each.
VARIATIONS: dict[str, dict[str, Any]] = {
    "default": {},
    "no reward noise": {"reward_noise": 0.0},
    "reward noise 10": {"reward_noise": 10.0},
    "one initialisation": {"hyperparameters": "policy_output_scale=1"},
    "learning rates drawn": {
        "hyperparameters": "policy_output_scale=1,0.01 learning_rate=0.0003,0.001,0.003"
    },
    "area under the curve": {"fitness": "area"},
    "return on Pendulum": {"fitness": "transfer"},
    "four bandits": {
        "tasks": "Synthetic-Pendulum-v1,Synthetic-CartPole-v1,Synthetic-Acrobot-v1,"
        "Synthetic-MountainCarContinuous-v0"
    },
    "no PPO base": {"base": "none"},
    "temporal": {"temporal": True},
    "no gate": {"gate": 0.0},
    "no gate, xi 1e-4": {"gate": 0.0, "xi": 1e-4},
    "small steps": {"sigma": 0.01, "learning_rate": 0.003},
    "large steps": {"sigma": 0.1, "learning_rate": 0.03},
    # A training of 1350 steps, less than a hundredth of Pendulum's.
    "90 contexts": {"contexts": 90},
    "stopped by validation": {"validate": True},
}
REFERENCES = ("ppo", "ppo-1", "dpo")
NO_SEARCH = "no search"  # stands for the meta-seed of a reference


@dataclass(frozen=True)
class Evaluation:
    """Where objectives are judged. The seeds are neither those of searches nor those that report."""

    name: str
    environment: str
    backend: str | None = None
    steps: int | None = None
    policy_output_scale: float = 1.0
    seeds: int = 20
    first_seed: int = 21_000

    def seed_list(self) -> list[int]:
        return list(range(self.first_seed, self.first_seed + self.seeds))


EVALUATIONS = (
    Evaluation("Pendulum", "Pendulum-v1"),
    Evaluation("Pendulum, small last layer", "Pendulum-v1", policy_output_scale=0.01),
    Evaluation("Hopper (spring), never used", "hopper", "spring", 500_000, seeds=6),
)


def settings_of(
    variation: str, seed: int, generations: int, population_size: int
) -> dict[str, Any]:
    """The settings of `lpo meta-train` for a variation."""
    return {
        "command": "meta-train",
        "seed": seed,
        "population_size": population_size,
        "generations": generations,
        **VARIATIONS[variation],
    }


def summary(report: Mapping[str, Any]) -> list[dict[str, Any]]:
    """One row an objective: per evaluation the estimate, and the paired difference to the default's.

    A difference is over the searches of one seed in both; a reference, which has one set of agents and
    no search, stands against each search of the default.
    """
    rows = []
    default = report["objectives"].get("default", {}).get("returns", {})
    for name, entry in report["objectives"].items():
        row: dict[str, Any] = {"name": name, "seconds": entry.get("seconds")}
        for evaluation, returns in entry["returns"].items():
            of_default = default.get(evaluation, {})
            own = dict.fromkeys(of_default, returns[NO_SEARCH]) if name in REFERENCES else returns
            seeds = [seed for seed in of_default if seed in own]
            row["searches"] = 0 if name in REFERENCES else len(returns)
            row[evaluation] = estimate(np.concatenate(list(returns.values())))
            if seeds and name != "default":
                row[f"{evaluation}, difference"] = paired_difference(
                    np.concatenate([own[seed] for seed in seeds]),
                    np.concatenate([of_default[seed] for seed in seeds]),
                )
        rows.append(row)
    return rows


def findings(rows: Sequence[Mapping[str, Any]], evaluations: Sequence[str]) -> str:
    """Which variations of a `summary` are clearly better or worse than the default: an interval without zero."""

    def differing(row: Mapping[str, Any], sign: int) -> list[str]:
        found = {name: row.get(f"{name}, difference") for name in evaluations}
        return [
            name
            for name, x in found.items()
            if x is not None and (x.low > 0 if sign > 0 else x.high < 0)
        ]

    found = {
        row["name"]: (differing(row, 1), differing(row, -1))
        for row in rows
        if row["searches"] and row["name"] != "default"
    }
    parts = {
        "Clearly worse than the default somewhere, and nowhere clearly better": [
            name for name, (better, worse) in found.items() if worse and not better
        ],
        "Clearly better somewhere, and nowhere clearly worse": [
            name for name, (better, worse) in found.items() if better and not worse
        ],
        "Clearly better in one place and worse in another": [
            f"{name} (better: {', '.join(better)}; worse: {', '.join(worse)})"
            for name, (better, worse) in found.items()
            if better and worse
        ],
        "Not clearly apart from it": [name for name, x in found.items() if x == ([], [])],
    }
    return " ".join(f"{said}: {'; '.join(names) or 'none'}." for said, names in parts.items())


def markdown(report: Mapping[str, Any]) -> str:
    """The page with the table."""
    evaluations = [e["name"] for e in report["evaluations"]]
    searches, rows = report["searches"], summary(report)
    lines = [
        "# What makes an objective carry over from a bandit",
        "",
        "`python -m experiments.transfer_study`, then with `--variations` and `--meta-seeds` for more searches",
        "",
        f"Each row is learned on a bandit by {searches['generations']} generations of "
        f"{searches['population_size']} candidates, as many times as the column of searches says; it differs from "
        "the default in what its name says. Then PPO is trained with it. Final return with the most likely actions, "
        "interquartile mean over agents and 95 % bootstrap interval; in round brackets the paired difference to the "
        "default's searches of the same seeds where its interval excludes zero. Intervals are over agents: how much "
        "another search would differ, only the rows of several searches say.",
        "",
        findings(rows, evaluations),
        "",
        "![Final returns by variation](figures/transfer_study.png)",
        "",
        "| objective | " + " | ".join(evaluations) + " | searches | minutes |",
        "| --- |" + " --- |" * (len(evaluations) + 2),
    ]
    for row in rows:
        cells = []
        for evaluation in evaluations:
            cell = text(row[evaluation]) if evaluation in row else ""
            difference = row.get(f"{evaluation}, difference")
            if difference is not None and (difference.low > 0 or difference.high < 0):
                sign = "+" if difference.value > 0 else "\u2212"
                cell += f" ({sign}{abs(difference.value):.0f})"
            cells.append(cell)
        minutes = "" if row["seconds"] is None else f"{row['seconds'] / 60:.1f}"
        searched = str(row["searches"] or "")
        lines.append(f"| {row['name']} | {' | '.join(cells)} | {searched} | {minutes} |")
    described = [
        f"{e['name']}: {e['seeds']} agents a search, seeds from {e['first_seed']}"
        + (f", {e['steps']} steps" if e["steps"] else "")
        + (
            f", last layer times {e['policy_output_scale']:g}"
            if e["policy_output_scale"] != 1
            else ""
        )
        for e in report["evaluations"]
    ]
    machine = report["machine"]
    lines += [
        "",
        "; ".join(described) + ". PPO and DPO have one set of agents each.",
        "",
        "The commands:",
        "",
        *(
            f"- {name}: `{entry['command']}`"
            for name, entry in report["objectives"].items()
            if "command" in entry
        ),
        "",
        f"Measured on {machine['cores']} cores, {machine['processor']}.",
        "",
    ]
    return "\n".join(lines)


def draw(report: Mapping[str, Any]) -> Figure:
    """One panel an evaluation, one line an objective: interquartile mean with its interval, each agent a dot."""

    evaluations = [e["name"] for e in report["evaluations"]]
    rows = summary(report)
    with figure_style():
        figure = Figure(figsize=(11.0, 1.6 + 0.32 * len(rows)))
        panels = figure.subplots(1, len(evaluations), sharey=True, squeeze=False)[0]
        for axes, evaluation in zip(panels, evaluations, strict=True):
            for position, row in enumerate(rows):
                if evaluation not in row:
                    continue
                color = {"default": VERMILLION}.get(
                    row["name"], BLUE if row["name"] in REFERENCES else GREY
                )
                returns = report["objectives"][row["name"]]["returns"][evaluation]
                agents = np.concatenate(list(returns.values()))
                estimate_row(axes, position, agents, row[evaluation], color)
            axes.set_title(evaluation)
            axes.set_xlabel("final return")
            axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
        panels[0].set_yticks(range(len(rows)), [row["name"] for row in rows])
        panels[0].invert_yaxis()
        figure.suptitle("Interquartile mean with its 95 % interval, each agent a dot")
    return figure


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--variations", nargs="*", default=list(VARIATIONS), choices=VARIATIONS)
    parser.add_argument("--meta-seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--generations", type=int, default=30)
    parser.add_argument("--population-size", type=int, default=32)
    parser.add_argument("--runs", type=Path, default=Path("runs/transfer_study"))
    parser.add_argument("--out", type=Path, default=Path("docs/data/transfer_study.json"))
    parser.add_argument("--page", type=Path, default=Path("docs/transfer_study.md"))
    parser.add_argument("--only-render", action="store_true")
    arguments = parser.parse_args(argv)
    configure_jax()
    searches = {
        "generations": arguments.generations,
        "population_size": arguments.population_size,
    }
    keys = ("searches", "objectives")
    report = read(arguments.out, missing_is_new=not arguments.only_render, keys=keys)
    if not arguments.only_render:
        _measure(arguments, report, searches)

    arguments.page.write_text(markdown(report))
    (arguments.page.parent / "figures").mkdir(exist_ok=True)
    plotting.save(draw(report), arguments.page.parent / "figures" / "transfer_study.png")
    return 0


def _measure(
    arguments: argparse.Namespace, report: dict[str, Any], searches: Mapping[str, Any]
) -> None:

    if report and report["searches"] != searches:
        raise UserError(
            f"{arguments.out} holds a study of other searches ({report['searches']}): choose another --out."
        )
    report |= {
        "searches": dict(searches),
        "evaluations": [asdict(e) for e in EVALUATIONS],
        "versions": package_versions(),
        "machine": machine_description(),
    }
    entries = report.setdefault("objectives", {})
    arguments.out.parent.mkdir(parents=True, exist_ok=True)

    def judge(name: str, evaluation: Evaluation, objectives: Mapping[str, Any]) -> None:
        comparison = compare(
            evaluation.environment,
            list(objectives.values()),
            evaluation.seed_list(),
            spec=environment_agent("ppo", evaluation.environment)
            .with_steps(evaluation.steps)
            .with_values(policy_output_scale=evaluation.policy_output_scale),
            backend=evaluation.backend,
            points=1,
        )
        returns = entries[name].setdefault("returns", {}).setdefault(evaluation.name, {})
        for seed, curves in zip(objectives, comparison.curves, strict=True):
            returns[seed] = np.round(curves.final, 2).tolist()
            print(f"{name} | {evaluation.name} | {seed} | {estimate(curves.final)}", flush=True)
        write_json(arguments.out, report)

    for name in (*REFERENCES, *arguments.variations):
        entry = entries.setdefault(name, {})
        if name in REFERENCES:
            objectives = {NO_SEARCH: load_objective(name)}
        else:
            objectives = {
                str(seed): _learn(arguments, name, seed, entry) for seed in arguments.meta_seeds
            }
        for evaluation in EVALUATIONS:
            known = entry.get("returns", {}).get(evaluation.name, {})
            missing = {seed: x for seed, x in objectives.items() if seed not in known}
            if missing:
                judge(name, evaluation, missing)


def _learn(arguments: argparse.Namespace, name: str, seed: int, entry: dict[str, Any]) -> Any:
    """A variation's objective of one search, and into the entry what it took."""
    settings = settings_of(name, seed, arguments.generations, arguments.population_size)
    objective = objective_of_run(settings, arguments.runs / f"{name.replace(' ', '-')}-{seed}")
    entry["command"] = command_of("lpo", {**settings, "seed": None})
    cost = objective.metadata["cost"]
    entry["seconds"] = cost["seconds"]
    if "generation" in cost:
        entry.setdefault("stopped_at", {})[str(seed)] = cost["generation"]
    return replace(objective, name=f"{name}-{seed}")


if __name__ == "__main__":
    sys.exit(exit_status("transfer_study", main))
