"""A linear bandit's policy moves to where its agents do well in spite of their errors."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scb import refinement
from scb.aggregation import Learned, Visited
from scb.configurations import config_dict
from scb.discovery import DiscoveryConfig, discover
from scb.environments.linear import PolicyDistanceParts, fitted, with_states
from scb.environments.synthetic import BanditConfig, bandit_for
from scb.environments.zoo import load_bandit, save_bandit
from scb.errors import UserError
from scb.evolution import EvolutionConfig
from scb.keys import split_key
from scb.measurement import Place
from scb.refinement import Refinement, RefinementConfig, paired_ranks, refined
from scb.runs import Run
from tests.scb.probes import TWO_TARGETS, ContinuousCorridor

CORRIDOR = Place("corridor", ContinuousCorridor(cells=2), TWO_TARGETS)
TARGETS = np.array([-0.5, 1.5])
LINEAR = BanditConfig(form="linear")


def bandit_of(place):
    return bandit_for(place.env, place.params, LINEAR, place.name)


def actions_of(bandit, weights, observations):
    parts = PolicyDistanceParts.of(weights["reward"], *bandit.bounds)
    return np.asarray(parts.middle + parts.half_width * parts.best(observations))


class Off:
    """An agent that does what a bandit wants, and its state more."""

    def __init__(self, bandit, weights):
        self.parts = PolicyDistanceParts.of(weights["reward"], *bandit.bounds)

    def act(self, state, observation, key, params, mode):
        assert mode
        return self.parts.middle + self.parts.half_width * self.parts.best(observation) + state


def test_a_policy_makes_up_for_what_all_its_agents_do_wrong():
    bandit = bandit_of(CORRIDOR)
    zero = jax.tree.map(jnp.zeros_like, bandit.init_weights(jax.random.key(0)))
    eye = {"Dense_0": {"kernel": 0.5 * jnp.eye(2), "bias": jnp.full(2, 0.5)}}
    weights = {"initial_state": eye, "reward": zero["reward"]}
    # Alike but for a little, one of them better off by far.
    errors = jnp.array([[0.4], [0.3], [0.5]])
    learned = {
        "off": Learned(np.zeros(3), errors, split_key(jax.random.key(0), 3), np.zeros(3, bool))
    }
    refine = Refinement(bandit, {"off": Off(bandit, weights)}, CORRIDOR, generations=100)
    found, steps = refine(weights, learned, jax.random.key(1))
    assert steps == 100 * 64 * 2
    np.testing.assert_allclose(
        actions_of(bandit, found, jnp.eye(2))[:, 0], TARGETS - 0.4, atol=0.15
    )
    jax.tree.map(np.testing.assert_array_equal, found["initial_state"], weights["initial_state"])


def test_algorithms_take_turns_and_a_pair_has_one_agent_and_one_start():
    bandit, met = bandit_of(CORRIDOR), []

    def recorder(name):
        def program(changes, which, keys, mean, states, weights):
            met.append((name, np.asarray(which), jax.random.key_data(keys), states))
            return np.arange(64.0), np.full(64, 2)

        return program

    refine = Refinement(bandit, {}, CORRIDOR, generations=3)
    refine._programs = {name: recorder(name) for name in ("ppo", "td3")}
    learned = {
        name: Learned(np.zeros(3), f"{name}'s", None, np.zeros(3, bool)) for name in ("ppo", "td3")
    }
    _, steps = refine(bandit.init_weights(jax.random.key(0)), learned, jax.random.key(1))
    assert steps == 3 * 64 * 2
    assert [(name, states) for name, _, _, states in met] == [
        ("ppo", "ppo's"),
        ("td3", "td3's"),
        ("ppo", "ppo's"),
    ]
    for _, which, keys, _ in met:
        np.testing.assert_array_equal(which[:32], which[32:])
        np.testing.assert_array_equal(keys[:32], keys[32:])
        assert set(which) == {0, 1, 2}
    assert len({keys.tobytes() for _, _, keys, _ in met}) == 3


@pytest.mark.parametrize("noise", [0.0, 0.2])
def test_noise_is_a_share_of_half_the_actions_range(noise):
    bandit = bandit_of(CORRIDOR)
    weights = jax.tree.map(jnp.zeros_like, bandit.init_weights(jax.random.key(0)))
    refine = Refinement(bandit, {"off": Off(bandit, weights)}, CORRIDOR, 1, noise)
    same = {k: jnp.zeros_like(weights["reward"][k]) for k in ("kernel", "bias")}
    changes = jax.tree.map(lambda x: jnp.zeros((64, *x.shape)), same)
    keys, which = split_key(jax.random.key(1), 64), np.zeros(64, int)
    returns, _ = refine._programs["off"](changes, which, keys, same, jnp.zeros((1, 1)), weights)
    # The agent does 0.5, which is 1 from either target: a deviation e costs 2 e, to one side or the other, and e^2.
    deviation = noise * 1.5
    assert np.std(returns) == pytest.approx(np.sqrt(2) * 2 * deviation, rel=0.25)
    assert np.mean(returns) == pytest.approx(-2 * deviation**2, abs=0.3 if noise else 1e-5)


def test_more_agents_than_pairs_have_their_turns_in_other_generations():
    bandit, met = bandit_of(CORRIDOR), {"ppo": [], "td3": []}

    def recorder(name):
        def program(changes, which, keys, mean, states, weights):
            met[name].extend(which[:32])
            return np.arange(64.0), np.full(64, 2)

        return program

    refine = Refinement(bandit, {}, CORRIDOR, generations=8)
    refine._programs = {name: recorder(name) for name in met}
    learned = {name: Learned(np.zeros(128), name, None, np.zeros(128, bool)) for name in met}
    refine(bandit.init_weights(jax.random.key(0)), learned, jax.random.key(1))
    assert all(sorted(agents) == list(range(128)) for agents in met.values())


def test_pairs_are_ranked_by_their_difference_whoever_they_are_of():
    # Of three pairs the second is of an agent that earns a thousand times as much.
    ranks = paired_ranks(np.array([1.0, 3000.0, 2.0, 3.0, 2999.0, 7.0]))
    np.testing.assert_allclose(ranks, [-2 / 3, 1 / 3, -1, 2 / 3, -1 / 3, 1])
    # Nothing is known of a pair of which one side diverged; the others differ by 10 and by -20.
    ranks = paired_ranks(np.array([np.nan, -200.0, -300.0, -250.0, -210.0, -280.0]))
    np.testing.assert_allclose(ranks, [0, 2 / 3, -1, 0, -2 / 3, 1])
    assert not paired_ranks(np.array([np.nan, -np.inf, 1.0, 2.0])).any()


PENDULUM = Place.named("Pendulum-v1")


@pytest.fixture
def bandit():
    return bandit_of(PENDULUM)


@pytest.mark.parametrize("visits", [True, False])
def test_the_round_whose_agents_earn_most_is_kept(visits, bandit, monkeypatch):
    seen, returns = [], iter([-5.0, -3.0, -4.0])

    class Fake:
        steps, agents = 10, None

        def __init__(self, bandit, specs, place, number, episodes):
            assert (number, episodes) == (3, 4)

        def __call__(self, weights, key):
            seen.append(weights)
            return next(returns), {}

        def visits(self, weights, learned):
            assert visits
            return Visited(None, 0.5 * np.ones((2, 3, 3)))

    def moving(bandit, agents, place, generations, noise):
        assert (generations, noise) == (6, 0.3)

        def refine(weights, learned, key):
            kernel = weights["reward"]["kernel"] + 1.0
            return {**weights, "reward": {**weights["reward"], "kernel": kernel}}, 100

        return refine

    monkeypatch.setattr(refinement, "Learners", Fake)
    monkeypatch.setattr(refinement, "Refinement", moving)
    start = bandit.init_weights(jax.random.key(0))
    config = RefinementConfig(rounds=2, generations=6, agents=3, visits=visits, noise=0.3)
    weights, report = refined(bandit, start, {}, PENDULUM, jax.random.key(1), config)
    assert (report["refinement"], report["refined_return"]) == (1, -3.0)
    jax.tree.map(np.testing.assert_array_equal, weights, seen[1])
    # Three times the agents', two searches and what the agents visited in two rounds.
    assert report["environment_steps"] == 3 * 10 + 2 * 100 + (2 * 6 if visits else 0)
    for before, after in pairwise(seen):
        difference = after["reward"]["kernel"] - before["reward"]["kernel"]
        np.testing.assert_allclose(difference, 1.0, atol=1e-5)
    # Half of the contexts lie where the agents were, all in one place; or all where they were.
    means = [w["initial_state"]["Dense_0"]["bias"] for w in seen]
    for before, after in pairwise(means):
        np.testing.assert_allclose(after, (before + 0.5) / 2 if visits else before, rtol=1e-5)


def test_new_contexts_leave_the_policy_and_have_the_moments_of_both(bandit):
    rng = np.random.default_rng(0)
    own, other = rng.normal(1, 2, (500, 3)), rng.normal(-3, 0.5, (500, 3))
    actions = np.tanh(own @ np.array([[0.1], [0.2], [-0.1]]) + 0.3)
    low, high = bandit.bounds
    before = fitted(own, actions, low, high)
    after = with_states(before, other)
    states = np.concatenate([own, other])
    np.testing.assert_allclose(
        actions_of(bandit, after, states), actions_of(bandit, before, states), atol=1e-5
    )
    contexts = after["initial_state"]["Dense_0"]
    np.testing.assert_allclose(contexts["bias"], states.mean(axis=0), rtol=1e-5)
    covariance = contexts["kernel"].T @ contexts["kernel"]
    np.testing.assert_allclose(covariance, np.cov(states.T), rtol=0.01, atol=0.01)


def test_only_a_linear_bandit_is_refined():
    once = RefinementConfig(rounds=1)
    with pytest.raises(UserError, match="there are 1 refinement rounds, and only a linear"):
        DiscoveryConfig(refinement=once)
    DiscoveryConfig(bandit=LINEAR, refinement=once)
    said = r"^agents \(--refinement-agents\) is 4, and there are no refinement rounds"
    with pytest.raises(UserError, match=said):
        RefinementConfig(agents=4)


@pytest.mark.slow
def test_a_search_goes_on_from_a_bandit_that_it_refined_once(bandit, tmp_path, monkeypatch):
    path = tmp_path / "start.npz"
    weights = bandit.init_weights(jax.random.key(3))
    save_bandit(path, bandit, weights)
    config = DiscoveryConfig(
        start=str(path),
        bandit=LINEAR,
        refinement=RefinementConfig(rounds=1, generations=2, agents=2),
        agents_per_candidate=1,
        evaluation_episodes=1,
        evolution=EvolutionConfig(population_size=2, num_generations=1, mean_evaluations=1),
    )
    run = Run.open(tmp_path / "run", config_dict(config))
    first, outcome = discover(config, run, quiet=True)
    assert set(first.start_reports) == {"refinement"}
    kept = load_bandit(tmp_path / "run" / "refinement.npz").default_params.weights
    start = first.initial_solution(jax.random.key(0))
    jax.tree.map(np.testing.assert_array_equal, kept, start)
    monkeypatch.delattr("scb.discovery.refined")
    run = Run.open(tmp_path / "run", config_dict(config), resume=True)
    resumed, again = discover(config, run, quiet=True)
    assert resumed.start_reports == first.start_reports
    jax.tree.map(np.testing.assert_array_equal, again.mean, outcome.mean)
