"""Does a bandit train agents that its search never saw: drawn hyperparameters, other networks, no gradients?

    python -m experiments.generality

Agents of the paper's algorithms are trained for the inner loop's 10 000 steps in the zoo's bandit, in
bandits of one recipe with drawn and with fixed hyperparameters of the inner agents, and in the
environment itself; so are agents with other networks. A policy is evolved without gradients in each,
and the bandits' optimal policies need no training. The searches are run folders under
runs/generality and are resumed.
"""

import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import scb
from experiments import searches
from experiments.page import CLASSIC_CONTROL, Experiment, Save, finite, span, table, text
from experiments.page import main as run
from experiments.searches import PAPER_SIZES
from scb import plotting
from scb.agents.spec import AgentSpec, algorithms_for, bandit_agent
from scb.analysis.optimal_actions import optimal_policy
from scb.curriculum import paper_curriculum
from scb.discovery import DiscoveryConfig
from scb.environments.registry import environment_spec
from scb.environments.zoo import bandit_metadata, open_bandit
from scb.evaluation import evaluate
from scb.evolution import map_population
from scb.keys import root_key, split_key
from scb.neuroevolution import NeuroevolutionConfig, evolve_policy
from scb.seeds import REPORTING
from scb.statistics import (
    Estimate,
    estimate,
    normalized_score,
    paired_difference,
    stratified_estimate,
)

ZOO, DRAWN, FIXED, ENVIRONMENT = SOURCES = (
    "bandit of the zoo",
    "search, drawn hyperparameters",
    "search, fixed hyperparameters",
    "the environment itself",
)
TOGETHER = "all algorithms"
WIDE, SWISH = "1 x 512 network", "swish"
EVOLVED, OPTIMAL = "neuroevolution", "CB-optimal policy"
# Not in the paper's inner loop: what it calls out of distribution.
UNSEEN = (WIDE, SWISH, EVOLVED, OPTIMAL)
TICKS = {
    TOGETHER: "all\nalgorithms",
    WIDE: "1 x 512",
    SWISH: SWISH,
    EVOLVED: "neuro-\nevolution",
    OPTIMAL: "optimal\npolicy",
}


def config_of(environment: str, source: str, plan: Mapping[str, Any]) -> DiscoveryConfig:
    """The search whose inner agents' hyperparameters are drawn, or fixed; nothing else differs."""
    size, curriculum = plan["sizes"][environment], None
    # A bandit that is fitted to an expert reaches MountainCar's goal from the start.
    if plan["init"] == "random":
        curriculum = paper_curriculum(environment, size["generations"])
    return searches.config_of(
        environment,
        plan,
        size,
        plan["seed"],
        fixed_hyperparameters=source != DRAWN,
        curriculum=curriculum,
        init=plan["init"],
    )


def measure(plan: Mapping[str, Any], report: dict[str, Any], save: Save) -> None:
    """One kind of agent from one source at a time."""
    found, random = report.setdefault("environments", {}), report.setdefault("random", {})
    failed, digests = report.setdefault("failed", {}), report.setdefault("sha256", {})
    generations = report.setdefault("generation", {})
    for environment in plan["environments"]:
        if environment not in random:
            random[environment] = round(environment_spec(environment).random_return(), 2)
            digests[environment] = bandit_metadata(environment_spec(environment).bandit)["sha256"]
        entry = found.setdefault(environment, {source: {} for source in SOURCES})
        chosen = generations.setdefault(environment, {})
        for source in SOURCES:
            lacking = [
                agent
                for agent in agents_of(environment)
                if agent not in entry[source] and (agent, source) != (OPTIMAL, ENVIRONMENT)
            ]
            if not lacking and source in chosen:
                continue
            trainer = _Trainer(environment, source, plan)
            chosen[source] = trainer.generation
            save()
            for agent in lacking:
                returns = trainer.returns(agent)
                entry[source][agent], number = finite(returns, random[environment])
                if number:
                    failed[f"{environment}, {source}, {agent}"] = number
                save()


