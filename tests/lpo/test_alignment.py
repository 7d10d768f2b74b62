"""Which bandit regime ranks objectives as an environment does: the measure, and what it is measured on."""

from dataclasses import asdict, replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpo import alignment as module
from lpo import figures
from lpo.alignment import (
    Regime,
    alignment,
    known_drifts,
    measure_alignment,
    other_drifts,
    regime_fitness,
)
from lpo.fitness import LABELS
from scb import plotting
from scb.agents.spec import environment_agent
from scb.environments.registry import make
from scb.environments.spec import EnvironmentSpec
from scb.environments.synthetic import BanditConfig
from scb.environments.synthetic_mdp import synthetic_for
from scb.environments.zoo import save_bandit
from scb.errors import UserError
from scb.keys import root_key
from scb.population import map_population
from scb.statistics import correlation_text

TINY = Regime(reward_noise=0.0, contexts=10, iterations=4, epochs=1, minibatches=1)


def returns(**means: float) -> dict[str, np.ndarray]:
    """Four agents each, scattered by less than the objectives differ."""
    return {name: mean + np.array([-0.1, 0.1, 0.0, 0.0]) for name, mean in means.items()}


def test_alignment_is_one_where_the_orders_agree_and_minus_one_where_they_are_reversed():
    outcome = returns(a=-900.0, b=-500.0, c=-200.0)
    same = alignment(returns(a=0.1, b=5.0, c=7.0), outcome)
    assert (same.spearman, same.low, same.high) == (1.0, 1.0, 1.0)
    assert alignment(returns(a=3.0, b=2.0, c=1.0), outcome).spearman == -1.0
    # One pair exchanged: 1 - 6 (0 + 1 + 1) / (3 (9 - 1)) = 0.5.
    assert alignment(returns(a=1.0, b=3.0, c=2.0), outcome).spearman == pytest.approx(0.5)


def test_the_mean_of_a_fitness_counts_and_the_interquartile_mean_of_an_outcome():
    # By their medians the fitnesses of a and b would change places; by its mean c's outcome would be the lowest.
    fitness = {"a": np.array([0.0, 0.0, 0.0, 100.0]), "b": np.full(4, 10.0), "c": np.full(4, 30.0)}
    outcome = {"a": np.full(4, 2.0), "b": np.full(4, 1.0), "c": np.array([3.0, 3.0, 3.0, -100.0])}
    assert alignment(fitness, outcome).spearman == 1.0


def test_the_interval_of_an_alignment_leaves_out_a_fortieth_on_either_side():
    # Drawn anew, all three agents of a are its best in one of 27 resamples, in which it overtakes b.
    fitness = {"a": np.array([0.0, 0.0, 9.0]), "b": np.full(3, 8.0), "c": np.full(3, 20.0)}
    found = alignment(fitness, returns(a=1.0, b=2.0, c=3.0))
    assert (found.spearman, found.low, found.high) == (1.0, 0.5, 1.0)


def test_agents_that_scatter_more_than_objectives_differ_leave_a_wide_interval():
    generator = np.random.default_rng(0)
    outcome = {name: generator.normal(0.0, 10.0, 8) for name in "abcde"}
    fitness = {name: generator.normal(0.0, 10.0, 8) for name in "abcde"}
    result = alignment(fitness, outcome)
    assert result.high - result.low > 0.5
    assert alignment(fitness, outcome) == result


def test_a_fitness_that_tells_nothing_apart_has_no_correlation():
    outcome = returns(a=1.0, b=2.0, c=3.0)
    flat = {name: np.ones(4) for name in "abc"}
    result = alignment(flat, outcome)
    assert result.spearman is None
    assert correlation_text({"spearman": None, "low": 0.0, "high": 0.0}) == "none: all alike"


def test_of_single_agents_a_correlation_has_no_interval():
    single = {name: np.array([x]) for name, x in (("a", 1.0), ("b", 2.0), ("c", 3.0))}
    for fitness, outcome in ((single, returns(a=1, b=2, c=3)), (returns(a=1, b=2, c=3), single)):
        found = alignment(fitness, outcome)
        assert (found.spearman, found.low, found.high) == (1.0, None, None)
        assert correlation_text(asdict(found)) == "1.00, one agent: no interval"


