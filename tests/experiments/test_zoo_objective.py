"""How a zoo's entry names the objectives that it was compared with."""

import json
from pathlib import Path

import pytest

from experiments.understanding import read_comparison
from experiments.zoo_objective import _short


def test_a_comparison_names_a_run_by_its_folder_and_the_entry_by_its_name():
    def short(name):
        return _short(name, Path("runs/temporal/objective.npz"), "ta-lpo")

    assert short("runs/temporal/objective.npz") == "ta-lpo"
    assert short("temporal") == "ta-lpo"  # as lpo evaluate names it
    assert short("runs/several-bandits/objective.npz") == "several-bandits"
    assert short("runs/kept/first.npz") == "first"
    assert short("ppo-0.3") == "ppo-0.3"


@pytest.mark.parametrize(
    ("told", "hyperparameters"),
    [
        ({"hyperparameters": {"learning_rate": 0.1}}, {"learning_rate": 0.1}),
        # As earlier versions wrote them.
        ({"policy_output_scale": 0.01}, {"policy_output_scale": 0.01}),
        ({"policy_output_scale": 1.0}, {}),
        ({}, {}),
    ],
)
def test_a_comparison_says_what_was_other_than_the_environments_own(
    told, hyperparameters, tmp_path
):
    curve = {
        **told,
        "environment": "Pendulum-v1",
        "backend": None,
        "objective": "ppo",
        "seeds": [1],
        "episodes": 20,
        "mode_actions": True,
        "steps": [0, 10],
        "returns": [[0.0, 1.0]],
        "final_iqm": {},
        "area_iqm": {},
    }
    path = tmp_path / "comparison.json"
    content = {"curves": [curve], "reference": "ppo", "paired_differences": {}}
    path.write_text(json.dumps(content))
    assert read_comparison(path)["hyperparameters"] == hyperparameters
