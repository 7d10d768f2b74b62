"""What all agents share: evaluation in another environment, and the registry of algorithms."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from gymnax.environments import spaces
from gymnax.wrappers import StickyActionWrapper

from lpo.objectives import load_objective
from scb.agents.agent import Agent, AgentConfig, Algorithm
from scb.agents.normalization import RunningStatistics
from scb.agents.off_policy import OffPolicyState
from scb.agents.ppo import PPO, PPOConfig, PPOHyperparameters
from scb.agents.spec import ALGORITHMS, algorithms_for, bandit_agent, environment_agent
from scb.agents.tables import Setting, Tables
from scb.agents.td3 import TD3, TD3Config, TD3Hyperparameters
from scb.cli import main
from scb.discovery import BanditDiscovery, DiscoveryConfig
from scb.environments.registry import make
from scb.environments.returns import random_return
from scb.environments.synthetic import BanditConfig
from scb.errors import UserError
from scb.spaces import action_size
from scb.warm_start import WarmStartConfig
from tests.scb.probes import ContinuousCorridor, Corridor, CorridorParams, small_agents

# -- what agents are made of
# ------------------------------------------------------------


def test_what_is_no_environment_and_what_is_no_drift_are_told_apart_from_bugs():
    with pytest.raises(UserError, match="the environment is a str: give a gymnax 1"):
        PPO("Pendulum-v1", PPOConfig())
    objective = load_objective("lpo-pendulum")
    env, params = ContinuousCorridor(), CorridorParams()
    with pytest.raises(
        UserError, match="the drift is a Objective, which is no function: of an obj"
    ):
        PPO(env, PPOConfig(), objective)
    agent = PPO(env, PPOConfig(), objective.drift)
    with pytest.raises(
        UserError, match="the agent's drift cannot take the hyperparameters' drift: of an objective"
    ):
        agent.init(jax.random.key(0), PPOHyperparameters(), params)
    with pytest.raises(UserError, match=r"and objective\.parameters as the hyperparameters' drift"):
        jax.jit(agent.train)(jax.random.key(0), PPOHyperparameters(), params)
    with pytest.raises(UserError, match="the agent's drift cannot take"):  # PPO's own clip
        given = PPOHyperparameters(drift=objective.parameters)
        PPO(env, PPOConfig()).init(jax.random.key(0), given, params)
    agent.init(jax.random.key(0), PPOHyperparameters(drift=objective.parameters), params)


def test_a_wrapper_is_refused_whose_step_an_evaluation_would_go_round():
    env = StickyActionWrapper(Corridor(), 1.0)
    with pytest.raises(UserError, match=r"StickyActionWrapper: .* make a subclass of one"):
        PPO(env, PPOConfig())


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"total_steps": 1e4}, r"total_steps is 10000.0: it must be a whole number"),
        ({"num_envs": np.int64(0)}, "num_envs is 0: it must be at least 1"),
        ({"hidden_sizes": 64}, "hidden_sizes is 64: give one size a layer"),
        ({"hidden_sizes": (8, 0)}, r"hidden_sizes\[1\] is 0: it must be at least 1"),
        ({"hidden_sizes": (8.0,)}, r"hidden_sizes\[0\] is 8.0: it must be a whole number"),
    ],
)
def test_settings_that_no_agent_can_have_are_told(setting, message):
    with pytest.raises(UserError, match=message):
        TD3Config(**setting)


class Several(ContinuousCorridor):
    """Observations of several parts."""

    def observation_space(self, params=None):
        return spaces.Dict({"cell": spaces.Discrete(3)})


def test_spaces_of_several_parts_are_told():
    with pytest.raises(
        UserError, match=r"has a gymnax\S*Dict of observations: one Box or Discrete"
    ):
        PPO(Several(), PPOConfig()).init(jax.random.key(0), PPOHyperparameters(), CorridorParams())
    with pytest.raises(UserError, match=r"has a gymnax\S*Tuple of actions: one Box or Discrete"):
        action_size(spaces.Tuple([spaces.Discrete(2)]))


class Unbounded(ContinuousCorridor):
    def action_space(self, params=None):
        return spaces.Box(-jnp.inf, jnp.inf, (1,), jnp.float32)


def test_actions_without_bounds_are_for_ppo_alone():
    env, key = Unbounded(), jax.random.key(0)
    PPO(env, PPOConfig()).init(key, PPOHyperparameters(), env.default_params)
    with pytest.raises(UserError, match="give the environment finite ones"):
        TD3(env, TD3Config()).train(key, TD3Hyperparameters(), env.default_params)
    with pytest.raises(UserError, match="give the environment finite ones"):
        random_return(env, env.default_params, 2)


# -- evaluation in another environment
# ------------------------------------------------------------


@struct.dataclass
class BoundedParams(CorridorParams):
    bound: Any = 4.0


class BoundedCorridor(ContinuousCorridor):
    """Its parameters hold the bound of its actions, as Pendulum's do; they lie in [-bound, bound]."""

    @property
    def default_params(self):
        return BoundedParams()

    def action_space(self, params):
        return spaces.Box(-params.bound, params.bound, (1,), jnp.float32)