def algorithms_of(environment: str) -> tuple[str, ...]:
    """The paper's inner-loop algorithms."""
    env, env_params = scb.make(environment)
    return algorithms_for(env.action_space(env_params))


def agents_of(environment: str) -> list[str]:
    """Every kind of agent that is trained: the algorithms, each with other networks too, and those without any."""
    algorithms = algorithms_of(environment)
    others = [f"{name}, {kind}" for kind in (WIDE, SWISH) for name in algorithms]
    return [*algorithms, *others, EVOLVED, OPTIMAL]


class _Trainer:
    """What trains agents in one source and judges them in the environment."""

    def __init__(self, environment: str, source: str, plan: Mapping[str, Any]) -> None:

        self.environment, self.plan = environment, plan
        self.env, self.env_params = scb.make(environment)
        self.space = self.env.action_space(self.env_params)
        self.generation: int | None = None  # of a search, at which its mean was judged best
        self.trained_in: Any = self.env
        self.trained_in_params: Any = self.env_params
        if source == ZOO:
            self.trained_in = open_bandit(environment_spec(environment).bandit)
            self.trained_in_params = self.trained_in.default_params
        elif source != ENVIRONMENT:
            kind = "drawn" if source == DRAWN else "fixed"
            problem, outcome = searches.search(
                config_of(environment, source, plan), f"{plan['runs']}/{environment}-{kind}"
            )
            self.generation = outcome.best_mean_generation
            self.trained_in = problem.bandit
            self.trained_in_params = problem.bandit.params(outcome.best_mean)

    def returns(self, agent: str) -> np.ndarray:
        """[N] mean returns of agents of one kind, most likely actions."""

        key = root_key(REPORTING.start)
        if agent == OPTIMAL:
            return self._optimal(key)
        if agent == EVOLVED:
            return self._evolved(key)
        algorithm, _, network = agent.partition(", ")
        return self._trained(with_network(bandit_agent(algorithm, self.environment), network), key)

    def _trained(self, spec: AgentSpec, key: Any) -> np.ndarray:

        agent, episodes = spec.agent(self.trained_in), self.plan["episodes"]
        key_draw, key_agents = split_key(key)
        number = self.plan["agents"]

        def judged(hyperparameters: Any, key: Any, params: Any) -> Any:
            key_train, key_judge = split_key(key)
            state = agent.train(key_train, hyperparameters, params)
            return agent.evaluate(
                state, key_judge, episodes, self.env, self.env_params, mode=True
            ).returns.mean()

        hyperparameters = spec.sample(key_draw, number)
        keys = split_key(key_agents, number)
        judge = map_population(judged, number, (0, 0, None))
        return np.asarray(judge(hyperparameters, keys, self.trained_in_params))

    def _evolved(self, key: Any) -> np.ndarray:

        config = NeuroevolutionConfig(**self.plan["neuroevolution"])
        if self.trained_in is self.env:
            config = in_environment(config, int(self.env_params.max_steps_in_episode))
        return self._judged_policies(
            lambda key: evolve_policy(self.trained_in, self.trained_in_params, key, config), key
        )

    def _optimal(self, key: Any) -> np.ndarray:

        policy = optimal_policy(self.trained_in, self.trained_in_params)
        return self._judged_policies(lambda key: policy, key)

    def _judged_policies(self, make: Callable[[Any], Any], key: Any) -> np.ndarray:

        def judged(key: Any) -> Any:
            key_make, key_judge = split_key(key)
            policy, episodes = make(key_make), self.plan["episodes"]
            return evaluate(self.env, self.env_params, policy, key_judge, episodes).returns.mean()

        number = self.plan["agents"]
        return np.asarray(map_population(judged, number, (0,))(split_key(key, number)))


