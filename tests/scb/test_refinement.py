"""A linear bandit's policy moves to where its agents do well in spite of their errors."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scb import warm_start
from scb.aggregation import Learned, Visited
from scb.discovery import DiscoveryConfig
from scb.environments.linear import PolicyDistanceParts
from scb.environments.synthetic import BanditConfig, bandit_for
from scb.errors import UserError
from scb.experts import Expert
from scb.measurement import Place
from scb.refinement import Refinement, paired_ranks
from scb.warm_start import WarmStartConfig
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
    learned = {"off": Learned(np.zeros(3), errors)}
    refine = Refinement(bandit, {"off": Off(bandit, weights)}, CORRIDOR, generations=100)
    found, steps = refine(weights, learned, jax.random.key(1))
    assert steps == 100 * 64 * 2
    np.testing.assert_allclose(
        actions_of(bandit, found, jnp.eye(2))[:, 0], TARGETS - 0.4, atol=0.15
    )
    jax.tree.map(np.testing.assert_array_equal, found["initial_state"], weights["initial_state"])


def test_pairs_are_ranked_by_their_difference_whoever_they_are_of():
    # Of three pairs the second is of an agent that earns a thousand times as much.
    ranks = paired_ranks(np.array([1.0, 3000.0, 2.0, 3.0, 2999.0, 7.0]))
    np.testing.assert_allclose(ranks, [-2 / 3, 1 / 3, -1, 2 / 3, -1 / 3, 1])
    assert np.isfinite(paired_ranks(np.array([np.nan, -np.inf, 1.0, 2.0]))).all()


@pytest.fixture
def pendulum(monkeypatch):
    def turning(observation):
        return 2 * jnp.tanh(observation[1:2] - observation[2:])

    found = Expert(turning, mean_return=-1000.0, environment_steps=7)
    monkeypatch.setattr(warm_start, "find_expert", lambda *arguments: found)
    return Place.named("Pendulum-v1")


def test_the_round_whose_agents_earn_most_is_kept(pendulum, monkeypatch):
    seen, returns = [], iter([-5.0, -3.0, -4.0])

    class Fake:
        steps, agents = 10, None

        def __init__(self, bandit, specs, place, number, episodes):
            assert (number, episodes) == (3, 4)

        def __call__(self, weights, key):
            seen.append(weights)
            observation = jnp.tile(jnp.array([1.0, 0.0, 0.5]), (2, 3, 1))
            return next(returns), Visited(jnp.zeros((2, 3)), observation), {}

    def moving(bandit, agents, place, generations):
        assert generations == 6

        def refine(weights, learned, key):
            kernel = weights["reward"]["kernel"] + 1.0
            return {**weights, "reward": {**weights["reward"], "kernel": kernel}}, 100

        return refine

    monkeypatch.setattr(warm_start, "Learners", Fake)
    monkeypatch.setattr(warm_start, "Refinement", moving)
    bandit = bandit_of(pendulum)
    settings = {"refinement_rounds": 2, "refinement_generations": 6, "refinement_agents": 3}
    config = WarmStartConfig(num_states=256, num_actions=2, **settings)
    weights, report = warm_start.warm_start(bandit, {}, pendulum, jax.random.key(1), config)
    assert (report["refinement"], report["refined_return"]) == (1, -3.0)
    jax.tree.map(np.testing.assert_array_equal, weights, seen[1])
    # The expert's, the dataset's, three times the agents', two searches and what the agents visited in two rounds.
    assert report["environment_steps"] == 7 + 256 * 200 + 3 * 10 + 2 * 100 + 2 * 6
    # Each fit holds the policy that was found: a kernel that is larger by 1, and again.
    for before, after in pairwise(seen):
        difference = after["reward"]["kernel"] - before["reward"]["kernel"]
        np.testing.assert_allclose(difference, 1.0, atol=0.05)
    # Half of the contexts lie where the agents were, all in one place.
    spreads = [np.linalg.norm(w["initial_state"]["Dense_0"]["kernel"]) for w in seen]
    assert spreads[0] > spreads[1] > spreads[2]


def test_only_a_linear_bandit_is_refined():
    with pytest.raises(UserError, match="refinement_rounds is 1, and only a linear bandit's"):
        DiscoveryConfig(warm_start=WarmStartConfig(refinement_rounds=1))
    DiscoveryConfig(bandit=LINEAR, warm_start=WarmStartConfig(refinement_rounds=1))
