"""A mistake on a command line costs one sentence and exit code 2, and never a file that was there."""

import json
import os
from pathlib import Path

import jax
import pytest
from gymnax.environments import spaces

from lpo import cli
from scb.environments.synthetic import BanditConfig, SyntheticBandit
from scb.environments.zoo import save_bandit
from tests.lpo.conftest import PROGRAMS

pytestmark = pytest.mark.usefixtures("working_folder", "no_training")


# -- mistakes -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("train --environment Pendulm-v1", "unknown environment 'Pendulm-v1': did you mean Pend"),
        ("evaluate --environment hoper", "unknown environment 'hoper': did you mean hopper"),
        ("meta-train --environment Synthetic-Pendulm-v1", "did you mean Synthetic-Pendulum-v1"),
        ("train --objective dop", "unknown objective 'dop': did you mean dpo?"),
        ("evaluate --objectives ppo dop", "unknown objective 'dop': did you mean dpo?"),
        ("meta-train --contexts 7", "contexts is 7, and a batch is cut into 10 equal minibatches"),
        ("meta-train --drift netwrok", "unknown learned drift 'netwrok': did you mean network?"),
        ("meta-train --drift dpo", "unknown learned drift 'dpo': "),
        ("certify dop", "unknown objective 'dop': did you mean dpo?"),
        ("run --objective dop", "unknown objective 'dop': did you mean dpo?"),
        ("meta-train --strategy Open_SE", "unknown evolution strategy 'Open_SE': did you mean Op"),
        ("run --preset quik", "unknown preset 'quik': did you mean quick"),
        ("meta-train --preset papre", "unknown preset 'papre': did you mean paper"),
        ("meta-train --fitness retrun", "unknown fitness 'retrun': did you mean return"),
        ("meta-train --base pop", "unknown drift base 'pop': did you mean ppo"),
        ("meta-train --drift mirror --temporal", "the drift mirror has no temporal"),
    ],
)
def test_an_unknown_name_is_answered_by_near_ones(refused, arguments, message):
    assert message in refused(*arguments.split())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("meta-train --population-size 1", "population_size is 1"),
        ("meta-train --population-size 3", "Open_ES samples antithetic pairs, so it must be even"),
        (
            "meta-train --generations 0",
            "num_generations (--generations) is 0: it must be at least 1",
        ),
        (
            "meta-train --generations -2",
            "num_generations (--generations) is -2: it must be 0 or larger",
        ),
        ("meta-train --agents-per-candidate 0", "agents_per_candidate is 0"),
        ("meta-train --contexts 0", "contexts is 0"),
        ("meta-train --evaluation-episodes 0", "evaluation_episodes is 0"),
        ("meta-train --sigma 0", "sigma is 0.0: it must be positive"),
        ("meta-train --learning-rate -1", "learning_rate is -1.0: it must be positive"),
        (
            "meta-train --reward-noise nan",
            "reward_noise is nan: it must be 0 or larger, and finite",
        ),
        ("meta-train --seed -1", "seed is -1: it must be 0 or larger"),
        ("run --seed -1", "seed is -1: it must be 0 or larger"),
        # 10 000 + 1000 x 5 000 000 has more than 32 bits.
        ("run --seed 5000000", "seed is 5000000: it must be 0 or larger, and below 10000"),
        ("train --steps 0", "steps is 0: it must be at least 1"),
        ("train --steps -100", "steps is -100: it must be at least 1"),
        ("evaluate --steps -100", "steps is -100: it must be at least 1"),
        ("train --seeds 0", "seeds is 0: it must be at least 1"),
        (
            "evaluate --seeds 100000000",
            "seeds is 100000000: each is an agent to train, and at most",
        ),
        ("evaluate --seeds -1", "seeds is -1: it must be at least 1"),
        ("train --seed -1", "seed is -1: it must be 0 or larger"),
        ("train --seed 4294967296", "a seed is 4294967296"),
    ],
)
def test_a_number_out_of_range_is_told_its_range(refused, arguments, message):
    assert message in refused(*arguments.split())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            "train --backend spring",
            "the backend is 'spring', and Pendulum-v1 has no choice of physics",
        ),
        # Nor is a folder left behind, which would be in the corrected command's way.
        (
            "train --backend spring --out new",
            "the backend is 'spring', and Pendulum-v1 has no choice of physics",
        ),
        ("meta-train --environment Pendulum-v1 --fitness transfer", "asks for a bandit"),
        ("meta-train --tasks ,", "the list of tasks is empty"),
        ("meta-train --environment a --tasks b,c", "the environment a and the tasks b,c are both"),
        ("meta-train --horizons 0.5,x", "horizons '0.5,x' are no numbers"),
        ("align --bandits Pendulum-v1", "'Pendulum-v1' is none"),
        ("align --objectives ppo", "'ppo' is in the family already, as 'ppo-0.2': leave it out"),
        ("align --agents -4", "agents is -4: it must be at least 1."),
        # Before the agents of the environment are trained.
        ("align --minibatches 7", "contexts is 200, and a batch is cut into 7 equal minibatches"),
        ("align --steps 0 --out new", "steps is 0: it must be at least 1"),
        ("evaluate --suite classic --steps 0 --out new", "steps is 0: it must be at least 1"),
        (
            "evaluate --suite classic --backend spring",
            "Pendulum-v1 none has a choice: leave it out.",
        ),
        (
            "evaluate --suite brax --backend sprig",
            "those with a choice take generalized, mjx, posi",
        ),
        ("align --contexts 0", "contexts is 0: it must be at least 1."),
        ("evaluate --objectives", "no objectives: give at least one"),
        ("train --hyperparameters", "a flag that takes NAME=A NAME=B has no value"),
        ("meta-train --hyperparameters", "a flag that takes NAME=A,B NAME=A has no value"),
        (
            "evaluate --steps 2147483648",
            "steps is 2147483648: it must be at least 1, and below 2^31",
        ),
        ("train --environment=", "unknown environment ''"),
        ("evaluate --environment=", "unknown environment ''"),
        ("evaluate --seeds 99999999999", "seeds is 99999999999: it must be"),
        ("evaluate --steps 99999999999999999999", "it must be"),
        ("evaluate --hyperparameters num_envs=99999999999", "num_envs is 99999999999: it must be"),
        ("evaluate --objectives ppo ppo", "objective 'ppo' is there twice"),
        ("run --objective ppo", "named 'ppo', as one that every run is compared with anyway"),
        ("certify missing.npz", "missing.npz does not exist"),
    ],
)
def test_what_does_not_go_together_is_refused(refused, arguments, message):
    assert message in refused(*arguments.split())


