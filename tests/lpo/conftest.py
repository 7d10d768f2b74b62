"""A small agent and a small learned objective, which the tests of `lpo` share."""

from collections.abc import Callable
from pathlib import Path

import jax
import pytest

from lpo.drifts import LearnedDrift
from lpo.objectives import save_objective
from scb.agents.ppo import PPOConfig

# What an artefact must say beside its weights.
METADATA = {"config": {}, "seeds": {}, "results": {}, "cost": {}, "command": "a test"}


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
