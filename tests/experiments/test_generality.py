import copy
from dataclasses import replace

import numpy as np
import pytest

from experiments import generality
from experiments.generality import (
    DRAWN,
    ENVIRONMENT,
    EVOLVED,
    FIXED,
    OPTIMAL,
    SOURCES,
    SWISH,
    TOGETHER,
    WIDE,
    ZOO,
)
from experiments.harness import CLASSIC_CONTROL
from experiments.reports import forget_replaced
from scb.environments.registry import environment_spec
from scb.environments.zoo import bandit_metadata, load_bandit
from scb.measurement import Place
from scb.neuroevolution import NeuroevolutionConfig
from scb.seeds import REPORTING

TINY = {
    "environments": ["CartPole-v1"],
    "seed": 0,
    "algorithms": ["ppo"],
    "init": "random",
    "combine": "mean",
    "sizes": {"CartPole-v1": {"generations": 1, "population_size": 2, "agents_per_candidate": 1}},
    "sigma": 0.02,
    "evaluation_episodes": 1,
    "mean_evaluations": 2,
    "agents": 2,
    "episodes": 2,
    "neuroevolution": {"population_size": 8, "num_generations": 2, "episodes": 4, "sigma": 0.1},
}
RANDOM = environment_spec("CartPole-v1").random_return()


def report(**returns):
    """CartPole in which agents from each source earn what is said here, else 400."""
    kinds = [f"{name}{kind}" for kind in ("", f", {WIDE}", f", {SWISH}") for name in ("ppo", "sac")]
    entry = {}
    for source in SOURCES:
        earned = {kind: [float(returns.get(source.split()[-1], 400.0))] * 12 for kind in kinds}
        earned[EVOLVED] = [395.0, 405.0, 400.0, 400.0] * 3
        if source != ENVIRONMENT:
            earned[OPTIMAL] = [500.0] * 12
        entry[source] = {"returns": earned, "failed": {}}
    entry[ZOO]["sha256"] = bandit_metadata("Synthetic-CartPole-v1")["sha256"]
    entry[DRAWN]["generation"], entry[FIXED]["generation"] = 15, 0
    return {
        "plan": generality.EXPERIMENT.presets["quick"],
        "environments": {"CartPole-v1": entry},
    }


def test_columns_pool_the_algorithms():
    entry = {
        "ppo": [1.0, 2.0],
        "sac": [3.0, 4.0],
        f"ppo, {WIDE}": [5.0],
        f"sac, {WIDE}": [6.0],
        f"ppo, {SWISH}": [7.0],
        f"sac, {SWISH}": [8.0],
        EVOLVED: [9.0],
    }
    found = generality.columns({"returns": entry})
    assert list(found) == ["ppo", "sac", TOGETHER, WIDE, SWISH, EVOLVED]
    np.testing.assert_array_equal(found[TOGETHER], [1.0, 2.0, 3.0, 4.0])
    np.testing.assert_array_equal(found[WIDE], [5.0, 6.0])


def test_the_two_searches_differ_in_drawn_hyperparameters_alone():
    plan = generality.EXPERIMENT.presets["quick"]
    drawn, fixed = (generality.config_of("Pendulum-v1", x, plan) for x in (DRAWN, FIXED))
    assert fixed.fixed_hyperparameters and not drawn.fixed_hyperparameters
    assert replace(fixed, fixed_hyperparameters=False) == drawn


def test_neuroevolution_takes_as_many_steps_of_an_environment_as_of_a_bandit():
    config = NeuroevolutionConfig(population_size=64, num_generations=200, episodes=32)
    there = generality.in_environment(config, 200)
    assert (there.episodes, there.num_generations) == (1, 32)
    assert there.num_generations * 64 * 200 == 200 * 64 * 32
    assert generality.in_environment(replace(config, num_generations=1), 999).num_generations == 1


def test_every_kind_of_agent_has_draws_of_its_own_in_every_environment():
    kinds = {
        (name, agent.partition(", ")[0])
        for name in CLASSIC_CONTROL
        for agent in generality.agents_of(name)
    }
    seeds = [generality.seed_of(*kind) for kind in kinds]
    assert len(set(seeds)) == len(kinds) and set(seeds) <= set(REPORTING)