def in_environment(config: NeuroevolutionConfig, limit: int) -> NeuroevolutionConfig:
    """The neuroevolution of a bandit with as many steps of an environment: one episode a candidate."""
    steps = config.population_size * config.num_generations * config.episodes
    generations = max(1, steps // (config.population_size * limit))
    return replace(config, episodes=1, num_generations=generations)


def with_network(spec: AgentSpec, network: str) -> AgentSpec:
    """The same algorithm with one of the networks that no search saw, or with its own."""

    changes: dict[str, dict[str, Any]] = {
        "": {},
        WIDE: {"hidden_sizes": (512,)},
        SWISH: {"activation": "swish"},
    }
    return spec.with_values(**changes[network])


def columns(entry: Mapping[str, list[float]]) -> dict[str, np.ndarray]:
    """{column of the figure: [N] returns}: algorithms, all of them together, and agents that no search saw."""
    trained = {name: np.asarray(x) for name, x in entry.items()}
    algorithms = [name for name in trained if "," not in name and name not in UNSEEN]
    found = {name: trained[name] for name in algorithms}
    found[TOGETHER] = np.concatenate(list(found.values()))
    for network in (WIDE, SWISH):
        found[network] = np.concatenate([trained[f"{name}, {network}"] for name in algorithms])
    return found | {name: trained[name] for name in (EVOLVED, OPTIMAL) if name in trained}


def normalized(report: Mapping[str, Any], source: str, column: str) -> list[np.ndarray]:
    """Per environment the scores of one kind of agent: 0 a random policy, 1 the paper's expert."""
    return [
        normalized_score(
            columns(entry[source])[column],
            report["random"][name],
            environment_spec(name).reference_return(),
        )
        for name, entry in report["environments"].items()
    ]


def _unseen_worse(report: Mapping[str, Any]) -> list[str]:
    """Which agents that no search saw are clearly worse in the zoo's bandits than the paper's algorithms.

    Networks differ from the paper's agent by agent; other agents are compared by intervals that lie apart.
    """
    together = normalized(report, ZOO, TOGETHER)
    own = stratified_estimate(together)

    def worse(name: str) -> bool:
        scores = normalized(report, ZOO, name)
        if name in (WIDE, SWISH):
            difference = stratified_estimate(scores, together)
            return difference.high is not None and difference.high < 0
        high = stratified_estimate(scores).high
        return high is not None and own.low is not None and high < own.low

    return [name for name in UNSEEN if worse(name)]


def _differences(report: Mapping[str, Any]) -> tuple[Estimate, Estimate]:
    """What the zoo's bandits bring over the environments, and drawn hyperparameters over fixed ones in a search."""
    zoo, itself, drawn, fixed = (
        normalized(report, source, TOGETHER) for source in (ZOO, ENVIRONMENT, DRAWN, FIXED)
    )
    return stratified_estimate(zoo, itself), stratified_estimate(drawn, fixed)


def parts(report: Mapping[str, Any]) -> list[bool | None]:
    """Robustness, what drawing hyperparameters brings (None where it is not clear), agents that no search saw."""
    robust, drawn = map(_sign, _differences(report))
    worse = _unseen_worse(report)
    return [robust > 0, None if drawn == 0 else drawn > 0, *(x not in worse for x in UNSEEN)]


def verdict(report: Mapping[str, Any]) -> str:
    """Robustness to drawn hyperparameters, what drawing them in the search brings, and agents that no search saw."""
    scores = {
        source: stratified_estimate(normalized(report, source, TOGETHER)) for source in SOURCES
    }
    robust, drawn = _differences(report)
    listed = ", ".join(f"{source} {text(x, 2)}" for source, x in scores.items())
    unseen = {name: stratified_estimate(normalized(report, ZOO, name)) for name in UNSEEN}
    worse = _unseen_worse(report)
    return (
        "normalised scores (0 a random policy, 1 the paper's expert; the mean over environments of the interquartile "
        f"mean over agents) of the paper's algorithms with drawn hyperparameters: {listed}. The zoo's bandits "
        + ("are" if _sign(robust) > 0 else "are not")
        + f" more robust to hyperparameters than the environments (difference {text(robust, 2, sign=True)}). Drawing "
        f"them in the search (one search each) changes {text(drawn, 2, sign=True)}: "
        + {1: "it helps", 0: "no clear difference", -1: "it harms here"}[_sign(drawn)]
        + f" ({_by_environment(report)}). Agents that are not in the paper's inner loop, in the zoo's bandits: "
        + ", ".join(f"{name} {text(x, 2)}" for name, x in unseen.items())
        + "; "
        + (
            f"clearly worse than those that are: {' and '.join(worse)}."
            if worse
            else "none is clearly worse than those that are."
        )
    )


def _by_environment(report: Mapping[str, Any]) -> str:
    """Where drawing hyperparameters in the search helps or harms, and where neither search left its start."""
    found: dict[str, list[str]] = {}
    for name, entry in report["environments"].items():
        chosen = report["generation"][name]
        if chosen[DRAWN] == chosen[FIXED] == 0:
            said = "the common start is still the best in"
        else:
            # The same seeds and the same drawn hyperparameters in both.
            drawn, fixed = (columns(entry[source])[TOGETHER] for source in (DRAWN, FIXED))
            said = {1: "clearly better in", 0: "not clearly apart in", -1: "clearly worse in"}[
                _sign(paired_difference(drawn, fixed))
            ]
        found.setdefault(said, []).append(name)
    return "; ".join(f"{said} {' and '.join(names)}" for said, names in found.items())


def _sign(difference: Estimate) -> int:
    """1 or -1 where the interval excludes zero, else 0."""
    assert difference.low is not None and difference.high is not None
    return int(difference.low > 0) - int(difference.high < 0)


def body(report: Mapping[str, Any]) -> list[str]:
    """How it was measured, and a table for each environment."""
    plan = report["plan"]
    own = plan["neuroevolution"]
    steps = own["num_generations"] * own["population_size"] * own["episodes"]
    algorithms = searches.algorithms_text(plan["algorithms"])
    sizes = list(plan["sizes"].values())
    failed = sum(report["failed"].values())
    lines = [
        f"{plan['agents']} agents of each algorithm with hyperparameters drawn from the paper's lists, 10 000 steps, "
        f"{plan['episodes']} episodes of most likely actions; reporting seed 10 000. *{TOGETHER}*, *{WIDE}* and "
        f"*{SWISH}* are over the agents of all algorithms. Neuroevolution is SNES on a policy network with {steps} "
        f"steps: in bandits {own['num_generations']} generations of {own['population_size']} candidates on "
        f"{own['episodes']} contexts, in environments as many steps with one episode a candidate. The two searches "
        f"train {algorithms} for {span(x['generations'] for x in sizes)} generations of "
        f"{span(x['population_size'] for x in sizes)} candidates (SNES, standard deviation {plan['sigma']:g}, returns "
        f"combined by {plan['combine']}), from one "
        f"{'fit to an expert' if plan['init'] == 'expert' else 'random start'}, and differ only in whether the inner "
        "agents' hyperparameters are drawn or the paper's underlined ones. What the zoo's bandits were found with "
        "stands in their commands (`scb list`). Interquartile means with 95 % intervals. Agents whose return was no "
        f"number, counted as a random policy: {failed}.",
    ]
    generations = ", ".join(
        f"{name} {chosen[DRAWN]} and {chosen[FIXED]}"
        for name, chosen in report["generation"].items()
    )
    lines += [
        "",
        "A search gives the mean that was judged best, of these generations (drawn and fixed hyperparameters; 0 is the "
        f"start, which both have in common): {generations}.",
    ]
    for name, entry in report["environments"].items():
        by_source = {source: columns(entry[source]) for source in SOURCES}
        rows = [
            [
                column,
                *(
                    text(estimate(found[column]), 1) if column in found else ""
                    for found in by_source.values()
                ),
            ]
            for column in by_source[ZOO]
        ]
        lines += ["", f"## {name}", "", *table(["agents", *SOURCES], rows)]
    return lines


def draw(report: Mapping[str, Any]) -> Figure:
    """A panel an environment; right of the dashed line what the paper's inner loop does not have."""

    looks = (
        (plotting.BLUE, "o"),
        (plotting.SKY_BLUE, "s"),
        (plotting.GREEN, "^"),
        (plotting.VERMILLION, "D"),
    )
    names = list(report["environments"])
    with plotting.figure_style():
        figure = Figure(figsize=(12.0, 3.1 * -(-len(names) // 2)))
        panels = figure.subplots(-(-len(names) // 2), 2, squeeze=False).ravel()
        for axes in panels[len(names) :]:
            axes.axis("off")
        for axes, name in zip(panels, names, strict=False):
            entry = report["environments"][name]
            shown = list(columns(entry[ZOO]))
            for i, (source, (color, marker)) in enumerate(zip(SOURCES, looks, strict=True)):
                for column, values in columns(entry[source]).items():
                    found = estimate(values)
                    x = shown.index(column) + 0.17 * (i - 1.5)
                    axes.errorbar(
                        x,
                        found.value,
                        plotting.error_bar(found),
                        fmt=marker,
                        color=color,
                        capsize=2,
                        markersize=4,
                    )
            axes.axvline(
                shown.index(TOGETHER) + 0.5, color=plotting.BLACK, linestyle="--", linewidth=1
            )
            axes.set_xticks(
                range(len(shown)),
                [TICKS.get(x, x.upper()) for x in shown],
                fontsize=8,
            )
            axes.set_ylabel("return")
            axes.set_title(name)
        handles: list[Any] = [
            panels[0].plot([], [], marker, color=color)[0] for color, marker in looks
        ]
        plotting.legend_below(figure, (handles, list(SOURCES)), columns=4)
        plotting.figure_title(
            figure,
            "Judged in the environment after training in ...; right of the line: not in the paper's inner loop",
        )
    return figure


_SHARED: dict[str, Any] = {
    "environments": list(CLASSIC_CONTROL),
    "seed": 0,
    "neuroevolution": {"population_size": 64, "num_generations": 200, "episodes": 32, "sigma": 0.1},
}

EXPERIMENT = Experiment(
    name="generality",
    title="What agents a bandit can train",
    paper="figures 3 and 8 to 11",
    claim="bandits are much more robust to an agent's hyperparameters than their environments are, more so where the "
    "search drew them; and they train agents that no search saw: other networks, other activations, neuroevolution; "
    "the CB-optimal policy does well in the environment.",
    presets={
        "quick": {
            **_SHARED,
            "runs": "runs/generality/quick",
            "algorithms": ["ppo"],
            "init": "expert",
            "combine": "ranks",
            "sizes": {
                name: {"generations": 20, "population_size": 16, "agents_per_candidate": 2}
                for name in CLASSIC_CONTROL
            },
            "sigma": 0.02,
            "evaluation_episodes": 8,
            "mean_evaluations": 32,
            "agents": 8,
            "episodes": 50,
        },
        "paper": {
            **_SHARED,
            "runs": "runs/generality/paper",
            "algorithms": [],
            "init": "random",
            "combine": "mean",
            "sizes": PAPER_SIZES,
            "sigma": 0.05,
            "evaluation_episodes": 50,
            "mean_evaluations": 64,
            "agents": 20,
            "episodes": 50,
        },
    },
    minutes={"quick": "60 to 120 min", "paper": "days; for a GPU"},
    measure=measure,
    parts=parts,
    verdict=verdict,
    body=body,
    draw=draw,
    needs="keeps its searches under runs/generality",
)


if __name__ == "__main__":
    sys.exit(run(EXPERIMENT))
