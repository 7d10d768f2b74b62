"""A mistake on the command line `scb` costs one sentence and exit code 2, and writes nothing."""

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import scb
from tests.scb.calling import call

pytestmark = pytest.mark.usefixtures("small_agents")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("train --algorithm pop", "unknown algorithm 'pop': did you mean ppo"),
        ("train --algorithm dqn", "dqn does not fit the environment's continuous actions: use ppo"),
        ("train --bandit FILE --algorithm td3", "td3 does not fit the environment's discrete act"),
        (
            "train --backend spring",
            "the backend is 'spring', and Pendulum-v1 has no choice of physics",
        ),
        ("train --bandit Synthetic-Pendulum-v2", "unknown bandit 'Synthetic-Pendulum-v2'"),
        ("train --bandit nowhere.npz", "nowhere.npz does not exist"),
        ("train --agents 0", "agents is 0: it must be at least 1"),
        (
            "train --agents 100001",
            "agents is 100001: each is an agent to train, and at most 100000",
        ),
        ("train --episodes -1", "episodes is -1: it must be at least 1"),
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
        ("discover --generations -1", "num_generations (--generations) is -1"),
        (
            "discover --refinement-rounds 1 --refinement-agents 0",
            "agents (--refinement-agents) is 0: it",
        ),
        ("discover --generations 0 --init random", "0 generations, and nothing is found before"),
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
        (
            "discover --backend spring",
            "the backend is 'spring', and Pendulum-v1 has no choice of physics",
        ),
        (
            "discover --environment Pendulum-v1 --algorithms ppo,dqn",
            "dqn does not fit the environment's continuous actions: use ppo, sac, ddpg, td3",
        ),
        (
            "discover --environment CartPole-v1 --algorithms td3",
            "td3 does not fit the environment's discrete actions: use ppo, sac, dqn, ddqn",
        ),
        ("discover --algorithms pop", "unknown algorithm 'pop': did you mean ppo"),
        ("discover --algorithms ,", "the list of algorithms, of ppo, sac,"),
        ("discover --algorithms ''", "td3 or all, is empty: give one or more"),
        (
            "discover --environment CartPole-v1 --curriculum linear:100:501:0:5",
            "ends with episodes of 501 steps, but one of CartPole-v1 takes at most 500",
        ),
        ("discover --curriculum linear", "the curriculum 'linear' is not understood: give paper"),
        ("discover --curriculum linear:1:2:3", "'linear:1:2:3' is not understood"),
        ("discover --curriculum linear:1:2:3:4:5", "'linear:1:2:3:4:5' is not understood"),
        ("discover --curriculum linear:1.5:2:3:4", "'linear:1.5:2:3:4' is not understood"),
        ("discover --curriculum linear:a:2:3:4", "'linear:a:2:3:4' is not understood"),
        ("discover --curriculum ''", "the curriculum '' is not understood"),
        (
            "discover --curriculum liner:1:2:3:4",
            "unknown curriculum shape 'liner': did you mean li",
        ),
        ("discover --curriculum linear:0:2:3:4", "the curriculum's initial length is 0"),
        ("discover --curriculum linear:1:2:-3:4", "at which the curriculum begins is -3"),
        ("discover --curriculum linear:1:2:3:0", "the curriculum's transition is 0"),
        ("discover --mode al", "unknown mode 'al': did you mean all"),
        ("discover --parameterization IT", "unknown parameterization 'IT': did you mean"),
        ("discover --parameterization T", "(T) cannot be fitted to an expert, as is the default"),
        ("discover --parameterization TI --init random --max-steps 0", "max_steps is 0"),
        ("discover --max-steps 5", "max_steps is 5, and parameterization I has episodes of 1 step"),
        (
            "discover --parameterization TI --from-bandit Synthetic-Pendulum-v1",
            "a synthetic MDP cannot start from a bandit",
        ),
        ("discover --expert pop", "unknown expert 'pop': did you mean ppo"),
        ("discover --expert dqn", "dqn does not fit the environment's continuous actions"),
        ("discover --expert sac --expert-steps 4", "prefill is 8, which leaves nothing of 4"),
        (
            "discover --expert evolution --expert-steps 10",
            "expert_steps is 10, and the expert of Pendulum-v1 is found by evolution, which trains no",
        ),
        (
            "discover --min-spread 1 --construction q",
            "min_spread is 1.0, and the construction q cannot use it: leave it out, or take action_distance.",
        ),
        ("discover --discount 0.9", "discount is 0.9, and the construction action_distance cannot"),
        (
            "discover --expert-generations 9",
            "expert_generations is 9, and the expert of Pendulum-v1 is found by ppo, which is trained",
        ),
        (
            "discover --expert linear --num-experts 3",
            "num_experts is 3, and the expert of Pendulum-v1 is found by linear, which trains no agent",
        ),
        (
            "discover --form linear --hidden-size 8 --init random",
            "hidden_size is 8, and the form linear has no networks: leave it out, or take the form",
        ),
        (
            "discover --form linear --fit-steps 8",
            "fit_steps is 8, and the form linear is fitted in closed form, to the expert's actions",
        ),
        ("discover --min-spread -1", "min_spread is -1.0: it must be 0 or larger, and finite"),
        ("discover --min-spread nan", "min_spread is nan: it must be 0 or larger, and finite"),
        ("discover --judge-agents -1", "judge_agents is -1: it must be 0 or larger"),
        ("discover --population-size 200000", "population_size is 200000: each is an agent to tr"),
        ("discover --num-experts 200000", "num_experts is 200000: each is an agent to train"),
        ("discover --judge-agents 200000", "judge_agents is 200000: each is an agent to train"),
        (
            "discover --mean-evaluations 200000",
            "mean_evaluations is 200000: each is an agent to tr",
        ),
        (
            "discover --form linear --latent uniform",
            "the contexts of the form linear are normally distributed, and the latent is uniform",
        ),
        ("discover --form linear --latent-size 2", "latent_size is 2, and the form linear makes"),
        (
            "discover --form linear --strategy Open_ES",
            "Open_ES has one deviation for all weights, and those of this bandit have different",
        ),
        (
            "discover --init random --expert linear --stretch 3",
            "stretch is 3.0, and nothing is fitted to an expert: leave it out, or choose init ex",
        ),
        (
            "discover --from-bandit Synthetic-Pendulum-v1 --num-experts 3",
            "num_experts is 3, and nothing is fitted to an expert",
        ),
        ("discover --out elsewhere --resume FOLDER", "--out is elsewhere and --resume"),
        ("explain Synthetic-Pendulum-v1 --seed 4294967296 --out new", "a seed is 4294967296"),
        (
            "discover --strategy DifferentialEvolution",
            "DifferentialEvolution compares fitness with that of earlier generations, which ranks",
        ),
        (
            "discover --strategy HillClimbing --combine mean --mode sequential",
            "HillClimbing compares fitness with that of earlier generations, which is another",
        ),
        (
            "discover --strategy HillClimbing --combine mean --environment MountainCar-v0 --curriculum paper",
            "HillClimbing compares fitness with that of earlier generations, which is of episodes of other lengths",
        ),
        ("train --seed 4294967296 --out new", "a seed is 4294967296: each must be a whole number"),
        ("discover --judge-episodes 0", "judge_episodes is 0: it must be at least 1"),
        ("import-published nowhere", "nowhere does not exist: give the published"),
        ("discover --out FOLDER", "already exists and is not empty"),
        ("discover --out FILE/run", "cannot write to"),
        ("discover --resume FOLDER", "is not a run"),
        ("discover --resume", "--resume names no run: give the folder of one"),
        ("discover --out", "--out names no folder: give one, such as --out runs/NAME."),
        ("explain Synthetic-Pendulum-v1 --out=", "--out names no folder: give one"),
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
    refused(shlex.split(arguments), message)
    assert sorted(bandit_file.parent.iterdir()) == before


