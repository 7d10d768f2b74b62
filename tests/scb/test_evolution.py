import json
import math
import os
import signal
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import chex
import evosax.algorithms
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import scb
from scb.configurations import config_dict
from scb.errors import UserError
from scb.evolution import COMBINATIONS, EnvironmentSteps, EvolutionConfig, evolve
from scb.keys import key_at, root_key, split_key
from scb.population import combine_tasks, map_population, rank_failed_last
from scb.runs import Run, read_config
from scb.statistics import iqm
from scb.strategies import GRADIENT_ESTIMATING, REMEMBERING, STRATEGIES, Strategy
from tests.scb.probes import Parabola, Slope

CONFIG = EvolutionConfig(
    population_size=8,
    num_generations=8,
    sigma=0.3,
    mean_evaluations=4,
    evaluate_mean_every=3,
    checkpoint_every=3,
)


def with_strategy(strategy, **changes):
    """A short search by it, with steps that get somewhere where it does not size them itself."""
    steps = {"learning_rate": 0.3} if strategy in GRADIENT_ESTIMATING else {}
    return replace(CONFIG, strategy=strategy, **steps, **changes)


def column(outcome, name):
    return [line[name] for line in outcome.metrics]


def distance(solution):
    return float(np.linalg.norm(solution["x"] - 3.0))


# -- what evolution achieves
# --------------------------------------------------------------------------

START = math.sqrt(2 * 3.0**2)  # distance of (0, 0) from (3, 3)


@pytest.mark.parametrize("strategy", ["SNES", "Open_ES", "CMA_ES", "SimpleGA"])
def test_strategies_find_the_maximum(strategy):
    config = with_strategy(strategy, num_generations=40)
    outcome = evolve(Parabola(noise=0.5), config, quiet=True)
    assert distance(outcome.mean) < START / 6
    assert distance(outcome.best_mean) < START / 6


def test_without_generations_a_search_ends_with_its_start():
    problem, config = Parabola(noise=0.5), replace(CONFIG, num_generations=0)
    outcome = evolve(problem, config, quiet=True)
    for solution in (outcome.mean, outcome.best_mean):
        np.testing.assert_array_equal(
            solution["x"], problem.initial_solution(jax.random.key(0))["x"]
        )
    assert outcome.validate(outcome.mean)["fitness"].shape == (config.mean_evaluations,)
    cost = outcome.cost(problem, config, best=True)
    assert cost["generation"] == 0
    assert {cost[name] for name in cost if name.startswith("environment_steps")} == {0}


def test_an_averaged_mean_is_of_the_search_distributions_that_were():
    # A search of fewer generations ends where one of more was.
    means = [
        evolve(Parabola(), replace(CONFIG, num_generations=n), quiet=True).mean["x"]
        for n in range(1, 6)
    ]
    expected = np.mean(means[:3], axis=0)
    for mean in means[3:]:
        expected = expected + (mean - expected) / 3
    config = replace(CONFIG, num_generations=5, averaging=3, evaluate_mean_every=1)
    outcome = evolve(Parabola(), config, quiet=True)
    np.testing.assert_allclose(outcome.mean["x"], expected, rtol=1e-5)
    # What is judged is the average, whose fitness the parabola says: after two generations, and at the end.
    judged = [outcome.metrics[2]["mean/fitness"], outcome.metrics[-1]["final_mean/fitness"]]
    after = [np.mean(means[:2], axis=0), expected]
    np.testing.assert_allclose(judged, [-np.sum((x - 3.0) ** 2) for x in after], rtol=1e-4)


class Scattered(Parabola):
    """Its noise is a candidate's own."""

    def evaluate(self, candidate, key, generation):
        own = jax.random.fold_in(key, jax.lax.bitcast_convert_type(candidate["x"][0], jnp.int32))
        return super().evaluate(candidate, own, generation)


def test_where_fitness_is_noisy_the_average_is_closer_to_the_maximum_than_the_last_mean():
    # Steps of one size, for ever.
    config = with_strategy("Open_ES", num_generations=100, evaluate_mean_every=200)
    config = replace(config, learning_rate=1.0)
    last, average = (
        np.mean(
            [
                distance(evolve(Scattered(noise=5.0), replace(c, seed=seed), quiet=True).mean)
                for seed in range(4)
            ]
        )
        for c in (config, replace(config, averaging=50))
    )
    assert average < 0.7 * last


class Wide(Parabola):
    """Of 20 numbers."""

    def initial_solution(self, key):
        return {"x": np.zeros(20, np.float32)}


