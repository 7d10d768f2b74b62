"""The command line `lpo`: what works, and how its processes are set up."""

import inspect
import json
import os
import shlex
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lpo
import scb.cli
import scb.commands
from lpo import cli, commands, training_commands
from lpo.commands import MetaTrain
from lpo.comparison import Comparison, LearningCurves
from lpo.drifts import DRIFTS, ClosedFormDrift, NoDrift
from lpo.fitness import LABELS
from lpo.inner_loop import MetaTrainingConfig
from lpo.meta_training import TEMPORAL_HORIZONS
from lpo.objectives import Objective, closed_form, load_objective, zoo_names
from lpo.pipeline import RunAll
from scb.agents.ppo import PPOHyperparameters
from scb.agents.spec import AgentSpec
from scb.errors import UserError
from scb.evolution import evolve
from scb.runs import config_dict
from scb.seeds import SEARCHING
from tests.locking import is_locked
from tests.recording import recorded_seeds

pytestmark = pytest.mark.usefixtures("working_folder", "no_training")


# -- processes of its own -----------------------------------------------------------------------


@pytest.fixture
def python(working_folder):
    """Runs Python with arguments, and with environment variables changed or (None) left out."""

    def run(*arguments: str, **changes: str | None) -> subprocess.CompletedProcess[str]:
        variables = {**os.environ, "PYTHONPATH": str(Path(lpo.__file__).parents[1]), **changes}
        return subprocess.run(
            [sys.executable, *arguments],
            capture_output=True,
            text=True,
            check=False,
            env={name: value for name, value in variables.items() if value is not None},
            cwd=working_folder,
        )

    return run


CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
CONFIGURED = """
import lpo.cli
from experiments import __main__ as experiments
experiments.found()  # none of them computes at import
from scb.cli import configure_jax
configure_jax()
import jax
print(jax.device_count("cpu"), jax.config.values["jax_compilation_cache_dir"])
"""


@pytest.mark.parametrize(
    ("devices", "cache", "expected"),
    [
        (None, None, f"{CORES} home/lpo/jax"),
        pytest.param("3", "elsewhere", "3 elsewhere", marks=pytest.mark.slow),
    ],
)
def test_jax_gets_a_device_a_core_and_a_cache_unless_told_otherwise(
    python, devices, cache, expected
):
    finished = python(
        "-c",
        CONFIGURED,
        JAX_NUM_CPU_DEVICES=devices,
        JAX_COMPILATION_CACHE_DIR=cache,
        XLA_FLAGS=None,
        XDG_CACHE_HOME="home",
    )
    assert finished.stdout.strip() == expected


def test_a_caller_that_has_used_jax_keeps_its_devices(monkeypatch):
    before = jax.device_count()
    monkeypatch.delenv("JAX_NUM_CPU_DEVICES", raising=False)
    cores = set(range(before + 1))
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: cores, raising=False)
    scb.cli.configure_jax()
    assert jax.device_count() == before


def test_every_public_name_is_there():
    for name in lpo.__all__:
        assert getattr(lpo, name).__name__ == name
    with pytest.raises(AttributeError, match="module 'lpo' has no attribute 'Drfit'"):
        _ = lpo.Drfit


def test_a_bug_is_not_dressed_up_as_a_mistake(monkeypatch):
    def broken(name):
        raise ValueError("a bug")

    monkeypatch.setattr(commands, "load_objective", broken)
    with pytest.raises(ValueError, match="a bug") as error:
        cli.main(["certify", "ppo"])
    assert not isinstance(error.value, UserError)


# -- what works ---------------------------------------------------------------------------------


def test_certify_says_what_it_found(capsys):
    assert cli.main(["certify", "ppo-0.3"]) == 0
    assert capsys.readouterr().out.startswith("ppo-0.3 is a drift: min f 0,")


def test_certify_exits_with_one_where_the_conditions_fail(monkeypatch, capsys):
    class Bias(NoDrift):
        def __call__(self, parameters, log_ratio, advantage, progress):
            return jnp.ones_like(log_ratio)

    monkeypatch.setattr(commands, "load_objective", lambda name: Objective(name, Bias(), ()))
    with pytest.raises(SystemExit) as stop:
        cli.main(["certify", "mine"])
    assert stop.value.code == 1
    assert capsys.readouterr().out.startswith("mine is NOT a drift: min f 1, at ratio 1 |f| 1")