@pytest.mark.parametrize(
    ("fitness", "outcome", "message"),
    [
        (returns(a=1, b=2, c=3), returns(a=1, b=2, d=3), "of different objectives"),
        (returns(a=1, b=2), returns(a=1, b=2), "there are 2 objectives, which rank nothing"),
    ],
)
def test_what_cannot_be_ranked_is_refused(fitness, outcome, message, one_sentence):
    with pytest.raises(UserError) as error:
        alignment(fitness, outcome)
    assert message in one_sentence(str(error.value))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"bandit": "Pendulum-v1"}, "a regime asks for a bandit, and 'Pendulum-v1' is none"),
        ({"iterations": 0}, "iterations is 0: it must be at least 1."),
        ({"reward_noise": -1.0}, "reward_noise is -1.0: it must be 0 or larger, and finite."),
        (
            {"reward_noise": float("inf")},
            "reward_noise is inf: it must be 0 or larger, and finite.",
        ),
    ],
)
def test_a_regime_that_cannot_be_is_refused(arguments, message, one_sentence):
    with pytest.raises(UserError) as error:
        Regime(**arguments)
    assert message in one_sentence(str(error.value))


def test_a_regime_on_a_synthetic_mdp_has_no_reward_noise(one_sentence, tmp_path):
    path = tmp_path / "mdp.npz"
    env, params = make("Pendulum-v1")
    mdp = synthetic_for(env, params, "T", BanditConfig(hidden_size=2), "mdp", None)
    save_bandit(path, mdp, mdp.init_weights(root_key(0)))
    with pytest.raises(UserError) as error:
        Regime(bandit=str(path))
    message = f"reward_noise is 5, and '{path}' is a synthetic MDP, whose reward has none: take 0."
    assert message in one_sentence(str(error.value))
    regime = Regime(bandit=str(path), reward_noise=0.0, iterations=7)
    assert regime.spec().config.num_iterations == 7
    with pytest.raises(
        UserError, match=r"contexts is 50, and the batches of .* are its environment's"
    ):
        replace(regime, contexts=50)


def test_a_regime_changes_what_it_names_and_keeps_the_settings_own():
    ppo = known_drifts()[2]
    own = environment_agent("ppo", "Pendulum-v1")
    plain = Regime().task(ppo)
    assert plain.spec.config.num_iterations == own.config.num_iterations == 15
    assert plain.spec.config.batch_size == 200
    assert Regime().spec().hyperparameters == own.hyperparameters
    regime = replace(TINY, learning_rate=0.5, policy_output_scale=0.25)
    config = regime.task(ppo).spec.config
    assert (config.num_iterations, config.batch_size) == (4, 10)
    assert (config.num_epochs, config.num_minibatches) == (1, 1)
    hyperparameters = regime.spec().hyperparameters
    assert (hyperparameters.learning_rate, hyperparameters.policy_output_scale) == (0.5, 0.25)
    assert hyperparameters.discount == own.hyperparameters.discount
    assert str(Regime()) == "default"
    assert str(Regime(reward_noise=0.0, contexts=50)) == "reward noise 0.0, contexts 50"


def test_the_family_is_ppo_dpo_and_none_each_with_its_own_parameters():
    family = {objective.name: objective for objective in known_drifts()}
    assert {"ppo-0.2", "ppo-1", "none", "dpo-2-0.6", "dpo-4-1.2"} <= set(family)
    log_ratio, advantage = jnp.full(1, 0.5), jnp.ones(1)

    def charge(name):
        objective = family[name]
        return float(objective.drift(objective.parameters, log_ratio, advantage, jnp.zeros(1))[0])

    # r = 1.649: a clip of 0.2 charges r - 1.2, one of 1 and none nothing.
    assert charge("ppo-0.2") == pytest.approx(np.exp(0.5) - 1.2, rel=1e-5)
    assert charge("ppo-1") == charge("none") == 0.0
    assert charge("dpo-1-0.3") > charge("dpo-4-1.2") > 0.0


