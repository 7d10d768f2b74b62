import numpy as np
import pytest

from experiments import brax_training as experiment
from experiments.brax_training import OURS, PUBLISHED, task
from lpo.full_size import full_size
from scb import measurement

NAMES = (task(OURS, "hopper", "spring"), task(PUBLISHED, "hopper", "generalized"))


def curves(steps, *agents):
    return {"steps": steps, "returns": [list(x) for x in agents]}


@pytest.fixture
def report():
    in_bandit = curves([0, 5000, 10_000], [0.0, 100.0, 200.0], [0.0, 150.0, 200.0])
    fast = curves([0, 400_000, 800_000], [0.0, 250.0, 300.0], [0.0, 100.0, 260.0])
    slow = curves([0, 400_000, 800_000], [0.0, 10.0, 90.0], [0.0, 20.0, 80.0])
    plan = {**experiment.EXPERIMENT.presets["quick"], "bandit_algorithms": ["ppo", "sac"]}
    return {
        "plan": plan,
        "left_out": [],
        "bandits": {name: {"ppo": in_bandit, "sac": in_bandit} for name in NAMES},
        "environments": {"hopper (spring)": {"ppo": fast}, "hopper (generalized)": {"ppo": slow}},
    }


def test_steps_to_match_are_of_the_first_evaluation_that_reaches_the_level():
    found = curves([0, 10, 20], [0.0, 5.0, 9.0], [0.0, 9.0, 2.0], [0.0, 1.0, 2.0])
    assert experiment.steps_to_match(found, 8.0) == [20, 10, None]
    assert experiment.steps_without(found, 8.0) == [10, 0, 20]
    assert experiment.steps_without(found, -1.0) == [0, 0, 0]


@pytest.mark.slow
def test_agents_are_followed_in_a_bandit_and_in_an_environment(tmp_path, monkeypatch, small_agents):
    # Pendulum stands in for Brax, whose physics compile for long.
    plan = {
        "published": None,
        "bandits": [[OURS, "Pendulum-v1", None]],
        "bandit_algorithms": ["ppo"],
        "bandit_agents": 2,
        "environment_agents": 2,
        "environment_steps": {"Pendulum-v1": {"ppo": 32}},
        "episodes": 2,
        "points": 2,
        "rows": tmp_path / "kept",
    }
    found, saved = {}, []
    experiment.measure(plan, found, lambda: saved.append(1))
    in_bandit = found["bandits"][task(OURS, "Pendulum-v1", None)]["ppo"]
    own = found["environments"]["Pendulum-v1"]["ppo"]
    assert in_bandit["steps"] == [0, 16] and own["steps"] == [0, 16, 32]
    assert np.shape(in_bandit["returns"]) == (2, 2) and np.shape(own["returns"]) == (2, 3)
    experiment.measure(plan, found, lambda: saved.append(1))
    assert len(saved) == 2

    # As if killed before the report had them: their agents are kept, and not trained again.
    def forbidden(*arguments):
        raise AssertionError("trained")

    monkeypatch.setattr(measurement, "_program_of", forbidden)
    lost = found["environments"]["Pendulum-v1"].pop("ppo")
    experiment.measure(plan, found, lambda: None)
    assert found["environments"]["Pendulum-v1"]["ppo"]["returns"] == lost["returns"]


def test_published_bandits_that_are_in_the_report_need_no_folder(monkeypatch):
    published = [PUBLISHED, "Pendulum-v1", None]
    plan = {
        "published": None,
        "bandits": [published],
        "bandit_algorithms": ["ppo", "sac"],
        "environment_steps": {"Pendulum-v1": {"ppo": 32}},
    }
    name = task(*published)
    whole = curves([0, 10_000], [0.0, 1.0])
    monkeypatch.setattr(experiment, "_in_environment", lambda *_: whole)
    found = {"bandits": {name: {"ppo": whole, "sac": whole}}}
    experiment.measure(plan, found, lambda: None)
    assert found["left_out"] == [] and found["environments"] == {"Pendulum-v1": {"ppo": whole}}
    # A part of its algorithms can't be completed, and makes no row of the figure.
    found = {"bandits": {name: {"ppo": whole}}}
    experiment.measure(plan, found, lambda: None)
    assert found["left_out"] == [name] and found["bandits"] == {}


def outcomes(found):
    """Of the claims about steps, then of those about standing still."""
    judged = [x.outcome for x in experiment.EXPERIMENT.judged(found)]
    return judged[::2], judged[1::2]


def test_claims_follow_the_figures(report):
    said = experiment.EXPERIMENT.block("verdict", report)
    assert "undecided: all 2 pairs of bandit and algorithm have fewer than 10 agents" in said
    assert "1 of the 2 levels the median agent does not reach" in said
    body = experiment.EXPERIMENT.block("body", report)
    assert "| 200 [200, 200] | 2 of 2 | 200000 | 600000 | 20 to 60 | 20 to 60 |" in body
    assert "| 200 [200, 200] | 0 of 2 | 800000 |  | more than 80 |" in body
    # Two agents each decide nothing, whatever they say.
    assert outcomes(report) == (["undecided", "undecided"], ["undecided"] * 2)
    bandit = report["bandits"][NAMES[0]]["ppo"]
    report["bandits"][NAMES[0]]["ppo"] = {**bandit, "returns": bandit["returns"] * 5}
    # Ten do, and 200 is less than standing still.
    assert sorted(outcomes(report)[1]) == ["does not hold", "undecided"]
    report["bandits"][NAMES[0]]["ppo"] = bandit
    curve = report["environments"]["hopper (generalized)"]["ppo"]
    many = {**curve, "returns": curve["returns"] * 5}
    report["environments"]["hopper (generalized)"]["ppo"] = many
    assert outcomes(report)[0] == ["undecided", "holds"]
    said = experiment.EXPERIMENT.block("verdict", report)
    assert "takes more than 80 times the steps (hopper" in said and "The other 1 of 2 pairs" in said
    report["environments"]["hopper (generalized)"]["ppo"] = curve
    # Of two agents one gets there: the median is not that one's.
    report["environments"]["hopper (spring)"]["ppo"]["returns"][0] = [0.0, 0.0, 0.0]
    said = experiment.EXPERIMENT.block("verdict", report)
    assert "2 of the 2 levels the median agent does not reach" in said
    assert "| 1 of 2 | 600000 |  | more than 60 |" in experiment.EXPERIMENT.block("body", report)


