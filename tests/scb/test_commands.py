"""The command line `scb`, called in this process but for one test."""

import contextlib
import io
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import scb
from lpo.cli import scb_main
from scb import artefacts
from scb.agents.ppo import PPOConfig
from scb.commands import discovery_config
from scb.discovery import DiscoveryConfig
from scb.environments.registry import make
from scb.environments.synthetic import BanditConfig, bandit_for
from scb.environments.zoo import load_bandit, save_bandit, zoo_names

METADATA = {"seeds": {}, "results": {}, "cost": {}, "command": "scb discover", "config": {}}
TINY = PPOConfig(
    num_envs=2, num_steps=8, num_epochs=1, num_minibatches=1, total_steps=16, hidden_sizes=(4,)
)
DISCOVER = ["discover", "--environment", "CartPole-v1", "--init", "random", "--generations", "2"]
DISCOVER += ["--population-size", "4", "--agents-per-candidate", "2", "--evaluation-episodes", "1"]
DISCOVER += ["--seed", "7", "--activation", "relu", "--latent", "uniform"]


def call(*arguments):
    """Exit code, stdout and stderr of one command."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = scb_main([str(argument) for argument in arguments])
        except SystemExit as stop:  # tyro's own refusals and its help
            code = stop.code
    return SimpleNamespace(code=code, out=out.getvalue(), err=err.getvalue())


@pytest.fixture(scope="module", autouse=True)
def small_inner_loop():
    """The commands take the paper's 10 000 steps; here 16 must do."""
    with pytest.MonkeyPatch.context() as patch:
        for module in ("scb.discovery", "scb.commands"):
            patch.setattr(f"{module}.inner_loop_config", lambda name: TINY)
        patch.setattr("scb.discovery.EvolutionConfig.mean_evaluations", 2)
        yield


