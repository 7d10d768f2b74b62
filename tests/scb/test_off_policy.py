from collections.abc import Callable
from dataclasses import replace
from functools import cache
from operator import itemgetter
from typing import Any, NamedTuple

import chex
import gymnax
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from gymnax.environments import spaces
from scipy import integrate, stats

import scb
from scb.agents import replay, sac
from scb.agents.dqn import DQN, DQNConfig, DQNHyperparameters
from scb.agents.normalization import RunningStatistics
from scb.agents.off_policy import Moment, Transition, polyak_average, target_values
from scb.agents.sac import SAC, SACConfig, SACHyperparameters
from scb.agents.spec import environment_agent
from scb.agents.td3 import TD3, TD3Config, TD3Hyperparameters, ddpg_config
from scb.environments.registry import environment_names
from scb.environments.synthetic import BanditConfig, SyntheticBandit
from scb.errors import UserError
from scb.population import map_population
from scb.statistics import iqm
from tests.scb.probes import ContinuousCorridor, Corridor, CorridorParams


class Case(NamedTuple):
    """An algorithm with a kind of actions."""

    agent: Callable[..., Any]
    config: Callable[..., Any]
    hyperparameters: Any
    corridor: type[Corridor]

    def make(self, env=None, **fields):
        return self.agent(env or self.corridor(), self.config(**SMALL | fields))

    @property
    def discrete(self):
        return self.corridor is Corridor

    @property
    def space(self):
        return self.corridor().action_space()


CASES = {
    "dqn": Case(DQN, DQNConfig, DQNHyperparameters(double=0.0), Corridor),
    "ddqn": Case(DQN, DQNConfig, DQNHyperparameters(double=1.0), Corridor),
    "discrete sac": Case(SAC, SACConfig, SACHyperparameters(), Corridor),
    "continuous sac": Case(SAC, SACConfig, SACHyperparameters(), ContinuousCorridor),
    "ddpg": Case(TD3, ddpg_config, TD3Hyperparameters(target_noise=0.0), ContinuousCorridor),
    "td3": Case(TD3, TD3Config, TD3Hyperparameters(), ContinuousCorridor),
}
# One of each program: DQN differs from double DQN, and DDPG from TD3, only in how it learns.
PROGRAMS = ["dqn", "discrete sac", "continuous sac", "td3"]
SMALL: dict[str, Any] = {
    "num_envs": 2,
    "prefill": 400,
    "buffer_size": 500,
    "batch_size": 8,
    "gradient_steps": 1,
    "total_steps": 481,
    "hidden_sizes": (4,),
}

each_case = pytest.mark.parametrize("name", CASES)
each_program = pytest.mark.parametrize("name", PROGRAMS)


def in_numpy(tree):
    """Where taking a member is no program."""

    def fetch(x):
        return x if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key) else np.asarray(x)

    return jax.tree.map(fetch, tree)


def flat(tree):
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(tree)])


# -- targets and their networks, by hand
# --------------------------------------------------------------


def test_the_target_bootstraps_unless_the_episode_terminated():
    # 1 + 0.5 * 4 = 3; a terminated step is worth its reward, 2.
    two = np.zeros((2, 1))
    batch = Transition(two, two, np.array([1.0, 2.0]), np.array([0.0, 1.0]), two)
    for last in (4.0, np.inf, np.nan):
        found = target_values(batch, np.array([4.0, last]), 0.5)
        np.testing.assert_array_equal(found, [3.0, 2.0])


def test_a_polyak_of_099_keeps_99_percent_of_the_target():
    # 0.99 * 1 + 0.01 * 3 = 1.02.
    np.testing.assert_allclose(polyak_average({"w": 1.0}, {"w": 3.0}, 0.99)["w"], 1.02)


def constant(params, bias, kernel=0.0):
    """A single layer's parameters with this bias; its kernel is `kernel` for the last input and 0 for the rest.

    Twins are stacked: [2, 1] biases for critics.
    """

    def fill(path, leaf):
        if path[-1].key == "kernel":
            filled = np.zeros_like(leaf)
            filled[..., -1, :] = kernel
            return filled
        return np.full_like(leaf, bias)

    return jax.tree_util.tree_map_with_path(fill, params)


def gradient(optimizer_state):
    """What Adam was given in its first update, ten times its running mean: of the biases, or of a number."""

    def is_adam(x):
        return isinstance(x, optax.ScaleByAdamState)

    (mean,) = (x.mu for x in jax.tree.leaves(optimizer_state, is_leaf=is_adam) if is_adam(x))
    return 10 * np.asarray(
        mean["params"]["MLP_0"]["Dense_0"]["bias"] if isinstance(mean, dict) else mean
    )


def one_transition(action, terminated, size=1):
    """`size` times the same: reward 1, from cell 0 to cell 1."""
    cells = np.eye(3, dtype=np.float32)
    action = np.array(action, np.int32 if isinstance(action, int) else np.float32)
    return Transition(
        observation=np.tile(cells[0], (size, 1)),
        action=np.tile(action, (size, *[1] * action.ndim)),
        reward=np.ones(size, np.float32),
        terminated=np.full(size, terminated, np.float32),
        next_observation=np.tile(cells[1], (size, 1)),
    )


@cache
def linear(name):
    """An agent whose networks are single layers, its first learner, and its jitted `learn` and `explore`."""
    agent = CASES[name].make(hidden_sizes=())
    h, params = CASES[name].hyperparameters, agent.env.default_params
    learner = jax.jit(agent.init_learner)(jax.random.key(0), h, params)
    return agent, learner, jax.jit(agent.learn), jax.jit(agent.explore)


def learn_once(name, learner, batch, key=0, step=0, **hyperparameters):
    agent, _, learn, _ = linear(name)
    h = {"discount": 0.5} | hyperparameters
    h = jax.tree.map(np.float32, CASES[name].hyperparameters.replace(**h))
    moment = Moment(h, agent.env.default_params, step=np.int32(step))
    return learn(learner, batch, jax.random.key(key), moment)