def test_the_environment_of_the_evaluation_says_nothing_of_what_the_agents_actions_mean():
    # In the other corridor, whose parameters have no bound, actions are clipped to [-1, 2], and three
    # cells pay 1 - (a - 1/2)^2. The agent's lie in [-4, 4].
    config = TD3Config(hidden_sizes=(4,))
    agent, other = TD3(BoundedCorridor(), config), ContinuousCorridor()
    trained_in = BoundedParams()
    key = jax.random.key(1)
    learner = agent.init_learner(key, TD3Hyperparameters(), trained_in)
    state = OffPolicyState(learner, None, RunningStatistics.start(3), None, 0, key)
    squashed = agent._networks(trained_in)[0].apply(learner.params["policy"], jnp.eye(3))
    actions = np.clip(trained_in.bound * squashed[:, 0], -1, 2)
    assert np.ptp(squashed) > 0.1
    episodes = agent.evaluate(state, key, 1, other, other.default_params, mode=True)
    np.testing.assert_allclose(episodes.returns, np.sum(1 - (actions - 0.5) ** 2), rtol=1e-5)


def test_an_environment_of_other_observations_or_actions_is_refused():
    env, discrete = ContinuousCorridor(), Corridor()
    agent = PPO(env, PPOConfig())
    state = agent.init(jax.random.key(0), PPOHyperparameters(), env.default_params)
    has = "has 3 observations and 1 action dimensions"
    for other, theirs in (
        (discrete, "3 observations and 2 discrete"),
        (ContinuousCorridor(5), "5"),
    ):
        with pytest.raises(UserError, match=f"{has}, .* has {theirs}"):
            agent.evaluate(state, jax.random.key(0), 1, other)


@pytest.mark.parametrize("name", ["ppo", "sac", "dqn"])
@pytest.mark.parametrize("mode", [True, False])
def test_an_agent_that_diverged_earns_no_number(name, mode):
    # Discrete actions would hide it: the likeliest of NaN is action 0.
    env = Corridor()
    with small_agents():
        spec = environment_agent(name, "CartPole-v1")
    agent = spec.agent(env)
    state = jax.jit(agent.init)(jax.random.key(0), spec.hyperparameters, env.default_params)
    earned = jax.jit(lambda s: agent.evaluate(s, jax.random.key(1), 3, mode=mode).returns)
    assert np.isfinite(earned(state)).all()
    broken = jax.tree.map(
        lambda x: x * jnp.nan if jnp.issubdtype(x.dtype, jnp.floating) else x, agent.learned(state)
    )
    if name == "ppo":
        state = state.replace(params=broken)
    else:
        state = state.replace(learner=state.learner.replace(params=broken))
    assert np.isnan(earned(state)).all()


def test_an_agent_says_what_it_takes():
    env = Corridor()
    params = env.default_params
    with pytest.raises(UserError, match="is a TD3Config, and PPO takes a PPOConfig"):
        PPO(env, TD3Config())
    agent = PPO(env, PPOConfig())
    with pytest.raises(
        UserError, match=r"the hyperparameters are of the class CorridorParams: give \(key, PPOHyp"
    ):
        agent.train(jax.random.key(0), params, PPOHyperparameters())
    state = agent.init(jax.random.key(0), PPOHyperparameters(), params)
    with pytest.raises(UserError, match="the environment is a str: give a gymnax 1"):
        agent.evaluate(state, jax.random.key(0), 5, "CartPole-v1")
    with pytest.raises(UserError, match="num_episodes is -1: it must be at least 1"):
        agent.evaluate(state, jax.random.key(0), -1)
    with pytest.raises(UserError, match="horizon is 0: it must be at least 1"):
        agent.evaluate(state, jax.random.key(0), 5, horizon=0)


