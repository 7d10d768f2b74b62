"""Stable-Baselines3 as it comes, trained in bandits, and for as many steps in the environments themselves.

    make sb3

Its algorithms with their default hyperparameters train in a bandit of the zoo or in Gymnasium's environment, and
are judged in the environment after several numbers of steps. It has an environment of its own (`make sb3` makes
it), in which every agent is a process. What --out holds already is not trained again. In a bandit of one's own alone:

    python -m experiments sb3 --environments Pendulum-v1 --algorithms ppo --bandit FILE.npz --out FILE.json
"""

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from experiments.claims import Claim, judge, of_agents
from experiments.harness import Experiment, last_line
from experiments.parts import InParts, Part
from experiments.reports import Report, bandit_of, settled
from scb import plotting
from scb.environments.registry import environment_spec
from scb.environments.zoo import bandit_metadata, load_bandit
from scb.errors import UserError, at_least, one_of
from scb.files import packed_row, unpacked
from scb.gymnasium import NAMESPACE
from scb.judgement import check_fits
from scb.measurement import Place
from scb.plotting import thousands
from scb.seeds import REPORTING, reporting
from scb.statistics import DECIDING, Estimate, estimate, paired_difference

PEER_SCRIPT = Path(__file__).with_name("peers") / "sb3_peer.py"
BANDIT, ENVIRONMENT = PLACES = ("bandit", "environment")
# SAC, TD3 and DDPG update after every step, and take minutes where PPO takes seconds.
LONG, SHORT = (10_000, 20_000, 50_000, 100_000, 150_000), (10_000,)
STEPS = {"ppo": LONG, "dqn": LONG, "sac": SHORT, "td3": SHORT, "ddpg": SHORT}
CONTINUOUS, DISCRETE = ("ppo", "sac", "td3", "ddpg"), ("ppo", "dqn")
ALGORITHMS = {
    "Pendulum-v1": CONTINUOUS,
    "MountainCarContinuous-v0": CONTINUOUS,
    "CartPole-v1": DISCRETE,
    "Acrobot-v1": DISCRETE,
    "MountainCar-v0": DISCRETE,
}
EPISODES = 20
COLORS = {
    "ppo": plotting.BLUE,
    "dqn": plotting.BLACK,
    "sac": plotting.VERMILLION,
    "td3": plotting.GREEN,
    "ddpg": plotting.ORANGE,
}
LOOKS = {
    BANDIT: plotting.Look(plotting.GREY, marker="o"),
    ENVIRONMENT: plotting.Look(plotting.GREY, ":", "x"),
}


@dataclass(frozen=True)
class Options:
    """Who is trained, and where."""

    python: Path = Path(".venv-sb3/bin/python")
    """of an environment with stable-baselines3 and this library"""
    environments: tuple[str, ...] = tuple(ALGORITHMS)
    """of Gymnasium, for which the zoo has bandits"""
    algorithms: tuple[str, ...] = tuple(STEPS)
    """those of them that an environment's actions allow"""
    seeds: int = 10
    """agents of each"""
    bandit: Path | None = None
    """path.npz of a bandit in place of the zoo's; of one environment, in a report of its own (--out)"""
    longest: int = LONG[-1]
    """training steps that no agent exceeds"""

    def __post_init__(self) -> None:
        at_least(1, self, "seeds")
        at_least(LONG[0], self, "longest")
        for name in self.environments:
            one_of("environment", name, ALGORITHMS)
        for name in self.algorithms:
            one_of("algorithm", name, STEPS)
        if not any(cells(self)):
            raise UserError(
                f"of the environments {', '.join(self.environments)} none allows what is asked for "
                f"({', '.join(self.algorithms)}): give another of --algorithms."
            )
        if self.bandit is not None and len(self.environments) != 1:
            raise UserError(
                f"the bandit {self.bandit} is for one environment, and there are {len(self.environments)}: name it by "
                "--environments."
            )