def test_what_confirms_the_choice_did_not_choose():
    def parameters(objectives):
        return {tuple(map(float, jax.tree.leaves(o.parameters))) for o in objectives}

    assert len(parameters(other_drifts())) == len(other_drifts()) == 12
    assert not parameters(other_drifts()) & parameters(known_drifts())


@pytest.mark.slow
def test_the_environment_of_a_bandit_has_the_physics_asked_for(monkeypatch):
    made, make = [], EnvironmentSpec.make

    def recorded(spec, backend=None, **arguments):
        made.append((spec.name, backend))
        return make(spec, backend, **arguments)

    def nothing(function, size, axes):
        return lambda *_: np.zeros((size, len(LABELS)))

    module.forget_programs()
    monkeypatch.setattr(EnvironmentSpec, "make", recorded)
    monkeypatch.setattr(module, "map_population", nothing)
    regime_fitness(replace(TINY, bandit="Synthetic-hopper"), known_drifts()[:1], [1], "spring")
    assert ("hopper", "spring") in made
    module.forget_programs()


def test_a_regime_trains_every_objective_on_every_seed_under_its_noise(monkeypatch):
    met = {}

    def program(regime, drift, size, backend):
        def called(*arguments):
            names = ("clips", "seeds", "hyperparameters", "judged_in", "trained_in")
            met.update(zip(names, arguments, strict=True))
            return np.tile(np.arange(float(size))[:, None], len(LABELS))

        return called

    monkeypatch.setattr(module, "_program", program)
    regime = replace(TINY, reward_noise=5.0, learning_rate=0.5)
    first, second = known_drifts()[:2]
    found = regime_fitness(regime, [first, second], [3, 2])
    np.testing.assert_array_equal(met["seeds"], [3, 2, 3, 2])
    np.testing.assert_allclose(met["clips"], [0.05, 0.05, 0.1, 0.1])
    assert met["hyperparameters"].learning_rate == 0.5
    assert met["judged_in"].reward_noise == 0.0 < met["trained_in"].reward_noise
    assert found[second.name]["transfer"].tolist() == [2.0, 3.0]


@pytest.mark.slow
def test_agents_of_a_regime_are_judged_in_every_way():
    ppo = known_drifts()[2]
    dpo = known_drifts()[-1]
    fitness = regime_fitness(TINY, [ppo, dpo], [1, 2, 3])[ppo.name]
    assert tuple(fitness) == LABELS
    assert all(x.shape == (3,) and np.isfinite(x).all() for x in fitness.values())
    # In the bandit a return is one reward; on Pendulum 200 of down to -16.3.
    assert np.abs(fitness["return, mode actions"]).max() < 100
    assert -16.3 * 200 < fitness["transfer"].min() <= fitness["transfer"].max() < -100
    # Another clip shares the program; neither it nor other seeds change what an agent learns.
    again = regime_fitness(TINY, [known_drifts()[0], ppo], [3, 2])[ppo.name]
    np.testing.assert_allclose(again["transfer"], fitness["transfer"][[2, 1]], rtol=1e-4)


def test_an_agent_that_diverged_is_the_worst_and_all_of_them_are_an_error(monkeypatch):
    ppo, seeds = known_drifts()[2], [1, 2, 3]
    earned = np.arange(3.0)[:, None] + np.zeros(len(LABELS))
    earned[2] = np.nan
    monkeypatch.setattr(module, "_program", lambda *_: lambda *_: earned)
    fitness = regime_fitness(TINY, [ppo], seeds)[ppo.name]["transfer"]
    assert fitness[2] < fitness[0] < fitness[1] and np.isfinite(fitness[2])
    earned[:] = np.nan
    with pytest.raises(UserError, match=r"every agent diverged in .*: lower its learning rate"):
        regime_fitness(TINY, [ppo], seeds)


