"""What becomes of a search: which mean is saved, and what the objective's file says of it."""

import jax
import numpy as np
import pytest

from lpo import meta_training
from lpo.drifts import LearnedDrift
from lpo.inner_loop import MetaTrainingConfig
from lpo.meta_training import MetaTraining, learn_objective
from scb.environments.zoo import bandit_metadata
from scb.errors import UserError
from scb.evolution import EvolutionConfig, Outcome
from scb.runs import Run, config_dict

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

        outcome = Outcome(FINAL, BEST, generation, metrics, 1.0, validate)
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


def test_where_no_mean_could_be_judged_nothing_is_saved(learned, tmp_path):
    with pytest.raises(UserError, match="no mean is best"):
        learned(True, generation=-1)
    assert not list((tmp_path / "run").glob("objective*"))
