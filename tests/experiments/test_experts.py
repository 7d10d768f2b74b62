import copy
import json
from pathlib import Path

import pytest

from experiments import experts
from experiments.page import CLASSIC_CONTROL
from scb.environments.registry import environment_spec

COMMITTED = Path(__file__).parents[2] / "docs" / "data" / "experts.json"


@pytest.fixture
def report():
    return json.loads(COMMITTED.read_text())


def test_an_expert_is_trained_and_judged_on_as_many_episodes_as_asked(small_agents):
    plan = {
        "environments": ["CartPole-v1"],
        "agents": 2,
        "selection_episodes": 2,
        "evaluations": 6,
    }
    found, saved = {}, []
    experts.measure(plan, found, lambda: saved.append(1))
    returns = found["environments"]["CartPole-v1"]["returns"]
    assert len(returns) == 6 and all(1.0 <= x <= 500.0 for x in returns)
    experts.measure(plan, found, lambda: saved.append(1))
    assert saved == [1]


def test_the_committed_experts_are_near_optimal(report):
    from scb.statistics import iqm

    assert list(report["environments"]) == list(CLASSIC_CONTROL)
    best = {name: float(iqm(x["returns"])) for name, x in report["environments"].items()}
    assert best["CartPole-v1"] == 500.0
    assert best["MountainCar-v0"] > -120.0 and best["MountainCarContinuous-v0"] > 94.0
    assert best["Acrobot-v1"] > -80.0 and best["Pendulum-v1"] > -155.0
    assert all(len(x["returns"]) == 200 for x in report["environments"].values())


def test_the_verdict_names_what_is_below_the_paper(report):
    changed = copy.deepcopy(report)
    for name, entry in changed["environments"].items():
        entry["returns"] = [environment_spec(name).reference_return()] * 10
    assert "on the paper's level or above it everywhere" in experts.verdict(changed)
    changed["environments"]["Pendulum-v1"]["returns"] = [-300.0] * 10
    assert "below the paper's interval in Pendulum-v1, on" in experts.verdict(changed)
    assert experts.parts(changed) == [True] * 4 + [False]


def test_the_page_and_the_figure_show_ours_beside_the_papers(report):
    lines = experts.body(report)
    assert any("\u2212117.7 [\u2212119.2, \u2212115.3]" in line for line in lines)
    figure = experts.draw(report)
    assert [axes.get_title(loc="left") for axes in figure.axes] == list(CLASSIC_CONTROL)