@pytest.mark.slow
def test_regimes_that_differ_in_traced_numbers_share_a_program_and_nothing_else(monkeypatch):
    ppo, made = known_drifts()[2], []
    module.forget_programs()
    monkeypatch.setattr(
        module,
        "map_population",
        lambda function, size, axes: made.append(1) or map_population(function, size, axes),
    )
    plain, noisy, fast = (
        regime_fitness(regime, [ppo], [1, 2])[ppo.name]["return, mode actions"]
        for regime in (TINY, replace(TINY, reward_noise=9.0), replace(TINY, learning_rate=0.02))
    )
    assert len(made) == 1
    assert (plain != noisy).all() and (plain != fast).all() and (noisy != fast).all()
    regime_fitness(replace(TINY, iterations=2), [ppo], [1, 2])
    assert len(made) == 2
    module.forget_programs()
    again = regime_fitness(TINY, [ppo], [1, 2])[ppo.name]["return, mode actions"]
    assert len(made) == 3
    np.testing.assert_allclose(again, plain, rtol=1e-5)


@pytest.mark.slow
def test_the_report_holds_every_regime_and_is_drawn(monkeypatch, tmp_path):
    fixed = returns(**{"ppo-0.2": 1.0, "none": 2.0, "dpo-2-0.6": 3.0})
    family = [objective for objective in known_drifts() if objective.name in fixed]
    curves = [SimpleNamespace(objective=n, final=x) for n, x in fixed.items()]
    found = SimpleNamespace(curves=curves)
    monkeypatch.setattr(module, "compare", lambda *arguments, **named: found)
    monkeypatch.setattr(
        module,
        "regime_fitness",
        lambda regime, objectives, seeds, backend: {
            o.name: {name: regime.reward_noise * fixed[o.name] for name in LABELS}
            for o in objectives
        },
    )
    regimes = [Regime(reward_noise=1.0), Regime(reward_noise=0.0)]
    told: list[str] = []
    report = measure_alignment(regimes, family, "Pendulum-v1", [7, 8], tell=told.append)
    assert [row["name"] for row in report["regimes"]] == ["reward noise 1.0", "reward noise 0.0"]
    aligned, flat = (row["alignment"]["transfer"]["spearman"] for row in report["regimes"])
    assert (aligned, flat) == (1.0, None)
    assert len(told) == 3
    # An interrupted measurement goes on where it was.
    monkeypatch.setattr(module, "compare", None)
    kept: list[int] = []
    longer = measure_alignment(
        [*regimes, Regime(reward_noise=2.0)],
        family,
        "Pendulum-v1",
        [7, 8],
        tell=told.append,
        done=report,
        keep=lambda found: kept.append(len(found["regimes"])),
    )
    assert kept == [3] and longer["regimes"][:2] == report["regimes"][:2]
    # Of a bandit that was replaced since nothing is known.
    longer["regimes"][0]["sha256"] = "another's"
    again = measure_alignment(regimes, family, "Pendulum-v1", [7, 8], tell=told.append, done=longer)
    assert [row["name"] for row in again["regimes"]][-1] == "reward noise 1.0"
    assert len(again["regimes"]) == 3
    with pytest.raises(UserError, match="measured with other objectives, agents or steps"):
        measure_alignment(regimes, family[:2], "Pendulum-v1", [7, 8], done=report)
    path = plotting.save(figures.alignment_heatmap(report), tmp_path / "alignment.png")
    assert path.stat().st_size > 5000


def test_a_regime_says_its_bandit_where_that_is_another_environments():
    row = {"name": "default", "bandit": "Synthetic-Pendulum-v1"}
    assert figures.regime_label(row, "Pendulum-v1") == "default"
    assert figures.regime_label(row, "Acrobot-v1") == "bandit Synthetic-Pendulum-v1"
    noisy = {"name": "reward noise 1.0", "bandit": "Synthetic-Pendulum-v1"}
    assert figures.regime_label(noisy, "Acrobot-v1").endswith("-v1, reward noise 1.0")
    own = {"name": "bandit Synthetic-Acrobot-v1", "bandit": "Synthetic-Acrobot-v1"}
    assert figures.regime_label(own, "Acrobot-v1") == own["name"]