def test_agents_have_the_same_draws_wherever_they_are_trained(monkeypatch):
    drawn = []

    def measured(spec, train_in, judge_in, agents, **more):
        drawn.append((judge_in.name, tuple(agents.names), agents.hyperparameters.learning_rate))
        return []

    monkeypatch.setattr(generality.measurement, "measure", measured)
    monkeypatch.setattr(generality, "pivot", lambda rows, column: rows)
    plan = {"agents": 4, "episodes": 1}
    judge_in = Place.named("Pendulum-v1")
    bandit = load_bandit("Synthetic-Pendulum-v1")
    for agent in ("td3", f"td3, {WIDE}"):
        for train_in in (Place(ZOO, bandit, bandit.default_params), judge_in):
            generality._returns(agent, train_in, judge_in, plan)
    (first, *others) = drawn
    for other in others:
        assert other[:2] == first[:2]
        np.testing.assert_array_equal(other[2], first[2])


def test_every_algorithm_meets_every_network():
    agents = generality.agents_of("Pendulum-v1")
    assert len(agents) == 4 * 3 + 2 and f"td3, {SWISH}" in agents


def test_a_replaced_bandit_is_measured_again_and_nothing_else(monkeypatch):
    measured = []
    ours = bandit_metadata("Synthetic-CartPole-v1")["sha256"]
    monkeypatch.setattr(
        generality, "_source", lambda place, source, plan: (source, {"sha256": ours})
    )
    monkeypatch.setattr(
        generality,
        "_returns",
        lambda agent, source, *_: measured.append((agent, source)) or [np.nan],
    )
    agents = ["ppo", EVOLVED, OPTIMAL]
    monkeypatch.setattr(generality, "agents_of", lambda name: agents)
    found = report()
    sources = found["environments"]["CartPole-v1"]
    sources[ZOO] |= {"sha256": "replaced", "failed": {"ppo": 2, f"ppo, {WIDE}": 1}}
    before = copy.deepcopy(sources)
    forget_replaced(found)
    plan = found["plan"] | {"environments": ["CartPole-v1"]}
    generality.measure(plan, found, lambda: None)
    assert measured == [(agent, ZOO) for agent in agents]
    again = {
        "sha256": ours,
        # What random actions earn instead of no number.
        "returns": {x: [round(RANDOM, 2)] for x in agents},
        "failed": {x: 1 for x in agents},
    }
    assert sources == before | {ZOO: again}


@pytest.mark.slow
def test_agents_from_a_bandit_and_from_the_environment(tmp_path, monkeypatch, small_agents):
    monkeypatch.setattr(generality, "SOURCES", (ZOO, ENVIRONMENT))
    kinds = {"ppo", f"ppo, {WIDE}", EVOLVED, OPTIMAL}
    monkeypatch.setattr(
        generality, "agents_of", lambda name: ["ppo", f"ppo, {WIDE}", EVOLVED, OPTIMAL]
    )
    found, saved = {}, []
    plan = {**TINY, "runs": str(tmp_path)}
    generality.measure(plan, found, lambda: saved.append(1))
    entry = found["environments"]["CartPole-v1"]
    assert set(entry[ZOO]["returns"]) == kinds
    assert set(entry[ENVIRONMENT]["returns"]) == kinds - {OPTIMAL}
    # What is optimal in the zoo's bandit solves CartPole without any training.
    assert entry[ZOO]["returns"][OPTIMAL] == [500.0, 500.0]
    assert 10.0 < RANDOM < 40.0
    generality.measure(plan, found, lambda: saved.append(1))
    assert len(saved) == 2  # a source each, once


@pytest.mark.slow
def test_agents_from_a_search(tmp_path, monkeypatch, small_agents):
    monkeypatch.setattr(generality, "SOURCES", (DRAWN,))
    monkeypatch.setattr(generality, "agents_of", lambda name: ["ppo"])
    found = {}
    generality.measure({**TINY, "runs": str(tmp_path)}, found, lambda: None)
    entry = found["environments"]["CartPole-v1"]
    # Judged before its only generation and after it.
    assert entry[DRAWN]["generation"] in (0, 1)
    assert all(8.0 <= x <= 500.0 for x in entry[DRAWN]["returns"]["ppo"])


