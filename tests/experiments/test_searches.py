import numpy as np
import pytest
from matplotlib.figure import Figure

from experiments import ablations, episode_lengths, generality, searches
from experiments.claims import Claim, judge
from scb import plotting
from scb.commands import Discover
from scb.discovery import DiscoveryConfig, discover
from scb.evolution import EvolutionConfig

CONFIG = DiscoveryConfig(
    "CartPole-v1",
    agents_per_candidate=1,
    evaluation_episodes=1,
    init="random",
    evolution=EvolutionConfig(
        population_size=2, num_generations=2, mean_evaluations=2, evaluate_mean_every=1
    ),
)


@pytest.mark.slow
def test_a_search_that_has_ended_is_read_and_not_run_again(tmp_path, small_agents):
    _, first = discover(CONFIG, tmp_path / "run")
    _, again = discover(CONFIG, tmp_path / "run")
    assert again.metrics == first.metrics
    assert again.seconds == pytest.approx(first.seconds, abs=1e-3)
    np.testing.assert_array_equal(
        again.mean["reward"]["Dense_0"]["kernel"], first.mean["reward"]["Dense_0"]["kernel"]
    )
    found = searches.curve(first.metrics)
    assert found["generation"] == [0, 1, 2]
    assert found["fitness"][-1] == pytest.approx(
        first.metrics[-1]["final_mean/fitness_iqm"], abs=0.01
    )
    assert found["failed"] == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("experiment", "part"),
    [(ablations, "environments"), (episode_lengths, "sizes"), (generality, "sizes")],
)
def test_searches_of_the_papers_size_are_those_of_its_preset(experiment, part):
    for name, size in experiment.EXPERIMENT.presets["paper"][part].items():
        paper = Discover.presets["paper"]({"environment": name})
        assert (
            size.items()
            >= {
                "generations": paper.evolution.num_generations,
                "population_size": paper.evolution.population_size,
                "agents_per_candidate": paper.agents_per_candidate,
            }.items()
        )


def test_the_last_judgement_is_over_searches_that_have_one():
    curves = {str(i): {"fitness": [0.0, x]} for i, x in enumerate([1.0, None, 4.0])}
    found = searches.final(curves, np.mean)
    assert (found.estimate.value, found.failed, found.searches) == (2.5, 1, 3)
    assert found.text(1) == "2.5 [1.0, 4.0] (1 of 3 failed)"
    none = searches.final({"0": {"fitness": [None]}}, np.mean)
    assert none.estimate is None and none.text() == "all failed"


def test_a_judgement_without_a_number_is_a_gap_and_failures_are_averaged():
    metrics = [
        {"generation": 0, "failed": 2, "mean/fitness": -7.0, "mean/fitness_iqm": -6.0},
        {"generation": 1, "failed": 4},
        {"generation": 2, "failed": 0, "mean/fitness": float("nan")},
        {"generation": 3, "failed": 1, "final_mean/fitness": -3.0, "final_mean/fitness_iqm": -2.0},
    ]
    assert searches.curve(metrics) == {
        "generation": [0, 2, 4],
        "fitness": [-6.0, None, -2.0],
        "mean": [-7.0, None, -3.0],
        "failed": [0.0, 3.0, 0.5],
    }


def test_a_search_that_went_on_is_drawn_beside_one_that_did_not_end_before():
    def line(generation, kind=None, worth=None):
        judged = {f"{kind}/fitness{of}": worth for of in ("", "_iqm")} if kind else {}
        return {"generation": generation, "failed": 0, **judged}

    begun, after = line(0, "mean", 1.0), [line(2, "mean", 3.0), line(3, "final_mean", 4.0)]
    ended = line(1, "final_mean", 2.0)
    straight = searches.curve([begun, line(1), *after])
    assert searches.curve([begun, ended, *after]) == straight
    assert (straight["generation"], straight["fitness"]) == ([0, 2, 4], [1.0, 3.0, 4.0])
    assert searches.curve([begun, ended])["fitness"] == [1.0, 2.0]


def test_a_line_is_the_mean_over_searches_and_leaves_gaps():
    axes = Figure().subplots()
    curves = [
        {"generation": [0, 1, 2], "fitness": [1.0, None, 3.0]},
        {"generation": [0, 1, 2], "fitness": [3.0, None, 3.0]},
    ]
    plotting.search_curve(axes, curves, "two", plotting.LINES[0])
    np.testing.assert_array_equal(axes.lines[0].get_ydata(), [2.0, np.nan, 3.0])
    plotting.search_curve(axes, [], "none", plotting.LINES[0])
    assert len(axes.lines) == 1


def test_only_five_searches_or_more_are_told_apart():
    def ending(*fitness):
        return {str(i): {"fitness": [x]} for i, x in enumerate(fitness)}

    def outcome(one, other):
        return judge([Claim("one ends higher", searches.difference(one, other, np.mean))])[
            0
        ].outcome

    high, low = ending(*range(10, 15)), ending(*range(5))
    assert outcome(high, low) == "holds" and outcome(low, high) == "does not hold"
    assert outcome(high, ending(*range(9, 16))) == "undecided"
    # 2.3 apart: beyond the percentiles of resamples, 1.7, and within Student's t of four degrees, 2.78.
    assert outcome(ending(2.3, 3.3, 4.3, 5.3, 6.3), low) == "undecided"
    assert outcome(ending(2.9, 3.9, 4.9, 5.9, 6.9), low) == "holds"
    assert outcome(ending(10, 11), ending(0, 1)) == "undecided"
    assert outcome(ending(10), ending(*range(5))) == "undecided"
    # A failure is worse than any return.
    assert outcome(ending(10, 11, 12, 13, 14, None), low) == "undecided"
    assert outcome(ending(*[None] * 5), low) == "undecided"