@pytest.mark.parametrize(
    ("name", "terminated", "expected"),
    [("dqn", 0.0, -2.5), ("ddqn", 0.0, -1.5), ("dqn", 1.0, 0.0), ("ddqn", 1.0, 0.0)],
)
def test_double_q_learning_picks_by_the_network_and_judges_by_the_target(
    name, terminated, expected
):
    # Q = (1, 2) and its target (5, 3) everywhere, reward 1, discount 1/2. Q-learning's target is
    # 1 + 5/2 = 3.5; the network prefers action 1, which the target judges 3: 1 + 3/2 = 2.5.
    # The gradient of (Q(s, 0) - target)^2 / 2 is Q - target: -2.5, -1.5, and 0 where it terminates.
    _, learner, *_ = linear(name)
    learner = replace(
        learner,
        params={"q": constant(learner.params["q"], [1.0, 2.0])},
        targets={"q": constant(learner.targets["q"], [5.0, 3.0])},
    )
    after = learn_once(name, learner, one_transition(0, terminated), max_grad_norm=1e9)
    np.testing.assert_allclose(gradient(after.optimizer["q"]), [expected, 0.0], atol=1e-5)


def critics_by_hand(name):
    """A TD3 or DDPG whose critics are 1 and 2 and whose targets' are 5 + a and 3 + a; target policy tanh(0)."""
    agent, learner, *_ = linear(name)
    number = agent.config.num_critics
    params, targets = dict(learner.params), dict(learner.targets)
    params["critics"] = constant(params["critics"], [[1.0], [2.0]][:number])
    targets["critics"] = constant(targets["critics"], [[5.0], [3.0]][:number], kernel=1.0)
    targets["policy"] = constant(targets["policy"], [0.0])
    return replace(learner, params=params, targets=targets)


@pytest.mark.parametrize(
    ("name", "terminated", "expected"),
    [("ddpg", 0.0, [-2.75]), ("td3", 0.0, [-1.75, -0.75]), ("td3", 1.0, [0.0, 1.0])],
)
def test_the_smaller_target_critic_judges_the_target_policys_action(name, terminated, expected):
    # The target policy's tanh(0) is the middle of [-1, 2]: a = 0.5. DDPG: 1 + 5.5/2 = 3.75; TD3:
    # 1 + 3.5/2 = 2.75. Q - target is 1 - 3.75; 1 - 2.75 and 2 - 2.75; and 1 - 1 and 2 - 1 where the
    # episode terminates.
    learner = critics_by_hand(name)
    batch = one_transition([0.0], terminated)
    after = learn_once(name, learner, batch, target_noise=0.0, max_grad_norm=1e9)
    bias = gradient(after.optimizer["critics"])
    np.testing.assert_allclose(bias[:, 0], expected, atol=1e-5)


def test_target_noise_is_clipped_in_units_of_half_the_action_spaces_width():
    # Noise of deviation 10^6, clipped to +-0.4 half widths of 1.5: a = 0.5 +- 0.6, so the target is
    # 1 + (3.5 +- 0.6)/2 = 2.75 +- 0.3, and the first critic's gradient 1 - 2.75 -+ 0.3.
    learner = critics_by_hand("td3")
    noise = {"target_noise": 1e6, "target_noise_clip": 0.4, "max_grad_norm": 1e9}
    batch = one_transition([0.0], 0.0)
    found = {
        round(
            float(
                gradient(learn_once("td3", learner, batch, key, **noise).optimizer["critics"])[0, 0]
            ),
            3,
        )
        for key in range(8)
    }
    assert found == {-2.05, -1.45}


def test_discrete_sac_bootstraps_from_the_expected_soft_value():
    # Policy (3/4, 1/4), target critics (4, 2) and (3, 5), of which the smaller are (3, 2), and a
    # temperature of 2. The entropy is -3/4 ln 3/4 - 1/4 ln 1/4 = 0.5623, so the next state is worth
    # 3/4 * 3 + 1/4 * 2 + 2 * 0.5623 = 3.8747 and the target is 1 + 3.8747/2 = 2.9373. The critics
    # say 0 of everything: their gradient is -2.9373 each for the action taken.
    _, learner, *_ = linear("discrete sac")
    params = {
        "policy": constant(learner.params["policy"], [np.log(3.0), 0.0]),
        "critics": constant(learner.params["critics"], 0.0),
        "log_temperature": np.log(np.float32(2.0)),
    }
    targets = {"critics": constant(learner.targets["critics"], [[4.0, 2.0], [3.0, 5.0]])}
    learner = replace(learner, params=params, targets=targets)
    for terminated, expected in ((0.0, -2.9373), (1.0, -1.0)):
        after = learn_once("discrete sac", learner, one_transition(0, terminated))
        np.testing.assert_allclose(
            gradient(after.optimizer["critics"]), [[expected, 0.0]] * 2, atol=1e-3
        )
        # Temperature: its logarithm's gradient is 2 * (entropy - 0.7 ln 2) = 2 * (0.5623 - 0.4852).
        found = gradient(after.optimizer["log_temperature"])
        np.testing.assert_allclose(found, 0.1542, atol=1e-3)


def test_continuous_sac_bootstraps_from_the_smaller_critic_and_the_entropy():
    # The policy is tanh of a standard normal u; its entropy is 1/2 ln(2 pi e) + E ln(1 - tanh^2 u),
    # by quadrature. The target critics are 5 and 3, the temperature is 2: 1 + (3 + 2 H)/2 = 2.5 + H.
    # H is estimated by 4096 samples of a log-density of deviation about 0.6: error 0.01.
    def log_jacobian(u):
        return stats.norm.pdf(u) * np.log1p(-(np.tanh(u) ** 2))

    entropy = 0.5 * np.log(2 * np.pi * np.e) + integrate.quad(log_jacobian, -8, 8)[0]
    _, learner, *_ = linear("continuous sac")
    params = {
        "policy": constant(learner.params["policy"], 0.0),
        "critics": constant(learner.params["critics"], 0.0),
        "log_temperature": np.log(np.float32(2.0)),
    }
    targets = {"critics": constant(learner.targets["critics"], [[5.0], [3.0]])}
    learner = replace(learner, params=params, targets=targets)
    after = learn_once("continuous sac", learner, one_transition([0.0], 0.0, size=4096))
    found = gradient(after.optimizer["critics"])
    np.testing.assert_allclose(found, np.full((2, 1), -(2.5 + entropy)), atol=0.05)
    # The target entropy is -1: 2 * (H + 1).
    found = gradient(after.optimizer["log_temperature"])
    np.testing.assert_allclose(found, 2 * (entropy + 1), atol=0.1)


