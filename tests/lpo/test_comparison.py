"""Comparing objectives: the same seeds for all, and numbers that can be redone by hand."""

import json
import os
import subprocess
import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpo.comparison import (
    Comparison,
    LearningCurves,
    compare,
    learning_curves,
    ppo_spec,
)
from lpo.objectives import Objective, load_objective
from scb.agents.ppo import PPOHyperparameters
from scb.agents.spec import AgentSpec
from scb.environments.registry import environment_spec
from scb.errors import UserError

SEEDS = (7, 8, 9)


def curves(objective: str = "ppo", returns=((0.0, 2.0, 4.0), (1.0, 1.0, 7.0))) -> LearningCurves:
    """Two seeds, evaluated before, half way through, and at the end of 20 steps."""
    returns = np.asarray(returns)
    seeds = list(range(len(returns)))
    return LearningCurves(
        "Pendulum-v1", None, objective, np.array([0, 10, 20]), returns, seeds, 5, True
    )


# -- by hand ------------------------------------------------------------------------------------


def test_final_is_the_last_evaluation_and_area_the_mean_without_the_untrained_agent():
    # (2 + 4) / 2 = 3 and (1 + 7) / 2 = 4; what was there before training counts in neither.
    np.testing.assert_array_equal(curves().final, [4.0, 7.0])
    np.testing.assert_array_equal(curves().area, [3.0, 4.0])


def test_a_difference_is_positive_where_the_objective_is_better_than_the_reference():
    reference = curves("ppo", [[0, 0, -5.0]] * 4)
    better, worse = curves("dpo", [[0, 0, -3.0]] * 4), curves("none", [[0, 0, -9.0]] * 4)
    differences = Comparison([reference, better, worse]).differences()
    assert differences.keys() == {"dpo", "none"}
    # -3 - -5 = 2 and -9 - -5 = -4; equal seeds leave the interval no width.
    assert (differences["dpo"].value, differences["dpo"].low, differences["dpo"].high) == (2, 2, 2)
    assert differences["none"].value == -4


def test_differences_are_of_what_is_asked_for():
    found = Comparison([curves("ppo", [[0, 0, -5.0]] * 4), curves("dpo", [[0, 4, -3.0]] * 4)])
    # Over the training (4 - 3) / 2 = 0.5, and (0 - 5) / 2 = -2.5.
    assert found.differences("area")["dpo"].value == 3
    with pytest.raises(UserError, match="kind of return"):
        found.differences("middle")
    once = [replace(x, steps=x.steps[[0, 2]], returns=x.returns[:, [0, 2]]) for x in found.curves]
    with pytest.raises(UserError, match="2 points or more"):
        Comparison(once).differences("early")
    assert [axes.get_ylabel() for axes in found.figure().axes] == [
        "return (interquartile mean)",
        "final return",
    ]


def test_agents_that_diverge_count_as_random_actions_and_are_told(monkeypatch):
    def measured(*_, objectives, agents, **__):
        ends = {7: -200.0, 8: None, 9: -300.0}
        return [
            {
                "objective": o.name,
                "seed": seed,
                "step": step,
                "return": x if o.name == "dpo" else -1,
            }
            for o in objectives
            for seed in agents
            for step, x in ((0, -1200.0), (10, ends[seed]))
        ]

    monkeypatch.setattr("lpo.comparison.measure", measured)
    made = compare("Pendulum-v1", [load_objective("ppo"), load_objective("dpo")], SEEDS)
    random = environment_spec("Pendulum-v1").random_return()
    np.testing.assert_array_equal(made.curves[1].final, [-200.0, random, -300.0])
    assert [c.failed for c in made.curves] == [0, 1]
    assert made.caution.startswith("1 of 3 agents of dpo diverged")
    json.dumps(made.as_dict(), allow_nan=False)


def hoppers(objective: str, ends: list[float]) -> LearningCurves:
    returns = np.array([[10.0, end] for end in ends])
    place, steps, seeds = ("hopper", "spring", objective), np.array([0, 10]), list(range(len(ends)))
    speeds = np.full(returns.shape, 0.25)
    moving = {"lengths": 10 * returns, "speeds": speeds}
    return LearningCurves(*place, steps, returns, seeds, 5, mode_actions=True, **moving)


