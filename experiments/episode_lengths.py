"""Synthetic MDPs that may take many steps end after one: episode lengths, and what the limit is worth.

    python -m experiments.episode_lengths

Searches of the parameterisation TI (initial state, transition, reward and termination are learned)
with several limits of the episode's length, in run folders under runs/episode_lengths.
"""

import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.page import CLASSIC_CONTROL, Experiment, Save, table, text
from experiments.page import main as run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from scb.discovery import DiscoveryConfig
    from scb.statistics import Estimate

OWN = "max"  # the evaluation environment's own limit
BINS = {"1": 1, "2": 2, "3 to 5": 5, "6 to 10": 10, "11 to 50": 50, "more": np.inf}
JUDGE_SEED = 10_000


def config_of(environment: str, limit: str, plan: Mapping[str, Any]) -> "DiscoveryConfig":
    """The search of an MDP with this limit: the paper's recipe, at the plan's size."""
    from scb.discovery import DiscoveryConfig
    from scb.evolution import EvolutionConfig

    return DiscoveryConfig(
        environment,
        parameterization="TI",
        max_steps=None if limit == OWN else int(limit),
        algorithms=tuple(plan["algorithms"]),
        agents_per_candidate=plan["agents_per_candidate"],
        evaluation_episodes=plan["evaluation_episodes"],
        init="random",
        evolution=EvolutionConfig(
            strategy="SNES",
            population_size=plan["population_size"],
            num_generations=plan["generations"][environment],
            sigma=0.05,
            mean_evaluations=plan["mean_evaluations"],
            seed=plan["seed"],
        ),
    )


def measure(plan: Mapping[str, Any], report: dict[str, Any], save: Save) -> None:
    """A limit of an environment at a time."""
    report["plan"] = dict(plan)
    found = report.setdefault("environments", {})
    for environment in CLASSIC_CONTROL:
        entry = found.setdefault(environment, {"returns": {}})
        for limit in plan["limits"]:
            if limit not in entry["returns"]:
                _measure_limit(environment, limit, plan, entry)
                save()


def _measure_limit(
    environment: str, limit: str, plan: Mapping[str, Any], entry: dict[str, Any]
) -> None:
    import jax

    from experiments.searches import search
    from lpo.suite import random_return
    from scb.agents.hyperparameters import algorithms_for, inner_loop
    from scb.discovery import SyntheticTraining, judge

    folder = f"{plan['runs']}/{environment}-{limit}"
    problem, outcome = search(config_of(environment, limit, plan), folder)
    entry["random"] = round(random_return(problem.env, problem.env_params), 2)
    entry["limit"] = int(problem.env_params.max_steps_in_episode)
    space = problem.env.action_space(problem.env_params)
    returns: dict[str, list[float]] = {}
    for algorithm in plan["judged_by"] or algorithms_for(space):
        training = SyntheticTraining(
            problem.bandit,
            problem.env,
            problem.env_params,
            inner_loop(algorithm, environment, space),
        )
        (judged,) = judge(
            training, outcome.mean, JUDGE_SEED, plan["agents"], plan["episodes"], mode=True
        ).values()
        returns[algorithm] = np.round(judged, 2).tolist()
        if limit == OWN:
            lengths = synthetic_lengths(
                training, outcome.mean, jax.random.key(JUDGE_SEED), plan["agents"], plan["episodes"]
            )
            entry.setdefault("lengths", {})[algorithm] = binned(lengths)
    entry["returns"][limit] = returns


def synthetic_lengths(
    training: Any, weights: Any, key: Any, num_agents: int, num_episodes: int
) -> np.ndarray:
    """[N, E] steps of episodes in the synthetic environment itself, of agents trained there."""
    import jax

    params = training.synthetic.params(weights)
    key_draw, key_agents = jax.random.split(key)

    @jax.jit
    @jax.vmap
    def lengths(hyperparameters: Any, key: Any) -> Any:
        key_train, key_act = jax.random.split(key)
        state = training.agent.train(key_train, hyperparameters, params)
        return training.agent.evaluate(state, key_act, num_episodes, env_params=params).lengths

    keys = jax.random.split(key_agents, num_agents)
    return np.asarray(lengths(training.inner.sample(key_draw, num_agents), keys))


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


def scores(report: Mapping[str, Any], environment: str, limit: str) -> "Estimate":
    """Normalised score over the agents of all algorithms: 0 a random policy, 1 the paper's SAC expert."""
    from lpo.suite import REFERENCES
    from scb.statistics import estimate, normalized_score

    entry = report["environments"][environment]
    returns = np.concatenate([np.asarray(x) for x in entry["returns"][limit].values()])
    return estimate(normalized_score(returns, entry["random"], REFERENCES[environment]))