def test_the_squashed_density_is_that_of_a_tanh_of_a_normal():
    # Of a = tanh(u), u normal: density(u) / (1 - a^2).
    mean, std = np.float32([0.3, -1.0]), np.float32([0.5, 2.0])
    action, log_prob = jax.jit(sac._sample)(jax.random.key(0), mean, std)
    normal = np.arctanh(np.asarray(action, np.float64))
    expected = stats.norm.logpdf(normal, mean, std) - np.log1p(-(np.asarray(action) ** 2))
    np.testing.assert_allclose(log_prob, expected.sum(), rtol=1e-3)


def test_dqns_target_is_copied_every_so_many_environment_steps():
    # Every 6 steps of 2 environments at a time: after the third and the sixth.
    agent = CASES["dqn"].make(target_update_every=6)
    h = CASES["dqn"].hyperparameters
    _, learner, *_ = linear("dqn")
    update = jax.jit(agent.update_targets)
    copied = []
    for iteration in range(6):
        params = jax.tree.map(lambda x: np.asarray(x) + 1, learner.params)
        learner = update(replace(learner, params=params), h, iteration)
        copied.append(np.array_equal(flat(learner.targets), flat(learner.params)))
    assert copied == [False, False, True, False, False, True]


@pytest.mark.parametrize("name", ["discrete sac", "continuous sac", "ddpg", "td3"])
def test_the_other_targets_move_by_a_share_of_the_way(name):
    # The networks are 1 above their targets: a polyak of 0.75 moves by a quarter.
    agent, learner, *_ = linear(name)
    h = CASES[name].hyperparameters.replace(polyak=0.75)
    ahead = replace(learner, params=jax.tree.map(lambda x: np.asarray(x) + 1, learner.params))
    after = jax.jit(agent.update_targets)(ahead, h, 0)
    np.testing.assert_allclose(flat(after.targets) - flat(learner.targets), 0.25, atol=1e-6)
    assert jax.tree.structure(after) == jax.tree.structure(learner)


@pytest.mark.parametrize(
    ("name", "expected"), [("td3", [False, True, False, True]), ("ddpg", [True] * 4)]
)
def test_td3s_policy_learns_every_second_gradient_step_and_ddpgs_in_each(name, expected):
    _, learner, *_ = linear(name)
    moved = []
    for step in range(4):
        after = learn_once(name, learner, one_transition([0.0], 0.0), step=step)
        moved.append(not np.array_equal(*(flat(x.params["policy"]) for x in (learner, after))))
        assert not np.array_equal(*(flat(x.params["critics"]) for x in (learner, after)))
        learner = after
    assert moved == expected


# -- gathering experience
# -----------------------------------------------------------------------------


CHANGED: dict[type, dict[str, float]] = {
    DQN: {
        "learning_rate": 0.001,
        "discount": 0.1,
        "epsilon_start": 0.0,
        "epsilon_end": 1.0,
        "epsilon_decay": 0.1,
        "max_grad_norm": 1e-6,
        "double": 1.0,
    },
    SAC: {"learning_rate": 0.001, "discount": 0.1, "polyak": 0.1, "target_entropy_ratio": 0.1},
    TD3: {
        "learning_rate": 0.001,
        "discount": 0.1,
        "polyak": 0.1,
        "exploration_noise": 0.9,
        "target_noise": 0.9,
        "target_noise_clip": 0.01,
        "max_grad_norm": 1e-6,
    },
}
# Corridors: one of three cells, one that never ends, one that is cut every two steps (0 -> 1 -> 2),
# and one that ends after two steps in cell 1.
CORRIDORS: dict[str, dict[str, int]] = {
    "whole": {"last": 2, "max_steps_in_episode": 1000},
    "endless": {"last": 1000, "max_steps_in_episode": 1000},
    "cut": {"last": 1000, "max_steps_in_episode": 2},
    "short": {"last": 1, "max_steps_in_episode": 1000},
}


class Population(NamedTuple):
    agent: Any
    members: dict[str, Any]  # {name: (key, hyperparameters, params)}
    states: Any  # [N]

    def state(self, member):
        return jax.tree.map(itemgetter(list(self.members).index(member)), self.states)


@cache
def population(name):
    """One program's agents: the defaults in each corridor, and in the whole one with one number changed."""
    case = CASES[name]
    agent = case.make(
        normalize_observations=True, **{"target_update_every": 1000} if case.agent is DQN else {}
    )
    defaults = case.hyperparameters
    if case.agent is DQN:
        # Most steps are prefill: exploration is to fall until the last one.
        defaults = defaults.replace(epsilon_decay=1.0)
    rewards = np.float32([[1.0, 0.0, 0.2], [0.0, 1.0, 0.3], [1.0, 0.0, 0.0]])
    members = {}
    for i, (corridor, fields) in enumerate(CORRIDORS.items()):
        params = CorridorParams(rewards=rewards, **fields)
        members[corridor] = (jax.random.key(i), defaults, params)
    key, h, params = members["whole"]
    for hyperparameter, value in CHANGED[case.agent].items():
        members[hyperparameter] = (key, h.replace(**{hyperparameter: value}), params)
    keys, *numbers = zip(*members.values(), strict=True)
    stacked = (jax.tree.map(lambda *x: np.stack(x), *column) for column in numbers)
    states = jax.jit(jax.vmap(agent.train))(jnp.stack(keys), *stacked)
    return Population(agent, members, in_numpy(states))


