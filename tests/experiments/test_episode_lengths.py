import numpy as np
import pytest

from experiments import episode_lengths as experiment
from experiments.episode_lengths import BINS, OWN
from scb.environments.registry import environment_spec

TINY = {
    "seed": 0,
    "limits": [OWN, "1"],
    "algorithms": ["ppo"],
    "judged_by": ["ppo"],
    "sizes": {
        name: {"generations": 1, "population_size": 2, "agents_per_candidate": 1}
        for name in ("MountainCar-v0", "CartPole-v1")
    },
    "evaluation_episodes": 1,
    "mean_evaluations": 2,
    "agents": 2,
    "episodes": 3,
}


def report(one=-120.0, own=-150.0, single=9):
    """Two environments with these returns and this many of ten episodes of one step."""
    entry = {
        "limit": 200,
        "returns": {OWN: {"ppo": [own, own]}, "1": {"ppo": [one, one]}},
        "failed": {OWN: 0, "1": 1},
        "lengths": {"ppo": {**dict.fromkeys(BINS, 0), "1": single, "more": 10 - single}},
    }
    environments = {"MountainCar-v0": entry, "CartPole-v1": entry}
    return {"environments": environments, "plan": TINY}


def test_lengths_are_counted_once_each():
    counts = experiment.binned(np.array([[1, 1, 2], [5, 50, 51]]))
    assert counts == {"1": 2, "2": 1, "3 to 5": 1, "6 to 10": 0, "11 to 50": 1, "more": 1}


@pytest.mark.slow
def test_a_limits_search_is_judged_and_its_episodes_are_counted(
    tmp_path, monkeypatch, small_agents
):
    monkeypatch.setattr(experiment, "CLASSIC_CONTROL", ("MountainCar-v0",))
    found, saved = {}, []
    plan = {**TINY, "limits": [OWN], "runs": str(tmp_path)}
    experiment.measure(plan, found, lambda: saved.append(1))
    assert {x.name for x in tmp_path.iterdir()} == {"MountainCar-v0-max"}
    entry = found["environments"]["MountainCar-v0"]
    assert len(saved) == 1 and entry["limit"] == 200
    assert environment_spec("MountainCar-v0").random_return() == -200.0
    assert sum(entry["lengths"]["ppo"].values()) == 2 * 3
    returns = entry["returns"][OWN]["ppo"]
    assert len(returns) == 2 and all(-200.0 <= x <= -80.0 for x in returns)
    experiment.measure(plan, found, lambda: saved.append(1))
    assert len(saved) == 1


@pytest.mark.parametrize("preset", ["quick", "paper"])
def test_presets_have_the_environments_own_limit_and_a_single_step(preset):
    plan = experiment.EXPERIMENT.presets[preset]
    assert {OWN, "1"} <= set(plan["limits"])
    assert set(plan["sizes"]) == set(experiment.CLASSIC_CONTROL)
    config = experiment.config_of("Pendulum-v1", "10", plan)
    assert config.parameterization == "TI" and config.max_steps == 10


def test_one_search_of_each_decides_nothing():
    said = experiment.EXPERIMENT.block("verdict", report())
    assert "MountainCar-v0 90%" in said
    assert [x.outcome for x in experiment.EXPERIMENT.judged(report())] == ["undecided"] * 2
    said = experiment.EXPERIMENT.block("verdict", report(one=-190.0, single=3))
    assert "trains agents of 0.5 or more of the expert's score in MountainCar-v0 only" in said
    # Searches without a limit that get nowhere tell nothing.
    untold = experiment.EXPERIMENT.judged(report(own=-199.0))
    assert [x.outcome for x in untold] == ["not tested at this size"] * 2


def test_the_page_and_the_figure_show_every_limit():
    found = report()
    lines = experiment.EXPERIMENT.block("body", found).splitlines()
    assert sum(line.startswith("| ") for line in lines) == 2 * (2 + 2)
    left, right = experiment.draw(found).axes
    assert len(left.patches) == 2 * len(BINS)
    assert [t.get_text() for t in right.get_xticklabels()] == TINY["limits"]
