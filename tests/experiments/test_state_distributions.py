import numpy as np
import pytest

from experiments import state_distributions as experiment
from scb.files import packed, unpacked

LIMITS = [[0.0, 1.0], [0.0, 1.0]]


def entry(contexts, visited, bandit_actions, expert_actions, num_actions=2):
    return {
        "expert": -120.0,
        "labels": ["position", "velocity"],
        "limits": LIMITS,
        "num_actions": num_actions,
        "bounds": None if num_actions else [-2.0, 2.0],
        "contexts": experiment.stored_points(contexts, LIMITS),
        "visited": experiment.stored_points(visited, LIMITS),
        "bandit_actions": packed(bandit_actions),
        "expert_actions": packed(expert_actions),
    }


@pytest.fixture
def report():
    everywhere = np.random.default_rng(0).uniform(size=(4000, 2))
    nowhere = np.full((4000, 2), 0.5)
    smooth, rough = np.zeros((6, 6)), np.indices((6, 6)).sum(0) % 2
    return {
        "plan": experiment.EXPERIMENT.presets["quick"],
        "environments": {
            "MountainCar-v0": entry(everywhere, nowhere, smooth, rough),
            "Pendulum-v1": entry(nowhere, everywhere, 2.0 * rough, smooth, None),
        },
    }


def test_coverage_and_roughness_are_shares():
    corners = np.array([[0.01, 0.01], [0.02, 0.03], [0.99, 0.99]])
    assert experiment.coverage(corners, LIMITS) == 2 / 400
    assert experiment.outside(np.array([[0.5, 1.5], [0.5, 0.5]]), LIMITS) == 0.5
    checkered = np.indices((6, 6)).sum(0) % 2
    assert experiment.roughness(checkered, 2, None) == 1.0
    assert experiment.roughness(checkered, None, (0.0, 4.0)) == 0.25
    assert experiment.roughness(np.zeros((6, 6)), 2, None) == 0.0


def test_points_are_stored_to_a_thousandth_of_the_plane():
    limits = [[-2.0, 2.0], [10.0, 110.0]]
    points = np.random.default_rng(0).uniform([-2.0, 10.0], [2.0, 110.0], (100, 2))
    again = experiment.points_of(experiment.stored_points(points, limits), limits)
    np.testing.assert_allclose(again, points, atol=0.051)
    np.testing.assert_allclose(again[:, 0], points[:, 0], atol=0.0021)


@pytest.mark.slow
def test_states_and_best_actions_of_one_environment(small_agents):
    plan = {
        "environments": ["MountainCar-v0"],
        "agents": 2,
        "selection_episodes": 2,
        "episodes": 2,
        "entries": {},
    }
    found, saved = {}, []
    experiment.measure(plan, found, lambda: saved.append(1))
    examined = found["environments"]["MountainCar-v0"]
    contexts, visited = (
        experiment.points_of(examined[name], examined["limits"]) for name in ("contexts", "visited")
    )
    assert contexts.shape == visited.shape == (2000, 2)
    # An untrained agent stays in the valley; the bandit shows far more.
    assert np.ptp(contexts[:, 0]) > 2 * np.ptp(visited[:, 0])
    actions = unpacked(examined["bandit_actions"])
    assert actions.shape == (50, 50) and set(np.unique(actions)) <= {0.0, 1.0, 2.0}
    assert set(np.unique(unpacked(examined["expert_actions"]))) <= {0.0, 1.0, 2.0}
    experiment.measure(plan, found, lambda: saved.append(1))
    assert saved == [1]


def test_claims_are_over_environments(report):
    said = experiment.EXPERIMENT.block("verdict", report)
    assert "change less over the plane than the expert's in 1 of 2 environments, and" in said
    assert (
        "expert's states in 1. In the mean over all it is undecided whether contexts cover" in said
    )
    assert (
        " In the mean over all it is undecided whether the bandit's best actions change less"
        in said
    )
    # Wider and smoother in one of two environments: undecided, however many states there are.
    assert [x.outcome for x in experiment.EXPERIMENT.judged(report)] == ["undecided"] * 2
    report["environments"]["Pendulum-v1"] = report["environments"]["MountainCar-v0"]
    assert [x.outcome for x in experiment.EXPERIMENT.judged(report)] == ["holds"] * 2
    # Twice as far out as the plane reaches.
    entry = report["environments"]["MountainCar-v0"]
    entry["contexts"] = experiment.stored_points(np.full((4000, 2), 2.0), LIMITS)
    said = experiment.EXPERIMENT.block("body", report)
    assert "contexts off the plane" in said and "| 100.0% |" in said


def test_the_page_and_the_figure_show_both_distributions(report):
    lines = experiment.EXPERIMENT.block("body", report).splitlines()
    assert sum(line.startswith("| ") for line in lines) == 2 + 2
    figure = experiment.EXPERIMENT.figures(report)["state_distributions"]
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert {"MountainCar-v0: expert", "Pendulum-v1: bandit"} <= set(titles)