@each_program
def test_the_prefill_is_uniformly_random(name):
    # The first 400 of the steps.
    actions = np.asarray(population(name).state("endless").buffer.transitions.action)[:400]
    if CASES[name].discrete:
        assert stats.chisquare(np.bincount(actions, minlength=2)).pvalue > 1e-4
    else:
        assert stats.kstest(actions[:, 0], stats.uniform(-1.0, 3.0).cdf).pvalue > 1e-4


def test_random_actions_of_the_prefill_can_be_held():
    # 2 environments, 200 steps each: 10 blocks of 20 equal actions, the blocks drawn independently.
    env = ContinuousCorridor()
    agent = SAC(env, SACConfig(**SMALL | {"prefill_hold": 20}))
    state = jax.jit(agent.init)(jax.random.key(3), SACHyperparameters(), env.default_params)
    actions = np.asarray(state.buffer.transitions.action)[:400].reshape(10, 20, 2)
    assert (actions == actions[:, :1]).all()
    assert len(np.unique(actions[:, 0].round(6), axis=0)) > 3
    assert (actions[:, 0, 0] != actions[:, 0, 1]).any()


def test_epsilon_falls_linearly_over_its_fraction_of_the_training():
    # From 1 to 0.2 over half the training: 0.6 after a quarter. Half of the random actions of two
    # are the greedy one: 0.5, 0.3 and 0.1 are not. The error of a share of 4000 is 0.008.
    agent, learner, _, explore = linear("dqn")
    learner = replace(learner, params={"q": constant(learner.params["q"], [1.0, 0.0])})
    h = DQNHyperparameters(epsilon_start=1.0, epsilon_end=0.2, epsilon_decay=0.5)
    for progress, expected in ((0.0, 0.5), (0.25, 0.3), (0.5, 0.1), (1.0, 0.1)):
        moment = Moment(h, agent.env.default_params, progress)
        actions = explore(learner, np.ones((4000, 3), np.float32), jax.random.key(0), moment)
        np.testing.assert_allclose(np.mean(np.asarray(actions)), expected, atol=0.03)


@pytest.mark.parametrize("name", ["ddpg", "td3"])
def test_exploration_noise_is_in_units_of_half_the_action_spaces_width(name):
    # Around the middle of [-1, 2], deviation 0.2 * 1.5 = 0.3; its error is 0.3 / sqrt(2 * 4000).
    agent, learner, _, explore = linear(name)
    params = learner.params | {"policy": constant(learner.params["policy"], [0.0])}
    moment = Moment(TD3Hyperparameters(exploration_noise=0.2), agent.env.default_params)
    learner = replace(learner, params=params)
    actions = explore(learner, np.ones((4000, 3), np.float32), jax.random.key(0), moment)
    np.testing.assert_allclose(np.mean(actions), 0.5, atol=0.02)
    np.testing.assert_allclose(np.std(actions), 0.3, atol=0.015)


@each_program
def test_a_training_takes_as_many_steps_as_it_says_and_stores_them_all(name):
    # 481 steps, 400 of them prefill, are rounded up to whole steps of 2 environments:
    # 400 + 41 * 2 = 482, so in a corridor that never ends each environment has come 241 steps.
    agent, _, _ = population(name)
    assert (agent.config.num_iterations, agent.config.num_environment_steps) == (41, 482)
    state = population(name).state("endless")
    np.testing.assert_array_equal(state.environment[0].time, [241, 241])
    assert int(state.buffer.written) == 482 and int(state.iteration) == 41
    # Cells 0 1 2 in turns, 80 times, and cell 0 once more; the variance of a share is p (1 - p).
    share = np.array([81, 80, 80]) / 241
    np.testing.assert_array_equal(state.statistics.count, 482)
    np.testing.assert_allclose(state.statistics.mean, share, atol=1e-5)
    np.testing.assert_allclose(state.statistics.squares / 482, share * (1 - share), atol=1e-5)


@each_program
@pytest.mark.parametrize("corridor", ["cut", "short"])
def test_what_follows_a_step_is_stored_as_it_was_before_the_automatic_reset(name, corridor):
    # Cells 0 and 1 in turns, followed by 1 and 2 though the next episode starts in cell 0. In the
    # short corridor every second step terminates; in the one that is merely cut, none does.
    buffer = population(name).state(corridor).buffer
    steps = jax.tree.map(
        lambda x: np.asarray(x[:482]).reshape(241, 2, *x.shape[1:]), buffer.transitions
    )
    turn = np.tile((np.arange(241) % 2)[:, None], (1, 2))
    np.testing.assert_array_equal(steps.observation.argmax(-1), turn)
    np.testing.assert_array_equal(steps.next_observation.argmax(-1), turn + 1)
    np.testing.assert_array_equal(steps.terminated, turn if corridor == "short" else 0 * turn)


# -- known values
# -------------------------------------------------------------------------------------

