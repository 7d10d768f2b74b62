"""`lpo meta-train` as a command: its flags, what it writes, and what its resumed run takes from the folder."""

import inspect
import json
import shlex
from dataclasses import fields, replace

import pytest

import scb.cli
import scb.commands
from lpo import cli, commands
from lpo.commands import MetaTrain
from lpo.drifts import DRIFTS
from lpo.inner_loop import MetaTrainingConfig
from lpo.meta_training import TEMPORAL_HORIZONS
from lpo.objectives import load_objective, zoo_names
from scb.configurations import config_dict
from scb.errors import UserError
from scb.evolution import evolve
from tests.locking import is_locked
from tests.recording import recorded_seeds

pytestmark = pytest.mark.usefixtures("working_folder", "no_training")


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

    # A log that was lost leaves nothing to draw, and the objective is there all the same.
    (working_folder / "learned" / "metrics.jsonl").unlink()
    for file in ("objective.npz", "objective.json"):
        (working_folder / "learned" / file).unlink()
    assert cli.main(["meta-train", "--resume=learned"]) == 0
    assert (working_folder / "learned" / "objective.npz").exists()


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
--learning-rate-limit=0.2 --combine=mean --averaging=6
--mean-evaluations=5 --evaluate-mean-every=4 --checkpoint-every=3 --seed=9"""


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
    assert config["evolution"] == {"averaging": 1, **stored["evolution"]}
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


def test_inner_agents_hyperparameters_are_read_from_one_line(one_sentence):
    def config(text):
        return asked_for("" if text is None else f"'--hyperparameters={text}'")

    lists = config("learning_rate=0.0003,0.001 policy_output_scale=1").hyperparameters
    assert lists == {"learning_rate": (0.0003, 0.001), "policy_output_scale": (1.0,)}
    unquoted = "--hyperparameters learning_rate=0.0003,0.001 policy_output_scale=1 --seed=2"
    assert asked_for(unquoted).hyperparameters == lists
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