def test_certify_exits_with_one_where_a_drift_holds_policies_still(monkeypatch, capsys):
    barrier = closed_form("mine", ClosedFormDrift("0.2*abs(log_r)"))
    monkeypatch.setattr(commands, "load_objective", lambda name: barrier)
    with pytest.raises(SystemExit) as stop:
        cli.main(["certify", "mine"])
    assert stop.value.code == 1
    assert "is a drift whatever its weights, but one that MAY HOLD" in capsys.readouterr().out


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


@pytest.mark.parametrize("command", ["Train", "Evaluate", "Align"])
def test_seeds_that_train_agents_are_those_that_search_where_no_others_are_named(command):
    config = getattr(training_commands, command).parse([]).config
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


def test_meta_train_writes_an_objective_that_loads(
    monkeypatch, working_folder, tiny_agent, tiny_drift, capsys
):
    quick = MetaTrain.presets["quick"]
    presets = {"quick": lambda given: replace(quick(given), agent=tiny_agent)}
    monkeypatch.setattr(MetaTrain, "presets", presets)
    monkeypatch.setattr("lpo.meta_training.evolve", evolve)
    flags = {
        "population-size": 2,
        "generations": 2,
        "agents-per-candidate": 1,
        "evaluation-episodes": 2,
        "mean-evaluations": 2,
        "hidden-size": 4,
        "fitness": "transfer",
        "seed": 4,
        "out": "learned",
    }
    arguments = [f"--{name}={value}" for name, value in flags.items()]
    locked = []

    def certified(*given, own=commands.certify):
        locked.append(is_locked(working_folder / "learned" / ".lock"))
        return own(*given)

    monkeypatch.setattr(commands, "certify", certified)
    with recorded_seeds() as seeds:
        assert cli.main(["meta-train", *arguments]) == 0
    # The folder is the command's beyond the search, and no longer than the command.
    assert locked == [True] and not is_locked(working_folder / "learned" / ".lock")
    # Constants, the search, and the judges of its end: none that reports.
    assert seeds == {0, 4, 30_000}
    output = capsys.readouterr().out
    assert "it is a drift whatever its weights: min f 0" in " ".join(output.split())

    objective = load_objective(working_folder / "learned" / "objective.npz")
    assert objective.drift == tiny_drift
    config = objective.metadata["config"]["meta_training"]
    assert (config["fitness"], config["evolution"]["seed"]) == ("transfer", 4)
    # 2 generations x 2 candidates x 1 agent x 3 batches of 8 contexts; 2 episodes of 200 steps.
    assert objective.metadata["cost"]["environment_steps_training"] == 96
    assert objective.metadata["cost"]["environment_steps_evaluation"] == 1600
    figure = working_folder / "learned" / "figures" / "meta_training.png"
    assert figure.read_bytes().startswith(b"\x89PNG")

    # A finished search goes on with more generations, and replaces its objective.
    assert cli.main(["meta-train", "--resume=learned", "--generations=3"]) == 0
    longer = load_objective(working_folder / "learned" / "objective.npz").metadata
    assert longer["cost"]["environment_steps_training"] == 144
    assert longer["config"]["meta_training"]["evolution"]["num_generations"] == 3

    # The command that the artefact holds asks for the same again.
    again = MetaTrain.parse(shlex.split(objective.metadata["command"])[2:]).config
    assert config_dict(again) == config
    stored = json.loads((working_folder / "learned" / "config.json").read_text())
    longer_config = longer["config"]["meta_training"]
    sums = longer["config"]["bandit_sha256"]
    assert stored == {"command": longer["command"], "config": longer_config, "inputs": sums}


def test_a_process_that_is_not_the_first_is_told_what_it_resumes(monkeypatch):
    monkeypatch.setattr("scb.processes.first", lambda: False)
    monkeypatch.setattr("scb.processes.told", lambda said: ["--seed=7"] if said is None else said)
    # It need not see the folder.
    assert MetaTrain.parse(["--resume=nowhere"]).config.evolution.seed == 7
    monkeypatch.setattr("scb.processes.told", lambda said: "nowhere is not a run.")
    with pytest.raises(UserError, match="nowhere is not a run"):
        MetaTrain.parse(["--resume=nowhere"])


def test_a_resumed_run_logs_where_it_did():
    assert list(MetaTrain.parse(["--wandb=mine"]).further()) == ["--wandb=mine"]
    assert list(scb.commands.Discover.parse(["--wandb=mine", "--judge-agents=3"]).further()) == [
        "--wandb=mine",
        "--judge-agents=3",
    ]