def parts(options: Options, report: dict[str, Any]) -> Iterator[Part]:
    """A seed of everything at a time, so that all have as many wherever it ends."""
    if not options.python.exists():
        raise UserError(f"{options.python} is not there: run `make sb3`, or give another --python.")
    steps = {name: [n for n in of if n <= options.longest] for name, of in STEPS.items()}
    settled(report, steps=steps, episodes=EPISODES, bandit=_checksum(options))
    if options.bandit is None:
        sums = {name: bandit_of(name)[1] for name in options.environments}
        settled(report.setdefault("bandits", {}), **sums)  # of the zoo, by checksum
    python = str(options.python)
    yield Part(("peer_versions",), partial(last_line, [python, str(PEER_SCRIPT), "versions"]))
    for seed in reporting(options.seeds):
        for name, algorithm, place in cells(options):
            job = {
                "algorithm": algorithm,
                "train_in": trained_in(name, place, options.bandit),
                "judge_in": name,
                "steps": steps[algorithm],
                "episodes": EPISODES,
                "seed": seed,
            }
            yield Part(
                ("agents", name, algorithm, place, str(seed)), partial(_trained, python, job)
            )


measure = InParts(parts)


def _trained(python: str, job: Mapping[str, Any]) -> dict[str, str]:
    found = last_line([python, str(PEER_SCRIPT), json.dumps(job)])
    print(job["train_in"], job["algorithm"], job["seed"], found["returns"], flush=True)
    return {x: packed_row(found[x]) for x in ("returns", "seconds")}


def cells(options: Options) -> Iterator[tuple[str, str, str]]:
    """(environment, algorithm, place) of all that is asked for."""
    for name in options.environments:
        for algorithm in ALGORITHMS[name]:
            if algorithm in options.algorithms:
                places = PLACES if options.bandit is None else (BANDIT,)
                yield from ((name, algorithm, place) for place in places)


def _checksum(options: Options) -> str | None:
    """Of a bandit in place of the zoo's, which a report is then of; it must stand for the environment."""
    if options.bandit is None:
        return None
    (name,) = options.environments
    check_fits(load_bandit(str(options.bandit)), Place.named(name))
    return str(bandit_metadata(str(options.bandit))["sha256"])


def trained_in(environment: str, place: str, bandit: Path | None = None) -> str:
    """Gymnasium's name of where agents train, or a bandit's file."""
    if place == ENVIRONMENT:
        return environment
    if bandit is not None:
        return str(bandit.resolve())
    return f"{NAMESPACE}/{environment_spec(environment).bandit}"


def returns_of(agents: Mapping[str, Any], seeds: Sequence[str]) -> np.ndarray:
    """[S, P] what agents of these seeds earn after each number of steps."""
    return unpacked([agents[seed]["returns"] for seed in seeds])


def claims(report: Report) -> list[Claim]:
    """Of every algorithm: after the fewest and the most steps, more in the bandit than in the environment itself."""
    found = []
    for name, algorithms in report["agents"].items():
        for algorithm, places in algorithms.items():
            both = [places.get(place, {}) for place in PLACES]
            shared = sorted(set.intersection(*map(set, both)))
            steps = report["steps"][algorithm]
            for point in sorted({0, len(steps) - 1}):
                evidence: Any = None
                if shared:
                    here, there = (returns_of(cell, shared)[:, point] for cell in both)
                    evidence = of_agents(partial(paired_difference, here, there), len(shared))
                text = f"{name}, {algorithm.upper()} after {thousands(steps[point])} steps"
                found.append(Claim(text, evidence, places=0, of=point == len(steps) - 1))
    return found


