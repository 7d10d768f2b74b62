"""Synthetic MDPs that may take many steps end after one: episode lengths, and what the limit is worth.

    python -m experiments.episode_lengths

Searches of the parameterisation TI (initial state, transition, reward and termination are learned)
with several limits of the episode's length, in run folders under runs/episode_lengths.
"""

import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure

from experiments import searches
from experiments.page import CLASSIC_CONTROL, Experiment, Save, finite, span, table, text
from experiments.page import main as run
from experiments.searches import PAPER_SIZES
from scb import plotting
from scb.agents.spec import algorithms_for, bandit_agent
from scb.curriculum import paper_curriculum
from scb.discovery import DiscoveryConfig, SyntheticTraining
from scb.environments.registry import environment_spec
from scb.evolution import map_population
from scb.keys import root_key, split_key
from scb.seeds import REPORTING
from scb.statistics import Estimate, estimate, normalized_score, paired_difference

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


def measure(plan: Mapping[str, Any], report: dict[str, Any], save: Save) -> None:
    """A limit of an environment at a time."""
    found = report.setdefault("environments", {})
    for environment in CLASSIC_CONTROL:
        entry = found.setdefault(environment, {"returns": {}, "failed": {}})
        for limit in plan["limits"]:
            if limit not in entry["returns"]:
                _measure_limit(environment, limit, plan, entry)
                save()


def _measure_limit(
    environment: str, limit: str, plan: Mapping[str, Any], entry: dict[str, Any]
) -> None:

    folder = f"{plan['runs']}/{environment}-{limit}"
    problem, outcome = searches.search(config_of(environment, limit, plan), folder)
    entry["random"] = round(environment_spec(environment).random_return(), 2)
    entry["limit"] = int(problem.env_params.max_steps_in_episode)
    space = problem.env.action_space(problem.env_params)
    returns: dict[str, list[float]] = {}
    failed = 0
    for algorithm in plan["judged_by"] or algorithms_for(space):
        training = SyntheticTraining(
            problem.bandit,
            problem.env,
            problem.env_params,
            bandit_agent(algorithm, environment),
        )
        judged, lengths = returns_and_lengths(
            training, outcome.mean, root_key(REPORTING.start), plan["agents"], plan["episodes"]
        )
        returns[algorithm], number = finite(judged, entry["random"])
        failed += number
        if limit == OWN:
            entry.setdefault("lengths", {})[algorithm] = binned(lengths)
    entry["returns"][limit], entry["failed"][limit] = returns, failed


def returns_and_lengths(
    training: SyntheticTraining, weights: Any, key: Any, num_agents: int, num_episodes: int
) -> tuple[np.ndarray, np.ndarray]:
    """Of agents trained in the synthetic environment.

    Returns:
      ([N] mean returns in the environment with most likely actions, [N, E] steps of episodes in the synthetic one).
    """

    key_draw, key_agents = split_key(key)

    def one(hyperparameters: Any, key: Any, weights: Any) -> Any:
        key_train, key_judge, key_act = split_key(key, 3)
        state = training.train(weights, hyperparameters, key_train)
        returns = training.evaluate(state, key_judge, num_episodes, mode=True)
        params = training.synthetic.params(weights)
        episodes = training.agent.evaluate(state, key_act, num_episodes, env_params=params)
        return returns.mean(), episodes.lengths

    hyperparameters = training.spec.sample(key_draw, num_agents)
    keys = split_key(key_agents, num_agents)
    returns, lengths = map_population(one, num_agents, (0, 0, None))(hyperparameters, keys, weights)
    return np.asarray(returns), np.asarray(lengths)


def binned(lengths: np.ndarray) -> dict[str, int]:
    """{bin: number of episodes}."""
    lowest, counts = 0.0, {}
    for name, highest in BINS.items():
        counts[name] = int(np.sum((lengths > lowest) & (lengths <= highest)))
        lowest = highest
    return counts


def shares(entry: Mapping[str, Any]) -> dict[str, float]:
    """{bin: share of the episodes} over all algorithms."""
    counts = {x: sum(c[x] for c in entry["lengths"].values()) for x in BINS}
    total = sum(counts.values())
    return {x: n / total for x, n in counts.items()}


