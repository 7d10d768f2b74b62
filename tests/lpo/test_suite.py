"""Scores over a suite of environments: how they are normalised, aggregated, kept and refused."""

import json

import numpy as np
import pytest

from lpo import figures, suite, training_commands
from lpo.comparison import Comparison, LearningCurves, learning_curves
from lpo.objectives import learned_in, load_objective
from lpo.suite import SuiteScores, run_suite, suite_scores, suites
from scb import plotting
from scb.agents.ppo import PPOHyperparameters
from scb.agents.spec import AgentSpec, environment_agent
from scb.environments.registry import environment_names
from scb.environments.spec import EnvironmentSpec
from scb.errors import UserError


def curves(environment: str, objective: str, finals, backend=None) -> LearningCurves:
    finals = np.asarray(finals, np.float64)
    returns = np.stack([np.zeros_like(finals), finals], axis=1)
    seeds = list(range(len(finals)))
    return LearningCurves(
        environment, backend, objective, np.array([0, 100]), returns, seeds, 5, True
    )


def comparison(environment: str, **finals) -> Comparison:
    return Comparison([curves(environment, name, x) for name, x in finals.items()])


def test_every_environment_of_the_suites_can_be_made():
    found = suites()
    assert list(found) == ["classic", "minatar", "brax", "all"]
    assert set(found["all"]) <= set(environment_names())
    assert len(found["brax"]) >= 6
    assert {"CartPole-v1", "Pendulum-v1", "Breakout-MinAtar", "hopper"} <= set(found["all"])


def test_zero_is_random_and_one_is_the_reference():
    scores = suite_scores(
        {
            "CartPole-v1": comparison("CartPole-v1", ppo=[20.0, 260.0], dpo=[500.0, 500.0]),
            "Catch-bsuite": comparison("Catch-bsuite", ppo=[0.0, 10.0], dpo=[5.0, 15.0]),
        },
        {"CartPole-v1": 20.0, "Catch-bsuite": 0.0},
    )
    # 500 is published for CartPole; what nobody published has the best objective's: IQM 10.
    np.testing.assert_allclose(scores.scores[0], [[0.0, 0.5], [0.0, 1.0]])
    np.testing.assert_allclose(scores.scores[1], [[1.0, 1.0], [0.5, 1.5]])
    assert scores.reference == [500.0, 10.0]
    assert scores.sources[1] == "the best objective here"


def scored(scores) -> SuiteScores:
    """Of one objective."""
    scores = np.asarray([scores], np.float64)
    names = [f"e{i}" for i in range(scores.shape[1])]
    zeros, ones = [0.0] * len(names), [1.0] * len(names)
    return SuiteScores(names, ["ppo"], scores, zeros, ones, ["published"] * len(names), [])


def test_seeds_are_drawn_anew_in_every_environment():
    # Where both draw the same seeds, the four runs are always two zeros and two ones.
    (found,) = scored([[0.0, 1.0], [1.0, 0.0]]).aggregate()
    assert (found.value, found.low, found.high) == (0.5, 0.0, 1.0)


def test_the_interval_of_a_suite_leaves_out_a_fortieth_on_either_side():
    # Of three seeds the lowest is drawn three times in one of 27 resamples.
    (found,) = scored([[0.0, 1.0, 2.0]]).aggregate()
    assert (found.value, found.low, found.high) == (1.0, 0.0, 2.0)


def test_one_seed_has_no_interval():
    one = suite_scores(
        {"CartPole-v1": comparison("CartPole-v1", ppo=[260.0], dpo=[500.0])}, {"CartPole-v1": 20.0}
    )
    assert {(x.low, x.high) for x in (*one.aggregate(), *one.differences())} == {(None, None)}


def test_a_reference_that_is_chosen_among_the_objectives_is_chosen_anew_in_every_resample():
    # Alone, an objective is its own reference: 1 whatever the seeds, and so without any spread.
    catch = "Catch-bsuite"
    alone = suite_scores({catch: comparison(catch, ppo=[2.0, 6.0, 7.0])}, {catch: 0.0})
    (found,) = alone.aggregate()
    assert (found.value, found.low, found.high) == pytest.approx((1.0, 1.0, 1.0))
    # Under a published one it has some: (1 + 1 + 0.5) / 3 of CartPole's 500 over 20.
    published = suite_scores(
        {"CartPole-v1": comparison("CartPole-v1", ppo=[500.0, 500.0, 260.0])}, {"CartPole-v1": 20.0}
    )
    (found,) = published.aggregate()
    assert found.value == pytest.approx(2.5 / 3) and found.low < found.value < found.high


def test_published_brax_returns_are_of_one_physics():
    here = [curves("hopper", "ppo", [600.0, 700.0], backend="spring")]
    there = [curves("hopper", "ppo", [600.0, 700.0], backend="generalized")]
    assert suite.reference_of("hopper", Comparison(here))[0] == 650.0
    assert suite.reference_of("hopper", Comparison(there))[0] == 2521.9


