"""The command line `scb`, called in this process but for one test."""

import inspect
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import fields
from importlib import import_module
from pathlib import Path

import jax
import numpy as np
import pytest
from gymnax.environments import spaces
from jax.errors import JaxRuntimeError

from scb import artefacts, judgement, listing
from scb.cli import main, run_program
from scb.command_line import SharedOutput
from scb.commands import Discover, Judgement, TrainConfig
from scb.configurations import config_dict
from scb.console import console
from scb.curriculum import CurriculumConfig, paper_curriculum
from scb.discovery import BanditDiscovery, DiscoveryConfig
from scb.environments.registry import environment_spec, make
from scb.environments.synthetic import BanditConfig, SyntheticBandit
from scb.environments.zoo import bandit_metadata, load_bandit, save_bandit, zoo_names
from scb.evolution import EvolutionConfig
from scb.measurement import Place
from scb.warm_start import WarmStartConfig
from tests.recording import recorded_seeds
from tests.scb.calling import call
from tests.scb.probes import small_agents

DISCOVER = ["discover", "--environment", "CartPole-v1", "--init", "random", "--generations", "2"]
DISCOVER += ["--population-size", "4", "--agents-per-candidate", "2", "--evaluation-episodes", "1"]
DISCOVER += [
    "--seed",
    "7",
    "--activation",
    "relu",
    "--latent",
    "uniform",
    "--mean-evaluations",
    "2",
]


@pytest.fixture(scope="module", autouse=True)
def small_inner_loop():
    """The commands take the paper's 10 000 steps; here 16 must do."""
    with small_agents():
        yield