def asked_for(words=""):
    """The configuration that flags of `lpo meta-train` ask for."""
    return MetaTrain.parse(shlex.split(words)).config


EVERY_FLAG = """--preset=paper --tasks=Synthetic-CartPole-v1,hopper --drift=network --temporal --validate
--fitness=return-sampled --contexts=40 --horizons=0.5,2.0 '--hyperparameters=learning_rate=0.1,0.2 gae_lambda=0.5'
--reward-noise=1.5 --agents-per-candidate=3 --evaluation-episodes=8 --backend=generalized --initial-scale=0.3
--base=none --clip=0.3 --xi=0.001 --gate=0.2 --hidden-size=8 --strategy=ARS --population-size=6 --generations=7
--sigma=0.2 --sigma-decay=0.9 --sigma-limit=0.1 --learning-rate=0.3 --learning-rate-decay=0.8
--learning-rate-limit=0.2 --combine=mean --mean-evaluations=5 --evaluate-mean-every=4 --checkpoint-every=3 --seed=9"""


def test_every_flag_of_meta_train_reaches_the_configuration_and_its_command():
    words = [word for word in shlex.split(EVERY_FLAG) if word != "--drift=network"]
    command = MetaTrain.parse(words)
    assert sorted(shlex.split(command.command)) == sorted(["lpo", "meta-train", *words])
    # That is every field but what only a program sets; of two tasks "ranks" is what combines otherwise.
    config, paper = config_dict(command.config), config_dict(asked_for("--preset paper"))
    same = {name for name, value in paper.items() if value == config[name]}
    for group in ("drift", "evolution"):
        same |= {name for name, value in paper[group].items() if value == config[group][name]}
    assert same == {"agent", "combine"}
    # What is left out keeps its default: the preset quick is the library's but for the generations.
    quick, default = asked_for(), MetaTrainingConfig()
    assert MetaTrain.parse([]).command == "lpo meta-train"
    assert quick == replace(default, evolution=replace(default.evolution, num_generations=30))


@pytest.mark.parametrize("name", zoo_names())
def test_the_command_of_every_zoo_entry_asks_for_what_its_json_holds(name):
    metadata = load_objective(name).metadata
    config = config_dict(asked_for(metadata["command"].removeprefix("lpo meta-train")))
    stored = metadata["config"]["meta_training"]
    assert config["evolution"] == stored["evolution"]
    # An entry from before drifts had gates, or tasks were several, lacks what says so.
    for key in ("tasks", "fitness", "contexts", "horizons", "reward_noise", "validation"):
        assert config[key] == stored.get(key, config[key]), key


def test_defaults_that_depend_on_other_flags():
    both = asked_for("--tasks 'Synthetic-Pendulum-v1, Synthetic-CartPole-v1'")
    assert both.tasks == ("Synthetic-Pendulum-v1", "Synthetic-CartPole-v1")
    # Returns of different tasks have different scales.
    assert (both.evolution.combine, asked_for().evolution.combine) == ("ranks", "mean")
    assert asked_for("--environment Pendulum-v1").tasks == ("Pendulum-v1",)
    judged = asked_for("--validate")
    assert (judged.validation, judged.evolution.mean_evaluations) == (True, 16)
    temporal = asked_for("--temporal")
    assert temporal.drift.temporal and temporal.horizons == TEMPORAL_HORIZONS
    assert asked_for("--temporal --horizons None").horizons == ()
    for words in (
        "--drift mirror",
        "--temporal --horizons=None",
        "--validate --mean-evaluations=64",
    ):
        command = MetaTrain.parse(shlex.split(words))
        assert asked_for(command.command.removeprefix("lpo meta-train")) == command.config
    assert asked_for("--drift mirror").drift.name == "mirror"


@pytest.mark.parametrize(("command", "together"), [("run", False), ("meta-train", True)])
def test_flags_of_several_processes_are_shown_where_they_are_taken(command, together, capsys):
    with pytest.raises(SystemExit):
        cli.main([command, "--help"])
    assert ("--coordinator" in capsys.readouterr().out) == together


