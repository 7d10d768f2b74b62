import numpy as np
import pytest

from experiments import interpretability
from experiments.harness import CLASSIC_CONTROL
from scb.files import unpacked


def test_one_environment_is_examined(monkeypatch):
    monkeypatch.setattr(interpretability, "CLASSIC_CONTROL", ("MountainCar-v0",))
    report, saved = {}, []
    plan = {"episodes": 4, "repetitions": 2, "seed": 3}
    interpretability.measure(plan, report, lambda: saved.append(1))
    found = report["environments"]["MountainCar-v0"]
    assert saved == [1]
    assert found["importance"]["velocity"]["value"] > 3 * found["importance"]["position"]["value"]
    # Nothing is ever better than pushing; and a car that rolls to the right is pushed there.
    assert interpretability.nothing_done(found) == 0.0
    actions = unpacked(found["actions"])
    assert actions.shape == (60, 60)
    assert (actions[-1] == 2).all() and (actions[0] == 0).all()
    # The episode starts in the valley and ends at the goal.
    episode = unpacked(found["episode"])
    assert -0.6 <= episode[0, 0] <= -0.4 and episode[-1, 0] > 0.4
    # What is there is not examined again.
    interpretability.measure(plan, report, lambda: saved.append(2))
    assert saved == [1]


@pytest.fixture
def report(committed):
    return committed("interpretability")


def test_claims_follow_the_figures(report):

    def share(value):
        return {"value": value, "low": value - 0.01, "high": value + 0.01, "n": 20}

    for name, x in report["environments"]["Acrobot-v1"]["importance"].items():
        x |= share(0.5 if "velocity" in name else 0.01)
    for name in ("position (m)", "angle (rad)"):
        report["environments"]["CartPole-v1"]["importance"][name] |= share(0.02)
    said = interpretability.EXPERIMENT.block("verdict", report)
    assert "causes 50%, its other angular velocity 50%, and no angle more than 1%." in said
    found = [x.outcome for x in interpretability.EXPERIMENT.judged(report)]
    assert found == ["holds"] * 4 + ["does not hold"]
    # A share whose interval reaches over the tenth is undecided, wherever its point is.
    report["environments"]["CartPole-v1"]["importance"]["angle (rad)"] |= share(0.095)
    assert interpretability.EXPERIMENT.judged(report)[2].outcome == "undecided"


def test_the_figure_has_a_map_and_bars_of_each_environment(report):
    figure = interpretability.EXPERIMENT.figures(report)["interpretability"]
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert set(CLASSIC_CONTROL) <= set(titles)
    rows = sum(len(x["importance"]) for x in report["environments"].values())
    assert sum(len(axes.patches) for axes in figure.axes) >= rows
    lines = interpretability.EXPERIMENT.block("body", report).splitlines()
    assert sum(line.startswith("| ") for line in lines) == rows + 2
    assert np.isfinite(report["environments"]["Pendulum-v1"]["return"]["value"])