# -- artefacts that do not fit ------------------------------------------------------------------


@pytest.fixture
def cartpole_bandit(working_folder) -> Path:
    bandit = SyntheticBandit(4, spaces.Discrete(2), BanditConfig(hidden_size=2))
    weights = bandit.init_weights(jax.random.key(0))
    return save_bandit(working_folder / "Synthetic-CartPole-v1.npz", bandit, weights)


def test_a_bandit_of_another_environment_is_refused(refused, cartpole_bandit):
    message = refused(
        *("train", "--bandit", cartpole_bandit, "--evaluation-environment", "Pendulum-v1"),
        program="scb",
    )
    assert "has 4 observations and 2 discrete actions, Pendulum-v1 has 3 obs" in message


def test_bandits_and_objectives_do_not_stand_in_for_each_other(
    refused, cartpole_bandit, objective_file
):
    assert "is a bandit: give a drift here" in refused("train", "--objective", cartpole_bandit)
    message = refused("train", "--bandit", objective_file, program="scb")
    assert "is a drift: give a bandit or synthetic_mdp here" in message


@pytest.mark.parametrize("command", [["certify"], ["train", "--objective"], ["run", "--objective"]])
def test_weights_of_another_shape_are_refused(refused, working_folder, objective_file, command):
    path = working_folder / "other.npz"
    path.write_bytes(objective_file.read_bytes())
    metadata = json.loads(objective_file.with_suffix(".json").read_text())
    metadata["config"]["drift"]["hidden_size"] = 8
    path.with_suffix(".json").write_text(json.dumps(metadata))
    message = refused(*command, path)
    assert "has shape (8, 4) where (8, 8) is expected" in message


# -- folders ------------------------------------------------------------------------------------

WRITING = {
    "run": ["run", "--objective", "none"],
    "meta-train": ["meta-train"],
    "train": ["train"],
    "evaluate": ["evaluate"],
    "align": ["align"],
}


@pytest.mark.parametrize("command", WRITING)
def test_a_folder_that_holds_something_is_left_alone(refused, working_folder, command):
    (working_folder / "mine").mkdir()
    (working_folder / "mine" / "comparison.json").write_text("precious")
    message = refused(*WRITING[command], "--out", "mine")
    assert "mine already exists and is not empty: choose another --out" in message


@pytest.mark.parametrize("command", WRITING)
def test_a_folder_that_cannot_be_made_is_told_before_training(refused, working_folder, command):
    (working_folder / "file").write_text("precious")
    message = refused(*WRITING[command], "--out", "file/inside")
    assert "cannot write to file/inside (Not a directory): choose another --out" in message


@pytest.mark.parametrize("command", ["train", "evaluate"])
def test_a_folder_without_permission_is_told_before_training(refused, monkeypatch, command):
    # By a stand-in for the system's answer, since an administrator may write anywhere.
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert "cannot write to mine: choose another --out" in refused(command, "--out", "mine")


@pytest.mark.parametrize("command", ["run", "meta-train"])
@pytest.mark.parametrize("config", [None, "not json", "[1, 2]", '"text"'])
def test_only_a_run_can_be_resumed(refused, working_folder, command, config):
    (working_folder / "other").mkdir()
    if config is not None:
        (working_folder / "other" / "config.json").write_text(config)
    assert "other is not a run (no readable config.json)" in refused(command, "--resume", "other")


