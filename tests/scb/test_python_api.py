"""What a caller in Python gets wrong is told in a sentence, before anything is trained."""

import json
from dataclasses import dataclass
from pathlib import Path

import gymnasium
import gymnax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from gymnax.environments import environment

import lpo
import scb
from lpo.inner_loop import MetaTrainingConfig
from lpo.meta_training import meta_train
from scb.configurations import config_dict
from scb.discovery import BanditDiscovery, DiscoveryConfig, discover
from scb.errors import UserError, at_least
from scb.evolution import EvolutionConfig
from scb.runs import read_config, run_of

KEY = jax.random.key(0)


@pytest.fixture(scope="module")
def bandit():
    return gymnax.make("Synthetic-Pendulum-v1")


def test_parameters_of_another_environment_are_refused(bandit):
    env, params = bandit
    pendulum, pendulum_params = gymnax.make("Pendulum-v1")
    said = "are of the class EnvParams, and those of Synthetic-Pendulum-v1 of BanditParams"
    for agent, hyperparameters in (
        (scb.PPO(env, scb.PPOConfig()), scb.PPOHyperparameters()),
        (scb.SAC(env, scb.SACConfig()), scb.SACHyperparameters()),
    ):
        with pytest.raises(UserError, match=said):
            agent.train(KEY, hyperparameters, pendulum_params)
    agent = scb.PPO(env, scb.PPOConfig(total_steps=100))
    state = agent.init(KEY, scb.PPOHyperparameters(), params)
    with pytest.raises(UserError, match=r"of the class BanditParams, and those of Pendulum-v1 of"):
        agent.evaluate(state, KEY, 1, pendulum, params)
    assert agent.evaluate(state, KEY, 2, pendulum, pendulum_params).returns.shape == (2,)


def test_classes_of_one_name_are_told_by_their_modules():
    env, _ = gymnax.make("Pendulum-v1")
    agent = scb.PPO(env, scb.PPOConfig())
    said = r"class gymnax\..*cartpole\.EnvParams, and those of .* of gymnax\..*pendulum\.EnvParams"
    with pytest.raises(UserError, match=said):
        agent.train(KEY, scb.PPOHyperparameters(), gymnax.make("CartPole-v1")[1])


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"learning_rate": -1e-3}, "learning_rate has the value -0.001: it must be 0 or larger"),
        ({"discount": 1.5}, "discount has the value 1.5: it must be between 0 and 1"),
        ({"gae_lambda": np.float32(5.0)}, "gae_lambda has the value 5.0: it must be between"),
        ({"learning_rate": float("nan")}, "learning_rate has the value nan, which is no number"),
        ({"learning_rate": "a"}, "learning_rate has the value 'a', which is no number"),
        ({"learning_rate": np.ones(2)}, r"learning_rate has the shape \(2,\): give one number"),
        ({"discount": jnp.ones((1, 1))}, r"discount has the shape \(1, 1\): give one number"),
        (
            {"learning_rate": jnp.float32(jnp.nan)},
            "learning_rate has the value nan, which is no num",
        ),
        (
            {"gae_lambda": True},
            "gae_lambda has the value True, which is no number that an agent can",
        ),
    ],
)
def test_what_no_agent_can_be_trained_with_is_refused(values, message, bandit):
    env, params = bandit
    agent = scb.PPO(env, scb.PPOConfig())
    with pytest.raises(UserError, match=message):
        agent.init(KEY, scb.PPOHyperparameters(**values), params)
    spec = scb.environment_agent("ppo", "Pendulum-v1")
    with pytest.raises(UserError, match=message):
        spec.with_values(**values)


@pytest.mark.parametrize(
    ("agent", "hyperparameters"),
    [
        (scb.PPO, scb.PPOHyperparameters(learning_rate=None)),
        (scb.PPO, scb.PPOHyperparameters(entropy_coefficient=None)),
        (scb.SAC, scb.SACHyperparameters(learning_rate=None)),
        (scb.TD3, scb.TD3Hyperparameters(exploration_noise=None)),
    ],
)
def test_a_number_that_is_none_is_refused(agent, hyperparameters, bandit):
    env, params = bandit
    config = {scb.PPO: scb.PPOConfig, scb.SAC: scb.SACConfig, scb.TD3: scb.TD3Config}[agent]()
    with pytest.raises(UserError, match=r"has the value None, which is no number"):
        agent(env, config).init(KEY, hyperparameters, params)


