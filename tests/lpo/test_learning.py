"""What becomes of a search: which mean is saved, and what the objective's file says of it."""

import jax
import numpy as np
import pytest

from lpo import meta_training
from lpo.commands import MetaTrain
from lpo.drifts import LearnedDrift
from lpo.inner_loop import MetaTrainingConfig
from lpo.meta_training import MetaTraining, learn_objective
from lpo.pipeline import RunAll
from scb.commands import Discover
from scb.configurations import config_dict
from scb.environments.zoo import bandit_metadata, load_bandit, save_bandit
from scb.errors import UserError
from scb.evolution import EnvironmentSteps, EvolutionConfig, Outcome
from scb.runs import Run

DRIFT = LearnedDrift(hidden_size=4)
FINAL, BEST = (DRIFT.init(jax.random.key(i)) for i in (1, 2))
BANDITS = ("Synthetic-Pendulum-v1", "Synthetic-CartPole-v1")


@pytest.fixture
def learned(monkeypatch, tmp_path):
    """The objective of a search that ended so; an agent earns the sum of a solution's last layer."""

    def learn(validation, generation=3):
        evolution = EvolutionConfig(
            "Open_ES", population_size=2, num_generations=1, mean_evaluations=2, seed=5
        )
        config = MetaTrainingConfig(
            BANDITS, drift=DRIFT, validation=validation, evolution=evolution
        )
        metrics = [{"generation": 0, "fitness/mean": 1.0}]

        def validate(solution):
            return {"fitness": np.full(2, float(solution["output"].sum()))}

        outcome = Outcome(FINAL, BEST, generation, metrics, 1.0, EnvironmentSteps(0, 0), validate)
        monkeypatch.setattr(meta_training, "evolve", lambda *given: outcome)
        run = Run.open(tmp_path / "run", config_dict(config))
        return learn_objective(MetaTraining(config), run, "lpo meta-train")

    return learn


@pytest.mark.parametrize(("validation", "kept"), [(False, FINAL), (True, BEST)])
def test_with_validation_the_best_mean_is_saved_and_judged(learned, validation, kept):
    objective = learned(validation)
    np.testing.assert_array_equal(objective.parameters["output"], kept["output"])
    story = objective.metadata
    assert story["results"]["validation"]["value"] == pytest.approx(float(kept["output"].sum()))
    assert story["cost"].get("generation") == (3 if validation else None)
    assert story["seeds"] == {"meta_training": 5, "validation": 30_000}
    sums = {name: bandit_metadata(name)["sha256"] for name in BANDITS}
    assert story["config"]["bandit_sha256"] == sums
    assert story["config"]["homes"] == list(objective.homes)


def test_where_no_mean_could_be_judged_nothing_is_saved(learned, tmp_path):
    with pytest.raises(UserError, match="no mean is best"):
        learned(True, generation=-1)
    assert not list((tmp_path / "run").glob("objective*"))


@pytest.mark.parametrize(
    ("command", "flags"),
    [
        (MetaTrain, ["--tasks"]),
        (Discover, ["--environment=CartPole-v1", "--from-bandit"]),
    ],
)
def test_a_search_does_not_go_on_in_another_bandit(tmp_path, command, flags):
    path, zoo = tmp_path / "mine.npz", "Synthetic-CartPole-v1"
    bandit, metadata = load_bandit(zoo), bandit_metadata(zoo)
    weights = bandit.default_params.weights
    save_bandit(path, bandit, weights, metadata)
    command.parse([*flags, str(path), f"--out={tmp_path / 'run'}"]).open().close()
    command.parse([f"--resume={tmp_path / 'run'}"]).open().close()
    save_bandit(path, bandit, jax.tree.map(lambda x: 2 * x, weights), metadata)
    with pytest.raises(UserError, match=r"mine\.npz is not what it was when the run was started"):
        command.parse([f"--resume={tmp_path / 'run'}"]).open()


def test_a_whole_run_begins_with_the_bandit_that_ships(tmp_path):
    inputs = {"Synthetic-Pendulum-v1": bandit_metadata("Synthetic-Pendulum-v1")["sha256"]}
    assert RunAll.parse([f"--out={tmp_path / 'run'}"]).inputs() == inputs
    assert RunAll.parse([f"--out={tmp_path / 'run'}", "--objective=lpo-multi"]).inputs() == {}