PROBES = {
    # name: (rewards of the three cells, last, random_start, single_step, max_steps, discount)
    "reward 1": ((1, 1, 1), 0, 0, 0, 100, 0.9),
    "reward of the observation": ((-1, 1, 0.5), 1000, 1, 1, 100, 0.9),
    "a step before the reward": ((0, 1, 0), 1, 0, 0, 100, 0.9),
    "cut every two steps": ((0, 1, 0), 1000, 1, 0, 2, 0.5),
    "reward of the action": ((0, 0, 0), 0, 0, 0, 100, 0.9),
    "reward of both": ((0, 0, 0), 1000, 1, 1, 100, 0.9),
}
# Values where the action doesn't matter, of the cells that are visited:
#   one step: the reward.
#   a step before: Q(1) = 1, Q(0) = 0.9 * 1.
#   cut: the endless corridor of 3 cells of which cell 1 pays 1, at discount 1/2:
#     Q(1) = 1 + Q(1) / 8 = 8/7, Q(0) = Q(1) / 2 = 4/7, Q(2) = Q(1) / 4 = 2/7.
#   Without bootstrapping at the cut Q(2) would be about 0, as cell 1 is two steps away.
STATE_VALUES = {
    "reward 1": [1.0],
    "reward of the observation": [-1.0, 1.0, 0.5],
    "a step before the reward": [0.9, 1.0],
    "cut every two steps": [4 / 7, 8 / 7, 2 / 7],
}
# Discrete: what the two actions pay in each cell. Continuous: -|a - target|^2 / 2, by its target.
DISCRETE_REWARDS = {
    "reward of the action": [[0.0, 1.0]],
    "reward of both": [[1.0, 0.0], [0.0, 1.0], [1.0, 0.0]],
}
TARGETS = {"reward of the action": [1.25], "reward of both": [-0.5, 0.5, 1.5]}
ACTIONS = np.array([-1.0, 0.5, 2.0])


def expected_values(name, case):
    """[cells, actions] of the cells that a probe visits; continuous ones at ACTIONS."""
    if name in STATE_VALUES:
        return np.array(STATE_VALUES[name])[:, None]
    if case.discrete:
        return np.array(DISCRETE_REWARDS[name])
    return -0.5 * (ACTIONS - np.array(TARGETS[name])[:, None]) ** 2


def probe_rewards(case):
    """[probes, cells, 2 | 3] parameters of the corridors."""
    rewards = []
    for name, (cells, *_) in PROBES.items():
        if case.discrete:
            table = np.repeat(np.array(cells, float)[:, None], 2, axis=1)
            rows = DISCRETE_REWARDS.get(name, [])
        else:
            table = np.stack([np.array(cells, float), np.zeros(3), np.zeros(3)], axis=1)
            rows = [[0.0, 0.5, target] for target in TARGETS.get(name, [])]
        for cell, row in enumerate(rows):
            table[cell] = row
        rewards.append(table)
    return np.stack(rewards)


def q_values(agent, learner, params):
    """[critics, cells, actions]."""
    cells = np.eye(3)
    if isinstance(agent, DQN):
        return agent._network(params).apply(learner.params["q"], cells)[None]
    _, critics = agent._networks(params)
    if isinstance(agent.env.action_space(params), spaces.Discrete):
        return critics.apply(learner.params["critics"], cells)
    pairs = [(cell, [action]) for cell in cells for action in ACTIONS]
    observation, action = (np.stack(column) for column in zip(*pairs, strict=True))
    q = critics.apply(learner.params["critics"], observation, action)
    return q.reshape(-1, 3, len(ACTIONS))


@cache
def probe_program(name):
    """jit of [N] keys, hyperparameters, params -> ([N] values, greedy actions, learners)."""
    case = CASES[name]
    agent = case.make(
        num_envs=4,
        prefill=1600,
        buffer_size=4800,
        batch_size=64,
        total_steps=1600 + 4 * 800,
        hidden_sizes=(16,),
        **{"target_update_every": 40} if case.agent is DQN else {},
    )

    def train(key, h, params):
        state = agent.train(key, h, params)
        greedy = jax.vmap(lambda c: agent.act(state, c, key, params, mode=True))(jnp.eye(3))
        return q_values(agent, state.learner, params), greedy.reshape(3), state.learner

    return jax.jit(jax.vmap(train, in_axes=(0, 0, 0)))


@cache
def probe_agents(name):
    """{probe: ([critics, cells, actions] values, [cells] greedy actions, learner)}."""
    case = CASES[name]
    number = len(PROBES)
    columns = [np.array(column) for column in zip(*[p[1:] for p in PROBES.values()], strict=True)]
    last, random_start, single_step, max_steps, discount = columns
    params = CorridorParams(
        rewards=probe_rewards(case),
        last=last,
        random_start=random_start,
        single_step=single_step,
        max_steps_in_episode=max_steps,
    )
    h = jax.tree.map(lambda x: np.full(number, x), case.hyperparameters)
    h = h.replace(learning_rate=np.full(number, 0.01), discount=discount)
    program = probe_program("dqn" if case.agent is DQN else name)
    outcomes = program(jax.random.split(jax.random.key(0), number), h, params)
    return {
        probe: jax.tree.map(lambda x, i=i: np.asarray(x[i]), outcomes)
        for i, probe in enumerate(PROBES)
    }


@each_case
@pytest.mark.parametrize("probe", PROBES)
def test_the_values_of_a_probe_are_learned(name, probe):
    values, _, _ = probe_agents(name)[probe]
    expected = expected_values(probe, CASES[name])
    found = values[:, : len(expected)]
    # A parabola falls to -3 at the ends of the action space, where few steps are taken.
    atol = 0.1 if probe in STATE_VALUES or CASES[name].discrete else 0.2
    np.testing.assert_allclose(
        found, np.broadcast_to(expected, found.shape), atol=atol, rtol=atol / 2
    )


@each_case
@pytest.mark.parametrize("probe", TARGETS)
def test_the_best_actions_of_a_probe_are_learned(name, probe):
    _, greedy, _ = probe_agents(name)[probe]
    if CASES[name].discrete:
        best = np.argmax(DISCRETE_REWARDS[probe], axis=1)
        np.testing.assert_array_equal(greedy[: len(best)], best)
    else:
        best = np.array(TARGETS[probe])
        np.testing.assert_allclose(greedy[: len(best)], best, atol=0.15)