def test_numpys_numbers_are_pythons_in_a_configuration():
    config = scb.PPOConfig(num_envs=np.int64(4), hidden_sizes=(np.int32(8),))
    assert {type(config.num_envs), type(config.hidden_sizes[0])} == {int}
    meta = MetaTrainingConfig(
        contexts=np.int64(20),
        reward_noise=np.float32(5),
        hyperparameters={"learning_rate": tuple(np.float32([1e-3, 1e-2]))},
        evolution=EvolutionConfig(seed=np.int64(1)),
    )
    stored = config_dict(meta)
    assert (stored["contexts"], stored["reward_noise"], stored["evolution"]["seed"]) == (20, 5.0, 1)


def test_an_objective_is_certified_with_its_own_parameters():
    objective = lpo.load_objective("lpo-pendulum")
    with pytest.raises(UserError, match="comes with its own parameters: leave them out, or give"):
        lpo.certify(objective, objective.parameters)


def test_a_path_may_begin_at_home(tmp_path, monkeypatch, bandit):
    monkeypatch.setenv("HOME", str(tmp_path))
    env, params = bandit
    with pytest.raises(
        UserError, match="the metadata of Synthetic-Pendulum-v1 are of the class No"
    ):
        scb.save_bandit("~/mine.npz", env, params.weights, None)
    assert scb.save_bandit("~/mine.npz", env, params.weights, {}) == tmp_path / "mine.npz"
    assert scb.load_bandit("~/mine.npz").config == env.config


def test_a_run_may_begin_at_home(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    config = EvolutionConfig()
    for _ in range(2):  # made, and found
        with run_of("~/runs/mine", config, {}, ()) as run:
            assert run.folder == tmp_path / "runs" / "mine"
    assert read_config("~/runs/mine")["config"] == config_dict(config)
    assert not (tmp_path / "~").exists()


def test_a_bandit_may_be_named_by_a_path():
    path = Path(scb.__file__).parent / "zoo" / "Synthetic-Pendulum-v1.npz"
    assert DiscoveryConfig(environment="Pendulum-v1", start=path).start == str(path)
    meta = MetaTrainingConfig(tasks=[path, "Synthetic-CartPole-v1"])
    assert meta.tasks == (str(path), "Synthetic-CartPole-v1")
    json.dumps(config_dict(meta))


def test_numbers_of_any_library_are_hyperparameters(bandit):
    env, params = bandit
    agent = scb.PPO(env, scb.PPOConfig())
    values = {"learning_rate": np.float64(1e-3), "discount": jnp.float32(0.9), "gae_lambda": 1}
    agent.check_inputs(scb.PPOHyperparameters(**values), params)
    jax.eval_shape(lambda x: agent.init(KEY, scb.PPOHyperparameters(discount=x), params), 0.9)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: discover(None), "config is of the class NoneType: it must be of DiscoveryConfig"),
        (lambda: discover(DiscoveryConfig), r"config is the class DiscoveryConfig itself: make on"),
        (
            lambda: discover(DiscoveryConfig(), 3),
            "run is of the class int: it must be of Run or st",
        ),
        (lambda: meta_train(EvolutionConfig()), "config is of the class EvolutionConfig: it must"),
        (lambda: MetaTrainingConfig(drift=lpo.LearnedDrift), "drift is the class LearnedDrift its"),
        (lambda: lpo.compare("CartPole-v1", ["ppo"], [0], episodes=1.5), "episodes is 1.5: it mus"),
        (lambda: lpo.compare("CartPole-v1", ["ppo"], [0], points=1.5), "points is 1.5: it must be"),
        (lambda: MetaTrainingConfig(tasks=None), "the list of tasks is empty"),
        (lambda: scb.load_bandit(3), "a bandit is 3: give a name, or a file"),
        (
            lambda: scb.PPO(gymnax.make("Pendulum-v1")[0], scb.PPOConfig()).init(
                0, scb.PPOHyperparameters(), gymnax.make("Pendulum-v1")[1]
            ),
            r"the key is 0: give one of JAX's, such as jax\.random\.key\(0\)",
        ),
        (lambda: lpo.compare("CartPole-v1", {"ppo", "dpo"}, [0]), "are a set, which has no order"),
    ],
)
def test_arguments_of_another_class_are_told(call, message):
    with pytest.raises(UserError, match=message):
        call()


