import copy
import json
from pathlib import Path

import numpy as np
import pytest

from experiments import component_replacement as experiment
from experiments.component_replacement import (
    ACTION,
    BANDIT,
    CLONING,
    EXPERT,
    REWARDS,
    STATES,
    SYNTHETIC,
    Q,
    cell,
)

COMMITTED = Path(__file__).parents[2] / "docs" / "data" / "component_replacement.json"


@pytest.fixture
def report():
    return json.loads(COMMITTED.read_text())


def test_scores_are_between_the_random_policy_and_the_expert():
    report = {
        "expert": [-100.0] * 8,
        "random": -1100.0,
        "returns": {cell(BANDIT, SYNTHETIC): [-100.0] * 4, cell(Q, EXPERT): [-1100.0, -600.0] * 4},
    }
    found = experiment.scores(report)
    assert found[cell(BANDIT, SYNTHETIC)].value == 1.0
    assert found[cell(Q, EXPERT)].value == pytest.approx(0.25)


def test_the_verdict_follows_the_figures(report):
    changed = copy.deepcopy(report)
    good = changed["returns"][cell(BANDIT, SYNTHETIC)]
    bad = list(np.array(good) - 900.0)
    changed["returns"] = {
        cell(r, s): good if s == SYNTHETIC else bad for r in REWARDS for s in STATES
    }
    said = experiment.verdict(changed)
    assert "the contexts are what matters" in said
    changed["returns"] = {cell(r, s): good for r in REWARDS for s in STATES}
    said = experiment.verdict(changed)
    assert "are not always what matters" in said and "it is not clearly worse here" in said
    assert "not clearly less than" in said and "as good as" in said
    for reward in (ACTION, CLONING):
        changed["returns"][cell(reward, SYNTHETIC)] = bad
    said = experiment.verdict(changed)
    assert "which is less than" in said and "worse than the bandit" in said


def test_the_page_and_the_figure_show_every_combination(report):
    lines = experiment.body(report)
    assert sum(line.startswith("| ") for line in lines) == len(REWARDS) * len(STATES) + 2
    (axes,) = experiment.draw(report).axes
    dots = [line for line in axes.lines if len(line.get_xdata()) == report["agents"]]
    assert len(dots) == len(REWARDS) * len(STATES)


@pytest.mark.slow
def test_a_tiny_run_tells_the_bandits_contexts_from_the_experts_states():
    report = {}
    plan = {"experts": 2, "expert_episodes": 8, "agents": 8, "episodes": 4}
    experiment.measure(plan, report, lambda: None)
    found = experiment.scores(report)
    assert len(found) == 8
    assert found[cell(BANDIT, SYNTHETIC)].value > found[cell(BANDIT, EXPERT)].value + 0.2