@pytest.mark.parametrize("command", ["run", "meta-train"])
def test_a_folder_that_is_not_there_cannot_be_resumed(refused, command):
    assert "nowhere is not a run" in refused(command, "--resume", "nowhere")


@pytest.fixture
def interrupted(working_folder, monkeypatch, capsys) -> Path:
    """A meta-training that was interrupted at once."""

    def interrupt(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr("lpo.meta_training.evolve", interrupt)
    arguments = ["--population-size", "4", "--reward-noise", "2", "--out", "started"]
    assert cli.main(["meta-train", *arguments]) == 130
    error = capsys.readouterr().err
    assert error == "lpo: interrupted; a run with --out continues with --resume.\n"
    return working_folder / "started"


@pytest.mark.parametrize(
    ("flags", "difference"),
    [
        (["--population-size", "6"], "config.evolution.population_size (4 there, 6 now)"),
        (["--reward-noise", "0"], "config.reward_noise (2.0 there, 0.0 now)"),
        (["--seed", "5"], "config.evolution.seed (0 there, 5 now)"),
    ],
)
def test_a_resumed_run_keeps_its_settings(refused, interrupted, flags, difference):
    message = refused("meta-train", "--resume", interrupted, *flags)
    assert f"its config differs at {difference}" in message


def test_a_run_of_another_command_is_not_resumed(refused, interrupted):
    message = refused("run", "--resume", interrupted)
    assert "it was started with lpo meta-train --reward-noise=2.0 --population-size=4." in message


# As `lpo meta-train` wrote it until random keys were mended.
OLD = {"command": "meta-train", "environment": None, "seed": 3, "preset": "quick", "temporal": None}


def test_what_several_processes_do_not_share_is_refused_to_them(refused):
    message = refused("run", "--coordinator=here:1", "--processes=2", "--process=1")
    assert "--coordinator is given, and lpo run is no work of several processes" in message


def test_a_run_of_an_earlier_version_is_not_resumed(refused, working_folder):
    (working_folder / "config.json").write_text(json.dumps(OLD))
    for command in ("meta-train", "run"):
        message = refused(command, "--resume", working_folder)
        assert "or an earlier version, with other numbers; start another with --out." in message


def test_a_resumed_run_takes_the_stored_settings(interrupted, monkeypatch):
    seen = []

    def record(problem, config, run):
        seen.append((config.population_size, problem.config.reward_noise, run.resumed))
        raise KeyboardInterrupt

    monkeypatch.setattr("lpo.meta_training.evolve", record)
    assert cli.main(["meta-train", "--resume", str(interrupted)]) == 130
    # The same flags again are no contradiction.
    repeated = ["--population-size", "4", "--resume", str(interrupted)]
    assert cli.main(["meta-train", *repeated]) == 130
    assert seen == [(4, 2.0, True)] * 2


# -- what tyro parses ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments",
    [
        "",
        "tarin",
        "train --environmnet Pendulum-v1",
        "train --steps many",
        "train --seeds 1.5",
        "certify",
    ],
)
def test_what_cannot_be_parsed_is_a_mistake_too(arguments, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(arguments.split())
    assert stop.value.code == 2
    output = capsys.readouterr()
    assert "Traceback" not in output.err and output.err != ""


@pytest.mark.parametrize(
    ("program", "arguments", "mentioned"),
    [
        ("lpo", "", ["run", "meta-train", "train", "evaluate", "certify"]),
        ("lpo", "run", ["--preset", "--seed", "--out", "--resume", "--objective"]),
        (
            "lpo",
            "meta-train",
            ["--environment", "--fitness", "--reward-noise", "--strategy", "--population-size"],
        ),
        ("lpo", "train", ["--environment", "--objective", "--steps", "--seeds", "--out"]),
        ("lpo", "evaluate", ["--environment", "--objectives", "--seeds", "--backend"]),
        ("lpo", "certify", ["path.npz"]),
        ("scb", "", ["discover", "train", "list", "import-published"]),
        ("scb", "discover", ["--environment", "--init", "--strategy", "--resume"]),
        ("scb", "discover", ["--algorithms", "--mode", "--parameterization", "--curriculum"]),
        ("scb", "discover", ["--expert", "--min-spread", "--hyperparameters", "--mode-actions"]),
        ("scb", "train", ["--bandit", "--evaluation-environment", "--agents", "--algorithm"]),
        ("scb", "import-published", ["PATH", "--out"]),
        ("scb", "list", ["--help"]),
    ],
)
def test_help_names_the_flags(program, arguments, mentioned, capsys):
    with pytest.raises(SystemExit) as stop:
        PROGRAMS[program]([*arguments.split(), "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert f"usage: {program} {arguments}".rstrip() in text
    for name in mentioned:
        assert name in text