@pytest.mark.parametrize("agent", ["SAC", "TD3"])
def test_hyperparameters_of_another_algorithm_are_refused(bandit, agent):
    env, params = bandit
    made = getattr(scb, agent)(env, getattr(scb, f"{agent}Config")())
    said = rf"are of the class PPOHyperparameters: give \(key, {agent}Hyperparameters, the env"
    with pytest.raises(UserError, match=said):
        made.train(KEY, scb.PPOHyperparameters(), params)


def test_a_bandit_is_saved_with_weights_and_found_without_its_ending(bandit, tmp_path):
    env, params = bandit
    with pytest.raises(UserError, match="are of the class BanditParams: give a dict of arrays"):
        scb.save_bandit(tmp_path / "mine", env, params)
    scb.save_bandit(tmp_path / "mine", env, params.weights)
    assert scb.make(tmp_path / "mine")[0].name == "mine"
    assert scb.load_bandit(tmp_path / "mine").name == "mine"
    with pytest.raises(UserError, match="unknown environment"):
        scb.make(str(tmp_path / ("x" * 300)))


def test_a_bandit_has_an_action_space_of_gymnax():
    with pytest.raises(
        UserError, match=r"gymnasium\.spaces\.discrete\.Discrete: give gymnax's Box or"
    ):
        scb.SyntheticBandit(3, gymnasium.spaces.Discrete(2), scb.BanditConfig())


@pytest.mark.parametrize("value", ["no", 0, None])
def test_what_is_true_or_false_is_neither_text_nor_number(value):
    with pytest.raises(UserError, match=r"anneal_learning_rate is .*: it must be true or false"):
        scb.PPOConfig(anneal_learning_rate=value)


@pytest.mark.parametrize(
    ("field", "value", "called"),
    [
        ("population_size", 4.0, "population_size"),
        ("num_generations", 1.5, r"num_generations \(--generations\)"),
        ("mean_evaluations", "8", "mean_evaluations"),
    ],
)
def test_what_is_counted_is_a_whole_number(field, value, called):
    with pytest.raises(UserError, match=rf"^{called} is .*: it must be a whole number"):
        EvolutionConfig(**{field: value})


def test_a_class_whose_annotations_do_not_resolve_is_told_of_by_the_fields_name():
    @dataclass
    class Mine:
        size: "Nowhere"  # noqa: F821

    with pytest.raises(UserError, match=r"^size is 0: it must be at least 1"):
        at_least(1, Mine(0), "size")


def test_a_curriculum_in_words_is_the_one_that_they_say():
    def curriculum(words, environment="MountainCar-v0"):
        config = DiscoveryConfig(environment=environment, init="random", curriculum=words)
        return BanditDiscovery(config).config.curriculum

    assert str(curriculum("linear:100:200:0:5")) == "linear:100:200:0:5"
    assert curriculum("none") is None
    assert str(curriculum("paper")) != "None"
    with pytest.raises(UserError, match="the curriculum 'rubbish' is not understood"):
        DiscoveryConfig(curriculum="rubbish")
    with pytest.raises(UserError, match="it must be of CurriculumConfig or str or None"):
        DiscoveryConfig(curriculum=3)
    with pytest.raises(UserError, match="evolution is of the class dict"):
        DiscoveryConfig(evolution={})


def test_what_is_for_algorithms_that_are_none_is_refused():
    lists = {"ppo": {"learning_rate": [0.001]}, "SAC": {"learning_rate": [0.1]}}
    for name in ("lists", "configs"):
        with pytest.raises(UserError, match="unknown algorithm 'SAC': did you mean sac"):
            BanditDiscovery(DiscoveryConfig(init="random", **{name: lists}))
        for wrong in ('{"ppo": {}}', {"ppo": scb.PPOConfig()}):
            with pytest.raises(UserError, match=f"{name} is .*: give a dict of dicts"):
                DiscoveryConfig(**{name: wrong})


def test_parameters_of_a_class_of_ones_own_are_taken():
    @struct.dataclass
    class Own(environment.EnvParams):
        pass

    class Plain(environment.Environment):
        @property
        def default_params(self):
            return environment.EnvParams(max_steps_in_episode=3)

        @property
        def name(self):
            return "Plain"

    agent = scb.PPO(Plain(), scb.PPOConfig())
    agent.check_inputs(scb.PPOHyperparameters(), Own())  # gymnax's own class says nothing
    with pytest.raises(UserError, match="are of the class SACHyperparameters"):
        agent.check_inputs(scb.SACHyperparameters(), Own())