@pytest.mark.slow
@pytest.mark.parametrize("strategy", sorted(STRATEGIES))
def test_every_strategy_that_is_offered_gets_closer_to_the_maximum(strategy):
    # Of limited memory, LM_MA_ES has none for two numbers: its deviation is 0 soon.
    problem, size = (Wide(), 32) if strategy == "LM_MA_ES" else (Parabola(), 8)
    config = with_strategy(strategy, population_size=size, num_generations=40)
    outcome = evolve(problem, config, quiet=True)
    start = 3.0 * math.sqrt(outcome.best_mean["x"].size)
    assert distance(outcome.best_mean) < 0.75 * start
    assert sum(column(outcome, "failed")) == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "strategy", sorted(STRATEGIES.keys() & evosax.algorithms.distribution_based_algorithms.keys())
)
def test_a_strategy_remembers_fitness_where_another_scale_a_generation_moves_it(strategy):
    found = []
    for shift in (0.0, 5.0):
        config = with_strategy(strategy, population_size=32, sigma=0.5)
        search = Strategy(config, jnp.ones(20))
        state = search.start(root_key(0), jnp.ones(20))
        for generation in range(4):
            key_ask, key_tell = split_key(key_at(root_key(1), generation))
            population, state = search.ask(key_ask, state)
            fitness = -np.sum(np.square(population), axis=1) - shift * generation
            state = search.tell(key_tell, population, fitness, state)
        found.append(search.ask(root_key(2), state)[0])
    same = np.allclose(*found, atol=1e-6)
    assert np.isfinite(found).all() and same == (strategy not in REMEMBERING)


@pytest.mark.parametrize("strategy", ["DifferentialEvolution", "HillClimbing"])
def test_ranks_are_not_for_a_strategy_that_remembers_fitness(strategy):
    with pytest.raises(UserError, match=f"{strategy} compares fitness with that of earlier"):
        EvolutionConfig(strategy=strategy, combine="ranks")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"learning_rate": 0.1}, "learning_rate is 0.1, and SNES steps by a rule of its own"),
        ({"strategy": "PGPE", "sigma_decay": 0.9}, "sigma_decay is 0.9, and PGPE steps by"),
        ({"strategy": "CMA_ES", "sigma_limit": 0.1}, "sigma_limit is 0.1, and CMA_ES steps by"),
    ],
)
def test_what_a_strategy_does_not_use_is_refused(arguments, message):
    with pytest.raises(UserError, match=message):
        EvolutionConfig(**arguments)