@pytest.fixture(scope="module")
def discovered(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "cartpole"
    result = call(*DISCOVER, "--out", folder)
    assert result.code == 0, result.err
    return folder, result


@pytest.fixture(scope="module")
def bandit_file(tmp_path_factory):
    """A bandit of CartPole's shapes that nobody evolved."""
    bandit = bandit_for(*make("CartPole-v1"), BanditConfig(hidden_size=4), "Synthetic-CartPole-v1")
    path = tmp_path_factory.mktemp("bandits") / "Synthetic-CartPole-v1.npz"
    return save_bandit(path, bandit, bandit.init_weights(jax.random.key(0)), METADATA)


# -- discover
# -----------------------------------------------------------------------------------------


def test_a_discovery_says_what_its_bandit_is_worth_and_where_it_lies(discovered):
    folder, result = discovered
    lines = result.out.splitlines()
    assert lines[0].startswith("PPO, sampled hyperparameters, sampled actions, on CartPole-v1: IQM")
    assert "the most likely actions" in result.out
    path = "".join(lines[-2:]).split("bandit: ")[1]
    assert Path(path) == folder / "Synthetic-CartPole-v1.npz"
    assert "generation 2/2: fitness" in result.err


def test_a_discovery_leaves_a_bandit_with_its_story(discovered):
    folder, _ = discovered
    bandit = load_bandit(folder / "Synthetic-CartPole-v1.npz")
    assert bandit.config == BanditConfig(
        hidden_size=32, activation="relu", latent="uniform", latent_size=4
    )
    metadata = artefacts.load(folder / "Synthetic-CartPole-v1.npz", "bandit").metadata
    assert metadata["config"]["evaluation_environment"] == "CartPole-v1"
    assert metadata["config"]["started_from"] is None
    assert metadata["seeds"] == {"discovery": 7, "reporting": 10_000}
    for actions in ("sampled_actions", "mode_actions"):
        estimate = metadata["results"]["PPO"][actions]
        assert estimate["n"] == 20 and estimate["low"] <= estimate["value"] <= estimate["high"]
    # 2 generations of 4 candidates with 2 agents each: 16 training steps, 500 evaluation steps at
    # most.
    assert metadata["cost"]["environment_steps_training"] == 2 * 4 * 2 * 16
    assert metadata["cost"]["environment_steps_evaluation"] == 2 * 4 * 2 * 500
    assert metadata["cost"]["seconds"] > 0
    assert {p.name for p in folder.iterdir()} >= {"config.json", "metrics.jsonl", "checkpoints"}


def test_a_finished_discovery_is_resumed_to_the_same_bandit(discovered):
    folder, _ = discovered
    before = (folder / "Synthetic-CartPole-v1.npz").read_bytes()
    metrics = (folder / "metrics.jsonl").read_bytes()
    result = call("discover", "--resume", folder)
    assert (result.code, result.err) == (0, "")
    assert (folder / "Synthetic-CartPole-v1.npz").read_bytes() == before
    assert (folder / "metrics.jsonl").read_bytes() == metrics


def test_a_flag_that_contradicts_the_resumed_run_is_refused(discovered):
    folder, _ = discovered
    result = call("discover", "--resume", folder, "--seed", 8)
    assert result.code == 2
    assert "its config differs at seed (7 there, 8 now)" in result.err
    # The same flags again contradict nothing, and are judged before anything is computed.
    result = call("discover", "--resume", folder, "--preset", "paper")
    assert "its config differs at preset ('quick' there, 'paper' now)" in result.err


def test_a_discovery_from_a_bandit_tells_where_it_started(discovered, tmp_path):
    folder, _ = discovered
    start = folder / "Synthetic-CartPole-v1.npz"
    result = call(*DISCOVER, "--from-bandit", start, "--out", tmp_path / "second")
    assert result.code == 0, result.err
    origin = json.loads((tmp_path / "second" / "Synthetic-CartPole-v1.json").read_text())
    first = json.loads(start.with_suffix(".json").read_text())
    assert origin["config"]["started_from"]["sha256"] == first["sha256"]


def test_settings_become_a_configuration_and_what_is_left_out_keeps_its_default():
    assert discovery_config({}) == DiscoveryConfig()
    settings = {
        "sigma": 0.1,
        "generations": 5,
        "latent": "uniform",
        "construction": "q",
        "seed": None,
    }
    config = discovery_config(settings)
    assert (config.evolution.sigma, config.evolution.num_generations) == (0.1, 5)
    assert (config.bandit.latent, config.warm_start.construction) == ("uniform", "q")
    assert config.evolution.seed == DiscoveryConfig().evolution.seed
    assert not discovery_config({"fixed_hyperparameters": True}).sampled_hyperparameters


def test_a_refused_discovery_leaves_no_folder_behind(tmp_path):
    # Else the corrected command would be refused too: the folder would not be empty any more.
    for flag, value in [("environment", "CartPole-v2"), ("from-bandit", "nobody"), ("seed", "-1")]:
        assert call("discover", f"--{flag}", value, "--out", tmp_path / "run").code == 2
        assert not (tmp_path / "run").exists()


# -- train and list
# -----------------------------------------------------------------------------------


def test_training_prints_the_sorted_returns_and_their_mean(bandit_file):
    train = ["train", "--bandit", bandit_file, "--agents", "3", "--episodes", "2"]
    result = call(*train)
    assert (result.code, result.err) == (0, "")
    returns, mean = result.out.splitlines()
    assert returns.startswith("returns on CartPole-v1: ") and mean.startswith("IQM: ")
    numbers = [float(number) for number in returns.split(": ")[1].split()]
    assert len(numbers) == 3 and numbers == sorted(numbers)
    assert mean.endswith("(n=3)")
    # IQM of three numbers is their mean; the list is printed without decimals.
    assert float(mean.split()[1]) == pytest.approx(np.mean(numbers), abs=0.5)
    # The seed decides everything.
    assert call(*train).out == result.out
    assert call(*train, "--seed", "1").out != result.out


def test_listing_names_every_bandit_of_the_zoo():
    result = call("list")
    assert (result.code, result.err) == (0, "")
    table = result.out.replace("\n", "")
    assert zoo_names() and all(name in table for name in zoo_names())


# -- errors
# -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("train --bandit Synthetic-Pendulum-v2", "unknown bandit 'Synthetic-Pendulum-v2'"),
        ("train --bandit nowhere.npz", "nowhere.npz does not exist"),
        ("train --agents 0", "agents is 0: give at least 1"),
        ("train --episodes -1", "episodes is -1: give at least 1"),
        ("train --seed -1", "seed is -1: it must be 0 or larger"),
        (
            "train --bandit FILE --evaluation-environment Pendulum-v1",
            "Pendulum-v1 has 3 observations",
        ),
        ("train --bandit FILE --evaluation-environment Cart", "unknown environment 'Cart'"),
        ("discover --preset quik", "unknown preset 'quik': did you mean quick"),
        ("discover --environment Pendulum-v2", "unknown environment 'Pendulum-v2'"),
        ("discover --strategy SNESS", "unknown evolution strategy 'SNESS': did you mean SNES"),
        ("discover --strategy Open_ES --population-size 5", "it must be even"),
        ("discover --population-size 1", "population_size is 1"),
        ("discover --generations 0", "num_generations is 0"),
        ("discover --agents-per-candidate 0", "agents_per_candidate is 0"),
        ("discover --evaluation-episodes 0", "evaluation_episodes is 0"),
        ("discover --seed -1", "seed is -1"),
        ("discover --sigma 0", "sigma is 0.0"),
        ("discover --latent gauss", "unknown latent distribution 'gauss'"),
        ("discover --activation tan", "unknown bandit activation 'tan': did you mean tanh"),
        ("discover --init exprt", "unknown initialisation 'exprt': did you mean expert"),
        ("discover --construction Q", "unknown warm-start construction 'Q': did you mean q"),
        ("discover --combine rank", "unknown combination of tasks 'rank': did you mean ranks"),
        ("discover --from-bandit nobody", "unknown bandit 'nobody'"),
        ("discover --out FOLDER", "already exists and is not empty"),
        ("discover --out FILE/run", "cannot write to"),
        ("discover --resume FOLDER", "is not a run"),
    ],
)
def test_a_wrong_input_is_one_sentence_and_exit_code_2(
    bandit_file, monkeypatch, arguments, message
):
    monkeypatch.chdir(bandit_file.parent)
    arguments = arguments.replace("FILE", str(bandit_file)).replace(
        "FOLDER", str(bandit_file.parent)
    )
    before = sorted(bandit_file.parent.iterdir())
    result = call(*arguments.split())
    assert result.code == 2
    assert result.err.startswith("scb: ") and result.err.count("\n") == 1
    assert message in result.err
    assert result.err.rstrip().endswith((".", "?"))
    assert "Traceback" not in result.err and result.out == ""
    assert sorted(bandit_file.parent.iterdir()) == before


