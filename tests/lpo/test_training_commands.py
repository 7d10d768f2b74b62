"""`lpo train`, `lpo evaluate` and `lpo align` as commands: what they print, keep, and go on with."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

from lpo import align_command, cli, training_commands
from lpo.comparison import Comparison, LearningCurves
from lpo.fitness import LABELS
from scb.agents.ppo import PPOHyperparameters
from scb.agents.spec import AgentSpec
from scb.seeds import SEARCHING

pytestmark = pytest.mark.usefixtures("working_folder", "no_training")


def compared(environment, objectives, seeds, mode_actions=True, **_) -> Comparison:
    """Curves as a training would measure them: the return ends at -100 times the name's length."""
    steps = np.array([0, 1000])
    return Comparison(
        [
            LearningCurves(
                environment,
                None,
                objective.name,
                steps,
                np.tile([-1500.0, -100.0 * len(objective.name)], (len(seeds), 1)),
                list(seeds),
                20,
                mode_actions,
            )
            for objective in objectives
        ]
    )


@pytest.fixture
def trained(monkeypatch) -> None:
    monkeypatch.setattr(training_commands, "compare", compared)


@pytest.fixture
def interrupted_evaluation(working_folder, tiny_agent, monkeypatch):
    """A folder in which `lpo evaluate` wrote half of its agents, and what it would have written."""
    monkeypatch.undo()  # it trains
    monkeypatch.chdir(working_folder)
    spec = AgentSpec("ppo", tiny_agent, PPOHyperparameters())
    monkeypatch.setattr("lpo.comparison.environment_agent", lambda *_: spec)
    arguments = ["--environment=Synthetic-Pendulum-v1", "--objectives", "none", "dpo"]
    assert cli.main(["evaluate", *arguments, "--seeds=2", "--seed=7", "--out=o"]) == 0
    rows, comparison = working_folder / "o" / "rows.jsonl", working_folder / "o" / "comparison.json"
    whole = rows.read_bytes(), comparison.read_bytes()
    rows.write_bytes(whole[0][: len(whole[0]) // 2 + 9])
    comparison.unlink()
    return whole


def test_a_killed_evaluation_resumes_to_the_same_bytes(interrupted_evaluation, working_folder):
    assert cli.main(["evaluate", "--seeds", "2", "--resume", "o"]) == 0
    folder = working_folder / "o"
    written = [(folder / name).read_bytes() for name in ("rows.jsonl", "comparison.json")]
    assert written == list(interrupted_evaluation)
    assert [row["seed"] for row in map(json.loads, written[0].splitlines())][::4] == [7, 8, 7, 8]


def test_a_resumed_evaluation_may_have_more_seeds_and_objectives(
    interrupted_evaluation, working_folder, monkeypatch
):
    folder = working_folder / "o"
    (folder / "rows.jsonl").write_bytes(interrupted_evaluation[0])
    told: list[str] = []
    monkeypatch.setattr(training_commands, "_tell", told.append)
    more = ["--seeds=3", "--objectives", "none", "dpo", "ppo"]
    assert cli.main(["evaluate", *more, "--resume=o", "--out=o"]) == 0
    assert (folder / "rows.jsonl").read_bytes().startswith(interrupted_evaluation[0])
    curves = json.loads((folder / "comparison.json").read_text())["curves"]
    assert [(c["objective"], c["seeds"]) for c in curves] == [
        (name, [7, 8, 9]) for name in ("none", "dpo", "ppo")
    ]
    told.clear()
    assert cli.main(["evaluate", "--resume=o"]) == 0  # the folder knows what it has become
    assert told == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["evaluate", "--seeds=1"],
            "cannot resume o: its config differs at config.seeds (2 there, 1 now)",
        ),
        (
            ["evaluate", "--objectives", "dpo", "ppo"],
            "config.objectives (['none', 'dpo'] there, ['dpo', 'ppo'] now)",
        ),
        (
            ["train"],
            "cannot resume o with lpo train: it was started with lpo evaluate --environment",
        ),
    ],
)
def test_a_resumed_evaluation_keeps_its_settings(
    interrupted_evaluation, refused, arguments, message
):
    assert message in refused(*arguments, "--resume", "o")


@pytest.mark.parametrize(
    ("command", "objectives", "number"),
    [("evaluate", ("dpo", "shares:share"), "--seeds"), ("align", ("shares:share",), "--agents")],
)
def test_a_refused_resume_leaves_the_folder_as_it_was(
    trained, working_folder, refused, monkeypatch, capsys, command, objectives, number
):
    monkeypatch.setattr(align_command, "measure_alignment", lambda *_, **__: {"regimes": []})
    monkeypatch.setattr(align_command.figures, "alignment_heatmap", lambda _: Figure())
    for share in ("0.5", "0.25"):
        (working_folder / share).mkdir()
        text = f"def share(ratio, advantage):\n    return {share} * ratio * advantage\n"
        (working_folder / share / "shares.py").write_text(text)
    arguments = ["--objectives", *objectives, f"{number}=2"]
    monkeypatch.syspath_prepend(working_folder / "0.5")
    assert cli.main([command, *arguments, "--out=o"]) == 0
    monkeypatch.delitem(sys.modules, "shares")
    monkeypatch.syspath_prepend(working_folder / "0.25")
    capsys.readouterr()
    message = refused(command, f"{number}=3", "--resume=o")
    assert "cannot resume o: shares:share is not what it was when the run was started" in message


