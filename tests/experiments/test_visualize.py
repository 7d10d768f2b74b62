from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from experiments import visualize
from experiments.harness import CLASSIC_CONTROL


@pytest.fixture
def report(committed):
    return committed("visualize")


def test_the_strip_shows_an_episode_from_its_start_to_its_end(report):
    figure = visualize.draw(report)
    assert len(figure.axes) == len(CLASSIC_CONTROL) * visualize.FRAMES
    shown = visualize.film(report["environments"]["MountainCar-v0"])
    assert -0.6 <= shown[0, 0] <= -0.4 < 0.3 < shown[-1, 0]


def test_gifs_are_made_from_the_report(report, tmp_path):
    entry = report["environments"]["Pendulum-v1"]
    few = {"environments": {"Pendulum-v1": {**entry, "film": entry["film"][:5]}}}
    visualize.animate(few, tmp_path)
    with Image.open(tmp_path / "figures" / "visualize_Pendulum-v1.gif") as gif:
        assert gif.n_frames == 5


@pytest.mark.slow
def test_an_agent_is_trained_in_its_bandit_and_shown(monkeypatch):
    monkeypatch.setattr(visualize, "CLASSIC_CONTROL", ("CartPole-v1",))
    # As if the run had been interrupted with Hopper done, whose page is there.
    monkeypatch.setattr(visualize, "VIEWER", Path(__file__))
    found, saved = {"environments": {visualize.HOPPER: {}}}, []
    plan = {"agents": 2, "episodes": 2, "seed": 1, "every": 50}
    visualize.measure(plan, found, lambda: saved.append(1))
    entry = found["environments"]["CartPole-v1"]
    assert len(saved) == 1 and entry["shown"] == entry["steps"] == 500
    # Every fiftieth observation of 500, and the last.
    assert visualize.film(entry).shape == (11, 4)
    assert np.abs(visualize.film(entry)[0]).max() <= 0.05


def test_few_agents_decide_nothing(report):
    for entry in report["environments"].values():
        entry["agents"]["n"] = 4
    assert {x.outcome for x in visualize.EXPERIMENT.judged(report)} == {"undecided"}


def test_the_page_says_what_the_shown_episodes_earn(report):
    said = visualize.EXPERIMENT.block("verdict", report)
    told = [x.outcome for x in visualize.EXPERIMENT.judged(report)]
    outcome = dict(zip(report["environments"], told, strict=True))
    assert outcome["CartPole-v1"] == "holds" and outcome[visualize.HOPPER] == "holds"
    # −83 is above the tenth below the expert's −76.7, its interval's end is not.
    assert outcome["Acrobot-v1"] == "undecided"
    assert "On Hopper the agents earn 2363 [" in said
    lines = visualize.EXPERIMENT.block("body", report).splitlines()
    assert sum(line.startswith("| ") for line in lines) == 8
