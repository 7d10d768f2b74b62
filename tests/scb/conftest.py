"""A small bandit, which the tests of the command line share."""

from pathlib import Path

import jax
import pytest

from scb.environments.registry import make
from scb.environments.synthetic import BanditConfig, bandit_for
from scb.environments.zoo import save_bandit


@pytest.fixture(scope="module")
def bandit_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bandit of CartPole's shapes that nobody evolved."""
    bandit = bandit_for(*make("CartPole-v1"), BanditConfig(hidden_size=4), "Synthetic-CartPole-v1")
    path = tmp_path_factory.mktemp("bandits") / "Synthetic-CartPole-v1.npz"
    return save_bandit(path, bandit, bandit.init_weights(jax.random.key(0)))
