from types import SimpleNamespace

import numpy as np
import pytest

from experiments import brax_curriculum as experiment
from experiments import searches
from experiments.brax_curriculum import NONE
from scb.errors import UserError


def report(searches=1, **finals):
    plan = {**experiment.EXPERIMENT.presets["quick"], "seeds": {NONE: max(2, searches)}}
    plan["seeds"] |= {"linear": searches, "step": searches}
    curves = {
        shape: {
            str(seed): {
                "generation": [0, 60],
                "fitness": [10.0, finals.get(shape, 200.0) + 10.0 * seed],
                "mean": [10.0, 0.0],
                "failed": [0.0, 0.0],
                "seconds": 60.0,
            }
            for seed in range(number)
        }
        for shape, number in plan["seeds"].items()
    }
    return {"plan": plan, "curves": curves}


def test_a_curriculum_is_the_papers_in_another_shape():
    curriculum = searches.curriculum_of("hopper", "cosine", 2000)
    assert curriculum.shape == "cosine" and (curriculum.initial, curriculum.final) == (100, 1000)
    assert (curriculum.begin, curriculum.transition) == (200, 1600)
    assert searches.curriculum_of("hopper", "step", 60).begin == 6
    assert searches.curriculum_of("hopper", NONE, 60) is None
    with pytest.raises(UserError, match="no curriculum for Pendulum-v1"):
        searches.curriculum_of("Pendulum-v1", "linear", 60)
    config = experiment.config_of("linear", 2, experiment.EXPERIMENT.presets["paper"])
    assert (
        config.mode == "sequential" and config.backend == "generalized" and config.init == "random"
    )


@pytest.mark.slow
def test_a_search_with_a_curriculum_is_judged_over_whole_episodes(
    tmp_path, monkeypatch, small_agents
):
    # MountainCar has a curriculum too, and is far cheaper than Hopper.
    monkeypatch.setattr(experiment, "ENVIRONMENT", "MountainCar-v0")
    plan = {
        "runs": str(tmp_path),
        "backend": None,
        "algorithms": ["ppo"],
        "mode": "all",
        "population_size": 2,
        "generations": 1,
        "agents_per_candidate": 1,
        "evaluation_episodes": 2,
        "mean_evaluations": 2,
        "evaluate_mean_every": 1,
        "seeds": {"linear": 1},
    }
    found, saved = {}, []
    experiment.measure(plan, found, lambda: saved.append(1))
    assert len(saved) == 1
    # The curriculum starts with episodes of 1000 steps; MountainCar's own have 200.
    assert found["curves"]["linear"]["0"]["fitness"] == [-200.0, -200.0]
    experiment.measure(plan, found, lambda: saved.append(1))
    assert len(saved) == 1


def test_every_search_is_measured_once(monkeypatch):
    asked = []

    def search(config, folder):
        asked.append((config.curriculum, config.evolution.seed))
        line = {
            "generation": 0,
            "failed": 0,
            "final_mean/fitness": 7.0,
            "final_mean/fitness_iqm": 8.0,
        }
        return None, SimpleNamespace(metrics=[line], seconds=1.0)

    monkeypatch.setattr(searches, "discover", search)
    plan = {**experiment.EXPERIMENT.presets["quick"], "seeds": {NONE: 2, "step": 1}}
    found = {"plan": plan}
    experiment.measure(plan, found, lambda: None)
    # First seeds first, so that an interrupted measurement has every curriculum.
    assert [(c and c.shape, seed) for c, seed in asked] == [(None, 0), ("step", 0), (None, 1)]
    assert {shape: x.estimate.value for shape, x in experiment.finals(found).items()} == {
        NONE: 8.0,
        "step": 8.0,
    }
    experiment.measure(plan, found, lambda: None)
    assert len(asked) == 3


def outcomes(found):
    return [x.outcome for x in experiment.EXPERIMENT.judged(found)]


def test_claims_follow_the_figures():
    said = experiment.EXPERIMENT.block("verdict", report(linear=300.0, step=150.0))
    assert "205 [200, 210] without" in said and "the best ends at 210" in said
    assert "None of them earns what standing still does (1000)" in said
    assert set(outcomes(report(linear=300.0, step=150.0))) == {"not tested at this size"}
    # One search of a shape decides nothing, however far above it ends.
    assert outcomes(report(none=1000.0, linear=1500.0)) == ["undecided"] * 2
    several = report(5, none=1000.0, linear=1500.0, step=1010.0)
    assert outcomes(several) == ["holds", "undecided"]
    assert "None of them" not in experiment.EXPERIMENT.block("verdict", several)


def test_failed_searches_are_worse_than_any():
    found = report(5, none=1000.0, linear=1500.0, step=1500.0)
    found["curves"]["linear"]["0"]["fitness"][-1] = None
    assert outcomes(found) == ["undecided", "holds"]
    assert "(1 of 5 failed)" in experiment.EXPERIMENT.block("body", found)
    for curve in found["curves"][NONE].values():
        curve["fitness"][-1] = None
    said = experiment.EXPERIMENT.block("verdict", found)
    assert "all failed without a curriculum" in said and "Every search without one failed." in said


def test_the_page_and_the_figure_show_every_curriculum():
    found = report()
    body = experiment.EXPERIMENT.block("body", found)
    assert sum(line.startswith("| ") for line in body.splitlines()) == 3 + 2
    left, right = experiment.draw(found).axes
    assert len(left.lines) == len(right.lines) == 3
    lengths = {line.get_label(): line.get_ydata() for line in left.lines}
    assert lengths["linear"][0] == 100 and lengths["linear"][-1] == 1000
    np.testing.assert_array_equal(lengths[NONE], 1000)
