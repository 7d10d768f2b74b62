"""What must a linear expert bear for agents to learn from the bandit that is fitted to it?

    python -m experiments linear_fits

A linear policy of an environment is searched for without errors, under noise on its actions, and under errors that are
a function of the observation; a bandit is fitted to each on contexts as they were visited, stretched, and jittered
too; agents train in it and are judged in the environment. No evolution is involved. With more `--seeds` the same
command adds searches.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, partial
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments.claims import ENOUGH, Claim, of_searches
from experiments.harness import Experiment
from experiments.parts import InParts, Part
from experiments.reports import Report, settled
from scb import plotting
from scb.agents.spec import bandit_agent
from scb.environments.registry import environment_spec
from scb.environments.synthetic import BanditConfig, SyntheticBandit, bandit_for
from scb.errors import at_least
from scb.expert_data import expert_dataset
from scb.files import packed_row, unpacked
from scb.fitting import fit_bandit
from scb.keys import root_key, split_key
from scb.measurement import Agents, Place, as_random, measure
from scb.rows import pivot
from scb.seeds import REPORTING
from scb.statistics import pooled_estimate
from scb.warm_start import WarmStartConfig, find_expert

LONGER = {"expert_errors": 0.45, "expert_error_warmup": 100, "expert_generations": 300}
EXPERTS: dict[str, dict[str, Any]] = {
    "no errors": {},
    "noise": {"expert_noise": 0.4},
    "errors": {"expert_errors": 0.45},
    "errors, longer": LONGER,
    "errors, longer, less normalized": {**LONGER, "expert_normalization": 0.25},
}
CONTEXTS: dict[str, dict[str, Any]] = {
    "as visited": {},
    "stretched": {"stretch": 1.5},
    "stretched and jittered": {"stretch": 1.5, "jitter": 1.0},
}
ALGORITHMS = ("ppo", "td3")
SETTLED = ("generations", *ALGORITHMS, "episodes")  # the same for all searches of a report
JITTERED = "stretched and jittered"
BEFORE, NOW = ("noise", "stretched"), ("errors", JITTERED)
COLORS = dict(zip(CONTEXTS, (plotting.GREY, plotting.BLUE, plotting.VERMILLION), strict=True))


@dataclass(frozen=True)
class Options:
    """Where, and how much."""

    environments: tuple[str, ...] = ("hopper",)
    """of Brax"""
    seeds: int = ENOUGH
    """searches of each kind"""
    first_seed: int = 20
    """of the searches"""
    generations: int = 40
    """of a search"""
    ppo: int = 24
    """agents of PPO in every bandit"""
    td3: int = 8
    """agents of TD3"""
    episodes: int = 3
    """of an agent"""

    def __post_init__(self) -> None:
        at_least(1, self, "seeds", "generations", "ppo", "td3", "episodes")


def parts(options: Options, report: dict[str, Any]) -> Iterator[Part]:
    """One search of every kind after the other: all have as many wherever it ends."""
    settled(report, **{name: getattr(options, name) for name in SETTLED})
    for environment in options.environments:
        for seed in range(options.first_seed, options.first_seed + options.seeds):
            for name in EXPERTS:
                path = ("environments", environment, name, str(seed))
                yield Part(path, partial(_searched, environment, name, seed, options))


@cache
def _bandit(environment: str) -> tuple[Place, SyntheticBandit]:
    place = Place.named(environment)
    return place, bandit_for(place.env, place.params, BanditConfig(form="linear"), environment)


def _searched(environment: str, name: str, seed: int, options: Options) -> dict[str, Any]:
    place, bandit = _bandit(environment)
    key_expert, key_data, key_fit = split_key(root_key(seed), 3)
    common = {"expert": "linear", "expert_generations": options.generations, **EXPERTS[name]}
    expert = find_expert(place, key_expert, WarmStartConfig(**common))
    found: dict[str, Any] = {
        "expert": round(expert.mean_return, 1),
        "steps": expert.environment_steps,
        "returns": {},
    }
    for contexts, fields in CONTEXTS.items():
        dataset, _ = expert_dataset(expert, place, key_data, WarmStartConfig(**common, **fields))
        weights, _ = fit_bandit(bandit, dataset, key_fit)
        trained_in = Place(f"{name}, {contexts}", bandit, bandit.params(weights))
        found["returns"][contexts] = {}
        for algorithm in ALGORITHMS:
            spec = bandit_agent(algorithm, environment)
            number = getattr(options, algorithm)
            agents = Agents.drawn_from(spec, REPORTING.start, number)
            size = {"episodes": options.episodes, "side_by_side": number}
            returns = pivot(measure(spec, trained_in, place, agents, **size), "agent")
            found["returns"][contexts][algorithm] = packed_row(as_random(returns, place)[0])
    print(f"{environment}, {name}, seed {seed}: {found}", flush=True)
    return found


def earned(
    entry: Mapping[str, Any], expert: str, contexts: str, algorithm: str, seeds: Iterable[str] = ()
) -> np.ndarray:
    """[searches, agents] returns, of the searches of these seeds, or of all."""
    searches = [entry[expert][seed] for seed in seeds or sorted(entry[expert])]
    return unpacked([found["returns"][contexts][algorithm] for found in searches])


def claims(report: Report) -> list[Claim]:
    """Errors and jitter are worth it, together and each, to PPO's agents."""
    found = []
    for environment, entry in report["environments"].items():
        for (expert, contexts), (other, others), text in (
            (NOW, BEFORE, "with errors and jitter than with noise"),
            (NOW, (BEFORE[0], NOW[1]), "with errors than with noise, both with jitter"),
            (NOW, (NOW[0], BEFORE[1]), "with jitter than without, both with errors"),
            (NOW, ("no errors", NOW[1]), "with errors than without, both with jitter"),
            (
                ("errors, longer, less normalized", JITTERED),
                ("errors, longer", JITTERED),
                "when observations are normalized less, both with errors and jitter after 300 generations",
            ),
        ):
            seeds = sorted(entry.get(expert, {}).keys() & entry.get(other, {}).keys())
            evidence = None
            if seeds:
                ours = earned(entry, expert, contexts, "ppo", seeds)
                theirs = earned(entry, other, others, "ppo", seeds)
                evidence = of_searches(ours, theirs, paired=True)
            found.append(Claim(f"{environment}: PPO's agents earn more {text}", evidence, places=0))
    return found


