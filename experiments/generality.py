"""Does a bandit train agents that its search never saw: drawn hyperparameters, other networks, no gradients?

    python -m experiments generality

Agents of the paper's algorithms are trained for the inner loop's 10 000 steps in the zoo's bandit, in
bandits of one recipe with drawn and with fixed hyperparameters of the inner agents, and in the
environment itself; so are agents with other networks. A policy is evolved without gradients in each,
and the bandits' optimal policies need no training. The searches are run folders under
runs/generality and are resumed.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import scb
from experiments import searches
from experiments.claims import OF_THE_WAY, TENTH, Claim, of_agents
from experiments.harness import CLASSIC_CONTROL, Experiment
from experiments.parts import InParts, Keys, Part
from experiments.reports import Report, bandit_of, finite, lost, rows_in
from scb import measurement, plotting
from scb.agents.spec import ALGORITHMS, algorithms_for, bandit_agent
from scb.analysis.optimal_actions import optimal_policy
from scb.curriculum import paper_curriculum
from scb.discovery import DiscoveryConfig, discover
from scb.environments.registry import environment_spec
from scb.evaluation import evaluate
from scb.keys import root_key, split_key
from scb.measurement import Agents, Place
from scb.neuroevolution import NeuroevolutionConfig, evolve_policy
from scb.population import map_population
from scb.rows import pivot
from scb.seeds import reporting
from scb.statistics import (
    Estimate,
    estimate,
    iqm,
    paired_difference,
    stratified_estimate,
    worst_decile,
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
NETWORKS: dict[str, dict[str, Any]] = {
    "": {},
    WIDE: {"hidden_sizes": (512,)},
    SWISH: {"activation": "swish"},
}
# Not in the paper's inner loop: what it calls out of distribution.
UNSEEN = (WIDE, SWISH, EVOLVED, OPTIMAL)
TICKS = {
    TOGETHER: "all\nalgorithms",
    WIDE: "1 x 512",
    SWISH: SWISH,
    EVOLVED: "neuro-\nevolution",
    OPTIMAL: "optimal\npolicy",
}
RESAMPLES = 10_000  # enough for the ends of an interval that is corrected for many comparisons


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


def parts(plan: Mapping[str, Any], report: dict[str, Any]) -> Iterator[Part]:
    """What agents of each kind earn, a source at a time."""
    for environment in plan["environments"]:
        for source in SOURCES:
            path = ("environments", environment, source)
            kinds = [x for x in agents_of(environment) if (x, source) != (OPTIMAL, ENVIRONMENT)]
            places: dict[Keys, str] = {("returns", kind): kind for kind in kinds}
            measured = partial(_measured, environment, source, plan)
            yield Part.lacking(report, path, places, measured)


measure = InParts(parts)


def _measured(
    environment: str, source: str, plan: Mapping[str, Any], kinds: Sequence[str]
) -> dict[str, Any]:
    """What is said of a source, and {kind of agent: [N] returns}."""
    judge_in = Place.named(environment)
    train_in, said = _source(judge_in, source, plan)
    found = {kind: finite(_returns(kind, train_in, judge_in, plan), judge_in) for kind in kinds}
    failed = {kind: number for kind, (_, number) in found.items() if number}
    return {**said, "returns": {kind: x for kind, (x, _) in found.items()}, "failed": failed}


def agents_of(environment: str) -> list[str]:
    """Every kind of agent that is trained: the algorithms, each with other networks too, and those without any."""
    env, env_params = scb.make(environment)
    algorithms = algorithms_for(env.action_space(env_params))
    others = [f"{name}, {kind}" for kind in (WIDE, SWISH) for name in algorithms]
    return [*algorithms, *others, EVOLVED, OPTIMAL]


def _source(judge_in: Place, source: str, plan: Mapping[str, Any]) -> tuple[Place, dict[str, Any]]:
    """Where agents are trained, and what tells which: a checksum, or the generation whose mean was judged best."""
    if source == ENVIRONMENT:
        return judge_in, {}
    if source == ZOO:
        bandit, digest = bandit_of(judge_in.name)
        return Place(source, bandit, bandit.default_params), {"sha256": digest}
    kind = "drawn" if source == DRAWN else "fixed"
    problem, outcome = discover(
        config_of(judge_in.name, source, plan), f"{plan['runs']}/{judge_in.name}-{kind}"
    )
    place = Place(source, problem.bandit, problem.bandit.params(outcome.best_mean))
    return place, {"generation": outcome.best_mean_generation}


def _returns(agent: str, train_in: Place, judge_in: Place, plan: Mapping[str, Any]) -> np.ndarray:
    """[N] mean returns of agents of one kind, most likely actions."""
    number, episodes = plan["agents"], plan["episodes"]
    algorithm, _, network = agent.partition(", ")
    seed = seed_of(judge_in.name, algorithm)
    if agent not in (OPTIMAL, EVOLVED):
        spec = bandit_agent(algorithm, judge_in.name).with_values(**NETWORKS[network])
        agents = Agents.drawn_from(spec, seed, number)
        kept = rows_in(plan.get("rows"), judge_in.name, train_in.name, agent)
        rows = measurement.measure(spec, train_in, judge_in, agents, episodes=episodes, rows=kept)
        return pivot(rows, "agent")
    config = NeuroevolutionConfig(**plan["neuroevolution"])
    if train_in is judge_in:
        config = in_environment(config, int(judge_in.params.max_steps_in_episode))
    optimal = optimal_policy(train_in.env, train_in.params) if agent == OPTIMAL else None

    def judged(key: Any) -> Any:
        key_make, key_judge = split_key(key)
        policy = optimal or evolve_policy(train_in.env, train_in.params, key_make, config)
        return evaluate(judge_in.env, judge_in.params, policy, key_judge, episodes).returns.mean()

    keys = split_key(root_key(seed), number)
    return np.asarray(map_population(judged, number, (0,))(keys))


def seed_of(environment: str, agent: str) -> int:
    """The reporting seed of an algorithm, or of an agent that is none, in an environment, whatever it is trained in.

    One for each: agents that shared their draws over algorithms and environments would be few.
    """
    agents = [*ALGORITHMS, EVOLVED, OPTIMAL]
    offset = CLASSIC_CONTROL.index(environment) * len(agents) + agents.index(agent)
    return reporting(offset=offset)[0]


def in_environment(config: NeuroevolutionConfig, limit: int) -> NeuroevolutionConfig:
    """The neuroevolution of a bandit with as many steps of an environment: one episode a candidate."""
    steps = config.population_size * config.num_generations * config.episodes
    generations = max(1, steps // (config.population_size * limit))
    return replace(config, episodes=1, num_generations=generations)


def columns(entry: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """{column of the figure: [N] returns}: algorithms, all together, and agents that no search saw."""
    trained = {name: np.asarray(x) for name, x in entry["returns"].items()}
    algorithms = [name for name in trained if "," not in name and name not in UNSEEN]
    found = {name: trained[name] for name in algorithms}
    found[TOGETHER] = np.concatenate(list(found.values()))
    for network in (WIDE, SWISH):
        found[network] = np.concatenate([trained[f"{name}, {network}"] for name in algorithms])
    return found | {name: trained[name] for name in (EVOLVED, OPTIMAL) if name in trained}


def estimates(entry: Mapping[str, Any]) -> dict[str, Estimate]:
    """{column of the figure: what its agents earn}."""
    return {name: estimate(x) for name, x in columns(entry).items()}


def normalized(report: Mapping[str, Any], source: str, column: str) -> list[np.ndarray]:
    """Per environment the scores [N] of one kind of agent: 0 a random policy, 1 the paper's expert."""
    return [
        environment_spec(name).score(columns(entry[source])[column])
        for name, entry in report["environments"].items()
    ]


