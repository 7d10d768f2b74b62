"""A small bandit, a small agent and a small learned objective, which the tests of `lpo` share."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import gymnax
import jax
import jax.numpy as jnp
import pytest
from gymnax.environments import spaces

from lpo.drift import LearnedDrift
from lpo.objectives import save_objective
from scb.agents.ppo import PPOConfig
from scb.environments.synthetic import BanditConfig, SyntheticBandit

# What an artefact must say beside its weights.
METADATA = {"config": {}, "seeds": {}, "results": {}, "cost": {}, "command": "a test"}


def random_bandit(name: str, seed: int = 0) -> SyntheticBandit:
    """A bandit of Pendulum's shapes whose weights were never evolved."""
    action_space = spaces.Box(-2.0, 2.0, (1,), jnp.float32)
    shape = SyntheticBandit(3, action_space, BanditConfig(hidden_size=4))
    weights = shape.init_weights(jax.random.key(seed))
    return SyntheticBandit(3, action_space, shape.config, weights, name)


@pytest.fixture(scope="session")
def bandit_name() -> str:
    """Pendulum's bandit: the one that ships, or one of random weights under its name."""
    name = "Synthetic-Pendulum-v1"
    if name not in gymnax.registered_envs:
        gymnax.register(name, partial(random_bandit, name))
    return name


@pytest.fixture(scope="session")
def tiny_agent() -> PPOConfig:
    """Three batches of eight transitions."""
    return PPOConfig(
        num_envs=8,
        num_steps=1,
        num_epochs=2,
        num_minibatches=2,
        total_steps=24,
        hidden_sizes=(4,),
    )


@pytest.fixture(scope="session")
def tiny_drift() -> LearnedDrift:
    return LearnedDrift(hidden_size=4)


@pytest.fixture(scope="session")
def objective_file(tmp_path_factory: pytest.TempPathFactory, tiny_drift: LearnedDrift) -> Path:
    """tiny.npz and tiny.json: a learned objective of random weights. Not to be changed."""
    parameters = tiny_drift.init(jax.random.key(3))
    path, _ = save_objective(
        tmp_path_factory.mktemp("objective") / "tiny.npz", tiny_drift, parameters, METADATA
    )
    return path


@pytest.fixture(scope="session")
def one_sentence() -> Callable[[str], str]:
    """Checks that a message is one sentence on one line, and returns it."""

    def check(message: str) -> str:
        assert "\n" not in message
        assert message.endswith((".", "?"))
        assert ". " not in message and "? " not in message
        return message

    return check