@pytest.mark.parametrize(
    ("drift", "message"),
    [
        (lambda p, l, a, t: missing, "name 'missing' is not defined"),  # noqa: E741, F821
        (lambda p, l: l, "takes 2 positional arguments but 4 were given"),  # noqa: E741
        (lambda p, l, a, t: 0.0, r"drift returns \(\) for one ratio: give a penalty for each"),  # noqa: E741
        (lambda p, l, a, t: l.sum(), r"drift returns \(\) for one ratio"),  # noqa: E741
    ],
)
def test_a_drift_of_ones_own_that_fails_says_why(drift, message):
    agent = PPO(Corridor(), PPOConfig(), drift)
    with pytest.raises(UserError, match=message):
        agent.init(jax.random.key(0), PPOHyperparameters(), CorridorParams())


@pytest.mark.parametrize(
    ("name", "env"),
    [
        ("ppo", Corridor()),
        ("sac", Corridor()),
        ("dqn", Corridor()),
        ("sac", make("Pendulum-v1")[0]),
        ("td3", make("Pendulum-v1")[0]),
    ],
)
def test_agents_train_where_numbers_have_64_bits(name, env):
    with small_agents():
        spec = environment_agent(name, "Pendulum-v1" if name == "td3" else "CartPole-v1")
    with jax.enable_x64(True):
        agent = spec.agent(env)

        @jax.jit
        def earned(hyperparameters):
            trained = agent.train(jax.random.key(0), hyperparameters, env.default_params)
            return agent.evaluate(trained, jax.random.key(1), 2).returns

        assert np.isfinite(earned(spec.hyperparameters)).all()


# -- a new algorithm: its module and a row of the tables
# --------------------------------------------


@dataclass(frozen=True)
class ConstantConfig(AgentConfig):
    total_steps: int = 3

    @property
    def num_iterations(self) -> int:
        return self.total_steps

    def steps_after(self, num_iterations: int) -> int:
        return num_iterations


@struct.dataclass
class ConstantHyperparameters:
    action: Any = 1.0


class Constant(Agent):
    """Does the same whatever it sees."""

    def init(self, key, hyperparameters, env_params):
        return {"action": jnp.int32(hyperparameters.action), "iteration": jnp.int32(0)}

    def iterate(self, state, hyperparameters, env_params):
        return {**state, "iteration": state["iteration"] + 1}

    def choose(self, state, observation, key, env_params, mode):
        return state["action"]


@pytest.fixture
def constant(monkeypatch):
    algorithm = Algorithm(
        "constant", Constant, ConstantConfig, ConstantHyperparameters, actions=("discrete",)
    )
    tables = Tables(
        algorithm,
        lists={"action": (0.0, 1.0)},
        general=Setting({"total_steps": 5}, "this test"),
        environments={"CartPole-v1": Setting({"total_steps": 7}, "this test")},
    )
    monkeypatch.setitem(ALGORITHMS, algorithm.name, tables)


def test_a_registered_algorithm_is_known_everywhere(constant):
    assert algorithms_for(spaces.Discrete(2)) == ("ppo", "sac", "dqn", "constant")
    assert "constant" not in algorithms_for(spaces.Box(-1, 1, (1,)))
    assert bandit_agent("constant", "CartPole-v1").lists == {"action": (0.0, 1.0)}
    assert environment_agent("constant", "Acrobot-v1").steps == 5
    assert environment_agent("constant", "CartPole-v1").steps == 7
    assert WarmStartConfig(expert="constant").expert == "constant"
    with pytest.raises(UserError, match=r"constant does not fit .* continuous actions"):
        bandit_agent("constant", "Pendulum-v1")


def test_a_registered_algorithm_is_trained_in_a_discovery(constant):
    config = DiscoveryConfig(
        environment="CartPole-v1",
        algorithms=("constant",),
        init="random",
        bandit=BanditConfig(hidden_size=4),
        agents_per_candidate=4,
        evaluation_episodes=2,
    )
    problem = BanditDiscovery(config)
    weights = problem.initial_solution(jax.random.key(0))
    fitness = jax.jit(problem.evaluate)(weights, jax.random.key(1), jnp.int32(0))["fitness"]
    # Pushed to one side all the time, a pole falls within eleven steps at the latest.
    assert fitness.shape == (4,) and 8 <= fitness.min() <= fitness.max() <= 11
    assert problem.steps().training == 4 * 3


def test_a_registered_algorithm_is_one_of_the_command_lines(constant, capsys):
    arguments = ["train", "--bandit", "Synthetic-CartPole-v1", "--agents", "2", "--episodes", "2"]
    assert main([*arguments, "--algorithm", "constant"]) == 0
    assert "IQM" in capsys.readouterr().out
    assert main([*arguments, "--algorithm", "constnat"]) == 2
    assert "did you mean constant" in capsys.readouterr().err
