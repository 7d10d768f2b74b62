"""Synthetic MDPs that may take many steps end after one: episode lengths, and what the limit is worth.

    python -m experiments episode_lengths

Searches of the parameterisation TI (initial state, transition, reward and termination are learned)
with several limits of the episode's length, in run folders under runs/episode_lengths.
"""

from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure

from experiments import searches
from experiments.claims import OF_THE_WAY, TENTH, Claim
from experiments.harness import CLASSIC_CONTROL, Experiment
from experiments.parts import InParts, Part
from experiments.reports import Report, finite, lost
from scb import plotting
from scb.agents.spec import AgentSpec, algorithms_for, bandit_agent
from scb.curriculum import paper_curriculum
from scb.discovery import BanditDiscovery, DiscoveryConfig, discover
from scb.environments.registry import environment_spec
from scb.measurement import Agents, Judge, train_and_judge
from scb.population import map_population
from scb.seeds import REPORTING
from scb.statistics import Estimate, estimate, paired_difference

OWN = "max"  # the evaluation environment's own limit
BINS = {"1": 1, "2": 2, "3 to 5": 5, "6 to 10": 10, "11 to 50": 50, "more": np.inf}
GOOD = 0.5  # normalised score from which a search counts as one that has found something


def config_of(environment: str, limit: str, plan: Mapping[str, Any]) -> DiscoveryConfig:
    """The search of an MDP with this limit: the paper's recipe, at the plan's size."""
    size = plan["sizes"][environment]
    return searches.config_of(
        environment,
        plan,
        size,
        plan["seed"],
        parameterization="TI",
        max_steps=None if limit == OWN else int(limit),
        curriculum=paper_curriculum(environment, size["generations"]),
    )


def parts(plan: Mapping[str, Any], report: dict[str, Any]) -> Iterator[Part]:
    """Limits of environments."""
    for environment in CLASSIC_CONTROL:
        for limit in plan["limits"]:
            measured = partial(_of_limit, environment, limit, plan)
            yield Part(("environments", environment), measured, (("returns", limit),))


measure = InParts(parts)


def _of_limit(environment: str, limit: str, plan: Mapping[str, Any]) -> dict[str, Any]:
    folder = f"{plan['runs']}/{environment}-{limit}"
    problem, outcome = discover(config_of(environment, limit, plan), folder)
    entry: dict[str, Any] = {"limit": environment_spec(environment).episode_limit}
    space = problem.place.env.action_space(problem.place.params)
    returns: dict[str, list[float]] = {}
    failed = 0
    for algorithm in plan["judged_by"] or algorithms_for(space):
        judged, lengths = returns_and_lengths(
            bandit_agent(algorithm, environment), problem, outcome.mean, plan
        )
        returns[algorithm], number = finite(judged, problem.place)
        failed += number
        if limit == OWN:
            entry.setdefault("lengths", {})[algorithm] = binned(lengths)
    return {**entry, "returns": {limit: returns}, "failed": {limit: failed}}


def returns_and_lengths(
    spec: AgentSpec, problem: BanditDiscovery, weights: Any, plan: Mapping[str, Any]
) -> tuple[np.ndarray, np.ndarray]:
    """Of agents trained in the synthetic environment with these weights.

    Returns:
      ([N] mean returns in the environment with most likely actions, [N, E] steps of episodes in the synthetic one).
    """
    agents = Agents.drawn_from(spec, REPORTING.start, plan["agents"])

    def one(hyperparameters: Any, key: Any, weights: Any) -> Any:
        params = problem.bandit.params(weights)
        judges = {
            "environment": Judge(
                problem.place.env, problem.place.params, plan["episodes"], mode=True
            ),
            "synthetic": Judge(problem.bandit, params, plan["episodes"]),
        }
        agent = spec.agent(problem.bandit)
        _, earned = train_and_judge(agent, hyperparameters, key, params, judges)
        return earned["environment"].returns.mean(), earned["synthetic"].lengths

    mapped = map_population(one, plan["agents"], (0, 0, None))
    returns, lengths = mapped(agents.hyperparameters, agents.keys, weights)
    return np.asarray(returns), np.asarray(lengths)


def binned(lengths: np.ndarray) -> dict[str, int]:
    """{bin: number of episodes}."""
    bins = np.searchsorted(list(BINS.values()), lengths.ravel())
    counts = np.bincount(bins, minlength=len(BINS))
    return dict(zip(BINS, counts.tolist(), strict=True))


