"""A small agent and a small learned objective, which the tests of `lpo` share."""

from collections.abc import Callable
from pathlib import Path

import jax
import pytest

import scb
import scb.cli
from lpo import cli
from lpo.drifts import LearnedDrift
from lpo.inner_loop import MetaTrainingConfig
from lpo.objectives import save_objective
from scb.agents.ppo import PPOConfig
from scb.agents.spec import AgentSpec
from scb.evolution import EvolutionConfig


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
def tiny_spec() -> AgentSpec:
    """Two batches on a bandit."""
    return scb.environment_agent("ppo", "Pendulum-v1").on_bandit(20).with_steps(40)


@pytest.fixture(scope="session")
def tiny_drift() -> LearnedDrift:
    return LearnedDrift(hidden_size=4)


@pytest.fixture(scope="session")
def config(tiny_agent: PPOConfig, tiny_drift: LearnedDrift) -> MetaTrainingConfig:
    """Two generations of two candidates on Pendulum's bandit."""
    evolution = EvolutionConfig(
        strategy="Open_ES", population_size=2, num_generations=2, mean_evaluations=2, seed=1
    )
    return MetaTrainingConfig(
        tasks=("Synthetic-Pendulum-v1",),
        drift=tiny_drift,
        fitness="return",
        agent=tiny_agent,
        agents_per_candidate=1,
        evaluation_episodes=2,
        evolution=evolution,
    )


@pytest.fixture(scope="session")
def objective_file(tmp_path_factory: pytest.TempPathFactory, tiny_drift: LearnedDrift) -> Path:
    """tiny.npz and tiny.json: a learned objective of random weights. Not to be changed."""
    parameters = tiny_drift.init(jax.random.key(3))
    path, _ = save_objective(
        tmp_path_factory.mktemp("objective") / "tiny.npz", tiny_drift, parameters
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


PROGRAMS = {"lpo": cli.main, "scb": scb.cli.main}


@pytest.fixture
def working_folder(tmp_path, monkeypatch) -> Path:
    """Where default outputs such as runs/quick would go."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def files(folder: Path) -> dict[str, bytes]:
    paths = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


@pytest.fixture
def refused(capsys, working_folder, one_sentence):
    """Runs a command that must fail as a user's mistake does, and returns its sentence."""

    def run(*arguments: object, program: str = "lpo") -> str:
        before = files(working_folder)
        assert PROGRAMS[program]([str(a) for a in arguments]) == 2
        output, error = capsys.readouterr()
        assert output == ""
        assert error.startswith(f"{program}: ") and error.endswith("\n")
        assert files(working_folder) == before
        return one_sentence(error.removesuffix("\n"))

    return run


@pytest.fixture
def no_training(monkeypatch):
    """No mistake may get as far as training; the test that trains undoes this."""

    def refuse(*arguments, **named):
        raise AssertionError("this must fail before any training")

    monkeypatch.setattr("lpo.meta_training.evolve", refuse)
    monkeypatch.setattr("lpo.pipeline.run_pipeline", refuse)
    monkeypatch.setattr("scb.measurement._program_of", refuse)
