import pytest

from experiments import experts
from experiments.harness import CLASSIC_CONTROL


@pytest.fixture
def report(committed):
    return committed("experts")


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


def test_an_expert_is_next_to_the_papers_by_its_whole_interval(report):
    for name, entry in report["environments"].items():
        entry["returns"] = [experts.paper(name).value] * 10
    assert {x.outcome for x in experts.EXPERIMENT.judged(report)} == {"holds"}
    said = experts.EXPERIMENT.block("verdict", report)
    assert "every expert is next to the paper's or above it." in said
    # Reaching the paper's level with the better end of a wide interval decides nothing.
    report["environments"]["Acrobot-v1"]["returns"] = [-76.7] * 5 + [-500.0] * 5
    report["environments"]["Pendulum-v1"]["returns"] = [-300.0] * 10
    said = experts.EXPERIMENT.block("verdict", report)
    assert "not shown to be next to the paper's in Acrobot-v1 and Pendulum-v1." in said
    found = [x.outcome for x in experts.EXPERIMENT.judged(report)]
    assert found == ["undecided"] + ["holds"] * 3 + ["does not hold"]


def test_the_page_and_the_figure_show_ours_beside_the_papers(report):
    body = experts.EXPERIMENT.block("body", report)
    assert "\u2212117.7 [\u2212119.2, \u2212115.3]" in body
    figure = experts.EXPERIMENT.figures(report)["experts"]
    assert [axes.get_title(loc="left") for axes in figure.axes] == list(CLASSIC_CONTROL)