@pytest.fixture(scope="module")
def discovered(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "cartpole"
    with recorded_seeds() as seeds:
        result = call(*DISCOVER, "--judge-episodes", "2", "--out", folder)
    assert result.code == 0, result.err
    # Its own, that of its end's judges, and that of constants such as a pendulum's start.
    assert seeds - {0} == {7, 30_000}
    return folder, result


# -- discover
# -----------------------------------------------------------------------------------------


def test_a_discovery_says_what_its_bandit_is_worth_and_where_it_lies(discovered):
    folder, result = discovered
    lines = result.out.splitlines()
    # Every algorithm that fits the action space judges it, whichever trained in the search.
    text = " ".join(result.out.split())
    for algorithm in ("PPO", "SAC", "DQN"):
        assert f"{algorithm} on CartPole-v1: sampled actions IQM " in text
    assert text.count("; mode actions IQM ") == 3
    assert Path(lines[-1].removeprefix("bandit: ")) == folder / "Synthetic-CartPole-v1.npz"
    assert "generation 2/2: fitness" in result.err
    # Which may take longer than the search.
    assert result.err.splitlines()[-1] == "judging by 20 agents each of PPO, SAC, DQN"


def test_a_bandit_is_there_before_it_is_judged(discovered, tmp_path, monkeypatch):
    def interrupted(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr("scb.commands.judge_all", interrupted)
    assert call(*DISCOVER, "--out", tmp_path).code == 130
    path, whole = (
        tmp_path / "Synthetic-CartPole-v1.npz",
        discovered[0] / "Synthetic-CartPole-v1.npz",
    )
    assert path.read_bytes() == whole.read_bytes()
    assert bandit_metadata(path)["results"] == {}


def test_a_discovery_leaves_a_bandit_with_its_story(discovered):
    folder, _ = discovered
    bandit = load_bandit(folder / "Synthetic-CartPole-v1.npz")
    assert bandit.config == BanditConfig(
        hidden_size=32, activation="relu", latent="uniform", latent_size=4
    )
    metadata = artefacts.load(folder / "Synthetic-CartPole-v1.npz", "bandit").metadata
    assert metadata["config"]["evaluation_environment"] == "CartPole-v1"
    assert metadata["config"]["started_from"] is None
    assert metadata["seeds"] == {"discovery": 7, "validation": 30_000}
    assert metadata["results"].keys() == {"PPO", "SAC", "DQN"}
    for result in metadata["results"].values():
        for actions in ("sampled_actions", "mode_actions"):
            estimate = result[actions]
            assert estimate["n"] == 20
            assert estimate["low"] <= estimate["value"] <= estimate["high"]
    # 2 generations of 4 candidates with 2 agents each: 16 training steps, 500 evaluation steps at
    # most.
    assert metadata["cost"]["environment_steps_training"] == 2 * 4 * 2 * 16
    assert metadata["cost"]["environment_steps_evaluation"] == 2 * 4 * 2 * 500
    assert metadata["cost"]["environment_steps_judgements_evaluation"] > 0
    assert metadata["cost"]["seconds"] > 0
    assert {p.name for p in folder.iterdir()} >= {"config.json", "metrics.jsonl", "checkpoints"}


def test_a_finished_discovery_is_resumed_to_the_same_bandit(discovered, tmp_path):
    folder = Path(shutil.copytree(discovered[0], tmp_path / "copy"))
    before = (folder / "Synthetic-CartPole-v1.npz").read_bytes()
    metrics = (folder / "metrics.jsonl").read_bytes()
    result = call("discover", "--resume", folder, "--judge-agents", "0")
    assert (result.code, result.err) == (0, "")
    assert (folder / "Synthetic-CartPole-v1.npz").read_bytes() == before
    assert (folder / "metrics.jsonl").read_bytes() == metrics


def test_a_finished_discovery_goes_on_with_more_generations(discovered, tmp_path):
    folder = Path(shutil.copytree(discovered[0], tmp_path / "copy"))
    bandit = folder / "Synthetic-CartPole-v1.json"
    before = json.loads(bandit.read_text())
    words = ["--resume", folder, "--generations", "3", "--judge-agents", "0"]
    result = call("discover", *words)
    assert (result.code, result.err.count("generation 3/3: fitness")) == (0, 1)
    after = json.loads(bandit.read_text())
    assert after["sha256"] != before["sha256"]
    assert after["command"] == before["command"].replace("--generations=2", "--generations=3")
    result = call("discover", "--resume", folder, "--generations", "2")
    assert (
        f"cannot end {folder} after 2 generations: of 3 it has done 3, and has ended." in result.err
    )


def test_a_search_under_the_papers_curriculum_keeps_its_length(tmp_path):
    words = ["--environment=MountainCar-v0", "--curriculum=paper", "--generations=4"]
    Discover.parse([*words, "--out", str(tmp_path / "run")]).open().close()
    result = call("discover", "--resume", tmp_path / "run", "--generations=5")
    assert "its config differs at config.evolution.num_generations (4 there, 5 now)" in result.err
    result = call("discover", "--resume", tmp_path / "run", "--generations=3")
    assert "its config differs at config.evolution.num_generations (4 there, 3 now)" in result.err


def test_a_resumed_discovery_judges_as_it_was_told_to_at_first(tmp_path):
    folder = tmp_path / "run"
    words = ["--environment=CartPole-v1", "--judge-agents=3", "--judge-episodes=2"]
    command = Discover.parse([*words, "--out", str(folder)])
    command.open().close()
    resumed = Discover.parse(["--resume", str(folder)])
    assert resumed.judgement == command.judgement == Judgement(3, 2)
    # It is no part of what a search finds, so of the bandit's command neither, and can be another one.
    assert resumed.command == command.command == "scb discover --environment=CartPole-v1"
    again = Discover.parse(["--resume", str(folder), "--judge-agents=0"])
    assert again.judgement == Judgement(0, 2)
    again.open().close()


def test_a_slow_simulator_is_judged_by_fewer_episodes():
    assert [Judgement().episodes_in(x) for x in ("CartPole-v1", "hopper")] == [50, 5]
    assert Judgement(judge_episodes=7).episodes_in("hopper") == 7


def test_a_flag_that_contradicts_the_resumed_run_is_refused(discovered):
    folder, _ = discovered
    result = call("discover", "--resume", folder, "--seed", 8)
    assert result.code == 2
    assert "its config differs at config.evolution.seed (7 there, 8 now)" in result.err
    result = call("discover", "--resume", folder, "--preset", "paper")
    assert "its config differs at config.algorithms (['ppo'] there, [] now)" in result.err


def test_a_discovery_from_a_bandit_tells_where_it_started(discovered, tmp_path):
    folder, _ = discovered
    start = folder / "Synthetic-CartPole-v1.npz"
    out = ["--judge-agents", "0", "--out", tmp_path / "second"]
    result = call(*DISCOVER, "--from-bandit", start, *out)
    assert result.code == 0, result.err
    origin = json.loads((tmp_path / "second" / "Synthetic-CartPole-v1.json").read_text())
    first = json.loads(start.with_suffix(".json").read_text())
    assert origin["config"]["started_from"]["sha256"] == first["sha256"]
    assert origin["config"]["started_from"]["found"] == "random weights, evolved"


def asked_for(*arguments):
    """The configuration that a command asks for."""
    return Discover.parse([str(argument) for argument in arguments]).config


def test_flags_become_a_configuration_and_what_is_left_out_keeps_its_default():
    config = asked_for(
        *["--sigma", "0.1", "--generations", "5", "--latent", "uniform", "--construction", "q"]
    )
    assert (config.evolution.sigma, config.evolution.num_generations) == (0.1, 5)
    assert (config.bandit.latent, config.warm_start.construction) == ("uniform", "q")
    assert config.evolution.seed == DiscoveryConfig().evolution.seed
    assert asked_for("--fixed-hyperparameters").fixed_hyperparameters


EVERY_FLAG = """--preset=paper --environment=MountainCar-v0 --backend=spring --max-steps=5 --algorithms=ppo,dqn,ppo
--mode=sequential '--hyperparameters={"ppo": {"learning_rate": [0.25]}}'
'--configs={"ppo": {"num_steps": 50, "hidden_sizes": [8], "anneal_learning_rate": true}}' --agents-per-candidate=3
--evaluation-episodes=2 --optimal-policy-episodes=3 --optimal-policy-errors=0.5 --mode-actions
--curriculum=linear:2:4:0:2 --init=expert --reward-std=4.0
--select=best --form=linear
--expert=sac --expert-noise=0.2 --expert-errors=0.3 --expert-pupils=2
--expert-episode-steps=5 --expert-sigma=0.1 --expert-learning-rate=0.2 --expert-decay=0.9 --expert-reach=1.5
--expert-error-warmup=4 --expert-starts=2 --expert-normalization=0.5
--num-experts=3 --expert-steps=9 --expert-generations=8 --num-states=7
--aggregation-rounds=2 --aggregation-agents=3
--refinement-rounds=1 --refinement-generations=2 --refinement-agents=4 --no-refinement-visits --refinement-noise=0.1
--strategy=Open_ES --population-size=6 --generations=9 --sigma=0.2 --sigma-decay=0.9 --sigma-limit=0.1
--learning-rate=0.3 --learning-rate-decay=0.8 --learning-rate-limit=0.2 --combine=ranks --averaging=6
--mean-evaluations=5
--evaluate-mean-every=4 --checkpoint-every=3 --seed=8"""


def test_the_command_that_a_configuration_is_written_as_asks_for_it_again():
    words = shlex.split(EVERY_FLAG)
    command = Discover.parse(words)
    assert sorted(shlex.split(command.command)) == sorted(["scb", "discover", *words])
    assert Discover.parse(shlex.split(command.command)[2:]).config == command.config
    # That is every field but those that contradict others.
    paper = config_dict(Discover.parse(["--preset=paper", "--environment=CartPole-v1"]).config)
    same = {
        name
        for group in ("bandit", "warm_start", "refinement", "evolution")
        for name, value in paper[group].items()
        if value == getattr(getattr(command.config, group), name)
    } | {name for name, value in paper.items() if value == config_dict(command.config)[name]}
    contradicting = {"fixed_hyperparameters", "start", "parameterization", "construction"}
    contradicting |= {"min_spread", "stretch", "jitter", "discount", "horizon"}
    contradicting |= {"latent", "latent_size", "hidden_size", "activation"}
    contradicting |= {"fit_steps", "num_actions"}
    assert same == contradicting
    for text in (
        "--environment=CartPole-v1",
        "--fixed-hyperparameters",
        "--min-spread=0.5",
        "--stretch=1.5",
        "--jitter=1.0",
        "--latent=uniform",
        "--construction=q --discount=0.5 --horizon=4",
        "--num-actions=6 --fit-steps=3",
        "--hidden-size=3 --activation=relu",
        "--from-bandit=b.npz",
        "--latent-size=2",
        "--parameterization=TI --init=random",
    ):
        words = text.split()
        assert shlex.split(Discover.parse(words).command) == ["scb", "discover", *words]
    assert Discover.parse(["--preset=quick", "--generations=150"]).command == "scb discover"


@pytest.mark.parametrize("name", zoo_names())
def test_the_command_of_every_zoo_entry_asks_for_what_its_json_holds(name):
    metadata = bandit_metadata(name)
    found, stored = shlex.split(metadata["command"]), metadata["config"]["discovery"]
    config = config_dict(asked_for(*found[2:]))
    assert config["evolution"] == {"averaging": 1, **stored["evolution"]}
    assert config["bandit"] == {"form": "networks", **stored["bandit"]}
    assert config["refinement"] == {
        **config["refinement"],
        "visits": True,
        **stored.get("refinement", {}),
    }
    # What has another name by now, or was not there then, kept its default.
    different = {k for k in config.keys() & stored.keys() if config[k] != stored[k]}
    assert different <= {"warm_start", "refinement", "bandit", "evolution"}
    assert not config["fixed_hyperparameters"]


# Tables "Hyperparameters for meta-training", "Number of generations for each environment" and
# "Hyperparameters for evaluation length curricula" of Liesen et al. (2024): generations, population
# size, rollouts, evaluation seeds, mode, curriculum.
MOUNTAIN_CAR = ("linear", 1000, 200, 200, 600)
BRAX = ("linear", 100, 1000, 200, 1600)
PAPER = {
    "Acrobot-v1": (300, 128, 1, 50, "all", None),
    "CartPole-v1": (300, 128, 1, 50, "all", None),
    "MountainCar-v0": (1000, 128, 1, 50, "all", MOUNTAIN_CAR),
    "MountainCarContinuous-v0": (300, 128, 1, 50, "all", None),
    "Pendulum-v1": (1000, 64, 8, 50, "all", None),
    "inverted_pendulum": (300, 256, 1, 16, "sequential", None),
    "inverted_double_pendulum": (300, 256, 1, 16, "sequential", None),
    "reacher": (30, 256, 1, 16, "sequential", None),
    "pusher": (100, 256, 1, 16, "sequential", None),
    "hopper": (2000, 256, 1, 16, "sequential", BRAX),
    "walker2d": (2000, 256, 1, 16, "sequential", BRAX),
    "swimmer": (2000, 256, 1, 16, "sequential", BRAX),
    "halfcheetah": (2000, 256, 1, 16, "sequential", BRAX),
    "ant": (2000, 256, 1, 16, "sequential", BRAX),
}


@pytest.mark.parametrize("environment", PAPER)
def test_the_preset_paper_is_the_papers_tables(environment):
    config = asked_for("--preset", "paper", "--environment", environment)
    generations, population, rollouts, episodes, mode, curriculum = PAPER[environment]
    evolution = config.evolution
    assert (evolution.num_generations, evolution.population_size) == (generations, population)
    assert (config.agents_per_candidate, config.evaluation_episodes) == (rollouts, episodes)
    assert config.mode == mode
    assert config.curriculum == "paper"
    expected = None if curriculum is None else CurriculumConfig(*curriculum)
    assert paper_curriculum(environment, generations) == expected
    # The rows and tables that are the same for all: SNES from 0.05, 64 agents for the mean, the mean
    # of the returns, 32 tanh units, a normal latent as large as the observation.
    assert (evolution.strategy, evolution.sigma, evolution.combine) == ("SNES", 0.05, "mean")
    assert config.bandit == BanditConfig(32, "tanh", "normal", None)
    assert (config.init, config.start, config.parameterization) == ("random", None, "I")
    assert not config.fixed_hyperparameters and not config.mode_actions
    # All that fit the action space; Brax's and Pendulum's is continuous.
    assert config.algorithms == ()


def test_single_flags_override_the_preset_paper():
    paper = ["--preset", "paper", "--environment", "MountainCar-v0"]
    config = asked_for(*paper, "--generations", 10, "--algorithms", "ppo,DQN", "--mode=sequential")
    assert (config.algorithms, config.mode) == (("ppo", "dqn"), "sequential")
    assert config.evolution.population_size == 128
    # A hundredth of the generations: the transition begins at 2 and takes 6.
    curriculum = BanditDiscovery(config).config.curriculum
    assert curriculum == CurriculumConfig("linear", 1000, 200, 2, 6)
    assert asked_for(*paper, "--curriculum", "none").curriculum is None
    config = asked_for(*paper, "--curriculum", "cosine:50:100:3:4")
    assert config.curriculum == CurriculumConfig("cosine", 50, 100, 3, 4)


def test_the_preset_quick_trains_ppo_alone_unless_all_are_asked_for():
    assert asked_for().algorithms == ("ppo",)
    assert asked_for("--algorithms", "ppo, sac ,ppo").algorithms == ("ppo", "sac", "ppo")
    for words in ("all", " All "):
        assert asked_for("--algorithms", words).algorithms == ()


def test_a_file_gives_the_lists_to_draw_from(tmp_path):
    path = tmp_path / "lists.json"
    path.write_text('{"ppo": {"learning_rate": [0.25, 1]}, "sac": {"polyak": [0.5]}}')
    config = asked_for("--hyperparameters", path)
    assert config.lists == {"ppo": {"learning_rate": (0.25, 1)}, "sac": {"polyak": (0.5,)}}
    drawn = BanditDiscovery(config).specs["ppo"].sample(jax.random.key(0), 2)
    assert sorted(drawn.learning_rate.tolist()) == [0.25, 1.0]
    # The content itself does too, so that a run's command is whole without the file.
    assert asked_for("--hyperparameters", path.read_text()) == config


@pytest.mark.slow
def test_a_synthetic_mdp_is_discovered_and_its_command_asks_for_the_same_again(tmp_path):
    flags = [
        "--parameterization",
        "T",
        "--latent",
        "normal",
        "--max-steps",
        "3",
        "--mode",
        "sequential",
    ]
    flags += ["--algorithms", "ppo,dqn,ppo", "--curriculum", "linear:2:4:0:2", "--mode-actions"]
    flags += ["--fixed-hyperparameters", "--out", tmp_path / "run"]
    result = call(*DISCOVER, *flags, "--judge-agents", "0")
    assert result.code == 0, result.err
    path = tmp_path / "run" / "Synthetic-CartPole-v1.npz"
    mdp, params = make(str(path))
    assert (mdp.config.parameterization, params.max_steps_in_episode) == ("T", 3)
    metadata = json.loads(path.with_suffix(".json").read_text())
    assert (metadata["kind"], metadata["results"]) == ("synthetic_mdp", {})
    # 2 generations of 4 candidates: 2 agents, turns of 16 steps, episodes of at most 2, then 3.
    assert metadata["cost"]["environment_steps_training"] == 2 * 4 * 2 * 16
    assert metadata["cost"]["environment_steps_evaluation"] == 4 * 2 * (2 + 3)
    config = asked_for(*shlex.split(metadata["command"])[2:])
    assert config_dict(config) == metadata["config"]["discovery"]
    assert config.mode_actions and config.fixed_hyperparameters


def test_a_refused_discovery_leaves_no_folder_behind(tmp_path):
    # Else the corrected command would be refused too: the folder would not be empty any more.
    for flag, value in [
        ("environment", "CartPole-v2"),
        ("from-bandit", "nobody"),
        ("seed", "-1"),
        ("algorithms", "dqn"),
        ("expert", "dqn"),
        ("expert-steps", "0"),
        ("judge-agents", "-1"),
        ("curriculum", "linear:1:1000:0:1"),
    ]:
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


def test_a_bandit_is_judged_with_the_physics_that_it_was_found_with(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(judgement, "check_fits", lambda *_: None)
    monkeypatch.setattr(
        judgement.Place,
        "named",
        classmethod(lambda cls, *place: made.append(place) or cls(*place[:1], None, None)),
    )
    bandit = SyntheticBandit(11, spaces.Box(-1.0, 1.0, (3,)))
    metadata = {"config": {"evaluation_environment": "hopper", "backend": "spring"}}
    path = tmp_path / "bandit.npz"
    save_bandit(path, bandit, bandit.init_weights(jax.random.key(0)), metadata)
    places = [(None, None), ("hopper", None), (None, "generalized"), ("walker2d", None)]
    for environment, backend in places:
        judgement.evaluation_place(load_bandit(path), str(path), environment, backend)
    assert made[:2] == [("hopper", "spring")] * 2
    assert made[2:] == [("hopper", "generalized"), ("walker2d", None)]
    assert str(Place("hopper", None, None, "spring")) == "hopper (spring physics)"


def test_agents_that_diverge_count_as_random_actions_and_are_told(bandit_file, monkeypatch):
    def judged(spec, bandit, weights, judge_in, seed, agents, episodes, mode, rows):
        return {"mode_actions": np.array([100.0, np.nan, 300.0])}

    monkeypatch.setattr("scb.commands.judge", judged)
    shown = call("train", "--bandit", bandit_file).out
    random = environment_spec("CartPole-v1").random_return()
    assert f"returns on CartPole-v1: {random:.4g} 100 300" in shown
    assert shown.endswith("(n=3); 1 diverged, counted as random actions\n")


def test_what_is_printed_has_no_markup(capsys):
    console().print("139.4 [no interval] o10[/b]")
    assert capsys.readouterr().out == "139.4 [no interval] o10[/b]\n"


def test_training_keeps_agents_for_other_statistics_and_goes_on(bandit_file, tmp_path):
    run, rows = tmp_path / "run", tmp_path / "run" / "rows.jsonl"
    train = ["train", "--bandit", bandit_file, "--agents", "3", "--episodes", "2"]
    first = call(*train, "--out", run)
    kept = rows.read_text()
    found = [json.loads(line) for line in kept.splitlines()]
    assert first.out == call(*train).out
    assert [row["agent"] for row in found] == [0, 1, 2]
    assert all(1e-5 < row["learning_rate"] < 0.02 for row in found)
    # Killed while the second agent was written.
    rows.write_text(kept[: kept.index("\n") + 40])
    resumed = call("train", "--resume", run)
    assert (resumed.code, resumed.out) == (0, first.out) and rows.read_text() == kept
    assert call("train", "--resume", run, "--agents", "4").code == 2
    assert call(*train, "--algorithm", "td3", "--out", tmp_path / "none").code == 2
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize("algorithm", [pytest.param("sac", marks=pytest.mark.slow), "dqn", "ddqn"])
def test_every_fitting_algorithm_trains_in_a_bandit(bandit_file, algorithm):
    train = ["train", "--bandit", bandit_file, "--agents", "2", "--episodes", "1"]
    result = call(*train, "--algorithm", algorithm)
    assert (result.code, result.err) == (0, "")
    assert result.out.splitlines()[1].endswith("(n=2)")


def test_listing_names_every_bandit_of_the_zoo():
    result = call("list")
    assert (result.code, result.err) == (0, "")
    assert zoo_names()
    # This is no terminal: a name stands in one line, and what reads the pipe finds it.
    cells = [line.strip(" │").split("│") for line in result.out.splitlines() if "│" in line]
    assert [row[0].strip() for row in cells] == list(zoo_names()) and "…" not in result.out
    # Hopper: a fit of 447.9 s and a refinement of 190.5 s: 10.6 minutes.
    (row,) = (row for row in cells if row[0].strip() == "Synthetic-hopper")
    assert [x.strip() for x in row[-2:]] == ["fitted, refined", "11"]


def test_listing_as_json_has_the_command_that_found_a_bandit():
    result = call("list", "--json")
    assert (result.code, result.err) == (0, "")
    listed = {x["name"]: x for x in json.loads(result.out)}
    assert list(listed) == list(zoo_names())
    for name, x in listed.items():
        metadata = bandit_metadata(name)
        assert x["command"] == metadata["command"] and x["results"] == metadata["results"]
        # A command that finds others now says so.
        assert x.get("random_keys") == metadata.get("random_keys")
    assert listed["Synthetic-Acrobot-v1"]["found"] == "fitted"
    assert listed["Synthetic-Acrobot-v1"]["environment"] == "Acrobot-v1"
    # An expert of 7 085 274 steps, refinement of 2 016 747, 320 000 of candidates and 32 000 of judgements, whose
    # agents train in the bandit.
    assert listed["Synthetic-walker2d"]["environment_steps"] == 9_454_021
    assert listed["Synthetic-walker2d"]["bandit_steps"] == 3_200_000 + 320_000


def test_how_a_bandit_was_found():
    config = {"discovery": {"init": "random", "evolution": {"num_generations": 9}}}
    assert listing.found({"config": config, "cost": {}}) == "random weights, evolved"
    warm_start = {"aggregation_rounds": 2}
    evolution = {"num_generations": 3}
    config = {"discovery": {"init": "expert", "warm_start": warm_start, "evolution": evolution}}
    assert listing.found({"config": config, "cost": {"generation": 0}}) == "fitted with aggregation"
    config["discovery"]["refinement"] = {"rounds": 1}
    assert listing.found({"config": config, "cost": {}}) == (
        "fitted with aggregation, refined, evolved"
    )
    # One that goes on from another: the default of its own initialisation says nothing.
    del config["discovery"]["refinement"]
    for before, cost, expected in (
        ("random weights, evolved", {}, "random weights, evolved"),
        ("fitted", {}, "fitted, evolved"),
        ("fitted", {"generation": 0}, "fitted"),
    ):
        config["started_from"] = {"found": before}
        assert listing.found({"config": config, "cost": cost}) == expected


def test_what_the_fit_cost_that_a_bandit_goes_back_to():
    fit = {"expert_return": 7.0}
    first = {"cost": {"warm_start": fit}, "started_from": None}
    second = {"cost": {"seconds": 1.0}, "started_from": first}
    for metadata, expected in (
        ({"cost": first["cost"], "config": {}}, fit),
        ({"cost": {}, "config": {"started_from": second}}, fit),
        ({"cost": {}, "config": {"started_from": None}}, {}),
    ):
        assert listing.warm_start_cost(metadata) == expected


@pytest.mark.slow
def test_the_programs_say_their_version_and_complete_their_words():
    result = call("--version")
    assert (result.code, result.err) == (0, "")
    assert re.fullmatch(r"scb \d+\.\d+\.\d+ \(python .*jax .*\)\n", result.out)
    for program in ("scb", "lpo"):
        found = subprocess.run(
            [sys.executable, "-m", program, "--version"], capture_output=True, text=True, check=True
        )
        assert found.stdout.startswith(f"{program} {import_module(program).__version__} ")
    completion = call("--tyro-print-completion", "bash")
    assert completion.code in (0, None)
    assert "discover" in completion.out and "--population-size" in completion.out


def test_a_reader_that_stops_early_is_no_error(monkeypatch):
    # A file of its own, which the command may point elsewhere.
    with open(os.devnull, "w") as stdout:
        monkeypatch.setattr("sys.stdout", stdout)
        monkeypatch.setattr(
            "scb.listing.list_command", lambda: (_ for _ in ()).throw(BrokenPipeError)
        )
        assert main(["list"]) == 1


@pytest.mark.parametrize("arguments", [["--help"], ["discover", "--help"], ["train", "--help"]])
def test_help_is_shown_for_every_command(arguments):
    result = call(*arguments)
    assert result.code == 0
    assert "scb" in result.out


def test_every_flag_of_a_discovery_is_explained_in_a_group_of_its_own():
    for config in (
        DiscoveryConfig,
        BanditConfig,
        WarmStartConfig,
        EvolutionConfig,
        SharedOutput,
        TrainConfig,
    ):
        explained = "".join(inspect.cleandoc(part.__doc__) for part in config.__mro__)
        for field in fields(config):
            assert f"\n  {field.name}: " in explained
    shown = call("discover", "--help").out
    for group in ("bandit", "warm start", "outer loop", "output", "judgement"):
        assert f"{group} options" in shown
    # The preset's own values are shown as the defaults.
    paper = call("discover", "--preset", "paper", "--environment", "reacher", "--help").out
    assert "(default: 30)" in paper and "(default: 256)" in paper


def test_an_interruption_is_exit_code_130(monkeypatch, bandit_file):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("scb.commands.judge", interrupt)
    result = call("train", "--bandit", bandit_file)
    assert result.code == 130
    assert result.err == "scb: interrupted; a run with --out continues with --resume.\n"
    # What has no --resume does not speak of it.
    monkeypatch.setattr("scb.listing.list_command", interrupt)
    result = call("list")
    assert (result.code, result.err) == (130, "scb: interrupted.\n")


def test_out_of_memory_is_a_sentence(monkeypatch, bandit_file):
    def exhausted(*_, **__):
        raise JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 8 bytes.\nA table.")

    monkeypatch.setattr("scb.commands.judge", exhausted)
    result = call("train", "--bandit", bandit_file)
    assert result.code == 1
    assert result.err == (
        "scb: out of memory (RESOURCE_EXHAUSTED: Out of memory allocating 8 bytes): begin anew with fewer agents, "
        "candidates, episodes or environments.\n"
    )

    def another(*_, **__):
        raise JaxRuntimeError("INTERNAL: a bug")

    monkeypatch.setattr("scb.commands.judge", another)
    with pytest.raises(JaxRuntimeError):
        call("train", "--bandit", bandit_file)


def test_a_path_after_an_equals_sign_may_begin_at_home(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    found = []

    def show(out: str, *, of: str) -> None:
        """Shows."""
        found.extend([out, of])

    assert (
        run_program(
            "show",
            "Shows.",
            lambda: {"show": show, "hide": show},
            ["show", "--out=~/a", "--of=b=~"],
        )
        == 0
    )
    assert found == [str(tmp_path / "a"), "b=~"]
