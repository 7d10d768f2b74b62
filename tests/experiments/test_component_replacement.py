import numpy as np
import pytest

from experiments import component_replacement as experiment
from experiments.component_replacement import (
    ACTION,
    BANDIT,
    CLONING,
    EXPERT,
    REPLACED,
    REWARDS,
    STATES,
    SYNTHETIC,
    Q,
    cell,
)
from scb.statistics import iqm


@pytest.fixture
def report(committed):
    return committed("component_replacement")


def with_returns(bandit, *experts):
    """A report in which agents of the bandit earn `bandit`, and those of an expert {(reward, states): return}."""
    return {
        "random": -1100.0,
        "bandit": bandit,
        "experts": {
            str(i): {"own": [-100.0] * 8, "returns": {cell(*x): r for x, r in returns.items()}}
            for i, returns in enumerate(experts)
        },
    }


def test_scores_are_between_the_random_policy_and_each_expert():
    report = with_returns(
        [-100.0] * 4, {(Q, EXPERT): [-1100.0, -600.0] * 2}, {(Q, EXPERT): [-600.0] * 4}
    )
    report["experts"]["1"]["own"] = [0.0] * 8
    np.testing.assert_allclose(
        experiment.scores_of(report, Q, EXPERT), [[0.0, 0.5] * 2, [5 / 11] * 4]
    )
    # The bandit is the same whoever the expert is, whose score is another.
    np.testing.assert_allclose(
        experiment.scores_of(report, BANDIT, SYNTHETIC), [[1.0] * 4, [10 / 11] * 4]
    )


def test_a_few_experts_decide_nothing(report):
    whole = [x.outcome for x in experiment.EXPERIMENT.judged(report)]
    assert "holds" in whole
    few = report | {"experts": dict(list(report["experts"].items())[:3])}
    assert {x.outcome for x in experiment.EXPERIMENT.judged(few)} == {"undecided"}


@pytest.mark.slow
def test_a_run_goes_on_with_the_expert_that_it_was_at(monkeypatch, small_agents):
    chosen = ((CLONING, SYNTHETIC), (BANDIT, EXPERT))
    monkeypatch.setattr(experiment, "REPLACED", chosen)
    report, saved = {}, []
    plan = {"experts": 1, "candidates": 1, "expert_episodes": 2, "agents": 2, "episodes": 2}
    experiment.measure(plan, report, lambda: saved.append(1))
    (entry,) = report["experts"].values()
    assert len(saved) == 1 + len(chosen) and set(entry["returns"]) == {cell(*x) for x in chosen}
    assert -1500.0 < report["random"] < -900.0 and len(entry["own"]) == 2
    experiment.measure(plan, report, lambda: saved.append(1))
    assert len(saved) == 1 + len(chosen)
    lost = entry["returns"].pop(cell(BANDIT, EXPERT))
    experiment.measure(plan, report, lambda: saved.append(1))
    assert len(saved) == 2 + len(chosen)
    np.testing.assert_allclose(entry["returns"][cell(BANDIT, EXPERT)], lost, rtol=0.05)


@pytest.mark.slow
def test_a_tiny_run_tells_the_bandits_contexts_from_the_experts_states():
    report = {}
    plan = {"experts": 1, "candidates": 2, "expert_episodes": 8, "agents": 8, "episodes": 4}
    experiment.measure(plan, report, lambda: None)
    found = {x: iqm(experiment.scores_of(report, *x)) for x in REPLACED}
    assert iqm(report["experts"]["0"]["own"]) > -250.0
    assert iqm(experiment.scores_of(report, BANDIT, SYNTHETIC)) > found[BANDIT, EXPERT] + 0.2


def outcomes(found):
    return [x.outcome for x in experiment.EXPERIMENT.judged(found)]


def test_claims_follow_the_figures():
    good, bad = [-200.0, -220.0, -180.0, -190.0], [-1000.0, -1020.0, -900.0, -950.0]
    needed = {(r, s): good if s == SYNTHETIC else bad for r, s in REPLACED}
    found = ["holds"] * 3 + ["undecided"] + ["holds"] * 2
    assert outcomes(with_returns(good, *[needed] * 5)) == found
    alike = dict.fromkeys(REPLACED, good)
    assert outcomes(with_returns(good, *[alike] * 5))[:3] == ["undecided"] * 3
    poor = needed | {(r, SYNTHETIC): bad for r in (ACTION, CLONING, Q)}
    found = ["holds", "undecided", "undecided", "holds"] + ["does not hold"] * 2
    assert outcomes(with_returns(good, *[poor] * 5)) == found
    # One expert of five from whom cloning learns nothing makes it uncertain: neither worse nor as good.
    assert outcomes(with_returns(good, *[needed] * 4, poor))[4:] == ["undecided"] * 2


def test_the_page_and_the_figure_show_every_combination(report):
    lines = experiment.EXPERIMENT.block("body", report).splitlines()
    assert sum(line.startswith("| ") for line in lines) == len(REWARDS) * len(STATES) + 2
    (axes,) = experiment.draw(report).axes
    dots = [line for line in axes.lines if len(line.get_xdata()) == len(report["experts"])]
    assert len(dots) == len(REWARDS) * len(STATES)
