"""How far agents are apart is taken before and after the clip, and the page says where the clip helps most."""

import numpy as np
import pytest

from experiments import saturation
from experiments.saturation import Options, bandits, spread
from scb.errors import UserError


def test_what_lies_beyond_an_end_is_the_same_action():
    # Two agents in two states, two actions: the first 2 and 3, both 1 after the clip; the second switches.
    means = np.array([[[2.0, 0.5], [2.0, -0.5]], [[3.0, 0.5], [3.0, -0.5]]])
    found = spread(means)
    assert found["beyond"] == pytest.approx([0.5, 0.5])  # the first of each two
    # Each is 0.5 from their mean of 2.5 in one action of two: sqrt(0.5^2 / 2).
    assert found["apart"] == pytest.approx(np.sqrt([0.125, 0.125]))
    assert found["clipped"] == pytest.approx([0.0, 0.0])
    assert found["directions"] == pytest.approx(1.0)


def test_two_actions_that_move_apart_are_two_directions():
    corners = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    assert spread(corners[None])["directions"] == pytest.approx(2.0)


def test_an_agent_that_diverged_is_counted_and_left_out():
    means = np.random.default_rng(0).normal(size=(5, 7, 2))
    without = saturation.spread(means[1:])
    means[0, 3] = np.nan
    found = saturation.spread(means)
    assert (without.pop("diverged"), found.pop("diverged")) == (0, 1)
    for name, values in without.items():
        np.testing.assert_array_equal(found[name], values)


def test_a_bandit_of_ours_is_taken_where_there_is_one():
    assert set(bandits("hopper", None)) == {"ours"}
    with pytest.raises(UserError, match="unknown bandit 'Synthetic-ant'"):
        bandits("ant", None)


def entry(beyond, apart, clipped):
    means = {"beyond": beyond, "apart": apart, "clipped": clipped}
    of_agents = {
        name: " ".join(str(x + d) for d in (-0.04, -0.01, 0.01, 0.04)) for name, x in means.items()
    }
    return {**of_agents, "directions": 2.0, "returns": "100 200 300 400", "actions": 6}


def test_the_page_says_where_the_clip_takes_most():
    report = {
        "size": {"agents": 4, "episodes": 1},
        "environments": {
            "hopper": {"ours": entry(0.2, 0.5, 0.4), "published": entry(0.4, 0.6, 0.4)},
            "halfcheetah": {"published": entry(0.95, 0.7, 0.1)},
        },
    }
    page = saturation.EXPERIMENT.page(report)
    assert "Furthest goes the published bandit of halfcheetah: 95 %" in page
    assert (
        "| hopper, ours | 250 [" in page
        and "| 0.20 [0.16, 0.24] | 0.50 [0.46, 0.54] | 0.40 [0.36, 0.44] | 2.0 of 6 |" in page
    )
    (axes,) = saturation.EXPERIMENT.figures(report)["saturation"].axes
    labels = [label.get_text() for label in axes.get_yticklabels()]
    assert labels == ["hopper, ours", "hopper, published", "halfcheetah, published"]
    low, high = axes.get_xlim()
    assert low == 0 and high > 0.74  # the outermost agent


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"agents": 1}, "agents is 1: it must be at least 2"),
        ({"environments": ("Hopper",)}, "unknown environment of a published bandit 'Hopper'"),
    ],
)
def test_impossible_options_are_refused(options, message):
    with pytest.raises(UserError, match=message):
        Options(**options)


def test_a_report_of_another_size_is_not_gone_on_with():
    report = {"size": {"agents": 4, "episodes": 1}}
    with pytest.raises(UserError, match=r"with size .*'agents': 4.*choose another --out"):
        saturation.measure(Options(environments=()), report, lambda: None)


@pytest.mark.slow
def test_agents_of_a_bandit_are_described(tmp_path):
    out = tmp_path / "saturation.json"
    flags = ["--environments", "hopper", "--agents", "2", "--episodes", "1", "--out", str(out)]
    assert saturation.EXPERIMENT.main(flags) == 0
    page = (tmp_path / "saturation.md").read_text()
    assert "| hopper, ours | " in page and "published |" not in page