def test_of_many_pairs_the_least_and_the_most_are_named(report):
    report["bandits"]["hopper (spring), published"] = report["bandits"]["hopper (spring), ours"]
    for algorithms in report["environments"].values():
        algorithms["ppo"]["returns"] *= 5
    said = experiment.EXPERIMENT.block("verdict", report)
    least, most = (
        "20 to 60 times the steps (hopper (spring), ours, PPO)",
        "more than 80 times the steps",
    )
    assert f"takes {least} at the least, and {most} (hopper (generalized), published, PPO)" in said
    assert "at the most, over 3 pairs." in said
    assert said.count("times the steps") == 2 and "decide nothing" not in said


def test_the_uncertainty_of_a_level_is_that_of_its_steps(report):
    # The interval of two agents is their range, 100 to 300: both agents earn 100 at the first evaluation.
    in_bandit = curves([0, 10_000], [0.0, 100.0], [0.0, 300.0])
    report["bandits"]["hopper (spring), ours"]["ppo"] = in_bandit
    body = experiment.EXPERIMENT.block("body", report)
    assert "| 200 [100, 300] | 2 of 2 | 200000 | 600000 | 20 to 60 | 0 to 40 |" in body
    for trained in report["environments"].values():
        trained["ppo"]["returns"] *= 5  # ten agents, of whom some decide
    assert outcomes(report)[0] == ["does not hold", "holds"]


def test_the_page_and_the_figure_show_bandits_environments_and_the_paper(report):
    body = experiment.EXPERIMENT.block("body", report)
    assert "| 854 | 2522 |" in body and "left out" not in body  # the paper's PPO on Hopper
    report["left_out"] = ["walker2d (generalized), published"]
    told = experiment.EXPERIMENT.block("body", report)
    assert "| left out | walker2d (generalized), published: --published" in told
    figure = experiment.draw(report)
    assert len(figure.axes) == 4
    ppo, sac = figure.axes[:2]
    # Bandit and environment; with SAC the bandit, and the paper's level in its physics.
    assert len(ppo.lines) == 2 and len(sac.lines) == 1
    assert len(figure.axes[3].lines) == 2
    np.testing.assert_array_equal(ppo.lines[0].get_xdata(), [5000, 10_000])


def test_ppo_is_not_trained_again_where_objectives_were_compared_at_this_length(monkeypatch):
    monkeypatch.setattr(experiment, "_curves", lambda *_: "trained")
    plan = {
        "environment_agents": 4,
        "environment_steps": {"hopper": {"ppo": 5_242_880, "sac": 1_000_000}},
    }
    kept = full_size("hopper").curves[0]
    found = experiment._in_environment("hopper", "generalized", plan, "ppo")
    np.testing.assert_array_equal(found["returns"], kept.returns)
    assert found["steps"][-1] == 5_242_880 and len(found["returns"]) >= 10
    # Other physics, another algorithm, fewer steps.
    assert experiment._in_environment("hopper", "spring", plan, "ppo") == "trained"
    assert experiment._in_environment("hopper", "generalized", plan, "sac") == "trained"
    shorter = {**plan, "environment_steps": {"hopper": {"ppo": 1_000_000}}}
    assert experiment._in_environment("hopper", "generalized", shorter, "ppo") == "trained"


def test_published_bandits_count_only_where_their_folder_is_named(monkeypatch, tmp_path):
    # Such a folder beside the checkout, or in a variable, changes nothing.
    (tmp_path / "shared" / "published_scbs").mkdir(parents=True)
    (tmp_path / "checkout").mkdir()
    monkeypatch.chdir(tmp_path / "checkout")
    monkeypatch.setenv("SCB_PUBLISHED", str(tmp_path / "shared" / "published_scbs"))
    plan = {
        "bandits": [[PUBLISHED, "hopper", "generalized"]],
        "bandit_algorithms": ["ppo"],
        "environment_steps": {"hopper": {"ppo": 32}},
        "published": None,
    }
    found = {}
    experiment.measure(plan, found, lambda: None)
    assert found["left_out"] == ["hopper (generalized), published"]
    assert found["bandits"] == found["environments"] == {}
    # Nor does one that holds others only.
    monkeypatch.setattr(experiment.zoo_table, "bandits", lambda name, folder: {OURS: None})
    experiment.measure({**plan, "published": tmp_path}, found, lambda: None)
    assert found["left_out"] == ["hopper (generalized), published"]
    monkeypatch.setattr(experiment.zoo_table, "bandits", lambda name, folder: {PUBLISHED: None})
    asked = []
    monkeypatch.setattr(
        experiment, "_in_bandit", lambda *x: asked.append(x) or curves([0, 1], [0, 1])
    )
    monkeypatch.setattr(experiment, "_in_environment", lambda *_: curves([0, 1], [0, 1]))
    experiment.measure({**plan, "published": tmp_path}, found, lambda: None)
    assert found["left_out"] == [] and asked[0][:2] == (PUBLISHED, "hopper")