def test_scores_without_an_environment_are_those_of_the_others():
    catch, cart = "Catch-bsuite", "CartPole-v1"
    known = {
        catch: comparison(catch, ppo=[1.0, 2.0], dpo=[2.0, 2.0]),
        cart: comparison(cart, ppo=[500.0, 300.0], dpo=[400.0, 400.0]),
    }
    random = {catch: 0.0, cart: 20.0}
    rest = suite_scores(known, random).without(cart)
    alone = suite_scores({catch: known[catch]}, random)
    assert rest.as_dict() == alone.as_dict() and rest.sources == alone.sources
    assert suite_scores(known, random).without(cart, catch) is None


def test_an_objective_was_learned_for_what_its_bandits_stand_for():
    names = ("ppo", "lpo-pendulum", "lpo-multi", "lpo-pendulum-ee")
    homes = [learned_in([load_objective(name)]) for name in names]
    assert homes == [[], ["Pendulum-v1"], ["CartPole-v1", "Pendulum-v1"], ["Pendulum-v1"]]


def test_an_environment_that_nobody_learned_is_left_out_and_said_so():
    catch, sea = "Catch-bsuite", "DeepSea-bsuite"
    scores = suite_scores(
        {
            catch: comparison(catch, ppo=[1.0, 1.0], dpo=[2.0, 2.0]),
            sea: comparison(sea, ppo=[-5.0, -5.0], dpo=[-6.0, -6.0]),
        },
        {catch: 0.0, sea: -5.0},
    )
    assert (scores.environments, scores.left_out) == ([catch], [sea])
    with pytest.raises(UserError, match="no objective is better than random actions anywhere"):
        suite_scores({sea: comparison(sea, ppo=[-5.0, -5.0])}, {sea: -5.0})


@pytest.mark.parametrize(
    ("second", "message"),
    [
        (
            comparison("DeepSea-bsuite", ppo=[1.0, 2.0]),
            "DeepSea-bsuite was run with other objectives than the rest",
        ),
        (comparison("DeepSea-bsuite", ppo=[1.0], dpo=[2.0]), "different numbers of seeds"),
    ],
)
def test_what_does_not_compare_is_refused(second, message):
    first = comparison("Catch-bsuite", ppo=[1.0, 1.0], dpo=[2.0, 2.0])
    random = {"Catch-bsuite": 0.0, "DeepSea-bsuite": 0.0}
    with pytest.raises(UserError, match=message):
        suite_scores({x.curves[0].environment: x for x in (first, second)}, random)


def scores_of(values) -> SuiteScores:
    values = np.asarray(values, np.float64)
    names = [f"e{i}" for i in range(values.shape[1])]
    rest = [0.0] * len(names)
    return SuiteScores(names, ["ppo", "dpo"], values, rest, rest, ["made up"] * len(names), [])


def test_aggregates_are_interquartile_means_and_differences_are_paired():
    # 8 runs: the two lowest and two highest are left out. What a seed does to both objectives
    # cancels in their difference, which is the same everywhere.
    base = np.array([[0.1, 0.2, 0.3, 0.4], [0.5, 0.6, 0.7, 0.8]])
    scores = scores_of([base, base + 0.25])
    first, second = scores.aggregate()
    assert first.value == pytest.approx((0.3 + 0.4 + 0.5 + 0.6) / 4)
    assert first.low < first.value < first.high
    none, difference = scores.differences()
    assert (none.value, none.low, none.high) == (0.0, 0.0, 0.0)
    assert difference.value == pytest.approx(0.25)
    assert difference.low == pytest.approx(0.25)
    assert difference.high == pytest.approx(0.25)
    assert second.n == 8


def test_a_profile_is_the_share_of_runs_above_a_threshold():
    scores = scores_of([[[0.0, 0.4], [0.6, 1.0]], [[1.0, 1.0], [1.0, 1.0]]])
    first, second = scores.profile(np.array([-0.1, 0.5, 0.9, 1.0]))
    assert [found.value for found in first] == [1.0, 0.5, 0.25, 0.0]
    assert [found.value for found in second] == [1.0, 1.0, 1.0, 0.0]
    assert all(found.low <= found.value <= found.high for found in (*first, *second))


@pytest.fixture
def trained(monkeypatch):
    """Trainings that are instantaneous; the list of those that were asked for."""
    asked = []

    def compare(environment, objectives, seeds, **arguments):
        asked.append((environment, arguments["backend"]))
        finals = {
            o.name: 100.0 + 10.0 * i + np.arange(len(seeds)) for i, o in enumerate(objectives)
        }
        return comparison(environment, **finals)

    monkeypatch.setattr(suite, "compare", compare)
    monkeypatch.setattr(EnvironmentSpec, "random_return", lambda *arguments: -1000.0)
    short = {"classic": ("CartPole-v1", "Pendulum-v1"), "brax": ("hopper", "CartPole-v1")}
    monkeypatch.setattr(suite, "suites", lambda: short)
    return asked