def normalized(report: Mapping[str, Any], environment: str, limit: str) -> np.ndarray:
    """[N] scores of the agents of all algorithms: 0 a random policy, 1 the paper's SAC expert."""
    entry = report["environments"][environment]
    returns = np.concatenate([np.asarray(x) for x in entry["returns"][limit].values()])
    return normalized_score(
        returns, entry["random"], environment_spec(environment).reference_return()
    )


def scores(report: Mapping[str, Any], environment: str, limit: str) -> Estimate:
    """Interquartile mean of `normalized`."""
    return estimate(normalized(report, environment, limit))


def _brought(report: Mapping[str, Any]) -> dict[str, Estimate]:
    """{environment: what a limit of one step changes}, with the same seeds and hyperparameters."""
    return {
        name: paired_difference(normalized(report, name, "1"), normalized(report, name, OWN))
        for name in report["environments"]
    }


def _single(report: Mapping[str, Any]) -> dict[str, float]:
    return {name: shares(x)["1"] for name, x in report["environments"].items()}


def _searched(report: Mapping[str, Any]) -> list[str]:
    """Where the search without a limit is not far from its end."""
    return [name for name in report["environments"] if scores(report, name, OWN).value >= GOOD]


def parts(report: Mapping[str, Any]) -> list[bool | None]:
    """Whether most environments' episodes end after a step, and whether that limit costs nothing clearly.

    Neither is told where fewer than half of the searches got anywhere.
    """
    single = _single(report)
    if 2 * len(_searched(report)) < len(single):
        return [None, None]
    most = sum(share > 0.8 for share in single.values())
    costs = any(x.high is not None and x.high < 0 for x in _brought(report).values())
    return [2 * most > len(single), not costs]


def verdict(report: Mapping[str, Any]) -> str:
    """How many episodes end after a step, and what a limit of one step costs or brings."""
    single, found = _single(report), _brought(report)
    most = [name for name, share in single.items() if share > 0.8]
    listed = ", ".join(f"{name} {share:.0%}" for name, share in single.items())
    good = _searched(report)
    differences = [f"{name} {text(x, 2, sign=True)}" for name, x in found.items()]
    better = [name for name, x in found.items() if x.low is not None and x.low > 0]
    worse = [name for name, x in found.items() if x.high is not None and x.high < 0]
    return (
        f"episodes of one step where many are allowed: {listed}; more than 80% in {len(most)} of {len(single)} "
        f"environments. {_searched_enough(good, len(single))} What a limit of one step changes in the normalised "
        f"score (one search each): {', '.join(differences)}; "
        + (
            "it costs nothing clearly"
            if not worse
            else f"it is clearly worse in {' and '.join(worse)}"
        )
        + (f", and is clearly better in {' and '.join(better)}." if better else ".")
    )


def _searched_enough(good: list[str], number: int) -> str:
    half = f"agents of {GOOD:g} or more of the expert's score"
    if len(good) == number:
        return f"Every search without a limit trains {half}."
    if not good:
        return (
            f"No search without a limit trains {half} after so few generations: these shares say "
            "little."
        )
    return (
        f"The search without a limit trains {half} in {' and '.join(good)} only: elsewhere it is far from its end, "
        "and its share says little."
    )


def body(report: Mapping[str, Any]) -> list[str]:
    """How it was searched, and both tables."""
    plan = report["plan"]
    limits, sizes = plan["limits"], plan["sizes"].values()
    algorithms = searches.algorithms_text(plan["algorithms"])
    judged = searches.algorithms_text(plan["judged_by"], "each of the paper's algorithms")
    failed = sum(sum(x["failed"].values()) for x in report["environments"].values())
    return [
        "SNES from random weights with standard deviation 0.05, inner loop: "
        f"{algorithms}, {span(x['generations'] for x in sizes)} generations of "
        f"{span(x['population_size'] for x in sizes)} candidates with "
        f"{span(x['agents_per_candidate'] for x in sizes)} agents, MountainCar with the paper's curriculum; one "
        f"search a limit. Then {plan['agents']} agents of {judged} are trained in the result. Lengths are of "
        f"{plan['episodes']} episodes of each in the synthetic MDP whose limit is the environment's own. Scores are "
        "normalised, 0 a random policy and 1 the paper's SAC expert (the paper divides by what each algorithm earns "
        "after training in a bandit); interquartile mean over agents with its 95 % interval. Agents whose return was "
        f"no number, counted as a random policy: {failed}.",
        "",
        "Share of episodes by length (steps):",
        "",
        *table(
            ["environment", "limit", *BINS],
            [
                [name, str(entry["limit"]), *(f"{share:.0%}" for share in shares(entry).values())]
                for name, entry in report["environments"].items()
            ],
        ),
        "",
        "Normalised score by the limit of an episode's length:",
        "",
        *table(
            ["environment", *limits],
            [
                [name, *(text(scores(report, name, limit), 2) for limit in limits)]
                for name in report["environments"]
            ],
        ),
    ]