def claims(report: Report) -> list[Claim]:
    """Robustness, by all agents and by the worst; what drawing hyperparameters brings; agents that no search saw."""
    scores = {source: normalized(report, source, TOGETHER) for source in SOURCES}
    robust = partial(stratified_estimate, scores[ZOO], scores[ENVIRONMENT], num_resamples=RESAMPLES)
    together = fewest(*scores[ZOO], *scores[ENVIRONMENT])
    # One search each: how far two others would be apart, agents can't tell.
    brought = stratified_estimate(scores[DRAWN], scores[FIXED]).value
    found = [
        Claim(
            "drawn hyperparameters: the mean score is better in the zoo's bandits",
            of_agents(partial(robust, statistic=np.mean), together),
        ),
        Claim(
            "and so is the worst decile",
            of_agents(partial(robust, statistic=worst_decile), together),
        ),
        Claim("more so where the search drew them", Estimate(brought, None, None, 1)),
    ]
    for name in UNSEEN:
        # Networks differ from the paper's agent by agent; other agents have nothing in common with them.
        ours = normalized(report, ZOO, name)
        evidence = partial(
            stratified_estimate,
            ours,
            scores[ZOO],
            paired=name in (WIDE, SWISH),
            num_resamples=RESAMPLES,
        )
        text = f"{name}: no worse than the paper's algorithms"
        few = fewest(*ours, *scores[ZOO])
        found.append(Claim(text, of_agents(evidence, few), 0.0, TENTH, OF_THE_WAY))
    return found