def test_where_no_agent_is_above_standing_still_it_is_said_that_nothing_can_be_told():
    fallen, moving = hoppers("ppo", [400.0, 1000.0]), hoppers("dpo", [900.0, 1001.0])
    assert [c.above_standing_still for c in (fallen, moving)] == [0.0, 0.5]
    assert Comparison([fallen]).caution.startswith("No agent is above standing still (1000)")
    assert Comparison([fallen]).few.startswith("With fewer than 10 agents no interval decides")
    assert Comparison([replace(fallen, seeds=list(range(10)))]).few == ""
    assert Comparison([fallen, moving]).caution == ""
    stored = Comparison([fallen, moving]).as_dict()["curves"][1]
    assert stored["final_lengths"] == [9000.0, 10010.0] and stored["final_speeds"] == [0.25, 0.25]
    assert (stored["standing_still"], stored["above_standing_still"]) == (1000.0, 0.5)
    # A pendulum that hangs still earns no more than a random one.
    assert curves().above_standing_still is None and Comparison([curves()]).caution == ""


def test_dictionaries_are_json_and_hold_what_was_measured():
    comparison = Comparison([curves("ppo"), curves("dpo")])
    content = comparison.as_dict()
    assert json.loads(json.dumps(content, allow_nan=False)) == content
    assert content["reference"] == "ppo"
    assert content["paired_differences"]["dpo"]["value"] == 0.0
    curve = content["curves"][0]
    assert curve["returns"] == [[0.0, 2.0, 4.0], [1.0, 1.0, 7.0]]
    assert (curve["steps"], curve["seeds"], curve["episodes"]) == ([0, 10, 20], [0, 1], 5)
    assert (curve["final_iqm"]["value"], curve["area_iqm"]["value"]) == (5.5, 3.5)


# -- trained ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def arguments(tiny_agent):
    # Seven batches of eight contexts.
    spec = AgentSpec(
        "ppo", replace(tiny_agent, total_steps=56), PPOHyperparameters(learning_rate=0.03)
    )
    return {
        "environment": "Synthetic-Pendulum-v1",
        "seeds": SEEDS,
        "spec": spec,
        "points": 3,
    }


@pytest.fixture(scope="module")
def objectives(objective_file, tiny_drift):
    weights = tiny_drift.init(jax.random.key(0))
    zero = {**weights, "output": jnp.zeros_like(weights["output"])}
    names = ("ppo", "dpo", "none", objective_file)
    return [*map(load_objective, names), Objective("zero", tiny_drift, zero)]


@pytest.fixture(scope="module")
def trained(arguments, objectives):
    comparison = compare(objectives=objectives, **arguments)
    return {c.objective: c for c in comparison.curves}


def test_every_member_of_the_contract_trains_inside_ppo(trained, arguments):
    assert list(trained) == ["ppo", "dpo", "none", "tiny", "zero"]
    spec = arguments["spec"].with_values(learning_rate=0.0)
    (untrained,) = compare(objectives=["ppo"], **{**arguments, "spec": spec}).curves
    for name, curve in trained.items():
        assert np.all(np.isfinite(curve.returns))
        # The same agents to begin with, and then others than those that did not learn, in the same evaluations.
        np.testing.assert_allclose(curve.returns[:, 0], untrained.returns[:, 0], rtol=1e-5)
        assert np.all(curve.returns[:, 1] != untrained.returns[:, 1]), name


def test_objectives_start_from_the_same_agents_and_lead_elsewhere(trained):
    # Paired seeds: the same networks and evaluation contexts, so the same return before training.
    for name in ("dpo", "none", "tiny"):
        start = trained[name].returns[:, 0]
        np.testing.assert_allclose(start, trained["ppo"].returns[:, 0], rtol=1e-5)
        assert np.all(np.any(trained[name].returns != trained["ppo"].returns, axis=1))


def test_training_with_zero_output_weights_is_training_with_ppos_clip(trained):
    # The two drifts differ by xi = 1e-6 at most.
    zero, ppo = trained["zero"].returns, trained["ppo"].returns
    np.testing.assert_allclose(zero, ppo, atol=1e-3)


def test_objectives_of_one_drift_share_a_program_and_keep_their_order(arguments, trained):
    clips = [load_objective(name) for name in ("ppo-0.01", "dpo", "ppo")]
    curves = {c.objective: c for c in compare(objectives=clips, **arguments).curves}
    assert list(curves) == ["ppo-0.01", "dpo", "ppo"]
    np.testing.assert_allclose(curves["ppo"].returns, trained["ppo"].returns, rtol=1e-4)
    assert np.abs(curves["ppo-0.01"].returns - curves["ppo"].returns).max() > 1e-3