def facts(report: Report) -> dict[str, Any]:
    """Estimates of every cell, and seconds of training per thousand steps."""
    tables: dict[str, dict[str, dict[str, list[Estimate]]]] = {}
    counts = set()
    for name, algorithms in report["agents"].items():
        for algorithm, places in algorithms.items():
            for place, agents in places.items():
                if not agents:
                    continue
                counts.add(len(agents))
                returns = returns_of(agents, sorted(agents))
                row = [estimate(column) for column in returns.T]
                if len(agents) < DECIDING:
                    row = [x.without_interval() for x in row]
                tables.setdefault(name, {}).setdefault(algorithm, {})[place] = row
    trained = {algorithm for of_it in tables.values() for algorithm in of_it}
    longest = max((n[-1] for n in report["steps"].values()), default=0)
    return {
        "tables": tables,
        "every": sorted({n for x in report["steps"].values() for n in x}),
        "counts": sorted(counts),
        "number": Counter(_outcomes(report)),
        "short": [x for x, n in report["steps"].items() if x in trained and n[-1] < longest],
        "deciding": DECIDING,
        "expert": {name: environment_spec(name).reference() for name in tables},
        "random": {name: environment_spec(name).random_return() for name in tables},
        "seed": REPORTING.start,
    }


def _outcomes(report: Report) -> list[str]:
    """What becomes of the claims after the most steps, of the algorithms that have enough agents."""
    return [
        x.outcome
        for x in judge(claims(report))
        if x.claim.of and x.estimate and x.estimate.n >= DECIDING
    ]


def draw(report: Mapping[str, Any]) -> Figure:
    """An environment a panel: return after each number of steps; beside it what has one number, each agent a dot."""
    shown = facts(report)
    tables = shown["tables"]
    short = {name: [x for x in of if len(report["steps"][x]) == 1] for name, of in tables.items()}
    number = len(tables) + sum(map(bool, short.values()))
    figure = Figure(figsize=(plotting.WIDTH, 2.9 * max(1, -(-number // 2))))
    if not tables:
        return figure
    panels = iter(plotting.panels(figure, number))
    for name, algorithms in tables.items():
        curves, once = next(panels), short[name]
        for algorithm, places in algorithms.items():
            for place, found in places.items() if algorithm not in once else ():
                look = replace(LOOKS[place], color=COLORS[algorithm])
                plotting.estimate_curve(curves, report["steps"][algorithm], found, look)
        for label, level in (
            ("expert", shown["expert"][name].value),
            ("random", shown["random"][name]),
        ):
            curves.axhline(level, color=plotting.GREY, linewidth=0.8, linestyle="--")
            curves.annotate(label, (1.0, level), xycoords=("axes fraction", "data"), fontsize=7)
        curves.set(title=name, xlabel="training steps", ylabel="return", xscale="log")
        curves.xaxis.set_major_formatter(EngFormatter(sep=""))
        if once:
            _draw_once(next(panels), name, once, report, tables[name])
    used = [x for x in COLORS if any(x in algorithms for algorithms in tables.values())]
    looks = {x.upper(): plotting.Look(COLORS[x]) for x in used}
    looks |= {f"trained in the {place}": look for place, look in LOOKS.items()}
    plotting.legend_of(figure, looks, columns=4)
    return figure


def _draw_once(
    axes: Any,
    name: str,
    algorithms: Sequence[str],
    report: Report,
    tables: Mapping[str, Mapping[str, Sequence[Estimate]]],
) -> None:
    """What agents earn of algorithms that are judged after one number of steps."""
    rows = {
        (algorithm, place): i + 0.4 * j
        for i, algorithm in enumerate(algorithms)
        for j, place in enumerate(PLACES)
        if place in tables[algorithm]
    }
    for (algorithm, place), position in rows.items():
        agents = report["agents"][name][algorithm][place]
        earned = returns_of(agents, sorted(agents))[:, 0]
        plotting.estimate_row(
            axes, position, earned, tables[algorithm][place][0], COLORS[algorithm]
        )
    after = thousands(report["steps"][algorithms[0]][0])
    axes.set(title=f"{name}, after {after} steps", xlabel="return, each agent a dot")
    labels = [f"{x.upper()}, {'bandit' if p == BANDIT else 'itself'}" for x, p in rows]
    axes.set_yticks(list(rows.values()), labels)
    axes.set_ylim(len(algorithms) - 0.3, -0.3)


EXPERIMENT = Experiment(
    "sb3",
    "What do Stable-Baselines3's agents earn after training in a bandit?",
    measure,
    draw=draw,
    claims=claims,
    facts=facts,
    options=Options,
    keys=("agents", "steps"),
)
