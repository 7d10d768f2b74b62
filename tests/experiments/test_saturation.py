"""What agents earn as one tells errors that all share from each one's own, of which the clip takes a part away."""

import jax.numpy as jnp
import numpy as np
import pytest

from experiments import saturation
from experiments.saturation import Options, bandits, spread
from experiments.zoo_table import Candidate
from scb.environments.zoo import load_bandit
from scb.errors import UserError
from scb.evaluation import evaluate
from scb.keys import named_key, root_key
from scb.measurement import Place
from scb.statistics import Estimate


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


def around(value, step):
    return " ".join(str(round(value + d * step, 4)) for d in (-4, -1, 1, 4))


def entry(beyond, apart, clipped, returns=250, together=250, best=250):
    distances = {"beyond": beyond, "apart": apart, "clipped": clipped}
    earned = {"returns": returns, "together": together, "best": best}
    return {
        **{name: around(value, 0.01) for name, value in distances.items()},
        **{name: around(value, 10) for name, value in earned.items()},
        "directions": 2.0,
        "actions": 6,
    }


def test_the_page_tells_errors_of_all_from_an_agents_own():
    report = {
        "size": {"agents": 4, "episodes": 1},
        "environments": {
            "hopper": {
                "ours": entry(0.2, 0.5, 0.4, returns=250, together=500, best=510),
                "published": entry(0.4, 0.6, 0.4, returns=250, together=240, best=500),
            },
            "halfcheetah": {"published": entry(0.95, 0.7, 0.1, 250, 400, 280)},
        },
    }
    page = saturation.EXPERIMENT.page(report)
    assert (
        "**Mostly each in its own way in hopper, ours. As one they are not much better in hopper, published.**"
        in page
    )
    assert "beyond an end: 95 % in halfcheetah, published." in page
    assert "the clip takes a part away, most where most of what agents would do" in page
    elsewhere = {"hopper": {"ours": entry(0.2, 0.5, 0.04, returns=250, together=500, best=510)}}
    page_of_it = saturation.EXPERIMENT.page(
        {**report, "environments": {**report["environments"], **elsewhere}}
    )
    assert (
        "a part away, most in hopper, ours; most of what agents would do lies beyond an end: 95 % in halfcheetah"
        in page_of_it
    )
    assert (
        "| hopper, ours | 250 [210, 290] | 500 [460, 540] | 510 [470, 550] | 0.96 [0.65, 1.39] | 0.20 [0.16, 0.24] | "
        "0.50 [0.46, 0.54] | 0.40 [0.36, 0.44] | 2.0 of 6 |" in page
    )
    assert (
        "| halfcheetah, published | 250 [210, 290] | 400 [360, 440] | 280 [240, 320] | the best is not above |"
        in page
    )
    earned, apart = saturation.EXPERIMENT.figures(report)["saturation"].axes
    labels = [label.get_text() for label in earned.get_yticklabels()]
    assert labels == ["hopper, ours", "hopper, published", "halfcheetah, published"]
    for axes, outermost in ((earned, 550), (apart, 0.74)):  # an agent or an episode
        low, high = axes.get_xlim()
        assert low == 0 and high > outermost


def test_where_nothing_is_apart_nothing_is_said_of_it():
    report = {
        "size": {"agents": 4, "episodes": 1},
        "environments": {"hopper": {"ours": entry(0.2, 0.5, 0.4)}},
    }
    page = saturation.EXPERIMENT.page(report)
    assert "**In no bandit mostly each in its own way, as far as this shows.** All agents" in page


def test_the_way_to_the_best_action_is_as_wide_as_its_parts():
    each, together, best = (
        Estimate(value, value - 10, value + 10, 8) for value in (100.0, 150.0, 200.0)
    )
    found = saturation.way(each, together, best)
    assert found.value == 0.5 and found.n == 8
    # From 110 to 140 of 210; from 110 to 160 of 190.
    assert (found.low, found.high) == (pytest.approx(0.3), pytest.approx(0.7))
    assert saturation.way(together, each, together) is None
    assert saturation.way(each, together, best.without_interval()) is None


class Pointing:
    """An agent whose state is the action that it takes."""

    def act(self, state, observation, key, env_params=None, mode=False):
        return state


def test_all_as_one_act_by_the_mean_of_their_actions():
    place, bandit = Place.named("Pendulum-v1"), load_bandit("Synthetic-Pendulum-v1")
    candidate = Candidate("Pendulum-v1", "ours", bandit, "")
    pushes = jnp.array([[-2.0], [0.0], [1.0], [1.0]])  # of mean 0
    earned = saturation.earned_together(Pointing(), pushes, candidate, place, root_key(0))
    key = named_key(root_key(0), "together")
    still = evaluate(place.env, place.params, lambda o, k: jnp.zeros(1), key, saturation.EPISODES)
    np.testing.assert_allclose(earned["together"], still.returns, rtol=1e-3)
    assert np.mean(earned["best"]) > -300 > np.mean(earned["together"])


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