def refused(arguments, message):
    result = call(*arguments)
    assert result.code == 2
    assert result.err.startswith("scb: ") and result.err.count("\n") == 1
    assert message in result.err
    assert result.err.rstrip().endswith((".", "?"))
    assert "Traceback" not in result.err and result.out == ""


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "cannot read lists.json (No such file or directory): give {"),
        ("", "lists.json is no JSON (Expecting value"),
        ("{'ppo': {}}", "lists.json is no JSON ("),
        (b"\xff\xfe", "lists.json is no JSON ("),
        ("[]", "lists.json holds no hyperparameter lists: give {"),
        ("[1, 2]", "lists.json holds no hyperparameter lists: give {"),
        ("{}", "lists.json holds no hyperparameter lists"),
        ('{"ppo": {}}', "lists.json holds no hyperparameter lists"),
        ('{"ppo": [0.1]}', "lists.json holds no hyperparameter lists"),
        ('{"pop": {"discount": [0.9]}}', "unknown algorithm 'pop': did you mean ppo"),
        ('{"ppo": {"lr": [0.1]}}', "unknown hyperparameter 'lr': known are learning_rate"),
        ('{"ppo": {"discount": []}}', "discount has [] for a list of values"),
        ('{"ppo": {"discount": 0.9}}', "discount has 0.9 for a list of values"),
        ('{"ppo": {"learning_rate": ["fast"]}}', "learning_rate has the value 'fast', which is no"),
        ('{"ppo": {"discount": [0.9, true]}}', "discount has the value True, which is no number"),
        ('{"ppo": {"discount": [null]}}', "discount has the value None, which is no number"),
        ('{"ppo": {"discount": [[0.9]]}}', "discount has the value [0.9], which is no number"),
        ('{"ppo": {"discount": [NaN]}}', "lists.json is no JSON (NaN is no JSON number)"),
        ('{"ppo": {"discount": [-Infinity]}}', "is no JSON (-Infinity is no JSON number)"),
        ('{"ppo": {"discount": [1e999]}}', "discount has the value inf, which is no number"),
        ('{"ppo": {"discount": [1e39]}}', "discount has the value 1e+39, which is no number"),
        ('{"ppo": {"learning_rate": [-1]}}', "learning_rate has the value -1: it must be 0 or lar"),
        ('{"ppo": {"discount": [7]}}', "discount has the value 7: it must be between 0 and 1"),
        ('{"sac": {"discount": [0.9]}}', "lists for sac, but the inner loop trains ppo"),
    ],
)
def test_a_wrong_file_of_hyperparameters_is_refused(tmp_path, monkeypatch, content, message):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "lists.json"
    if content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    before = sorted(tmp_path.iterdir())
    refused(["discover", "--hyperparameters", "lists.json"], message)
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"ppo": 1}', "the text holds no configurations: give {"),
        ('{"pop": {"num_steps": 5}}', "unknown algorithm 'pop': did you mean ppo"),
        (
            '{"ppo": {"num_step": 5}}',
            "unknown field of a configuration 'num_step': did you mean num_steps",
        ),
        ('{"ppo": {"learning_rate": 0.1}}', "unknown field of a configuration 'learning_rate'"),
        ('{"ppo": {"num_steps": 0.5}}', "num_steps is 0.5: it must be a whole number"),
        ('{"ppo": {"num_steps": "5"}}', "num_steps is '5': it must be a whole number"),
        (
            '{"ppo": {"num_envs": 1, "num_steps": 3, "num_minibatches": 2}}',
            "num_minibatches is 2, which does not divide a batch of 3",
        ),
        ('{"ppo": {"hidden_sizes": 64}}', "hidden_sizes is 64: give one size"),
        ('{"ppo": {"hidden_sizes": [64, "64"]}}', "hidden_sizes[1] is '64': it must be a whole"),
        ('{"ppo": {"activation": "tan"}}', "'tan': did you mean tanh"),
        ('{"ppo": {"activation": 1}}', "unknown activation 1"),
        ('{"ppo": {"anneal_learning_rate": 1}}', "anneal_learning_rate is 1: it must be true or"),
        ('{"sac": {"num_envs": 2}}', "configurations for sac, but the inner loop trains ppo"),
    ],
)
def test_wrong_configurations_are_refused(tmp_path, monkeypatch, content, message):
    monkeypatch.chdir(tmp_path)
    refused(["discover", "--configs", content], message)
    assert not list(tmp_path.iterdir())