@pytest.mark.parametrize("probe", TARGETS)
def test_sacs_temperature_makes_the_policy_as_random_as_asked(probe):
    # Two actions that pay 1 and 0: the soft optimum takes the better one with probability
    # p = 1 / (1 + exp(-1 / temperature)). Its entropy is to be 0.7 ln 2 = 0.4852, which is that of
    # p = 0.811: -0.811 ln 0.811 - 0.189 ln 0.189 = 0.170 + 0.315. So 1 / temperature =
    # ln(0.811 / 0.189) = 1.456, temperature = 0.687.
    _, _, learner = probe_agents("discrete sac")[probe]
    agent = CASES["discrete sac"].make(hidden_sizes=(16,))
    policy, _ = agent._networks(agent.env.default_params)
    best = np.array(DISCRETE_REWARDS[probe])
    apply = jax.jit(lambda params, cells: policy.apply(params, cells).probs)
    probability = np.asarray(apply(learner.params["policy"], np.eye(3)))[: len(best)]
    np.testing.assert_allclose((probability * best).sum(1), 0.811, atol=0.05)
    np.testing.assert_allclose(np.exp(learner.params["log_temperature"]), 0.687, atol=0.1)


# -- populations
# --------------------------------------------------------------------------------------


@each_program
def test_every_hyperparameter_has_an_effect(name):
    changed = CHANGED[CASES[name].agent]
    assert set(changed) == set(CASES[name].hyperparameters.__dataclass_fields__)
    base = flat(population(name).state("whole").learner.params)
    for hyperparameter in changed:
        other = flat(population(name).state(hyperparameter).learner.params)
        effect = np.abs(other - base).max()
        if (name, hyperparameter) == ("continuous sac", "target_entropy_ratio"):
            assert effect == 0.0  # continuous actions aim at an entropy of -A
        else:
            assert effect > 1e-5, hyperparameter


@pytest.mark.parametrize("name", ["dqn", "td3"])
def test_a_member_of_a_population_is_the_agent_that_is_trained_alone(name):
    # Other keys, other corridors, other hyperparameters. (SAC's turn is below, in bandits.)
    train = jax.jit(population(name).agent.train)
    for member in (*CORRIDORS, "learning_rate", "discount"):
        alone = train(*population(name).members[member])
        together = population(name).state(member)
        chex.assert_trees_all_close(together.learner.params, alone.learner.params, atol=1e-4)
        chex.assert_trees_all_close(together.statistics, alone.statistics, atol=1e-4)


def bandit(space, kind=SyntheticBandit, key=3):
    """A one-step bandit of random weights with 3 observations."""
    config = BanditConfig(hidden_size=8)
    weights = jax.jit(SyntheticBandit(3, space, config).init_weights)(jax.random.key(key))
    return kind(3, space, config, weights=weights, name="Synthetic-Random")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["discrete sac", "continuous sac"])
def test_bandits_of_different_weights_train_together_as_they_do_alone(name):
    case = CASES[name]
    env = bandit(case.space)
    agent = case.make(env)
    key_weights, key_train = jax.random.split(jax.random.key(2))
    bandits = jax.vmap(lambda key: env.params(env.init_weights(key)))(
        jax.random.split(key_weights, 2)
    )
    hyperparameters = jax.tree.map(lambda x: jnp.full(2, x), case.hyperparameters)
    hyperparameters = hyperparameters.replace(learning_rate=jnp.array([0.001, 0.005]))
    arguments = jax.random.split(key_train, 2), hyperparameters, bandits
    states = jax.jit(jax.vmap(agent.train))(*arguments)
    alone = jax.jit(agent.train)
    for i in range(2):
        together = jax.tree.map(itemgetter(i), states)
        key, h, params = jax.tree.map(itemgetter(i), arguments)
        chex.assert_trees_all_close(
            together.learner.params, alone(key, h, params).learner.params, atol=1e-4
        )
        # What it stored: in contexts of this bandit, what the actions pay in it.
        assert int(together.buffer.written) == 482
        stored = jax.tree.map(lambda x: x[:482], together.buffer.transitions)
        pays = jax.vmap(env.mean_reward, in_axes=(0, 0, None))
        expected = pays(stored.observation, stored.action, params)
        np.testing.assert_allclose(stored.reward, expected, atol=1e-5)
        np.testing.assert_array_equal(stored.terminated, 1.0)
        contexts, _ = jax.vmap(env.reset_env, in_axes=(0, None))(
            jax.random.split(jax.random.key(5), 1000), params
        )
        assert stats.ks_2samp(stored.observation[:, 0], contexts[:, 0]).pvalue > 1e-4


@each_program
def test_the_buffers_write_position_is_shared_by_a_population(name):
    # `out_axes=None` is refused by vmap for whatever depends on the member. A position for each
    # member would turn every write into a scatter, and every delayed update into both branches.
    case = CASES[name]
    agent = case.make()
    params = agent.env.default_params
    state = jax.eval_shape(agent.init, jax.random.key(0), case.hyperparameters, params)
    axes = jax.tree.map(lambda _: 0, state)
    axes = replace(axes, buffer=replace(axes.buffer, written=None), iteration=None)
    train = jax.vmap(lambda key: agent.train(key, case.hyperparameters, params), out_axes=axes)
    states = jax.eval_shape(train, jax.random.split(jax.random.key(0), 3))
    assert states.buffer.written.shape == () and states.iteration.shape == ()
    assert states.buffer.transitions.reward.shape == (3, SMALL["buffer_size"])


# -- one-step environments
# ----------------------------------------------------------------------------


class Unmarked(SyntheticBandit):
    """The same bandit, not known to have episodes of one step."""

    one_step = False