def test_seeds_differ_from_each_other(trained):
    assert len(set(trained["ppo"].returns[:, 1])) == len(SEEDS)


def test_the_same_seeds_and_objective_give_the_same_curves(trained, arguments, objectives):
    again = learning_curves(objective=objectives[0], **arguments)
    np.testing.assert_array_equal(again.returns, trained["ppo"].returns)


def test_a_training_ends_where_it_should_though_its_points_do_not_divide_it(trained):
    # 7 batches of 8 have no divisor near 3 points: two batches for each, and one for the last.
    curve = trained["ppo"]
    assert curve.steps.tolist() == [0, 16, 32, 48, 56]
    assert curve.returns.shape == (len(SEEDS), 5)
    assert (curve.environment, curve.backend) == ("Synthetic-Pendulum-v1", None)
    assert (curve.seeds, curve.episodes, curve.mode_actions) == (list(SEEDS), 20, True)


# -- bad input ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"environment": "CartPoel-v1"}, "unknown environment 'CartPoel-v1': did you mean CartPo"),
        ({"environment": "Pendulum-v1", "backend": "spring"}, "has no choice of physics"),
    ],
)
def test_what_cannot_be_trained_is_refused(arguments, changes, message, one_sentence):
    with pytest.raises(UserError) as error:
        learning_curves(objective=load_objective("ppo"), **{**arguments, **changes})
    assert message in one_sentence(str(error.value))


def test_two_objectives_of_one_name_are_refused(arguments, one_sentence):
    # Their results are told apart by name.
    pair = [load_objective("ppo"), replace(load_objective("dpo"), name="ppo")]
    with pytest.raises(UserError) as error:
        compare(objectives=pair, **arguments)
    assert "objective 'ppo' is there twice" in one_sentence(str(error.value))


@pytest.mark.parametrize(
    ("objectives", "seeds", "message"),
    [
        ([], [0], "no objectives: give at least one"),
        ("ppo", [0], "a single one: give a list"),
        (["ppo", "ppo"], [0], "objective 'ppo' is there twice"),
        (["ppo"], 2, r"the seeds are 2: give a list, such as \[0, 1\]"),
        (["ppo"], "01", "the seeds are '01'"),
    ],
)
def test_a_comparison_says_what_it_cannot_compare(objectives, seeds, message):
    with pytest.raises(UserError, match=message):
        compare("CartPole-v1", objectives, seeds)


def test_steps_and_drift_are_no_hyperparameters_of_a_comparison():
    for name, said in (
        ("total_steps", "the steps, which --steps gives"),
        ("drift", "the objective's own"),
    ):
        with pytest.raises(UserError, match=f"{name} is no hyperparameter here: it is {said}"):
            ppo_spec("CartPole-v1", hyperparameters={name: 1})


def test_a_comparison_keeps_its_rows_in_a_file(tmp_path, tiny_agent):
    spec = AgentSpec("ppo", tiny_agent, PPOHyperparameters())
    file = tmp_path / "rows.jsonl"
    first = compare("Synthetic-Pendulum-v1", ["ppo"], [0], spec, points=1, rows=file)
    kept = file.read_bytes()
    again = compare("Synthetic-Pendulum-v1", ["ppo"], [0], spec, points=1, rows=str(file))
    np.testing.assert_array_equal(first.curves[0].returns, again.curves[0].returns)
    assert file.read_bytes() == kept
    with pytest.raises(UserError, match=r"are kept in a \.jsonl file"):
        compare("Synthetic-Pendulum-v1", ["ppo"], [0], spec, rows=tmp_path / "rows.json")
    with pytest.raises(UserError, match=r"rows are 3: give the path of a \.jsonl file, or None"):
        compare("Synthetic-Pendulum-v1", ["ppo"], [0], spec, rows=3)
    for folder in ("", "."):
        with pytest.raises(UserError, match=r"are kept in a \.jsonl file"):
            compare("Synthetic-Pendulum-v1", ["ppo"], [0], spec, rows=folder)


