"""Meta-trainings that cannot be, the defaults, and the folder of one that Python starts."""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lpo
from lpo.commands import MetaTrain
from lpo.drifts import ClipDrift, LearnedDrift
from lpo.inner_loop import MetaTrainingConfig
from lpo.meta_training import MetaTraining, meta_train
from scb.agents.ppo import PPOConfig
from scb.errors import UserError
from scb.evolution import EvolutionConfig


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"fitness": "retrun"}, "unknown fitness 'retrun': did you mean return"),
        (
            {"tasks": ("Pendulum-v1",), "fitness": "transfer"},
            "fitness 'transfer' asks for a bandit, and 'Pendulum-v1' is none: use 'return' or "
            "'area', or train on 'Synthetic-Pendulum-v1'.",
        ),
        ({"tasks": ()}, "the list of tasks is empty: give at least one bandit or environment."),
        ({"tasks": ("a", "b", "a")}, "the task a is there twice: give each once."),
        (
            {"tasks": ("CartPole-v1", "Pendulum-v1"), "agent": PPOConfig()},
            "one agent configuration does not fit several tasks",
        ),
        (
            {
                "tasks": ("Synthetic-hopper", "Pendulum-v1"),
                "validation": True,
                "backend": "spring",
            },
            "needs a reference return of each, and hopper has none: leave out its task",
        ),
        ({"horizons": (0.5, 0.0)}, "horizon is 0.0: it must be positive, and finite."),
        ({"horizons": ("a",)}, "a horizon is 'a': it must be a number."),
        ({"horizons": (None,)}, "a horizon is None: it must be a number."),
        ({"drift": "dpo"}, "drift is of the class str: it must be of Drift."),
        ({"evolution": {}}, "evolution is of the class dict: it must be of EvolutionConfig."),
        ({"agent": 3}, "agent is of the class int: it must be of PPOConfig or None."),
        (
            {"horizons": (0.5,), "fitness": "area"},
            "fitness 'area' needs trainings of one length: take no horizons",
        ),
        (
            {
                "horizons": (0.5, 1.0),
                "evolution": EvolutionConfig(strategy="SimpleGA", combine="mean"),
            },
            "SimpleGA compares fitness with that of earlier generations, which is of trainings of other",
        ),
        ({"agents_per_candidate": 0}, "agents_per_candidate is 0: it must be at least 1."),
        ({"evaluation_episodes": -1}, "evaluation_episodes is -1: it must be at least 1."),
        ({"contexts": 0}, "contexts is 0: it must be at least 1."),
        (
            {"tasks": ("Pendulum-v1",), "reward_noise": 2.0},
            "reward_noise is 2.0, and none of the tasks is a bandit: leave it out, or take a bandit.",
        ),
        ({"tasks": ("Pendulum-v1",), "contexts": 7}, "contexts is 7, and none of the tasks is a"),
        ({"reward_noise": -0.1}, "reward_noise is -0.1: it must be 0 or larger, and finite."),
        (
            {"initial_scale": float("nan")},
            "initial_scale is nan: it must be 0 or larger, and finite.",
        ),
        ({"reward_noise": float("nan")}, "reward_noise is nan"),
        ({"reward_noise": float("inf")}, "reward_noise is inf"),
    ],
)
def test_a_configuration_that_cannot_be_is_refused(arguments, message, one_sentence):
    with pytest.raises(UserError) as error:
        MetaTrainingConfig(**arguments)
    assert message in one_sentence(str(error.value))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tasks": ("Synthetic-Pendulm-v1",)}, "did you mean Synthetic-Pendulum-v1"),
        (
            {"tasks": ("Pendulum-v1",), "backend": "spring"},
            "of Pendulum-v1 none has a choice: leave it out",
        ),
        (
            {"tasks": ("Synthetic-hopper",), "backend": "spring"},
            "backend is spring, and fitness is earned in bandits, which have no physics",
        ),
    ],
)
def test_an_environment_that_cannot_be_is_refused(config, changes, message, one_sentence):
    with pytest.raises(UserError) as error:
        MetaTraining(replace(config, **changes))
    assert message in one_sentence(str(error.value))


