"""How a zoo's entry names the objectives that it was compared with."""

from pathlib import Path

from experiments.zoo_entry import _short


def test_a_comparison_names_a_run_by_its_folder_and_the_entry_by_its_name():
    def short(name):
        return _short(name, Path("runs/temporal/objective.npz"), "ta-lpo")

    assert short("runs/temporal/objective.npz") == "ta-lpo"
    assert short("temporal") == "ta-lpo"  # as lpo evaluate names it
    assert short("runs/several-bandits/objective.npz") == "several-bandits"
    assert short("runs/kept/first.npz") == "first"
    assert short("ppo-0.3") == "ppo-0.3"