def test_physics_are_for_brax_alone(trained):
    objectives = [load_objective("ppo"), load_objective("dpo")]
    scores, comparisons = run_suite("brax", objectives, [1, 2], "spring", tell=lambda _: None)
    assert trained == [("hopper", "spring"), ("CartPole-v1", None)]
    assert list(comparisons) == scores.environments == ["hopper", "CartPole-v1"]


def test_a_new_family_has_its_suite(corridors, trained, monkeypatch):
    monkeypatch.setattr(suite, "suites", suites)
    scores, _ = run_suite("corridors", [load_objective("ppo")], [1, 2], tell=lambda _: None)
    assert scores.environments == ["Corridor-v0", "LongCorridor-v0"]
    assert set(scores.environments) <= set(suites()["all"])


@pytest.mark.slow
def test_a_killed_suite_is_completed_to_the_same_scores(tmp_path, tiny_agent, monkeypatch, capsys):
    spec = AgentSpec("ppo", tiny_agent, PPOHyperparameters())
    monkeypatch.setattr("lpo.comparison.environment_agent", lambda *_: spec)
    monkeypatch.setattr(EnvironmentSpec, "random_return", lambda *arguments: -1000.0)
    bandits = {"classic": ("Synthetic-CartPole-v1", "Synthetic-Pendulum-v1")}
    monkeypatch.setattr(suite, "suites", lambda: bandits)
    out = tmp_path / "suite"

    def evaluate(seeds=2):
        words = ["--suite=classic", "--objectives", "ppo", f"--seeds={seeds}", f"--out={out}"]
        training_commands.Evaluate.parse(words).run()

    evaluate()
    assert "normalised score" in capsys.readouterr().out
    first = json.loads((out / "suite.json").read_text())
    assert (first["objectives"], first["seeds"]) == (["ppo"], [1000, 1001])
    assert (out / "suite.png").stat().st_size > 5000
    assert first["elsewhere"] is None and not (out / "suite_elsewhere.png").exists()

    rows = (out / "rows.jsonl").read_bytes()
    (out / "rows.jsonl").write_bytes(rows[: len(rows) * 2 // 3])
    (out / "suite.json").unlink()
    evaluate()
    assert (out / "rows.jsonl").read_bytes() == rows
    assert json.loads((out / "suite.json").read_text()) == first

    with pytest.raises(UserError, match=r"its config differs at config.seeds \(2 there, 1 now\)"):
        evaluate(seeds=1)
    # A default is a setting too: with --out nothing grows that was not asked for by --resume.
    with pytest.raises(UserError, match=r"differs at config.objectives \(\['ppo'\] there"):
        training_commands.Evaluate.parse(["--suite=classic", f"--out={out}"]).run()

    # And what is over the environments that none was learned for has a figure of its own.
    monkeypatch.setattr(training_commands, "learned_in", lambda _: ["Synthetic-CartPole-v1"])
    training_commands.Evaluate.parse([f"--resume={out}", "--seeds=3"]).run()
    (left,) = json.loads((out / "suite.json").read_text())["elsewhere"]["environments"]
    assert left["name"] == "Synthetic-Pendulum-v1"
    assert (out / "suite_elsewhere.png").stat().st_size > 5000
    assert (out / "rows.jsonl").read_bytes().startswith(rows)
    assert json.loads((out / "suite.json").read_text())["seeds"] == [1000, 1001, 1002]


def test_a_suite_and_an_environment_do_not_go_together():
    with pytest.raises(UserError, match="are both given: leave one out"):
        training_commands.EvaluateConfig(environment="CartPole-v1", suite="classic")
    with pytest.raises(UserError, match="unknown suite 'clasic': did you mean classic"):
        training_commands.Evaluate.parse(["--suite=clasic"]).run()


def test_a_hyperparameter_that_one_environment_cannot_have_names_it(tmp_path):
    out = tmp_path / "suite"
    words = [
        "--suite=classic",
        "--hyperparameters",
        "num_envs=25 num_minibatches=8",
        f"--out={out}",
    ]
    with pytest.raises(
        UserError, match=r"^CartPole-v1: num_minibatches is 8, which does not divide"
    ):
        training_commands.Evaluate.parse(words).run()
    assert not out.exists()


def test_scores_are_drawn(tmp_path):
    scores = scores_of(np.random.default_rng(0).uniform(0.0, 1.2, (2, 5, 10)))
    assert (
        plotting.save(figures.suite_scores(scores, "classic"), tmp_path / "x.png").stat().st_size
        > 10_000
    )


@pytest.mark.slow
def test_minatars_setting_learns_breakout():
    spec = environment_agent("ppo", "Breakout-MinAtar").with_steps(65_536)
    curves = learning_curves("Breakout-MinAtar", load_objective("ppo"), [3, 4], spec=spec, points=4)
    assert curves.returns[:, 0].max() < 2.0  # random actions earn half a brick
    assert curves.final.min() > 3.0