def test_defaults_take_a_bandit_with_noise():
    # What the library recommends: documentation and the shipped objective rest on it.
    default = MetaTrainingConfig()
    assert (default.tasks, default.reward_noise) == (("Synthetic-Pendulum-v1",), 5.0)
    assert (default.drift, default.evolution.strategy) == (LearnedDrift(base="ppo"), "Open_ES")


@pytest.mark.slow
def test_a_folder_keeps_a_meta_training_from_python(config, tmp_path):
    folder = tmp_path / "run"
    longer = replace(config, evolution=replace(config.evolution, num_generations=4))
    shorter = replace(config, evolution=replace(config.evolution, num_generations=2))
    meta_train(shorter, folder, quiet=True)
    logged = (folder / "metrics.jsonl").read_text()
    # The same call with more generations goes on, and ends as one that had them from the start.
    grown = meta_train(longer, str(folder), quiet=True)
    assert (folder / "metrics.jsonl").read_text().startswith(logged)
    whole = meta_train(longer, quiet=True)
    jax.tree.map(np.testing.assert_array_equal, grown.mean, whole.mean)
    with pytest.raises(UserError, match=r"its config differs at config\.agents_per_candidate"):
        meta_train(replace(longer, agents_per_candidate=2), folder, quiet=True)


def test_a_drift_that_no_import_finds_is_told_before_it_learns(config, tmp_path):
    @dataclass(frozen=True)
    class Here(LearnedDrift):
        pass

    @dataclass(frozen=True)
    class Other(LearnedDrift):
        def __call__(self, parameters, log_ratio, advantage, progress, xp=jnp):
            return 2 * super().__call__(parameters, log_ratio, advantage, progress, xp)

    drift = Here(hidden_size=4)
    with pytest.warns(UserWarning, match="learned here cannot be saved: the drift .*Here is def"):
        meta_train(replace(config, drift=drift), tmp_path / "run", quiet=True)
    # Nor does its run go on with another class of the same fields.
    other = replace(config, drift=Other(hidden_size=4))
    with pytest.raises(UserError, match="Here is not part of it; put that back"), pytest.warns():
        meta_train(other, tmp_path / "run", quiet=True)


@dataclass(frozen=True)
class Nested(lpo.Drift):
    """One with a network's parameters, a dictionary inside of another one, or with what no file holds."""

    learned = True
    kind: str = "dict"

    def init(self, key, scale=1.0):
        weight = scale * jax.random.normal(key, (2,))
        return {"network": {"kernel": weight} if self.kind == "dict" else [weight]}

    def __call__(self, parameters, log_ratio, advantage, progress, xp=jnp):
        (weight,) = jax.tree.leaves(parameters)
        return xp.exp(weight[0]) * log_ratio**2


@pytest.mark.slow
def test_parameters_in_dictionaries_of_dictionaries_are_learned_and_saved(config, tmp_path):
    assert Nested().shapes() == {"network/kernel": (2,)}
    outcome = meta_train(replace(config, drift=Nested()), quiet=True)
    path, _ = lpo.save_objective(tmp_path / "nested.npz", Nested(), outcome.mean)
    back = lpo.load_objective(path)
    jax.tree.map(np.testing.assert_array_equal, back.parameters, outcome.mean)


def test_parameters_that_no_file_holds_are_told_before_they_are_learned(config):
    with pytest.raises(UserError, match=r"in a list, a tuple or a class .*: give dictionaries"):
        MetaTraining(replace(config, drift=Nested("list")))


def test_a_mistake_leaves_no_folder_of_a_meta_training(config, tmp_path):
    folder = tmp_path / "run"
    with pytest.raises(UserError, match="family clip, which has nothing to learn"):
        meta_train(replace(config, drift=ClipDrift()), folder)
    assert not folder.exists()


def test_a_run_from_python_is_none_of_the_command_line(config, tmp_path):
    meta_train(config, tmp_path / "run", quiet=True)
    with pytest.raises(UserError, match="it was started with python"):
        MetaTrain.parse([f"--resume={tmp_path / 'run'}"])