def draw(report: Mapping[str, Any]) -> Figure:
    """Left: lengths, a stacked bar an environment. Right: score against the limit."""

    colors = colormaps["viridis"](np.linspace(0.0, 0.95, len(BINS)))
    looks = (
        (plotting.BLUE, "o", "-"),
        (plotting.VERMILLION, "s", "--"),
        (plotting.GREEN, "^", "-."),
        (plotting.PURPLE, "D", ":"),
        (plotting.BLACK, "v", (0, (5, 1))),
    )
    limits = report["plan"]["limits"]
    with plotting.figure_style():
        figure = Figure(figsize=(12.0, 4.2))
        left, right = figure.subplots(1, 2)
        for row, entry in enumerate(report["environments"].values()):
            start = 0.0
            for (name, share), color in zip(shares(entry).items(), colors, strict=True):
                label = name if row == 0 else None
                left.barh(row, share, left=start, color=color, label=label)
                start += share
        left.set_yticks(range(len(report["environments"])), list(report["environments"]))
        left.invert_yaxis()
        left.set_xlabel("share of the episodes in the synthetic MDP")
        left.set_title("Steps of an episode, where many are allowed")
        below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.16), "fontsize": 8}
        left.legend(ncols=len(BINS), **below)
        for i, (name, (color, marker, style)) in enumerate(
            zip(report["environments"], looks, strict=False)
        ):
            found = [scores(report, name, limit) for limit in limits]
            right.errorbar(
                np.arange(len(limits)) + 0.06 * (i - 2),
                [e.value for e in found],
                plotting.error_bar(*found),
                color=color,
                marker=marker,
                linestyle=style,
                capsize=2,
                label=name,
            )
        right.set_xticks(range(len(limits)), limits)
        right.set_xlabel("longest episode (steps; max: the environment's own)")
        right.set_ylabel("normalised score in the environment")
        right.set_title("What the limit is worth")
        right.legend(ncols=3, columnspacing=1.0, **below)
    return figure


EXPERIMENT = Experiment(
    name="episode_lengths",
    title="How long the episodes of synthetic MDPs are",
    paper="figure 2",
    claim="in most environments more than 80% of the episodes of a synthetic MDP that may take many steps end after "
    "one; limiting them to one has next to no negative impact, and is sometimes better.",
    presets={
        "quick": {
            "runs": "runs/episode_lengths/quick",
            "seed": 0,
            "limits": [OWN, "10", "1"],
            "algorithms": ["ppo"],
            "judged_by": ["ppo", "sac"],
            "sizes": {
                name: {
                    "generations": 60 if name == "Pendulum-v1" else 30,
                    "population_size": 16,
                    "agents_per_candidate": 1,
                }
                for name in CLASSIC_CONTROL
            },
            "evaluation_episodes": 8,
            "mean_evaluations": 16,
            "agents": 8,
            "episodes": 50,
        },
        "paper": {
            "runs": "runs/episode_lengths/paper",
            "seed": 0,
            "limits": [OWN, "100", "50", "10", "5", "2", "1"],
            "algorithms": [],
            "judged_by": [],
            "sizes": PAPER_SIZES,
            "evaluation_episodes": 50,
            "mean_evaluations": 64,
            "agents": 20,
            "episodes": 50,
        },
    },
    minutes={"quick": "30", "paper": "days; for a GPU"},
    measure=measure,
    parts=parts,
    verdict=verdict,
    body=body,
    draw=draw,
    needs="keeps its searches under runs/episode_lengths",
)


if __name__ == "__main__":
    sys.exit(run(EXPERIMENT))
