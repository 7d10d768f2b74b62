"""A warm start goes where agents of its fit go, asks the expert what to do there, and keeps its best fit."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

from scb import aggregation, warm_start
from scb.agents.ppo import PPOConfig, PPOHyperparameters
from scb.agents.spec import AgentSpec
from scb.aggregation import Learners, Visited, best_round, trajectory
from scb.environments.registry import environment_spec
from scb.environments.synthetic import BanditConfig, bandit_for
from scb.errors import UserError
from scb.evaluation import Episodes
from scb.experts import Expert
from scb.keys import split_key
from scb.measurement import Place
from scb.warm_start import WarmStartConfig
from tests.scb.probes import ContinuousCorridor

TINY = PPOConfig(
    num_envs=2, num_steps=8, num_epochs=1, num_minibatches=1, total_steps=16, hidden_sizes=(4,)
)
SPECS = {"ppo": AgentSpec("ppo", TINY, PPOHyperparameters())}
STATES = 256


def turning(observation):
    """A linear policy of Pendulum's observation, within the bounds of its actions."""
    return 2 * jnp.tanh(observation[1:2] - observation[2:])


@pytest.fixture(scope="module")
def place():
    return Place.named("Pendulum-v1")


@pytest.fixture(scope="module")
def bandit(place):
    return bandit_for(place.env, place.params, BanditConfig(form="linear"), "Synthetic-Pendulum-v1")


@pytest.fixture
def expert(monkeypatch):
    found = Expert(turning, mean_return=-1000.0, environment_steps=7)
    monkeypatch.setattr(warm_start, "find_expert", lambda *arguments: found)


def started(bandit, place, rounds, quiet=True):
    config = WarmStartConfig(
        num_states=STATES,
        num_actions=2,
        **({"aggregation_rounds": rounds, "aggregation_agents": 2} if rounds else {}),
    )
    return warm_start.warm_start(bandit, SPECS, place, jax.random.key(1), config, quiet)


@pytest.fixture
def datasets(monkeypatch):
    """What every fit is made from."""
    seen, fit = [], warm_start.fit_bandit

    def spy(bandit, dataset, *arguments, **keywords):
        seen.append(jax.tree.map(np.asarray, dataset))
        return fit(bandit, dataset, *arguments, **keywords)

    monkeypatch.setattr(warm_start, "fit_bandit", spy)
    return seen


def test_what_agents_of_a_fit_visit_joins_the_dataset_with_the_experts_actions(
    bandit, place, expert, datasets, monkeypatch
):
    monkeypatch.setattr(aggregation, "TRAJECTORIES", 8)
    _, report = started(bandit, place, rounds=2)
    assert [len(dataset.observation) for dataset in datasets] == [STATES, 2 * STATES, 3 * STATES]
    for before, after in pairwise(datasets):
        np.testing.assert_array_equal(
            after.observation[: len(before.observation)], before.observation
        )
    # Cosine and sine of an angle: states of the pendulum, and none of them twice as the expert's.
    last = datasets[-1]
    np.testing.assert_allclose((last.observation[:, :2] ** 2).sum(axis=1), 1.0, rtol=1e-4)
    np.testing.assert_allclose(
        last.expert_action, jax.vmap(turning)(last.observation), rtol=1e-5, atol=1e-6
    )
    assert report["round"] in (0, 1, 2) and report["agents_return"] < 0
    # The expert's own; 256 trajectories of 200; and of two agents three judgements of 20 episodes
    # and two rounds of 4 trajectories each.
    assert report["environment_steps"] == 7 + (256 + 3 * 2 * 20 + 2 * 2 * 4) * 200


class Fake:
    """Agents that earn what the test says, at the top where nobody moves."""

    steps = 11

    def __init__(self, *arguments):
        self.returns = iter([-5.0, -3.0, -4.0])

    def __call__(self, weights, key):
        return next(self.returns), {"key": key}

    def visits(self, weights, learned):
        speed = 0.5 * jax.random.uniform(learned["key"])
        observation = jnp.tile(jnp.array([1.0, 0.0, speed]), (2, 3, 1))
        return Visited(jnp.zeros((2, 3)), observation)


def test_the_fit_whose_agents_earn_most_is_kept(
    bandit, place, expert, datasets, monkeypatch, capsys
):
    monkeypatch.setattr(warm_start, "Learners", Fake)
    weights, report = started(bandit, place, rounds=2, quiet=False)
    assert (report["round"], report["agents_return"]) == (1, -3.0)
    assert capsys.readouterr().err.splitlines()[-1] == "round 2/2: agents earn -4"
    second, _ = warm_start.fit_bandit(bandit, datasets[1], jax.random.key(0))
    jax.tree.map(np.testing.assert_array_equal, weights, second)