def test_fixed_hyperparameters_and_lists_to_draw_from_contradict_each_other(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lists.json").write_text('{"ppo": {"discount": [0.9]}}')
    flags = ["--hyperparameters", "lists.json", "--fixed-hyperparameters"]
    refused(["discover", *flags], "fixed hyperparameters are not drawn from lists")


def test_an_import_of_pickles_is_refused_and_writes_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "published").mkdir()
    (tmp_path / "published" / "pendulum.pkl").write_bytes(b"\x80")
    message = "published holds no .npz file, only pickles, which run code when they are opened"
    refused(["import-published", "published", "--out", "out"], message)
    (tmp_path / "published" / "pendulum.npz").write_bytes(b"\x80\x05N.")
    message = "pendulum.npz is not a usable .npz"
    refused(["import-published", "published", "--out", "out"], message)
    assert [path.name for path in tmp_path.iterdir()] == ["published"]


# As `scb discover` wrote it until random keys were mended.
OLD = {
    "command": "discover",
    "environment": "CartPole-v1",
    "seed": 7,
    "population_size": 4,
    "preset": "quick",
}


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (OLD, "an experiment started it, whose command goes on with it, or an earlier version"),
        ({}, "start another with --out"),
        (
            {"command": "lpo meta-train --seed=3", "config": {}},
            "with scb discover: it was started with lpo meta-train --seed=3.",
        ),
        (
            {"command": "scb discovery --seed=3", "config": {}},
            "with scb discover: it was started with scb discovery --seed=3.",
        ),
        (
            {"command": "scb discover 'x", "config": {}},
            "the command in its config.json is damaged (No closing quotation)",
        ),
        (
            {"command": "scb discover --seed=7", "config": {"environment": "CartPole-v1"}},
            "its config differs at config.environment ('CartPole-v1' there, 'Pendulum-v1' now)",
        ),
    ],
)
def test_a_run_of_something_else_is_not_resumed(tmp_path, config, message):
    (tmp_path / "config.json").write_text(json.dumps(config))
    refused(["discover", "--resume", tmp_path], message)


@pytest.mark.parametrize(
    "arguments", [["discovr"], ["train", "--agnts", "3"], ["train", "--agents", "three"]]
)
def test_a_flag_that_does_not_exist_is_exit_code_2_without_a_traceback(arguments):
    result = call(*arguments)
    assert result.code == 2
    assert result.err and "Traceback" not in result.err


def test_a_process_of_its_own_starts_and_refuses_in_one_sentence(tmp_path):
    # Without the settings that the tests run under: the command line configures JAX itself.
    environment = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    root = Path(scb.__file__).parents[1]
    completed = subprocess.run(
        [
            sys.executable,
            "-c",
            "import sys; from scb.cli import main; sys.exit(main())",
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