def verdict(report: Mapping[str, Any]) -> str:
    """How many episodes end after a step, and what a limit of one step costs or brings."""
    single = {name: shares(x)["1"] for name, x in report["environments"].items()}
    most = [name for name, share in single.items() if share > 0.8]
    listed = ", ".join(f"{name} {share:.0%}" for name, share in single.items())
    parts = [
        f"Episodes of one step where many are allowed: {listed}; more than 80% in {len(most)} of {len(single)} "
        "environments."
    ]
    better, worse = [], []
    for name in report["environments"]:
        one, own = scores(report, name, "1"), scores(report, name, OWN)
        assert one.low is not None and one.high is not None
        assert own.low is not None and own.high is not None
        if one.low > own.high:
            better.append(name)
        elif one.high < own.low:
            worse.append(name)
    parts.append(
        f"With a limit of one step the agents do better in {len(better)}"
        + (f" ({', '.join(better)})" if better else "")
        + f", worse in {len(worse)}"
        + (f" ({', '.join(worse)})" if worse else "")
        + ", and not clearly either in the others: "
        + (
            "one step costs nothing."
            if not worse
            else "one step is not always as good in searches of this size."
        )
    )
    return " ".join(parts)


def body(report: Mapping[str, Any]) -> list[str]:
    """How it was searched, and both tables."""
    plan = report["plan"]
    limits = plan["limits"]
    algorithms = ", ".join(x.upper() for x in plan["algorithms"]) or "all of the paper's algorithms"
    judged = ", ".join(x.upper() for x in plan["judged_by"]) or "each of the paper's algorithms"
    return [
        f"SNES from random weights, {plan['population_size']} candidates with {plan['agents_per_candidate']} agents "
        f"({algorithms}), {min(plan['generations'].values())} to {max(plan['generations'].values())} generations, one "
        f"search a limit. Then {plan['agents']} agents of {judged} are trained in the result. Lengths are of "
        f"{plan['episodes']} episodes of each in the synthetic MDP whose limit is the environment's own. Scores are "
        "normalised, 0 a random policy and 1 the paper's SAC expert; interquartile mean over agents with its 95 % "
        "interval.",
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


def draw(report: Mapping[str, Any]) -> "Figure":
    """Left: lengths, a stacked bar an environment. Right: score against the limit."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    from scb import plotting

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
        left.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=len(BINS), fontsize=8)
        for i, (name, (color, marker, style)) in enumerate(
            zip(report["environments"], looks, strict=False)
        ):
            found = [scores(report, name, limit) for limit in limits]
            values = [e.value for e in found]
            low = [e.value if e.low is None else e.low for e in found]
            high = [e.value if e.high is None else e.high for e in found]
            errors = np.abs(np.array([low, high]) - values)
            right.errorbar(
                np.arange(len(limits)) + 0.06 * (i - 2),
                values,
                errors,
                color=color,
                marker=marker,
                linestyle=style,
                capsize=2,
                label=name,
            )
        right.set_xticks(range(len(limits)), limits)
        right.set_xlabel("limit of an episode's length (steps; max: the environment's own)")
        right.set_ylabel("normalised score in the environment")
        right.set_title("What the limit is worth")
        right.legend(fontsize=8)
    return figure


EXPERIMENT = Experiment(
    name="episode_lengths",
    title="Synthetic MDPs end after one step",
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
            "population_size": 16,
            "agents_per_candidate": 1,
            "evaluation_episodes": 8,
            "mean_evaluations": 16,
            "generations": dict.fromkeys(CLASSIC_CONTROL, 30) | {"Pendulum-v1": 60},
            "agents": 8,
            "episodes": 50,
        },
        "paper": {
            "runs": "runs/episode_lengths/paper",
            "seed": 0,
            "limits": [OWN, "100", "50", "10", "5", "2", "1"],
            "algorithms": [],
            "judged_by": [],
            "population_size": 128,
            "agents_per_candidate": 1,
            "evaluation_episodes": 50,
            "mean_evaluations": 64,
            "generations": dict.fromkeys(CLASSIC_CONTROL, 300)
            | {"Pendulum-v1": 1000, "MountainCar-v0": 1000},
            "agents": 20,
            "episodes": 50,
        },
    },
    minutes={"quick": "25", "paper": "days; for a GPU"},
    measure=measure,
    verdict=verdict,
    body=body,
    draw=draw,
    needs="run folders under runs/episode_lengths",
)


if __name__ == "__main__":
    sys.exit(run(EXPERIMENT))