def shares(entry: Mapping[str, Any]) -> dict[str, float]:
    """{bin: share of the episodes} over all algorithms."""
    counts = {x: sum(c[x] for c in entry["lengths"].values()) for x in BINS}
    total = sum(counts.values())
    return {x: n / total for x, n in counts.items()}


def normalized(report: Mapping[str, Any], environment: str, limit: str) -> np.ndarray:
    """[N] scores of the agents of all algorithms: 0 a random policy, 1 the paper's SAC expert."""
    entry = report["environments"][environment]
    returns = np.concatenate([np.asarray(x) for x in entry["returns"][limit].values()])
    return environment_spec(environment).score(returns)


def scores(report: Mapping[str, Any], environment: str, limit: str) -> Estimate:
    """Interquartile mean of `normalized`."""
    return estimate(normalized(report, environment, limit))


def searched(report: Report) -> list[str]:
    """Where the search without a limit is not far from its end."""
    return [name for name in report["environments"] if scores(report, name, OWN).value >= GOOD]


def claims(report: Report) -> list[Claim]:
    """Most environments' episodes end after a step, and that limit costs nothing.

    There is one search of each, so neither has an interval; and nothing to say where fewer than half got anywhere.
    """
    environments = report["environments"]
    single = np.median([shares(x)["1"] for x in environments.values()])
    costs = np.mean([brought(report, name).value for name in environments])
    told = 2 * len(searched(report)) >= len(environments)

    def of_one_search(value: np.floating) -> Estimate | None:
        return Estimate(float(value), None, None, 1) if told else None

    return [
        Claim(
            "share of the median environment's episodes that end after a step",
            of_one_search(single),
            0.8,
        ),
        Claim("a limit of one step costs nothing", of_one_search(costs), 0.0, TENTH, OF_THE_WAY),
    ]


def brought(report: Report, environment: str) -> Estimate:
    """What a limit of one step changes, with the same seeds and hyperparameters; the interval is over agents."""
    limited, own = (normalized(report, environment, limit) for limit in ("1", OWN))
    return paired_difference(limited, own)


def facts(report: Report) -> dict[str, Any]:
    """Shares and scores of every environment."""
    environments, limits = report["environments"], report["plan"]["limits"]
    return {
        "shares": {name: shares(entry) for name, entry in environments.items()},
        "brought": {name: brought(report, name) for name in environments},
        "scores": {
            name: [scores(report, name, limit) for limit in limits] for name in environments
        },
        "searched": searched(report),
        "good": GOOD,
        "lost": lost(environments),
    }


def draw(report: Mapping[str, Any]) -> Figure:
    """Left: lengths, a stacked bar an environment. Right: score against the limit."""
    colors = colormaps["viridis"](np.linspace(0.0, 0.95, len(BINS)))
    looks: tuple[dict[str, Any], ...] = (
        {"color": plotting.BLUE, "marker": "o", "linestyle": "-"},
        {"color": plotting.VERMILLION, "marker": "s", "linestyle": "--"},
        {"color": plotting.GREEN, "marker": "^", "linestyle": "-."},
        {"color": plotting.PURPLE, "marker": "D", "linestyle": ":"},
        {"color": plotting.BLACK, "marker": "v", "linestyle": (0, (5, 1))},
    )
    limits = report["plan"]["limits"]
    figure = Figure(figsize=(12.0, 4.2))
    left, right = figure.subplots(1, 2)
    for row, entry in enumerate(report["environments"].values()):
        start = 0.0
        for (name, share), color in zip(shares(entry).items(), colors, strict=True):
            label = name if row == 0 else None
            left.barh(row, share, left=start, color=color, label=label)
            start += share
    plotting.name_rows(left, report["environments"])
    left.set(
        title="Steps of an episode, where many are allowed",
        xlabel="share of the episodes in the synthetic MDP",
    )
    below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.16), "fontsize": 8}
    left.legend(ncols=len(BINS), **below)
    for i, (name, look) in enumerate(zip(report["environments"], looks, strict=False)):
        found = [scores(report, name, limit) for limit in limits]
        x, y = np.arange(len(limits)) + 0.06 * (i - 2), [e.value for e in found]
        right.errorbar(x, y, plotting.error_bar(*found), **look, capsize=2, label=name)
    right.set_xticks(range(len(limits)), limits)
    right.set(
        title="What the limit is worth",
        xlabel="longest episode (steps; max: the environment's own)",
        ylabel="normalised score in the environment",
    )
    right.legend(ncols=3, columnspacing=1.0, **below)
    return figure


EXPERIMENT = Experiment.of_the_paper("episode_lengths", measure, draw, claims, facts=facts)