def test_a_search_for_an_expert_is_told_what_its_pupils_earn(bandit, place, monkeypatch):
    """Of two policies the second has the better pupils, whatever it earns itself."""
    numbers = []

    class Pupils(Fake):
        def __init__(self, bandit, specs, place, *numbers_of):
            numbers.append(numbers_of)
            super().__init__()

    monkeypatch.setattr(warm_start, "Learners", Pupils)

    def find(place, key, config, quiet, worth, folder):
        turned = Partial(lambda sign, observation: sign * turning(observation))
        experts = [Expert(Partial(turned, sign), 0.0, 0) for sign in (-1.0, 1.0)]
        earned, steps = zip(*(worth(expert, key) for expert in experts), strict=True)
        # The expert's trajectories, and the pupils' own steps.
        assert earned == (-5.0, -3.0) and steps == (256 * 200 + 11,) * 2
        return Expert(experts[int(np.argmax(earned))].policy, -1000.0, sum(steps))

    monkeypatch.setattr(warm_start, "find_expert", find)
    config = WarmStartConfig(expert="linear", expert_pupils=2, num_states=STATES, num_actions=2)
    weights, report = warm_start.warm_start(bandit, SPECS, place, jax.random.key(1), config)
    assert numbers == [(2, warm_start.PUPILS_EPISODES)]
    assert report["environment_steps"] == 3 * 256 * 200 + 22 and report["action_r2"] > 0.99
    # Its policy is the second: to the right of the top, towards it.
    reward = weights["reward"]
    observation = jnp.array([0.0, 1.0, 0.0])
    best = jnp.tanh((observation - reward["center"]) @ reward["kernel"] + reward["bias"])
    assert float(best[0]) == pytest.approx(float(turning(observation)[0]) / 2, abs=0.05)


def test_agents_whose_training_breaks_count_as_random_actions_and_are_not_followed(
    bandit, place, monkeypatch
):
    monkeypatch.setattr(aggregation, "TRAJECTORIES", 2)
    broken = jax.tree.map(lambda x: x * np.nan, bandit.init_weights(jax.random.key(0)))
    learners = Learners(bandit, SPECS, place, 2)
    earned, learned = learners(broken, jax.random.key(1))
    random = environment_spec("Pendulum-v1").random_return()
    assert earned == random and (learned["ppo"].returns == random).all()
    with pytest.raises(UserError, match=r"all agents of .* diverge"):
        learners.visits(broken, learned)
    sound, _ = split_key(jax.random.key(2))
    _, fine = learners(bandit.init_weights(sound), jax.random.key(1))
    states = jax.tree.map(
        lambda a, b: np.concatenate([a[:1], b[1:]]), fine["ppo"].states, learned["ppo"].states
    )
    one_of_two = {"ppo": fine["ppo"]._replace(states=states)}
    visited = learners.visits(bandit.init_weights(sound), one_of_two)
    assert visited.observation.shape == (1, 200, 3) and np.isfinite(visited.observation).all()


def test_an_agent_that_diverged_is_not_followed_where_actions_are_discrete(monkeypatch):
    # An argmax of NaN is an action, and what it leads to are states.
    monkeypatch.setattr(aggregation, "TRAJECTORIES", 4)
    place = Place.named("CartPole-v1")
    bandit = bandit_for(place.env, place.params, BanditConfig(hidden_size=4), "a bandit")
    learners = Learners(bandit, SPECS, place, 2)
    weights = jax.tree.map(lambda x: x * np.nan, bandit.init_weights(jax.random.key(0)))
    _, learned = learners(weights, jax.random.key(1))
    assert learned["ppo"].failed.all()
    with pytest.raises(UserError, match=r"all agents of .* diverge"):
        learners.visits(weights, learned)
    one = {"ppo": learned["ppo"]._replace(failed=np.array([True, False]))}
    assert learners.visits(weights, one).observation.shape[0] == 2


def test_agents_act_by_their_most_likely_actions_and_their_steps_are_counted(
    bandit, place, monkeypatch
):
    seen = []

    def trained(agent, hyperparameters, key, params, judges):
        seen.append(judges["return"])
        return (), {"return": Episodes(jnp.ones(3), jnp.ones(3), None)}

    monkeypatch.setattr(aggregation, "train_and_judge", trained)
    specs = {"ppo": SPECS["ppo"], "other": SPECS["ppo"]}
    learners = Learners(bandit, specs, place, 2, 3)
    # Two agents of two algorithms, three episodes of 200 steps.
    assert learners.steps == 2 * 2 * 3 * 200
    learners(bandit.init_weights(jax.random.key(0)), jax.random.key(1))
    assert [(judge.mode, judge.episodes) for judge in seen] == [(True, 3)] * 2


def test_a_trajectory_is_cut_where_pendulums_ends():
    env = ContinuousCorridor(cells=1)
    params = env.default_params.replace(max_steps_in_episode=1000, last=5)
    still = Place("corridor", env, params)
    seen = trajectory(still, lambda o, k: jnp.zeros(1), jax.random.key(0), jax.random.key(1))
    assert len(seen.observation) == aggregation.LENGTH == 200


def test_the_latest_fit_is_made_a_better_one_and_the_best_is_kept():
    class Earning:
        steps = 0

        def __init__(self):
            self.returns = iter([3.0, 1.0, 2.0])

        def __call__(self, weights, key):
            return next(self.returns), {}

    improved = []

    def improve(weights, learned, key):
        improved.append(weights)
        return (weights + 1, {}), 0

    (kept, _), _ = best_round((0, {}), Earning(), 2, jax.random.key(0), improve)
    assert improved == [0, 1] and kept == 0


def test_an_expert_below_random_actions_is_refused(bandit, place, monkeypatch):
    worse = Expert(turning, mean_return=-1500.0, environment_steps=7)
    monkeypatch.setattr(warm_start, "find_expert", lambda *arguments: worse)
    message = "the expert of Pendulum-v1 earns -1500 and random actions -1214: give it more steps"
    with pytest.raises(UserError, match=message):
        started(bandit, place, rounds=0)