def critics_and_policy(learner, name):
    """What both paths train: TD3's second critic has no part in one-step environments."""
    if name == "td3":
        first = jax.tree.map(lambda x: x[:1], learner.params["critics"])
        return learner.params | {"critics": first}
    return learner.params


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name in ("td3", "discrete sac") else ())
        for name in PROGRAMS
    ],
)
def test_learning_in_a_one_step_environment_is_learning_from_terminated_steps(name):
    # Twenty gradient steps of both programs on the same batches. Where every step terminates the
    # targets are the rewards, whatever the target networks say. The norm of TD3's gradient has two
    # critics in it, hence no clipping.
    case = CASES[name]
    space = case.space
    marked, unmarked = (case.make(bandit(space, kind)) for kind in (SyntheticBandit, Unmarked))
    assert marked.one_step and not unmarked.one_step
    params = marked.env.default_params
    h = case.hyperparameters
    if "max_grad_norm" in h.__dataclass_fields__:
        h = h.replace(max_grad_norm=1e9)
    key_init, key_data, key_learn = (jax.random.key(i) for i in range(3))
    # Data of the unmarked bandit's own.
    buffer = jax.jit(unmarked.init)(key_data, h, params).buffer
    np.testing.assert_array_equal(buffer.transitions.terminated[: SMALL["prefill"]], 1.0)

    def learn(agent, buffer):
        def step(learner, number):
            key_sample, key_step = jax.random.split(jax.random.fold_in(key_learn, number))
            batch = replay.sample(buffer, key_sample, 8)
            return agent.learn(learner, batch, key_step, Moment(h, params, step=number)), None

        start = agent.init_learner(key_init, h, params)
        end, _ = jax.lax.scan(step, start, jnp.arange(20))
        return critics_and_policy(start, name), critics_and_policy(end, name)

    starts, ends = zip(
        *[jax.jit(learn, static_argnums=0)(a, buffer) for a in (marked, unmarked)], strict=True
    )
    chex.assert_trees_all_close(*starts, rtol=1e-5)
    chex.assert_trees_all_close(*ends, atol=1e-5)
    assert np.abs(flat(ends[0]) - flat(starts[0])).max() > 0.01


# -- acting and evaluating
# ----------------------------------------------------------------------------


@each_program
def test_actions_have_the_spaces_dtype_and_shape_and_stay_within_its_bounds(name):
    # Observations far beyond any that was seen drive the networks to their extremes.
    agent, state, space = population(name).agent, population(name).state("whole"), CASES[name].space
    observations = 100.0 * np.random.default_rng(2).normal(size=(64, 3))
    for mode in (True, False):
        act = jax.jit(
            lambda o, k, mode=mode: jax.vmap(lambda o, k: agent.act(state, o, k, mode=mode))(
                o, jax.random.split(k, len(o))
            )
        )
        actions = act(observations, jax.random.key(1))
        assert actions.shape == (64, *space.shape) and actions.dtype == space.dtype
        low, high = (0, space.n - 1) if CASES[name].discrete else (space.low, space.high)
        assert np.all((actions >= low) & (actions <= high)) and len(np.unique(actions)) > 1


@pytest.mark.parametrize("name", ["continuous sac", "td3"])
@pytest.mark.parametrize("dtype", [jnp.int32, jnp.float16, jnp.float32])
def test_actions_are_stored_as_they_were_taken_whatever_type_the_space_has(name, dtype):
    agent = CASES[name].make(bandit(spaces.Box(0, 3, (2,), dtype)))
    given = CASES[name].hyperparameters, agent.env.default_params
    stored = jax.eval_shape(agent.init, jax.random.key(0), *given).buffer.transitions.action
    assert (stored.dtype, stored.shape[1:]) == (jnp.float32, (2,))


@pytest.mark.parametrize("name", ["continuous sac", "td3"])
def test_every_dimension_of_an_action_has_its_own_bounds(name):
    # A 2 x 2 action. Observations beyond any that was seen drive the networks to their extremes.
    low, high = np.float32([[-1.0, 0.0], [5.0, -9.0]]), np.float32([[1.0, 0.5], [6.0, 9.0]])
    agent = CASES[name].make(bandit(spaces.Box(low, high, (2, 2), jnp.float32)))
    h, params = CASES[name].hyperparameters, agent.env.default_params
    state = jax.jit(agent.init)(jax.random.key(0), h, params)
    observations = 1e4 * np.random.default_rng(2).normal(size=(200, 3))
    act = jax.jit(jax.vmap(lambda o: agent.act(state, o, jax.random.key(1), mode=True)))
    actions = act(observations)
    assert actions.shape == (200, 2, 2)
    stored = np.asarray(state.buffer.transitions.action)[: SMALL["prefill"]]
    for taken in (np.asarray(actions), stored):
        assert np.all((taken >= low) & (taken <= high))
    # The random ones come within a tenth of the width of either end.
    assert np.all(stored.min(axis=0) < low + 0.1 * (high - low))
    assert np.all(stored.max(axis=0) > high - 0.1 * (high - low))


@each_program
def test_evaluation_normalises_by_the_frozen_statistics(name):
    # Mean 0.3 and variance 4: the cell's observation 1 becomes (1 - 0.3) / 2 = 0.35, 0 becomes
    # -0.15, which an agent that doesn't normalise is given as it is.
    agent, plain = population(name).agent, CASES[name].make()
    frozen = RunningStatistics(np.float32(10.0), np.full(3, 0.3), np.full(3, 40.0))
    state = replace(population(name).state("whole"), statistics=frozen)

    def act(agent, observations):
        return jax.vmap(lambda o: agent.act(state, o, jax.random.key(1), None, False))(observations)

    by_hand = np.where(np.eye(3, dtype=bool), 0.35, -0.15)
    found, expected = jax.jit(lambda: (act(agent, np.eye(3)), act(plain, by_hand)))()
    np.testing.assert_allclose(found, expected, atol=1e-5)
    # Nothing is learned from evaluation episodes: the second of two equal ones is like the first.
    evaluate = jax.jit(lambda key: agent.evaluate(state, key, 4))
    first, second = (evaluate(jax.random.key(0)) for _ in range(2))
    np.testing.assert_array_equal(first.returns, second.returns)
    assert first.returns.shape == (4,)


def test_training_normalises_what_it_learns_from():
    # In a corridor that stays in cell 0 all inputs are normalised to 0 (no variance): kernels get no
    # gradient, only biases do.
    agent = CASES["dqn"].make(hidden_sizes=(), normalize_observations=True)
    params = agent.env.default_params.replace(last=0)
    h = CASES["dqn"].hyperparameters
    start = jax.jit(agent.init)(jax.random.key(0), h, params)
    end = jax.jit(agent.train_iterations, static_argnums=3)(start, h, params, 5)
    before, after = (s.learner.params["q"]["params"]["MLP_0"]["Dense_0"] for s in (start, end))
    np.testing.assert_allclose(after["kernel"][0], before["kernel"][0], atol=1e-6)
    assert np.abs(after["bias"] - before["bias"]).max() > 1e-3