@pytest.mark.parametrize("strategy", ["SNES", "Open_ES"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_fitness_is_maximised(strategy, sign):
    outcome = evolve(Slope(sign), with_strategy(strategy), quiet=True)
    assert sign * float(outcome.mean["x"].sum()) > 0.5


@pytest.mark.parametrize("strategy", ["SNES", "Open_ES"])
@pytest.mark.parametrize("sigma", [0.05, 2.0])
def test_the_search_starts_with_the_given_deviation(strategy, sigma):
    # x0 of 400 candidates around 0: the error of a deviation is 1 / sqrt(800) = 3.5 %.
    class Spread(Parabola):
        def evaluate(self, candidate, key, generation):
            return {"fitness": candidate["x"][0]}

    config = with_strategy(strategy, sigma=sigma, population_size=400, num_generations=1)
    deviations = column(evolve(Spread(), config, quiet=True), "fitness/std")
    assert deviations[0] == pytest.approx(sigma, rel=0.15)


def test_sigma_decays_down_to_its_limit():
    # evosax applies a schedule one generation late: sigma_g = max(0.5^(g - 1), 0.2) from g = 1 on.
    config = replace(
        CONFIG,
        strategy="Open_ES",
        population_size=400,
        num_generations=6,
        sigma=1.0,
        sigma_decay=0.5,
        sigma_limit=0.2,
    )
    deviations = column(evolve(Slope(1.0), config, quiet=True), "fitness/std")
    # The sum of two entries has sqrt(2) times the deviation of one.
    expected = np.sqrt(2) * np.array([1.0, 1.0, 0.5, 0.25, 0.2, 0.2])
    np.testing.assert_allclose(deviations, expected, rtol=0.15)


# -- what a candidate is given
# ------------------------------------------------------------------------


class Draw(Parabola):
    """Fitness is a number drawn from the key alone, or the generation."""

    def evaluate(self, candidate, key, generation):
        return {"fitness": jax.random.uniform(key), "generation": jnp.float32(generation)}

    def evaluate_mean(self, candidate, key):
        return {"fitness": jax.random.uniform(key), "square": jax.random.uniform(key) ** 2}


@pytest.fixture(scope="module")
def drawn():
    return evolve(Draw(), CONFIG, quiet=True)


def test_all_candidates_of_a_generation_share_their_randomness(drawn):
    assert column(drawn, "fitness/min") == column(drawn, "fitness/max")
    # And no two generations do.
    assert len(set(column(drawn, "fitness/mean"))) == 8


def test_a_candidate_is_told_the_generation(drawn):
    assert column(drawn, "candidates/generation") == list(range(8))
    assert column(drawn, "generation") == list(range(8))


def test_the_mean_is_judged_on_agents_of_its_own_every_third_generation_and_at_the_end(drawn):
    judged = [line["generation"] for line in drawn.metrics if "mean/fitness" in line]
    assert judged == [0, 3, 6]
    assert ["final_mean/fitness" in line for line in drawn.metrics] == 7 * [False] + [True]
    last = drawn.metrics[-1]
    # Four agents with four keys: were the keys equal, the mean square would be the squared mean.
    assert last["final_mean/square"] > last["final_mean/fitness"] ** 2 + 1e-4


def test_environment_steps_are_counted_apart(drawn):
    # 8 candidates of 10 training and 3 evaluation steps each: 80 and 24 a generation.
    assert column(drawn, "steps/training") == [80 * g for g in range(1, 9)]
    assert column(drawn, "steps/evaluation") == [24 * g for g in range(1, 9)]
    assert column(drawn, "steps/total") == [104 * g for g in range(1, 9)]
    assert EnvironmentSteps(training=10, evaluation=3).total == 13


def test_strategies_that_keep_a_population_are_not_judged_before_they_were_told_anything():
    config = with_strategy("SimpleGA", num_generations=4)
    outcome = evolve(Parabola(), config, quiet=True)
    assert [line["generation"] for line in outcome.metrics if "mean/fitness" in line] == [3]


class Overshoot(Slope):
    """Candidates are drawn to ever larger x, but the mean is judged best at (3, 3)."""

    def evaluate_mean(self, candidate, key):
        return {"fitness": -jnp.sum((candidate["x"] - 3.0) ** 2)}


def test_the_best_mean_is_the_one_that_was_judged_best():
    config = replace(CONFIG, num_generations=30, sigma=1.0, evaluate_mean_every=1)
    outcome = evolve(Overshoot(1.0), config, quiet=True)
    judged = [*column(outcome, "mean/fitness"), outcome.metrics[-1]["final_mean/fitness"]]
    assert outcome.best_mean_generation == int(np.argmax(judged))
    assert 0 < outcome.best_mean_generation < 30
    assert -(distance(outcome.best_mean) ** 2) == pytest.approx(max(judged), rel=1e-5)
    assert distance(outcome.mean) > 2 * distance(outcome.best_mean)


# -- several tasks
# ------------------------------------------------------------------------------------

# Three candidates on two tasks, the second of which scatters a hundred times more.
TASKS = np.array([[1.0, 100.0], [2.0, 300.0], [3.0, 200.0]])


class Luck(Parabola):
    """What an agent earns is its key's alone; below `least` it diverges."""

    least = 0.0

    def evaluate_mean(self, candidate, key):
        drawn = jax.random.uniform(key)
        return {"fitness": jnp.where(drawn < self.least, jnp.nan, drawn)}


def test_means_are_judged_by_agents_of_the_same_seeds():
    metrics = evolve(Luck(), CONFIG, quiet=True).metrics
    names = ("mean/fitness", "final_mean/fitness")
    judged = [line[name] for line in metrics for name in names if name in line]
    assert len(judged) == 4 and len(set(judged)) == 1


def test_a_mean_whose_agents_diverge_is_judged_by_these_too(monkeypatch):
    config = replace(CONFIG, mean_evaluations=16, num_generations=1)
    *_, key_mean = split_key(root_key(config.seed), 4)
    earned = np.asarray(jax.vmap(jax.random.uniform)(split_key(key_mean, 16)))
    fifth, fourth = np.sort(earned)[[4, 3]]

    monkeypatch.setattr(Luck, "least", (fifth + fourth) / 2)  # four of 16 diverge
    outcome = evolve(Luck(), config, quiet=True)
    assert outcome.metrics[0]["mean/fitness_iqm"] == pytest.approx(float(iqm(earned)), rel=1e-5)
    outcome.check(best=True)

    monkeypatch.setattr(Luck, "least", fifth + 1e-6)  # more than the mean leaves out
    outcome = evolve(Luck(), config, quiet=True)
    assert np.isfinite(outcome.metrics[0]["mean/fitness_iqm"])
    with pytest.raises(UserError, match="more than a quarter of the agents of every judgement"):
        outcome.check(best=True)


def test_the_best_mean_may_be_the_last():
    outcome = evolve(Slope(), CONFIG, quiet=True)
    assert outcome.best_mean_generation == CONFIG.num_generations
    np.testing.assert_array_equal(outcome.best_mean["x"], outcome.mean["x"])


def test_tasks_are_combined_by_their_mean():
    np.testing.assert_allclose(combine_tasks(TASKS, "mean"), [50.5, 151.0, 101.5])


def test_tasks_are_combined_by_ranks_whatever_their_scale():
    # Ranks 1 2 3 and 1 3 2: means 1, 2.5, 2.5. A tie shares its ranks: 1.5 1.5 3.
    np.testing.assert_allclose(combine_tasks(TASKS, "ranks"), [1.0, 2.5, 2.5])
    np.testing.assert_allclose(combine_tasks(TASKS * [1.0, -1e6], "ranks"), [2.0, 1.5, 2.5])
    np.testing.assert_allclose(combine_tasks(np.array([[1.0], [1], [2]]), "ranks"), [1.5, 1.5, 3])


@pytest.mark.parametrize("how", COMBINATIONS)
@pytest.mark.parametrize("broken", [np.nan, np.inf, -np.inf])
def test_a_candidate_that_failed_on_one_task_failed(how, broken):
    tasks = TASKS.copy()
    tasks[0, 1] = broken
    combined = combine_tasks(tasks, how)
    np.testing.assert_array_equal(np.isfinite(combined), [False, True, True])
    assert rank_failed_last(combined).argmin() == 0


class Vote(Parabola):
    """Two tasks want x0 to grow; a third wants it to shrink, a thousand times louder."""

    def evaluate(self, candidate, key, generation):
        x0 = candidate["x"][0]
        return {"fitness": x0 * jnp.array([1.0, 1.0, -1000.0]), "x0": x0}


def test_the_search_follows_the_mean_or_the_majority_of_tasks_and_logs_the_mean():
    ranks, mean = (
        evolve(Vote(), replace(CONFIG, combine=how), quiet=True) for how in ("ranks", "mean")
    )
    assert ranks.mean["x"][0] > 0.3 > -0.3 > mean.mean["x"][0]
    # Both start from the same candidates, whose logged fitness is -998/3 x0 either way.
    first = ranks.metrics[0]
    assert first["fitness/max"] == mean.metrics[0]["fitness/max"]
    assert first["fitness/mean"] == pytest.approx(-998 / 3 * first["candidates/x0"], rel=1e-4)


# -- candidates that fail
# -----------------------------------------------------------------------------


def test_failed_candidates_rank_below_the_worst():
    # Best 4, worst 1: a failed one gets 1 - (4 - 1) / 6 = 0.5.
    fitness = rank_failed_last(np.array([1.0, np.nan, 4.0, np.inf, -np.inf, 2.0]))
    np.testing.assert_array_equal(fitness, [1.0, 0.5, 4.0, 0.5, 0.5, 2.0])


@settings(max_examples=200)
@given(
    st.lists(
        st.one_of(st.floats(-1e6, 1e6, width=32), st.sampled_from([np.nan, np.inf, -np.inf])),
        min_size=1,
        max_size=10,
    ).filter(lambda values: np.isfinite(values).any())
)
def test_failed_candidates_are_always_last_and_the_others_are_untouched(values):
    given_fitness = np.array(values, np.float32)
    fitness = rank_failed_last(given_fitness)
    finite = np.isfinite(given_fitness)
    assert np.isfinite(fitness).all()
    np.testing.assert_array_equal(fitness[finite], given_fitness[finite])
    if not finite.all():
        assert fitness[~finite].max() < fitness[finite].min()


class Fragile(Parabola):
    """A parabola that breaks where x0 is negative; a mean is never judged a number."""

    def __init__(self, broken):
        self.broken = broken

    def evaluate(self, candidate, key, generation):
        fails = candidate["x"][0] < 0
        fitness = jnp.where(fails, self.broken, -jnp.sum((candidate["x"] - 3.0) ** 2))
        valid = jnp.where(fails, jnp.nan, fitness)
        return {"fitness": fitness, "fails": fails.astype(jnp.float32), "valid": valid}

    def evaluate_mean(self, candidate, key):
        return {"fitness": jnp.float32(jnp.nan)}


@pytest.mark.parametrize("strategy", ["SNES", "Open_ES"])
@pytest.mark.parametrize("broken", [np.nan, np.inf])
def test_failed_candidates_are_counted_and_never_poison_the_search(strategy, broken):
    config = with_strategy(strategy, num_generations=20)
    outcome = evolve(Fragile(broken), config, quiet=True)
    # The search starts at x0 = 0, so about half of the first generation fails.
    assert 0 < outcome.metrics[0]["failed"] < 8
    shares = np.array(column(outcome, "candidates/fails"))
    np.testing.assert_array_equal(column(outcome, "failed"), 8 * shares)
    # The log is of those that did not fail: what the strategy is told for the others is no measurement.
    for line in outcome.metrics:
        assert line["fitness/mean"] == pytest.approx(line["candidates/valid"], rel=1e-5)
        assert line["fitness/min"] <= line["fitness/mean"] <= line["fitness/max"] <= 0.0
    assert distance(outcome.mean) < START / 2
    # A mean that cannot be judged is not chosen: the start stays the best, and who wants the best is told.
    assert outcome.best_mean_generation == -1
    np.testing.assert_array_equal(outcome.best_mean["x"], [0.0, 0.0])
    outcome.check()
    with pytest.raises(UserError, match="judgement diverged, so no mean is best"):
        outcome.check(best=True)


def test_a_few_agents_that_diverged_do_not_void_a_judgement():
    class Diverging(Parabola):
        def evaluate_mean(self, candidate, key):
            fitness = super().evaluate_mean(candidate, key)["fitness"]
            return {"fitness": jnp.where(jax.random.uniform(key) < 0.1, jnp.nan, fitness)}

    outcome = evolve(Diverging(), replace(CONFIG, mean_evaluations=16), quiet=True)
    judged = [line["mean/fitness_iqm"] for line in outcome.metrics if "mean/fitness" in line]
    assert np.isfinite(judged).all() and outcome.best_mean_generation > 0
    assert distance(outcome.best_mean) < distance({"x": jnp.zeros(2)})
    outcome.check(best=True)


class Broken(Parabola):
    def evaluate(self, candidate, key, generation):
        return {"fitness": jnp.where(generation < 100, jnp.nan, candidate["x"].sum())}


@pytest.mark.parametrize("strategy", ["SNES", "Open_ES", "CMA_ES"])
def test_a_generation_that_fails_altogether_leaves_the_mean_where_it_was(strategy):
    outcome = evolve(Broken(), with_strategy(strategy), quiet=True)
    np.testing.assert_array_equal(outcome.mean["x"], [0.0, 0.0])
    assert column(outcome, "failed") == 8 * [8]
    # 0 would be the maximum. No number was measured, and the log has none.
    assert not [name for line in outcome.metrics for name in line if name.startswith("fitness/")]
    with pytest.raises(UserError, match="no candidate of 8 generations had a finite fitness"):
        outcome.check()
    evolve(Parabola(), CONFIG, quiet=True).check()


# -- what it cost, and what its end is worth


@pytest.mark.parametrize(
    ("strategy", "judgements"),
    [("SNES", 4), ("SimpleGA", 3)],  # a population has no mean before the first tell
)
def test_the_cost_counts_the_judgements_of_the_mean(strategy, judgements):
    # 8 generations of 8 candidates; judged before generations 0, 3 and 6 and after the last, by 4 agents.
    config = with_strategy(strategy)
    outcome = evolve(Parabola(), config, quiet=True)
    names = ("mean/fitness", "final_mean/fitness")
    assert sum(name in line for line in outcome.metrics for name in names) == judgements
    cost = outcome.cost(Parabola(), config, best=False)
    one, agent = Parabola().steps(), Parabola().judgement_steps()
    assert cost["environment_steps_training"] == 64 * one.training
    assert cost["environment_steps_evaluation"] == 64 * one.evaluation
    judged = judgements * 4
    assert cost["environment_steps_judgements_training"] == judged * agent.training
    assert cost["environment_steps_judgements_evaluation"] == judged * agent.evaluation
    assert "generation" not in cost
    assert outcome.cost(Parabola(), config, best=True)["generation"] == outcome.best_mean_generation


def test_an_end_is_judged_on_validation_seeds():
    class Noise(Parabola):
        def evaluate_mean(self, candidate, key):
            return {"fitness": jax.random.uniform(key)}

    ends = [
        evolve(Noise(), replace(CONFIG, num_generations=1, seed=seed), quiet=True)
        for seed in (0, 1)
    ]
    validated = [end.validate(end.mean)["fitness"] for end in ends]
    keys = jax.random.split(jax.random.key(30_000), 4)
    for of_one in validated:
        np.testing.assert_array_equal(of_one, jax.vmap(jax.random.uniform)(keys))
    assert ends[0].metrics[0]["final_mean/fitness"] != pytest.approx(validated[0].mean())


# -- devices
# ------------------------------------------------------------------------------------------


def test_the_tests_run_on_two_devices():
    assert len(jax.devices()) == 2


@pytest.mark.parametrize("size", [1, 2, 5, 8])
def test_a_mapped_function_does_not_see_how_many_devices_there_are(size):
    def function(weights, key, shared):
        return {"a": weights["w"] * shared + jax.random.normal(key), "b": weights["w"].sum()}

    key_weights, key_members = jax.random.split(jax.random.key(0))
    weights = {"w": jax.random.normal(key_weights, (size, 3))}
    keys = jax.random.split(key_members, size)
    mapped = map_population(function, size, (0, 0, None))(weights, keys, jnp.float32(2.0))
    expected = jax.vmap(function, in_axes=(0, 0, None))(weights, keys, jnp.float32(2.0))
    assert isinstance(mapped["a"], np.ndarray) and mapped["a"].shape == (size, 3)
    chex.assert_trees_all_close(mapped, jax.device_get(expected), atol=1e-6)


def test_a_population_is_spread_over_the_devices():
    # Seen from inside, each device has its half of the population.
    sizes = []

    def function(x):
        return jax.pure_callback(
            lambda x: sizes.append(x.shape) or x,
            jax.ShapeDtypeStruct((), jnp.float32),
            x,
            vmap_method="broadcast_all",
        )

    map_population(function, 8, (0,))(jnp.arange(8.0))
    assert sizes == [(4,), (4,)]


def test_a_population_that_the_devices_do_not_divide_evolves_as_on_one_device(monkeypatch):
    config = replace(CONFIG, population_size=5, mean_evaluations=3)
    on_two = evolve(Parabola(noise=0.5), config, quiet=True)
    first = jax.devices()[:1]
    monkeypatch.setattr("scb.processes.jax.local_devices", lambda: first)
    on_one = evolve(Parabola(noise=0.5), config, quiet=True)
    np.testing.assert_allclose(on_two.mean["x"], on_one.mean["x"], rtol=1e-5)
    for name in ("fitness/mean", "fitness/min", "fitness/max", "candidates/x0"):
        np.testing.assert_allclose(column(on_two, name), column(on_one, name), rtol=1e-4)


# -- interruption
# -------------------------------------------------------------------------------------


class Killed(BaseException):
    """A kill: nothing in the code may catch it."""


class KilledRun(Run):
    """Dies in generation `last`, after its line was written and in the middle of another."""

    last = 0

    def log(self, generation, metrics, seconds):
        super().log(generation, metrics, seconds)
        if generation == self.last:
            with (self.folder / "metrics.jsonl").open("a") as file:
                file.write('{"generation": 1')
            raise Killed


def evolve_in(folder, config, resume=False, kill_at=None, quiet=True):
    kind = Run if kill_at is None else KilledRun
    run = kind.open(folder, config_dict(config), resume=resume)
    if kill_at is not None:
        run.last = kill_at
    try:
        return evolve(Parabola(noise=0.5), config, run, quiet)
    finally:
        run.close()


def fingerprint(folder, outcome):
    """All bytes that must not depend on interruptions."""
    weights = [np.asarray(x).tobytes() for x in jax.tree.leaves((outcome.mean, outcome.best_mean))]
    metrics = (Path(folder) / "metrics.jsonl").read_bytes()
    return weights, outcome.best_mean_generation, metrics


RESUMED = {
    "SNES": with_strategy("SNES"),
    "Open_ES": with_strategy("Open_ES", averaging=4),
    "SimpleGA": with_strategy("SimpleGA"),
}


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """{strategy: fingerprint} of runs that nobody disturbed."""
    fingerprints = {}
    for strategy, config in RESUMED.items():
        folder = tmp_path_factory.mktemp(strategy) / "run"
        outcome = evolve_in(folder, config)
        fingerprints[strategy] = fingerprint(folder, outcome)
    return fingerprints


@pytest.mark.parametrize(
    ("strategy", "kills"),
    [
        # Checkpoints are written after generations 2, 5 and 7: before the first, in the generation
        # whose checkpoint was about to be written, between two, in the very last, and three times.
        ("SNES", [1]),
        ("SNES", [2]),
        ("SNES", [4]),
        ("SNES", [7]),
        ("SNES", [0, 5, 6]),
        ("Open_ES", [4]),
        ("SimpleGA", [4]),
    ],
)
def test_a_run_that_was_killed_and_resumed_ends_with_the_same_bytes(
    tmp_path, uninterrupted, strategy, kills
):
    config, folder = RESUMED[strategy], tmp_path / "run"
    for attempt, kill_at in enumerate(kills):
        with pytest.raises(Killed):
            evolve_in(folder, config, resume=attempt > 0, kill_at=kill_at)
    outcome = evolve_in(folder, config, resume=True)
    assert fingerprint(folder, outcome) == uninterrupted[strategy]
    # One line a generation in both logs, and the outcome tells the whole story.
    assert column(outcome, "generation") == list(range(8))
    assert len((folder / "timing.jsonl").read_text().splitlines()) == 8


def test_resuming_a_finished_run_changes_nothing(tmp_path, uninterrupted):
    folder = tmp_path / "run"
    evolve_in(folder, CONFIG)
    seconds = (folder / "timing.jsonl").read_bytes()
    outcome = evolve_in(folder, CONFIG, resume=True)
    assert fingerprint(folder, outcome) == uninterrupted["SNES"]
    assert (folder / "timing.jsonl").read_bytes() == seconds
    assert outcome.seconds == sum(json.loads(line)["seconds"] for line in seconds.splitlines())


def test_another_seed_ends_with_other_bytes(tmp_path, uninterrupted):
    outcome = evolve_in(tmp_path / "run", replace(CONFIG, seed=1))
    assert fingerprint(tmp_path / "run", outcome)[0] != uninterrupted["SNES"][0]


def test_a_finished_run_goes_on_with_more_generations(tmp_path, uninterrupted):
    evolve_in(tmp_path / "run", replace(CONFIG, num_generations=5))
    config = config_dict(CONFIG)
    run = Run.open(tmp_path / "run", config, resume=True, growing=["num_generations"])
    outcome = evolve(Parabola(noise=0.5), CONFIG, run, quiet=True)
    run.close()
    mean = [np.asarray(x).tobytes() for x in jax.tree.leaves(outcome.mean)]
    assert mean == uninterrupted["SNES"][0][: len(mean)]
    assert read_config(tmp_path / "run") == config
    assert [line["generation"] for line in outcome.metrics] == [*range(8)]
    # Judged before generations 0, 3 and 6, after the first end and after the last.
    one = Parabola().judgement_steps().training * CONFIG.mean_evaluations
    cost = outcome.cost(Parabola(), CONFIG, best=False)
    assert cost["environment_steps_judgements_training"] == 5 * one


def test_a_killed_run_ends_with_fewer_generations_as_one_that_had_so_few(tmp_path, uninterrupted):
    with pytest.raises(Killed):
        evolve_in(tmp_path / "run", replace(CONFIG, num_generations=100), kill_at=6)
    for few in (1, 6):  # as many as the newest checkpoint has
        config = config_dict(replace(CONFIG, num_generations=few))
        said = rf"after {few} generations: of 100 it has done 6; take at least 7\."
        with pytest.raises(UserError, match=said):
            Run.open(tmp_path / "run", config, resume=True, growing=["num_generations"])
    other = config_dict(replace(CONFIG, sigma=0.4))
    with pytest.raises(UserError, match=r"differs at sigma \(0.3 there, 0.4 now\)"):
        Run.open(tmp_path / "run", other, resume=True, growing=["num_generations"])
    config = config_dict(CONFIG)
    run = Run.open(tmp_path / "run", config, resume=True, growing=["num_generations"])
    outcome = evolve(Parabola(noise=0.5), CONFIG, run, quiet=True)
    run.close()
    assert fingerprint(tmp_path / "run", outcome) == uninterrupted["SNES"]
    assert read_config(tmp_path / "run") == config


def cut_in_half(folder):
    for path in [p for p in folder.rglob("*") if p.is_file()]:
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.mark.parametrize(
    ("damaged", "said"),
    [
        (["8"], ["checkpoint 8 is damaged: resuming from checkpoint 6 before it."]),
        (
            ["8", "6"],
            [
                "checkpoint 8 is damaged: resuming from checkpoint 3 before it.",
                "checkpoint 6 is damaged: resuming from checkpoint 3 before it.",
            ],
        ),
    ],
)
def test_a_damaged_checkpoint_is_told_and_the_one_before_is_taken(
    tmp_path, uninterrupted, capsys, damaged, said
):
    folder = tmp_path / "run"
    evolve_in(folder, CONFIG)
    for step in damaged:
        cut_in_half(folder / "checkpoints" / step)
    outcome = evolve_in(folder, CONFIG, resume=True, quiet=False)
    messages = capsys.readouterr().err.splitlines()
    assert [line for line in messages if "checkpoint" in line] == said
    assert fingerprint(folder, outcome) == uninterrupted["SNES"]


def test_a_process_that_was_killed_mid_way_is_resumed_to_the_same_bytes(tmp_path):
    # SIGKILL at no chosen moment after 25 generations, of a process of its own.
    config = replace(CONFIG, num_generations=100, checkpoint_every=7)
    code = f"""
import os, pathlib, signal, sys, threading, time
from scb.evolution import EvolutionConfig, evolve
from scb.configurations import config_dict
from scb.runs import Run
from tests.scb.probes import Parabola

def kill():
    log = pathlib.Path(sys.argv[1], "metrics.jsonl")
    while not log.exists() or log.read_bytes().count(b"\\n") < 25:
        time.sleep(0.01)
    os.kill(os.getpid(), signal.SIGKILL)

threading.Thread(target=kill, daemon=True).start()
config = EvolutionConfig(**{asdict(config)!r})
evolve(Parabola(0.5), config, Run.open(sys.argv[1], config_dict(config)), quiet=True)
time.sleep(60)
"""
    killed, whole = tmp_path / "killed", tmp_path / "whole"
    root = Path(scb.__file__).parents[1]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    process = subprocess.run([sys.executable, "-c", code, str(killed)], cwd=root, env=environment)
    assert process.returncode == -signal.SIGKILL
    assert 25 <= (killed / "metrics.jsonl").read_bytes().count(b"\n") < 100
    resumed = fingerprint(killed, evolve_in(killed, config, resume=True))
    assert resumed == fingerprint(whole, evolve_in(whole, config))


# -- what the user is told
# ----------------------------------------------------------------------------


def test_progress_says_fitness_failures_and_time_left(capsys):
    evolve(Fragile(np.nan), replace(CONFIG, num_generations=3))
    before, first, *_, last = capsys.readouterr().err.splitlines()
    assert before == "generation 1/3: compiling, the first takes longest"
    assert first.startswith("generation 1/3: fitness -") and "left" not in first  # it was compiled
    assert first.endswith(" failed")
    assert last.startswith("generation 3/3: ") and last.endswith(", 0.0 min left")
    evolve(Parabola(), replace(CONFIG, num_generations=1), quiet=True)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"strategy": "SNESS"}, "unknown evolution strategy 'SNESS': did you mean SNES or"),
        ({"strategy": "open_es"}, "unknown evolution strategy 'open_es': did you mean Open_ES"),
        ({"strategy": "RandomSearch"}, "unknown evolution strategy 'RandomSearch'"),
        ({"combine": "rank"}, "unknown combination of tasks 'rank': did you mean ranks"),
        ({"population_size": 1}, "population_size is 1: .* at least 2"),
        ({"population_size": 5, "strategy": "Open_ES"}, "population_size is 5: .* must be even"),
        (
            {"num_generations": -1},
            r"num_generations \(--generations\) is -1: it must be 0 or larger",
        ),
        ({"averaging": 0}, "averaging is 0: it must be at least 1"),
        (
            {"averaging": 2, "strategy": "SimpleGA"},
            "averaging is 2, and SimpleGA keeps a population",
        ),
        ({"mean_evaluations": 0}, "mean_evaluations is 0: it must be at least 1"),
        ({"evaluate_mean_every": 0}, "evaluate_mean_every is 0: it must be at least 1"),
        ({"checkpoint_every": 0}, "checkpoint_every is 0: it must be at least 1"),
        ({"seed": -1}, "seed is -1: it must be 0 or larger"),
        ({"sigma": 0.0}, "sigma is 0.0: it must be positive"),
        ({"sigma": math.nan}, "sigma is nan: it must be positive"),
        ({"learning_rate": -1.0}, "learning_rate is -1.0: it must be positive"),
        ({"sigma_decay": 0.0}, "sigma_decay is 0.0: it must be positive"),
        ({"sigma_limit": math.nan}, "sigma_limit is nan: it must be 0 or larger, and finite"),
    ],
)
def test_impossible_configurations_are_refused(arguments, message):
    with pytest.raises(UserError, match=message):
        EvolutionConfig(**arguments)


@pytest.mark.parametrize(
    ("strategy", "size", "reason"),
    [("PGPE", 5, "must be even"), ("DifferentialEvolution", 3, "population_size >= 4")],
)
def test_a_size_that_a_strategy_does_not_take_is_refused(strategy, size, reason):
    config = with_strategy(strategy, population_size=size)
    message = f"{strategy} does not take a population_size of {size} for 2 weights .*{reason}"
    with pytest.raises(UserError, match=message):
        evolve(Parabola(), config, quiet=True)


def test_a_configuration_is_plain_json():
    assert EvolutionConfig(**json.loads(json.dumps(config_dict(CONFIG)))) == CONFIG