def test_agents_of_another_arithmetic_are_no_pairs(tmp_path, tiny_agent, monkeypatch):
    spec = AgentSpec("ppo", tiny_agent, PPOHyperparameters())
    file = tmp_path / "rows.jsonl"
    compare("Synthetic-Pendulum-v1", ["ppo"], [0], spec, points=1, rows=file)
    monkeypatch.setattr("scb.measurement.arithmetic", lambda: {"jax_enable_x64": "True"})
    with pytest.raises(UserError, match=r"differs at versions\.jax_enable_x64"):
        compare("Synthetic-Pendulum-v1", ["ppo"], [0, 1], spec, points=1, rows=file)


def test_rows_are_kept_at_home(tmp_path, tiny_agent, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    spec = AgentSpec(
        "ppo",
        tiny_agent.__class__(num_envs=np.int64(2), num_steps=1, total_steps=4, num_minibatches=1),
        PPOHyperparameters(),
    )
    compare("Synthetic-Pendulum-v1", ["ppo"], [0], spec, points=1, rows="~/rows.jsonl")
    assert (tmp_path / "rows.jsonl").exists()


def test_rows_replace_no_json_of_something_else(tmp_path, tiny_agent):
    spec = AgentSpec("ppo", tiny_agent, PPOHyperparameters())
    for content in ('{"schema_version": 1, "kind": "drift"}', "no json", "[]"):
        (tmp_path / "mine.json").write_text(content)
        with pytest.raises(UserError, match=r"rows in .*would replace .*mine\.json, which is of"):
            compare("Synthetic-Pendulum-v1", ["ppo"], [0], spec, rows=tmp_path / "mine.jsonl")
        assert (tmp_path / "mine.json").read_text() == content
    # What a kill before the first agent leaves.
    (tmp_path / "mine.json").write_text('{"0123456789ab": {"agent": 1}}')
    compare("Synthetic-Pendulum-v1", ["ppo"], [0], spec, points=1, rows=tmp_path / "mine.jsonl")
    assert "0123456789ab" not in (tmp_path / "mine.json").read_text()


def test_a_file_that_may_only_be_read_gives_what_it_holds_and_trains_nobody(
    tmp_path, tiny_agent, monkeypatch
):
    spec = AgentSpec("ppo", tiny_agent, PPOHyperparameters())
    file = tmp_path / "rows.jsonl"
    first = compare("Synthetic-Pendulum-v1", ["ppo"], [0], spec, points=1, rows=file)
    may = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: not mode & os.W_OK and may(path, mode))
    again = compare("Synthetic-Pendulum-v1", ["ppo"], [0], spec, points=1, rows=file)
    np.testing.assert_array_equal(first.curves[0].returns, again.curves[0].returns)

    def trained(*arguments):
        raise AssertionError

    monkeypatch.setattr(AgentSpec, "agent", trained)
    with pytest.raises(UserError, match=r"cannot write to .*: choose another place"):
        compare("Synthetic-Pendulum-v1", ["ppo"], [0, 1], spec, points=1, rows=file)


def test_a_file_of_rows_is_one_process_es(tmp_path, tiny_agent):
    spec = AgentSpec("ppo", tiny_agent, PPOHyperparameters())
    file = tmp_path / "new" / "rows.jsonl"
    compare("Synthetic-Pendulum-v1", ["ppo"], [0, 1], spec, points=1, rows=file)
    once = file.read_text()
    assert [path.name for path in sorted(file.parent.iterdir())] == ["rows.json", "rows.jsonl"]
    program = (
        "import sys, time; from pathlib import Path; from scb.locks import held\n"
        "with held(Path(sys.argv[1])): print('held', flush=True); time.sleep(60)"
    )
    other = subprocess.Popen(
        [sys.executable, "-c", program, str(file)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert other.stdout.readline() == "held\n"
        with pytest.raises(UserError, match=r"rows\.jsonl is in use by another command \(process"):
            compare("Synthetic-Pendulum-v1", ["ppo"], [2], spec, points=1, rows=file)
    finally:
        other.kill()
        other.wait()
    # What two processes measured that had one file is kept once, in whatever order they wrote it.
    rows = once.splitlines(keepends=True)
    for twice in (rows + rows, [line for row in rows for line in (row, row)]):
        file.write_text("".join(twice))
        compare("Synthetic-Pendulum-v1", ["ppo"], [0, 1], spec, points=1, rows=file)
        assert file.read_text() == once
    with pytest.raises(UserError, match=r"are kept in a \.jsonl file"):
        compare("Synthetic-Pendulum-v1", ["ppo"], [0], spec, rows=tmp_path / "none" / "rows.json")
    assert not (tmp_path / "none").exists()
