"""`lpo run` from nothing to its report, at the smallest size that has every part."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lpo import cli, pipeline
from lpo.comparison import Comparison, LearningCurves
from lpo.objectives import load_objective
from lpo.pipeline import Evaluation, RunAll
from scb.agents.ppo import PPOConfig, PPOHyperparameters
from scb.agents.spec import AgentSpec
from scb.rows import pivot
from tests.recording import recorded_seeds


@pytest.fixture(scope="module", autouse=True)
def small(tiny_agent, tiny_drift):
    """A preset "tiny" with smaller networks, fewer contexts and steps than any preset has."""
    quick = RunAll.presets["quick"]({})
    evolution = replace(
        quick.search.evolution, population_size=2, num_generations=2, mean_evaluations=2
    )
    search = replace(
        quick.search,
        agent=tiny_agent,
        drift=tiny_drift,
        fitness="transfer",
        agents_per_candidate=1,
        evaluation_episodes=2,
        evolution=evolution,
    )

    def spec(algorithm, environment):
        agent = PPOConfig(
            num_envs=2,
            num_steps=8,
            num_epochs=2,
            num_minibatches=1,
            total_steps=32,
            hidden_sizes=(4,),
        )
        return AgentSpec(algorithm, agent, PPOHyperparameters())

    evaluations = (Evaluation("Pendulum-v1", None, seeds=2, steps=32),)
    config = replace(quick, search=search, evaluations=evaluations)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RunAll, "presets", {"tiny": lambda given: config})
        patch.setattr("lpo.comparison.environment_agent", spec)
        yield


@pytest.fixture(scope="module")
def folder(small, tmp_path_factory) -> Path:
    """A finished run. Tests may resume it, and leave it as it was but for clocks."""
    out = tmp_path_factory.mktemp("runs") / "tiny"
    with recorded_seeds() as seeds:
        assert cli.main(["run", "--preset", "tiny", "--seed", "3", "--out", str(out)]) == 0
    # Constants, the search, the judges of its end, and those of the report.
    assert seeds == {0, 3, 30_000, 13_000, 13_001}
    return out


def contents(folder: Path) -> dict[str, tuple[bytes, int]]:
    """{file: (its bytes, when it was written)}."""
    # But for the lock, which is each process's own.
    files = (x for x in sorted(folder.rglob("*")) if x.is_file() and x.name != ".lock")
    return {str(p.relative_to(folder)): (p.read_bytes(), p.stat().st_mtime_ns) for p in files}


def results(folder: Path) -> dict:
    return json.loads((folder / "results.json").read_text())


ROWS = ["rows.jsonl", "rows.json"]
LAST_STAGE = [
    "figures/Pendulum-v1.png",
    "figures/drift_and_gradient.png",
    "figures/environment_steps.png",
    "figures/meta_training.png",
    "report.html",
    "results.json",
]


def test_a_run_leaves_what_each_stage_made(folder):
    made = {
        name for name in contents(folder) if not name.startswith(("checkpoints", "tensorboard"))
    }
    evolution = ["config.json", "metrics.jsonl", "timing.jsonl", "lpo.json", "lpo.npz"]
    assert made == {*evolution, *ROWS, *LAST_STAGE}


def test_results_are_the_stored_rows(folder):
    comparison = results(folder)["comparisons"]["Pendulum-v1"]
    stored = comparison["curves"]
    rows = [json.loads(line) for line in (folder / "rows.jsonl").read_text().splitlines()]
    assert pivot(rows, "objective", "seed", "step").tolist() == [c["returns"] for c in stored]
    assert [curve["objective"] for curve in stored] == ["ppo", "dpo", "lpo"]
    assert comparison["reference"] == "ppo"
    for curve in stored:
        # Preset tiny judges two seeds, from 10 000 + 1000 x seed on; 2 batches of 2 x 8 steps, each
        # evaluated.
        assert curve["seeds"] == [13_000, 13_001]
        assert curve["steps"] == [0, 16, 32]
        # Of two seeds the interquartile mean drops none.
        assert curve["final_iqm"]["value"] == pytest.approx(np.mean(curve["returns"], axis=0)[-1])
    ppo, _, lpo = (curve["final_iqm"]["value"] for curve in stored)
    difference = comparison["paired_differences"]["lpo"]
    assert difference["value"] == pytest.approx(lpo - ppo)
    assert difference["n"] == 2


def test_results_count_the_steps_of_the_meta_training(folder):
    meta = results(folder)["meta_training"]
    # 2 generations of 2 candidates, of one agent each: 3 batches of 8 contexts, then 2 episodes of
    # 200 steps.
    assert meta["steps"] == {"training": 96, "evaluation": 1600, "total": 1696}
    # The same on Pendulum trains each agent for its 150 000 steps.
    assert meta["environment_steps"]["training"] == 600_000
    assert meta["environment_steps"]["evaluation"] == 1600
    assert (meta["environment"], meta["fitness"]) == ("Synthetic-Pendulum-v1", "transfer")
    assert meta["generations"] == 2


def test_the_learned_objective_is_stored_with_its_certificate(folder):
    objective = load_objective(folder / "lpo.npz")
    stored = results(folder)["objective"]
    assert stored == {"name": "lpo", "certificate": objective.metadata["certificate"]}
    assert stored["certificate"]["holds"] is True
    assert objective.metadata["cost"]["environment_steps_training"] == 96
    # The mean before the first generation and after the last is judged.
    judged = objective.metadata["results"]["mean_fitness"]
    assert [line["generation"] for line in judged] == [0, 2]


def test_the_report_shows_every_figure_in_its_place(folder):
    page = (folder / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 4


def test_the_command_of_a_run_starts_it_afresh(folder):
    command = "lpo run --preset=tiny --seed=3"
    assert results(folder)["command"] == command
    assert load_objective(folder / "lpo.npz").metadata["command"] == command
    assert command in (folder / "report.html").read_text()


def test_resuming_redoes_the_missing_stage_and_no_other(folder, monkeypatch):
    before, results_before = contents(folder), results(folder)
    for name in LAST_STAGE:
        (folder / name).unlink()

    def refuse(*arguments, **named):
        raise AssertionError("this stage was done already")

    monkeypatch.setattr("lpo.meta_training.evolve", refuse)
    monkeypatch.setattr("scb.measurement._program_of", refuse)
    assert cli.main(["run", "--resume", str(folder)]) == 0

    after = contents(folder)
    assert after.keys() == before.keys()
    for name in after.keys() - set(LAST_STAGE):
        assert after[name] == before[name], name
    for name in LAST_STAGE:
        if name.endswith(".png"):
            assert after[name][0] == before[name][0], name
    clocked = {"seconds": None}
    assert results(folder) | clocked == results_before | clocked


def test_resuming_trains_the_missing_agents_to_the_same_bytes(folder):
    before = contents(folder)
    rows = before["rows.jsonl"][0]
    (folder / "rows.jsonl").write_bytes(rows[: len(rows) // 2])
    assert cli.main(["run", "--resume", str(folder)]) == 0
    after = contents(folder)
    assert after["rows.jsonl"][0] == rows
    for name in ("lpo.npz", "lpo.json", "metrics.jsonl"):
        assert after[name] == before[name], name


@pytest.mark.slow
def test_a_half_saved_objective_is_saved_again(folder, monkeypatch):
    # The .json is written last: without it, the evolution's checkpoint gives the same weights.
    before = contents(folder)
    (folder / "lpo.json").unlink()
    assert cli.main(["run", "--resume", str(folder)]) == 0
    after = contents(folder)
    for name in ("lpo.npz", "lpo.json", "metrics.jsonl"):
        assert after[name][0] == before[name][0], name


def test_a_given_objective_is_judged_and_not_learned(tmp_path, objective_file, monkeypatch):
    def refuse(*arguments, **named):
        raise AssertionError("there is nothing to learn")

    monkeypatch.setattr("lpo.meta_training.evolve", refuse)
    monkeypatch.setattr(pipeline, "compare", fake_comparison)
    out = tmp_path / "run"
    arguments = ["--preset", "tiny", "--objective", str(objective_file), "--out", str(out)]
    assert cli.main(["run", *arguments]) == 0
    found = results(out)
    assert found["objective"]["name"] == "tiny"
    assert found["meta_training"] == {}
    assert found["comparisons"]["Pendulum-v1"]["paired_differences"].keys() == {"dpo", "tiny"}
    assert found["command"] == f"lpo run --preset=tiny --objective={objective_file}"
    assert not (out / "figures" / "meta_training.png").exists()


def fake_comparison(environment, objectives, seeds, *_, **named):
    returns = np.tile([-1500.0, -900.0, -200.0], (len(seeds), 1))
    steps = np.array([0, 16, 32])
    return Comparison(
        [
            LearningCurves(environment, None, o.name, steps, returns, list(seeds), 20, True)
            for o in objectives
        ]
    )


@pytest.mark.parametrize("preset", RunAll.presets.values(), ids=RunAll.presets)
def test_seeds_that_judge_are_not_those_that_learn(preset):
    # Learning takes the seed itself; and runs of neighbouring seeds are judged by different agents.
    for evaluation in preset({}).evaluations:
        first = pipeline.reporting_seeds(0, evaluation.seeds)
        second = pipeline.reporting_seeds(1, evaluation.seeds)
        assert min(first) == 10_000
        assert not set(first) & set(second)