def _searched_for(entry: Mapping[str, Any]) -> list[str]:
    """The kinds of expert that there are searches of."""
    return [name for name in EXPERTS if entry.get(name)]


def facts(report: Report) -> dict[str, Any]:
    """A row for every kind of expert and contexts."""
    tables: dict[str, Any] = {}
    for environment, entry in report["environments"].items():
        tables[environment] = {
            "standing": environment_spec(environment).standing_still(),
            "rows": [
                {
                    "expert": expert,
                    "contexts": contexts,
                    "own": np.mean([found["expert"] for found in entry[expert].values()]),
                    **{
                        algorithm: pooled_estimate(earned(entry, expert, contexts, algorithm))
                        for algorithm in ALGORITHMS
                    },
                    "searches": len(entry[expert]),
                }
                for expert in _searched_for(entry)
                for contexts in CONTEXTS
            ],
        }
    longer = {"longer": LONGER["expert_generations"], "warmup": LONGER["expert_error_warmup"]}
    return {"tables": tables, **longer}


def draw(report: Mapping[str, Any]) -> Figure:
    """A row an environment, a panel an algorithm: each agent a dot, the estimate with its interval."""
    number = len(report["environments"])
    figure = Figure(figsize=(9, 3.8 * number + 0.4))
    panels: Any = figure.subplots(number, 2, squeeze=False, sharey="row")
    for row, (environment, entry) in zip(panels, report["environments"].items(), strict=True):
        standing = environment_spec(environment).standing_still()
        for axes, algorithm in zip(row, ALGORITHMS, strict=True):
            for i, expert in enumerate(_searched_for(entry)):
                for j, contexts in enumerate(CONTEXTS):
                    returns = earned(entry, expert, contexts, algorithm)
                    x, found = i + 0.27 * (j - 1), pooled_estimate(returns)
                    near = np.linspace(-0.08, 0.08, returns.size)
                    look = {"color": COLORS[contexts]}
                    axes.plot(x + near, returns.ravel(), ".", alpha=0.35, markersize=3, **look)
                    if found.low is not None:
                        axes.plot([x, x], [found.low, found.high], linewidth=3, **look)
                    axes.plot([x], [found.value], "s", markersize=6, **look)
            if standing:
                axes.axhline(standing, color=plotting.GREY, linestyle=":")
            names = _searched_for(entry)
            axes.set_xticks(range(len(names)), [fill(name, 12) for name in names])
            axes.set_xlabel("what the expert was found under")
            axes.set_title(f"{environment}: {algorithm.upper()}'s agents")
        row[0].set_ylabel("return in the environment")
    plotting.legend_of(
        figure, {f"contexts {name}": {"color": color} for name, color in COLORS.items()}, 3
    )
    plotting.figure_title(figure, "Agents of bandits that were fitted to a linear expert")
    return figure


EXPERIMENT = Experiment(
    "linear_fits",
    "What must a linear expert bear for agents to learn from its bandit?",
    InParts(parts),
    draw=draw,
    claims=claims,
    facts=facts,
    options=Options,
    keys=("environments",),
)