@pytest.mark.parametrize(
    "arguments", [["discovr"], ["train", "--agnts", "3"], ["train", "--agents", "three"]]
)
def test_a_flag_that_does_not_exist_is_exit_code_2_without_a_traceback(arguments):
    result = call(*arguments)
    assert result.code == 2
    assert result.err and "Traceback" not in result.err


@pytest.mark.parametrize("arguments", [["--help"], ["discover", "--help"], ["train", "--help"]])
def test_help_is_shown_for_every_command(arguments):
    result = call(*arguments)
    assert result.code == 0
    assert "scb" in result.out


def test_an_interruption_is_exit_code_130(monkeypatch, bandit_file):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("scb.commands.judge", interrupt)
    result = call("train", "--bandit", bandit_file)
    assert result.code == 130
    assert result.err.startswith("scb: interrupted") and result.err.count("\n") == 1


def test_a_process_of_its_own_starts_and_refuses_in_one_sentence(tmp_path):
    # Without the settings that the tests run under: the command line configures JAX itself.
    environment = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    root = Path(scb.__file__).parents[1]
    completed = subprocess.run(
        [
            sys.executable,
            "-c",
            "import sys; from lpo.cli import scb_main; sys.exit(scb_main())",
            *("discover", "--environment", "Pendulum-v2", "--out", str(tmp_path / "run")),
        ],
        env={**environment, "PYTHONPATH": str(root), "XDG_CACHE_HOME": str(tmp_path / "cache")},
        capture_output=True,
        text=True,
    )
    assert completed.returncode == 2
    assert completed.stderr.startswith(
        "scb: unknown environment 'Pendulum-v2': did you mean Pendulum-v1 or "
    )
    assert completed.stderr.count("\n") == 1 and completed.stdout == ""
