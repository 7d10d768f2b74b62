"""Which bandit fitted to an expert trains best, per environment and algorithm.

    python -m experiments warm_start --environment MountainCar-v0

For one expert and one set of states, the bandit is fitted to each construction of the paper's lemma
(the Q-function, the normalised advantage, −‖a − a*‖, and that last one on states stretched to
unit spread), agents of every algorithm train in it with sampled hyperparameters, and their return in
the environment itself says which construction trains best. No evolution is involved. Environments
that --out holds already are kept, so that they can be measured one at a time.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.harness import Experiment, Save
from experiments.rendering import number, text
from experiments.reports import settled
from scb.agents.spec import algorithms_for, bandit_agent, tables_of
from scb.environments.synthetic import BanditConfig, bandit_for
from scb.errors import at_least
from scb.expert_data import expert_dataset
from scb.fitting import fit_bandit
from scb.judgement import counted, judge, told
from scb.keys import root_key, split_key
from scb.measurement import Place
from scb.statistics import estimate
from scb.stopwatch import Stopwatch
from scb.warm_start import WarmStartConfig, find_expert

# Not the seeds that results are reported on.
SEED = 7_000
ARMS: dict[str, dict[str, Any]] = {
    "Q": {"construction": "q"},
    "normalised advantage": {"construction": "advantage"},
    "−‖a − a*‖": {"construction": "action_distance"},
    "−‖a − a*‖, stretched states": {"construction": "action_distance", "min_spread": 1.0},
}


def markdown(report: Mapping[str, Any]) -> str:
    """A table, one row an environment and algorithm, one column a construction; the best in bold, where it is apart.

    That is, where its interval is above those of all other rewards; that of stretched states is none.
    """
    lines = [
        "| environment (expert) | algorithm | " + " | ".join(ARMS) + " |",
        "| --- | --- |" + " --- |" * len(ARMS),
    ]
    for name, result in report["environments"].items():
        arms = result["returns"]
        for algorithm in next(iter(arms.values())):
            if algorithm in ("fit", "fit_seconds"):
                continue
            iqms = {arm: arms[arm][algorithm]["mode_actions"]["iqm"] for arm in ARMS}
            best = max(iqms, key=lambda arm: iqms[arm]["value"])
            others = [
                x
                for arm, x in iqms.items()
                if ARMS[arm]["construction"] != ARMS[best]["construction"]
            ]
            if iqms[best]["low"] <= max(x["high"] for x in others):
                best = ""
            cells = [f"**{text(x)}**" if arm == best else text(x) for arm, x in iqms.items()]
            environment = f"{name} ({number(result['expert_return'])})"
            lines.append(f"| {environment} | {algorithm.upper()} | {' | '.join(cells)} |")
    return "\n".join(lines)


@dataclass(frozen=True)
class Options:
    """What is fitted, and how it is judged."""

    environment: tuple[str, ...] = ("MountainCar-v0",)
    algorithms: tuple[str, ...] = ()
    """the paper's for the action space if left out"""
    agents: int = 16
    episodes: int = 20

    def __post_init__(self) -> None:
        at_least(2, self, "agents")  # a single one has no interval
        for name in self.algorithms:
            tables_of(name)  # which says so of a name that is none
        at_least(1, self, "episodes")


def measure(options: Options, report: dict[str, Any], save: Save) -> None:
    """An environment at a time."""
    settled(report, seed=SEED, agents=options.agents, episodes=options.episodes)
    report.setdefault("environments", {})
    for name in options.environment:
        if name in report["environments"]:
            continue
        judge_in = Place.named(name)
        env, env_params = judge_in.env, judge_in.params
        space = env.action_space(env_params)
        key_expert, key_data, key_fit = split_key(root_key(SEED), 3)
        watch = Stopwatch()
        expert = find_expert(judge_in, key_expert, WarmStartConfig())
        seconds = watch.lap()
        print(
            f"{name}: the expert's return is {expert.mean_return:.1f} ({seconds:.0f} s)", flush=True
        )
        result: dict[str, Any] = {
            "expert_return": expert.mean_return,
            "expert_seconds": round(seconds, 1),
            "expert_environment_steps": expert.environment_steps,
            "returns": {},
        }
        bandit = bandit_for(env, env_params, BanditConfig(), name)
        for arm, fields in ARMS.items():
            config = WarmStartConfig(**fields)
            watch.lap()
            dataset, _ = expert_dataset(expert, judge_in, key_data, config)
            weights, fit = fit_bandit(
                bandit, dataset, key_fit, config.construction, config.fit_steps
            )
            row: dict[str, Any] = {"fit": fit, "fit_seconds": round(watch.lap(), 1)}
            for algorithm in options.algorithms or algorithms_for(space):
                spec = bandit_agent(algorithm, name)
                size = options.agents, options.episodes
                found = judge(spec, bandit, weights, judge_in, SEED, *size)
                returns, failed = counted(found, judge_in)
                row[algorithm] = {
                    actions: {
                        "iqm": estimate(x).as_dict(),
                        "agents": [round(float(r), 1) for r in np.sort(x)],
                    }
                    for actions, x in returns.items()
                }
                both = ", ".join(f"{actions} {estimate(x)}" for actions, x in returns.items())
                print(f"{name} | {arm} | {algorithm} | {both}{told(failed)}", flush=True)
            result["returns"][arm] = row
        report["environments"][name] = result
        save()
    print(markdown(report))


EXPERIMENT = Experiment(
    "warm_start",
    "Which bandit fitted to an expert trains best",
    measure,
    options=Options,
    out=Path("runs/warm_start.json"),
)