@pytest.mark.parametrize("drift", [name for name, drift in DRIFTS.items() if drift.learned])
def test_help_explains_every_flag_of_meta_train_in_groups(drift, capsys):
    config = MetaTrain.parse(["--drift", drift]).config
    kinds = (*type(config.drift).__mro__, type(config))
    explained = "".join(inspect.cleandoc(str(kind.__doc__)) for kind in kinds)
    for field in (*fields(config), *fields(config.drift)):
        assert f"\n  {field.name}: " in explained, field.name
    with pytest.raises(SystemExit):
        cli.main(["meta-train", "--drift", drift, "--help"])
    shown = capsys.readouterr().out
    for group in ("inner loop", "drift", "outer loop", "output"):
        assert f"{group} options" in shown


def test_a_run_of_everything_takes_its_seed_and_its_preset():
    command = RunAll.parse(["--preset", "paper", "--seed", "3"])
    assert command.command == "lpo run --preset=paper --seed=3"
    search = command.config.meta_training
    assert (search.evolution.seed, search.validation) == (3, True)
    assert (search.evolution.population_size, search.evolution.num_generations) == (64, 512)


def test_align_measures_every_combination_and_stores_it(monkeypatch, working_folder, capsys):
    asked, told = [], []

    def measure(
        regimes, objectives, environment, seeds, steps, backend, scale, tell, rows, done, keep
    ):
        assert scale == 0.01 and all(r.policy_output_scale == scale for r in regimes)
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
            "regimes": [{"name": str(r), "bandit": r.bandit, **measured} for r in regimes],
        }
        keep(report)
        told.append((len(known), rows.path.name))
        return report

    monkeypatch.setattr(training_commands, "measure_alignment", measure)
    flags = ["--objectives", "lpo-pendulum", "--agents=2", "--out=aligned"]
    flags += ["--policy-output-scale=0.01"]
    assert cli.main(["align", "--reward-noise", "0", "5", "--contexts", "50", "200", *flags]) == 0
    assert [(r.reward_noise, r.contexts) for r in asked] == [(0, 50), (0, 200), (5, 50), (5, 200)]
    output = capsys.readouterr().out
    assert "0.50 [0.25," in output and "contexts 50" in output
    stored = json.loads((working_folder / "aligned" / "alignment.json").read_text())
    assert len(stored["regimes"]) == 4
    assert (working_folder / "aligned" / "alignment.png").stat().st_size > 5000
    # What is there already is not measured again.
    assert cli.main(["align", "--resume=aligned"]) == 0
    assert told == [(0, "rows.jsonl"), (4, "rows.jsonl")]
    assert asked[4:] == asked[:4]


def test_inner_agents_hyperparameters_are_read_from_one_line(one_sentence):
    def config(text):
        return asked_for("" if text is None else f"'--hyperparameters={text}'")

    lists = config("learning_rate=0.0003,0.001 policy_output_scale=1").hyperparameters
    assert lists == {"learning_rate": (0.0003, 0.001), "policy_output_scale": (1.0,)}
    assert config(None).hyperparameters == {"policy_output_scale": (1.0, 0.01)}
    for text, message in (
        ("learning_rate", "the part 'learning_rate', which is no NAME=VALUE,VALUE"),
        ("learning_rate=fast", "learning_rate 'fast' are no numbers"),
        ("learning_rate=", "the list of learning_rate is empty"),
        ("learning_rat=0.1", "unknown hyperparameter 'learning_rat'"),
        ("drift=0.1", "drift is not drawn from a list"),
    ):
        with pytest.raises(UserError) as error:
            config(text)
        assert message in one_sentence(str(error.value))


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


def test_objectives_are_listed_with_what_ppo_earns_with_them(capsys):
    assert cli.main(["list"]) == 0
    rows = [line.strip(" │").split("│") for line in capsys.readouterr().out.splitlines()]
    table = {row[0].strip(): [cell.strip() for cell in row[1:]] for row in rows}
    # README's figures.
    assert table["ppo"][:3] == ["-250", "-950", "nothing: a formula"]
    assert table["lpo-pendulum"] == ["-177", "-231", "Synthetic-Pendulum-v1", "3"]
    assert cli.main(["list", "--json"]) == 0
    listed = {x["name"]: x for x in json.loads(capsys.readouterr().out)}
    assert listed.keys() == {"ppo", "dpo", "none", *zoo_names()}
    entry = listed["lpo-multi"]
    metadata = load_objective("lpo-multi").metadata
    assert entry["command"] == metadata["command"]
    assert entry["results"]["Pendulum-v1"]["n"] == 20 and entry["certificate"]["holds"]
    assert entry["learned_on"] == ["Synthetic-Pendulum-v1", "Synthetic-CartPole-v1"]