@pytest.mark.parametrize(
    ("every", "expected"), [(10, [0, 10, 20]), (8, [0, 8, 16, 20]), (30, [0, 20])]
)
def test_evaluations_happen_before_the_first_after_every_nth_iteration_and_at_the_end(
    every, expected
):
    # 440 steps, 400 of them prefill, in twos: 20 iterations.
    agent, h = CASES["dqn"].make(total_steps=440), CASES["dqn"].hyperparameters
    params = agent.env.default_params
    state, iterations = jax.jit(
        lambda key: agent.train_with_evaluations(
            key, h, params, lambda state, _: state.iteration, every
        )
    )(jax.random.key(0))
    np.testing.assert_array_equal(iterations, expected)
    assert state.iteration == 20


# MNISTBandit downloads its pictures when it is made; Brax takes a minute to trace.
@pytest.mark.parametrize(
    "environment",
    [
        # MinAtar's compile longest.
        pytest.param(n, marks=pytest.mark.slow) if n.endswith("MinAtar") else n
        for n in environment_names()
        if n in gymnax.registered_envs and "MNIST" not in n
    ],
)
def test_every_environment_can_be_trained_in(environment):
    # Traced only. A scan refuses a state whose shapes or dtypes change, a buffer another dtype.
    env, params = scb.make(environment)
    agent = SAC(env, SACConfig(**SMALL))
    state = jax.eval_shape(agent.train, jax.random.key(0), SACHyperparameters(), params)
    assert state.buffer.transitions.observation.dtype == jnp.float32


# -- what is refused
# ----------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [SACConfig, DQNConfig, TD3Config, ddpg_config])
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_envs": 0}, "num_envs is 0: it must be at least 1"),
        ({"buffer_size": 0}, "buffer_size is 0: it must be at least 1"),
        ({"prefill": 0}, "prefill is 0: it must be at least 1"),
        ({"prefill_hold": 0}, "prefill_hold is 0: it must be at least 1"),
        ({"batch_size": -1}, "batch_size is -1: it must be at least 1"),
        ({"gradient_steps": 0}, "gradient_steps is 0: it must be at least 1"),
        ({"total_steps": 0}, "total_steps is 0: it must be at least 1"),
        (
            {"num_envs": 3},
            "prefill is 1000, which 3 environments side by side cannot .*a multiple of 3",
        ),
        ({"buffer_size": 999}, "prefill is 1000, more than the replay buffer's 999"),
        ({"total_steps": 1000}, "prefill is 1000, which leaves nothing of 1000 steps to learn in"),
        ({"activation": "tan"}, "unknown activation 'tan': did you mean tanh?"),
    ],
)
def test_impossible_configurations_are_refused(make, arguments, message):
    with pytest.raises(UserError, match=message):
        make(**arguments)


@pytest.mark.parametrize(
    ("make", "field"),
    [(DQNConfig, "target_update_every"), (TD3Config, "num_critics"), (TD3Config, "policy_delay")],
)
def test_counts_of_one_algorithm_are_at_least_one(make, field):
    with pytest.raises(UserError, match=f"{field} is 0: it must be at least 1"):
        make(**{field: 0})


@pytest.mark.parametrize(
    ("name", "env", "message"),
    [
        (
            "dqn",
            ContinuousCorridor(),
            "dqn needs discrete actions, .*has continuous ones: use an algorithm",
        ),
        ("td3", Corridor(), "td3 needs continuous actions, .*has discrete ones: use an algorithm"),
        (
            "ddpg",
            Corridor(),
            "ddpg needs continuous actions, .*has discrete ones: use an algorithm",
        ),
    ],
)
def test_an_action_space_that_does_not_fit_is_answered_in_one_sentence(name, env, message):
    agent = CASES[name].make(env)
    with pytest.raises(UserError, match=message) as error:
        agent.init(jax.random.key(0), CASES[name].hyperparameters, env.default_params)
    assert str(error.value).endswith(".") and ". " not in str(error.value)


# -- real environments
# --------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["sac", "td3", "ddpg"])
def test_pendulum_is_learned_with_the_general_settings(algorithm):
    # The best policies lose 100 to 200, depending on where an episode starts; a random one loses
    # about 1200. Mode actions, 10 episodes a seed; the interquartile mean leaves out the best and
    # the worst seed.
    evaluations = evaluated_along_the_training("Pendulum-v1", algorithm, num_seeds=5)
    assert iqm(evaluations[:, -1]) >= -200.0, evaluations


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["dqn", "sac"])
def test_cartpole_is_solved_with_the_general_settings(algorithm):
    # 500 is the most that it pays. Off-policy agents find it and lose it again: what counts is that
    # an evaluation along the way shows it, of the median seed.
    evaluations = evaluated_along_the_training("CartPole-v1", algorithm, num_seeds=3)
    assert np.median(evaluations.max(axis=1)) == 500.0, evaluations


def evaluated_along_the_training(environment, algorithm, num_seeds):
    """[S, P] returns at about ten points of the training."""
    env, params = scb.make(environment)
    spec = environment_agent(algorithm, environment)
    agent = spec.agent(env)
    iterations = spec.config.num_iterations
    every = min(
        (n for n in range(1, iterations + 1) if iterations % n == 0),
        key=lambda n: abs(iterations / n - 10),
    )

    def returns(key):
        def judge(state, key):
            return agent.evaluate(state, key, 10, mode=True).returns.mean()

        return agent.train_with_evaluations(key, spec.hyperparameters, params, judge, every)[1]

    keys = jax.random.split(jax.random.key(7), num_seeds)
    return map_population(returns, num_seeds, (0,))(keys)