@pytest.mark.parametrize("preset", ["quick", "paper"])
def test_presets_make_configurations(preset):
    plan = generality.EXPERIMENT.presets[preset]
    assert plan["environments"] == list(CLASSIC_CONTROL)
    generality.config_of("Pendulum-v1", DRAWN, plan)


def outcomes(found):
    return [x.outcome for x in generality.EXPERIMENT.judged(found)]


def test_claims_follow_the_figures():
    # Robust by the mean and by the worst; one search each; 1 x 512, swish, neuroevolution and the optimal policy.
    expected = ["holds", "holds", "undecided", "holds", "holds", "holds", "holds"]
    assert outcomes(report(itself=50.0)) == expected
    assert outcomes(report())[:2] == ["undecided"] * 2
    changed = report()
    entry = changed["environments"]["CartPole-v1"]
    for source, value in ((DRAWN, 450.0), (FIXED, 300.0)):
        for agent in ("ppo", "sac"):
            entry[source]["returns"][agent] = [value] * 12
    entry[ZOO]["returns"][EVOLVED] = [100.0] * 12
    # However far apart two searches are, they are two.
    assert outcomes(changed)[2:] == ["undecided", "holds", "holds", "does not hold", "holds"]
    entry[DRAWN]["generation"] = 0
    said = generality.EXPERIMENT.block("body", changed)
    assert "| CartPole-v1 | +150.0 [150.0, 150.0] | 0 | " in said


def test_fewer_than_ten_agents_decide_nothing():
    found = report(itself=50.0)
    entry = found["environments"]["CartPole-v1"]
    assert outcomes(found)[-1] == "holds"
    entry[ZOO]["returns"][OPTIMAL] = [500.0] * 9
    *others, optimal = generality.EXPERIMENT.judged(found)
    assert {x.outcome for x in others[:2]} == {"holds"}
    assert optimal.outcome == "undecided" and optimal.estimate.low is None


def test_robustness_is_not_scored_by_what_drops_the_worst():
    # A fifth of the bandit's agents learn nothing: the interquartile mean is that of the others.
    found = report(itself=400.0)
    entry = found["environments"]["CartPole-v1"]
    for agent in ("ppo", "sac"):
        for source in (ZOO, ENVIRONMENT):
            for kind in (agent, f"{agent}, {WIDE}", f"{agent}, {SWISH}"):
                entry[source]["returns"][kind] = [400.0] * 10
        entry[ZOO]["returns"][agent] = [410.0] * 8 + [RANDOM] * 2
    facts = generality.facts(found)
    scores, (of_the_task, expert) = facts["scores"], facts["by_task"]["CartPole-v1"]
    # The only task.
    assert of_the_task.value == pytest.approx(scores[ZOO][0].value) and expert == 500.0
    assert scores[ZOO][0].value > scores[ENVIRONMENT][0].value
    assert scores[ZOO][1].value < scores[ENVIRONMENT][1].value and scores[ZOO][2].value == 0.0
    assert "holds" not in outcomes(found)[:2]


def test_another_network_is_compared_agent_by_agent():
    # Each agent earns 60 less with it, 0.125 of the way, and far less than agents differ from each other.
    found = report()
    entry = found["environments"]["CartPole-v1"][ZOO]["returns"]
    for algorithm in ("ppo", "sac"):
        entry[algorithm] = [500.0, 400.0, 300.0, 200.0] * 3
        entry[f"{algorithm}, {SWISH}"] = [440.0, 340.0, 240.0, 140.0] * 3
        entry[f"{algorithm}, {WIDE}"] = [490.0, 390.0, 290.0, 190.0] * 3
    entry[EVOLVED] = [340.0, 440.0, 240.0, 340.0] * 3
    assert outcomes(found)[3:6] == ["holds", "does not hold", "undecided"]


def test_the_page_and_the_figure_show_every_kind_of_agent():
    found = report()
    body = generality.EXPERIMENT.block("body", found)
    table = body.partition("## CartPole-v1")[2].partition("## ")[0]
    assert sum(line.startswith("| ") for line in table.splitlines()) == 7 + 2
    assert "| 15 | 0 |\n" in body
    axes = generality.draw(found).axes[0]
    shown = (TOGETHER, WIDE, SWISH, EVOLVED, OPTIMAL)
    ticks = ["PPO", "SAC", *(generality.TICKS[x] for x in shown)]
    assert [t.get_text() for t in axes.get_xticklabels()] == ticks