def fewest(*groups: np.ndarray) -> int:
    """How many agents there are where there are fewest."""
    return min(map(len, groups))


def facts(report: Report) -> dict[str, Any]:
    """Scores of every source by three statistics, and what the two searches differ by."""
    scores = {source: normalized(report, source, TOGETHER) for source in SOURCES}
    return {
        "scores": {
            source: [stratified_estimate(x, statistic=s) for s in (iqm, np.mean, worst_decile)]
            for source, x in scores.items()
        },
        "unseen": {name: stratified_estimate(normalized(report, ZOO, name)) for name in UNSEEN},
        "brought": {
            name: paired_difference(
                columns(entry[DRAWN])[TOGETHER], columns(entry[FIXED])[TOGETHER]
            )
            for name, entry in report["environments"].items()
        },
        "chosen": {
            name: [entry[x]["generation"] for x in (DRAWN, FIXED)]
            for name, entry in report["environments"].items()
        },
        "by_task": {
            name: (estimate(x), environment_spec(name).reference_return())
            for name, x in zip(
                report["environments"], normalized(report, ZOO, TOGETHER), strict=True
            )
        },
        "sources": SOURCES,
        "columns": {
            name: {source: estimates(entry[source]) for source in SOURCES}
            for name, entry in report["environments"].items()
        },
        "names": {"together": TOGETHER, "wide": WIDE, "swish": SWISH},
        "lost": lost(report["environments"]),
    }


def draw(report: Mapping[str, Any]) -> Figure:
    """A panel an environment; right of the dashed line what the paper's inner loop does not have."""
    looks: dict[str, dict[str, Any]] = {
        ZOO: {"color": plotting.BLUE, "marker": "o"},
        DRAWN: {"color": plotting.SKY_BLUE, "marker": "s"},
        FIXED: {"color": plotting.GREEN, "marker": "^"},
        ENVIRONMENT: {"color": plotting.VERMILLION, "marker": "D"},
    }
    names = list(report["environments"])
    figure = Figure(figsize=(12.0, 3.1 * -(-len(names) // 2)))
    for axes, name in zip(plotting.panels(figure, len(names)), names, strict=True):
        entry = report["environments"][name]
        shown = list(columns(entry[ZOO]))
        for i, (source, look) in enumerate(looks.items()):
            found = estimates(entry[source])
            axes.errorbar(
                [shown.index(column) + 0.17 * (i - 1.5) for column in found],
                [x.value for x in found.values()],
                plotting.error_bar(*found.values()),
                **look,
                linestyle="",
                capsize=2,
                markersize=4,
            )
        axes.axvline(shown.index(TOGETHER) + 0.5, color=plotting.BLACK, linestyle="--", linewidth=1)
        axes.set_xticks(range(len(shown)), [TICKS.get(x, x.upper()) for x in shown], fontsize=8)
        axes.set(title=name, ylabel="return")
    dots = {source: {**look, "linestyle": ""} for source, look in looks.items()}
    plotting.legend_of(figure, dots, columns=4)
    plotting.figure_title(
        figure,
        "Judged in the environment after training in ...; right of the line: not in the paper's inner loop",
    )
    return figure


EXPERIMENT = Experiment.of_the_paper("generality", measure, draw, claims, facts=facts)