@pytest.mark.parametrize(
    "command", [training_commands.Train, training_commands.Evaluate, align_command.Align]
)
def test_seeds_that_train_agents_are_those_that_search_where_no_others_are_named(command):
    config = command.parse([]).config
    assert set(config.seed_list()) <= set(SEARCHING)


def test_train_prints_the_curve_and_stores_it(trained, working_folder, capsys):
    arguments = ["--objective", "ppo", "--seeds", "2", "--seed", "5", "--sampled-actions"]
    assert cli.main(["train", *arguments, "--out", "results"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].strip() == "0 steps: return -1500.0"
    assert lines[1].strip() == "1000 steps: return -300.0"
    assert lines[2] == "final return, IQM: -300.0 [-300.0, -300.0] (n=2)"
    (curve,) = json.loads((working_folder / "results" / "comparison.json").read_text())["curves"]
    assert curve["returns"] == [[-1500.0, -300.0]] * 2
    assert (curve["seeds"], curve["mode_actions"]) == ([5, 6], False)
    assert (working_folder / "results" / "curves.png").read_bytes().startswith(b"\x89PNG")


def test_train_says_of_agents_that_diverged_that_they_did(monkeypatch, capsys):
    def diverged(*arguments, **settings):
        (curve,) = compared(*arguments, **settings).curves
        return Comparison([replace(curve, failed=1)])

    monkeypatch.setattr(training_commands, "compare", diverged)
    assert cli.main(["train", "--seeds=2"]) == 0
    *_, end, caution = capsys.readouterr().out.splitlines()
    assert end.startswith("final return") and caution.startswith("1 of 2 agents of ppo diverged")


def test_evaluate_compares_with_the_first_objective(trained, working_folder, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    assert cli.main(["evaluate", "--objectives", "dpo", "none", "--seeds", "4", "--out", "o"]) == 0
    table = capsys.readouterr().out
    assert "difference to dpo" in table
    # "none" has four letters and "dpo" three: -400 - -300 = -100.
    row = next(line for line in table.splitlines() if " none " in line)
    assert "-400.0 [-400.0, -400.0] (n=4)" in row
    assert "-100.0 [-100.0, -100.0] (n=4)" in row
    stored = json.loads((working_folder / "o" / "comparison.json").read_text())
    assert stored["reference"] == "dpo"
    assert stored["paired_differences"]["none"]["value"] == -100.0
    assert [c["seeds"] for c in stored["curves"]] == [[1000, 1001, 1002, 1003]] * 2


def test_files_of_one_name_are_told_apart_by_what_was_typed(
    trained, working_folder, objective_file, capsys
):
    # Every `lpo meta-train` writes an objective.npz.
    for folder in ("a", "bb"):
        (working_folder / folder).mkdir()
        for path in (objective_file, objective_file.with_suffix(".json")):
            (working_folder / folder / path.name).write_bytes(path.read_bytes())
    names = ["a/tiny.npz", "bb/tiny.npz"]
    assert cli.main(["evaluate", "--objectives", "ppo", *names, "--out", "o"]) == 0
    stored = json.loads((working_folder / "o" / "comparison.json").read_text())
    # -1000 - -300 and -1100 - -300.
    differences = {k: v["value"] for k, v in stored["paired_differences"].items()}
    assert differences == {"a/tiny.npz": -700.0, "bb/tiny.npz": -800.0}


def test_a_file_keeps_its_name_in_a_resumed_comparison_that_another_of_that_name_joins(
    trained, working_folder, objective_file
):
    for folder in ("a", "bb"):
        (working_folder / folder).mkdir()
        for path in (objective_file, objective_file.with_suffix(".json")):
            (working_folder / folder / path.name).write_bytes(path.read_bytes())
    assert cli.main(["evaluate", "--objectives", "ppo", "a/tiny.npz", "--out", "o"]) == 0
    more = ["evaluate", "--resume", "o", "--objectives", "ppo", "a/tiny.npz", "bb/tiny.npz"]
    for _ in range(2):
        assert cli.main(more) == 0
        stored = json.loads((working_folder / "o" / "comparison.json").read_text())
        assert stored["paired_differences"].keys() == {"tiny", "bb/tiny.npz"}


def test_align_measures_every_combination_and_stores_it(monkeypatch, working_folder, capsys):
    asked, told = [], []

    def measure(
        regimes, objectives, environment, seeds, policy_output_scale, rows, done, keep, **_
    ):
        assert policy_output_scale == 0.01
        assert all(r.policy_output_scale == policy_output_scale for r in regimes)
        asked.extend(regimes)
        assert {"ppo-0.2", "none", "lpo-pendulum"} <= {o.name for o in objectives}
        assert (environment, seeds) == ("Pendulum-v1", [500, 501])
        cell = {"spearman": 0.5, "low": 0.25, "high": 0.75}
        measured = {"alignment": dict.fromkeys(LABELS, cell)}
        known = done["regimes"] if done else []
        report = {
            "environment": environment,
            "agents": 2,
            "outcome_iqm": {o.name: 0.0 for o in objectives},
            "outcome": {o.name: [0.0, 0.0] for o in objectives},
            "regimes": [{"name": str(r), "bandit": r.bandit, **measured} for r in regimes],
        }
        keep(report)
        told.append((len(known), rows.path.name))
        return report

    monkeypatch.setattr(align_command, "measure_alignment", measure)
    flags = ["--objectives", "lpo-pendulum", "--agents=2", "--out=aligned"]
    flags += ["--policy-output-scale=0.01"]
    assert cli.main(["align", "--reward-noise", "0", "5", "--contexts", "50", "200", *flags]) == 0
    assert [(r.reward_noise, r.contexts) for r in asked] == [(0, 50), (0, 200), (5, 50), (5, 200)]
    output = capsys.readouterr().out
    assert "0.50 [0.25," in output and "contexts 50" in output
    assert "With fewer than 10 agents no interval decides anything; here are 2." in output
    stored = json.loads((working_folder / "aligned" / "alignment.json").read_text())
    assert len(stored["regimes"]) == 4
    assert (working_folder / "aligned" / "alignment.png").stat().st_size > 5000
    # What is there already is not measured again.
    assert cli.main(["align", "--resume=aligned"]) == 0
    assert told == [(0, "rows.jsonl"), (4, "rows.jsonl")]
    assert asked[4:] == asked[:4]
    for damage, said in (
        ('{"a', "Unterminated string"),
        ("{}", "it lacks outcome"),
        ("3", "no JSON obj"),
    ):
        (working_folder / "aligned" / "alignment.json").write_text(damage)
        assert cli.main(["align", "--resume=aligned"]) == 2
        message = capsys.readouterr().err
        assert "aligned/alignment.json is damaged" in message and said in message
    assert len(told) == 2


def test_objectives_are_compared_with_the_hyperparameters_that_are_given(
    capsys, monkeypatch, working_folder, one_sentence
):
    monkeypatch.undo()  # it trains
    monkeypatch.chdir(working_folder)
    flags = [
        "evaluate",
        "--environment=Pendulum-v1",
        "--steps=400",
        "--seeds=2",
        "--objectives=ppo",
    ]
    given = "learning_rate=0.5 num_envs=2 num_steps=50 num_minibatches=2 activation=tanh hidden_sizes=[8]"
    assert cli.main([*flags, f"--hyperparameters={given}", "--out=mine"]) == 0
    assert cli.main(["evaluate", "--resume=mine"]) == 0
    told = json.loads((working_folder / "mine" / "comparison.json").read_text())["curves"][0]
    assert told["steps"][-1] == 400 and told["hyperparameters"] == {
        "learning_rate": 0.5,
        "num_envs": 2,
        "num_steps": 50,
        "num_minibatches": 2,
        "activation": "tanh",
        "hidden_sizes": [8],
    }
    (who,) = json.loads((working_folder / "mine" / "rows.json").read_text()).values()
    trained = who["agent"]["config"] | who["agent"]["hyperparameters"]
    assert told["hyperparameters"].items() <= trained.items()
    capsys.readouterr()
    assert cli.main(["evaluate", "--resume=mine", "--hyperparameters=learning_rate=0.1"]) == 2
    assert "hyperparameters" in one_sentence(capsys.readouterr().err.removesuffix("\n"))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            "learning_rate",
            "the part 'learning_rate', which is no NAME=VALUE without a space: write",
        ),
        ("learning_rat=0.1", "unknown hyperparameter of PPO 'learning_rat': did you mean"),
        ("learning_rate=fast", "learning_rate has the value 'fast', which is no number"),
        ("learning_rate=NaN", "learning_rate has the value nan, which is no number"),
        ("learning_rate=null", "learning_rate has no value: give one, or leave it out"),
        ("num_envs=2 num_envs=4", "have num_envs twice: give it once"),
        ("hidden_sizes=[8, 8]", "the part '8]', which is no NAME=VALUE without a space"),
        ("num_envs=1.5", "num_envs is 1.5: it must be a whole number"),
        ("activation=sine", "unknown activation 'sine'"),
        ("anneal_learning_rate=1", "anneal_learning_rate is 1: it must be true or false"),
        ("drift=0.3", "drift is no hyperparameter here"),
        ("num_minibatches=3", "num_minibatches is 3, which does not divide a batch"),
    ],
)
def test_hyperparameters_that_ppo_cannot_have_are_refused(given, message, refused):
    for where in ("--environment=Pendulum-v1", "--suite=classic"):
        assert message in refused("evaluate", where, f"--hyperparameters={given}", "--out=o")
