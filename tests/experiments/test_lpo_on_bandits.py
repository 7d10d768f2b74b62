"""What the page and the figure of learned policy optimisation are made from."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments import lpo_on_bandits as module
from experiments import lpo_on_bandits_page as page_of_it
from experiments.rendering import text
from experiments.searches import meta_training
from lpo.comparison import Comparison, LearningCurves
from lpo.objectives import load_objective
from scb.errors import UserError


def line(generation, **more):
    return {
        "generation": generation,
        "steps/training": 100 * (generation + 1),
        "steps/evaluation": 20 * (generation + 1),
        "steps/total": 120 * (generation + 1),
        **more,
    }


METRICS = [
    line(0, **{"mean/fitness_iqm": -900.0}),
    line(1),
    line(2, **{"mean/fitness_iqm": -500.0}),
    line(3, **{"final_mean/fitness_iqm": -300.0}),
]


GPU = {"cores": 16, "processor": "a processor", "accelerator": "NVIDIA H100 80GB HBM3"}


def test_a_searchs_curve_is_its_judged_means_and_the_time_of_what_judged_nothing():
    curve = module.search_curve(METRICS, [50.0, 2.0, 9.0, 4.0])
    assert curve["generations"] == [0, 2, 4]
    assert curve["returns"] == [-900.0, -500.0, -300.0]
    assert curve["steps_per_generation"] == {"training": 100, "evaluation": 20, "total": 120}
    # Generation 1; the first compiles, and the others judge.
    assert curve["seconds_per_generation"] == 2.0


@pytest.fixture
def report():
    curve = module.search_curve(METRICS, [50.0, 2.0, 9.0, 4.0])
    searches = {
        source: {
            "settings": {
                "environment": environment,
                "generations": 4,
                "population_size": 2,
                "agents_per_candidate": 1,
            },
            "curves": [curve | ran] * number,
            "steps_to_judge": 1000,
        }
        for source, environment, number, ran in (
            ("bandit", "Synthetic-Pendulum-v1", 5, {}),
            ("environment", "Pendulum-v1", 1, {"machines": [GPU]}),
        )
    }
    finals = {
        "ppo": [[-900.0, -800.0]],
        "dpo": [[-300.0, -200.0]],
        "LPO (bandit)": [[-200.0 + x - 50.0, -200.0 + x + 50.0] for x in (0, -10, 10, -5, 5)],
        "LPO (environment)": [[-350.0, -250.0]],
    }
    table = {"protocol": "Two agents.", "seeds": [1, 2], "finals": finals, "areas": finals}
    return {
        "preset": "quick",
        "machine": {"cores": 2, "processor": "a processor", "accelerator": "none"},
        "versions": {"jax": "0.0"},
        "timing": {
            "population_size": 4,
            "machine": {"cores": 2, "processor": "a processor", "accelerator": "none"},
            "bandit": {"seconds_per_generation": 3.0, "steps_per_candidate": 60},
            "environment": {"seconds_per_generation": 60.0, "steps_per_candidate": 60},
            "ratios": {"seconds_per_generation": 20.0},
        },
        "searches": searches,
        "evaluations": {
            "Pendulum, Flax's initialisation": {
                **table,
                "tuned": "ppo-0.5",
                "sweep": {"ppo": -900.0, "ppo-0.5": -400.0},
            },
        },
    }


def test_the_page_says_costs_returns_and_differences(report):
    page = module.EXPERIMENT.page(report)
    # Half as many steps as were timed.
    bandit = (
        "| Synthetic-Pendulum-v1 | 5 | 4 | 2 x 1 | 100 + 20 | 2.0 on 2 cores | 1.5 | 480 | 1,000 |"
    )
    environment = "| Pendulum-v1 | 1 | 4 | 2 x 1 | 100 + 20 | 2.0 on H100 | 30.0 | 480 | 1,000 |"
    assert bandit in page and environment in page
    # No fewer steps here; 48 minutes over 4 generations of 28.5 seconds less.
    assert "paid for itself: never by steps of both, 26 by minutes; " in page
    # (-850 of PPO, -200 of the pooled bandit's objectives.)
    assert "| ppo | −850 [" in page
    assert "| LPO (bandit) | −200 [" in page
    assert "| ppo | +650 [" in page and "| LPO (environment) | +100 | " in page
    assert "The tuned clip is ppo-0.5: on other agents ppo −900, ppo-0.5 −400." in page
    (figure,) = module.EXPERIMENT.figures(report).values()
    assert len(figure.axes) == 3 + 2
    assert "| LPO (bandit), `lpo-pendulum` | " in page


def test_the_page_on_pendulum_has_the_differences_of_the_committed_report():
    docs = Path(module.__file__).parents[1] / "docs"
    tables = page_of_it.facts(json.loads((docs / "data/lpo_on_bandits.json").read_text()))["tables"]
    flax, small = (tables[f"Pendulum, {label}"]["against"] for label in module.SCALES)
    page = (docs / "pendulum.md").read_text()
    for name, (final, area) in small.items():
        shown = (final, area, flax[next(x for x in flax if _kind(x) == _kind(name))][0])
        assert f"| {' | '.join(text(x, 0, True) for x in shown)} |" in page


def _kind(name):
    """Of an objective; the best clip is another one with either initialisation."""
    return "tuned" if name.startswith("ppo-") else name


def test_one_search_decides_nothing_and_searches_of_other_sizes_are_not_compared(report):
    def outcomes():
        return {x.claim.text: x.outcome for x in module.EXPERIMENT.judged(report)}

    place = "Pendulum, Flax's initialisation"
    found = outcomes()
    assert found[f"{place}: LPO (bandit) ends higher than PPO"] == "holds"
    # 550 higher, by one search.
    assert found[f"{place}: LPO (environment) ends higher than PPO"] == "undecided"
    like = f"{place}: LPO (bandit) ends no lower than LPO (environment), after searches of one size"
    assert found[like] == "undecided"
    for table in report["evaluations"].values():
        table["finals"]["LPO (environment)"] *= 5
    assert outcomes()[like] == "holds"
    report["searches"]["bandit"]["settings"] |= {"population_size": 4}
    assert outcomes()[like] == "not tested at this size"


@pytest.fixture
def tiny(monkeypatch):
    """A preset of a search on either, and what was searched and judged; neither takes time."""
    asked, kept = [], []
    worth = {"ppo": -9.0, "ppo-0.5": -3.0}  # the best clip

    def objective_of_run(config, folder):
        asked.append(folder.name)
        folder.mkdir(parents=True)
        (folder / "metrics.jsonl").write_text("\n".join(json.dumps(x) for x in METRICS))
        timing = [json.dumps({"generation": i, "seconds": 2.0}) for i in range(len(METRICS))]
        (folder / "timing.jsonl").write_text("\n".join(timing))
        return replace(
            load_objective("dpo"), metadata={"cost": {"environment_steps_judgements_training": 7}}
        )

    def compare(environment, objectives, seeds, spec, rows, points=15):
        kept.append(rows.path)
        scale = spec.hyperparameters.policy_output_scale
        asked.append((environment, scale, *(o.name for o in objectives)))
        return Comparison(
            [
                LearningCurves(
                    environment,
                    None,
                    o.name,
                    np.array([0, 100]),
                    np.array([[-9.0, worth.get(o.name, -14.0) - i] for i in range(len(seeds))]),
                    list(seeds),
                    1,
                    True,
                )
                for o in objectives
            ]
        )

    def timing(options, found, save):
        asked.append(options.population_size)
        found["timed"] = True

    monkeypatch.setattr(module.meta_training_cost, "measure", timing)
    monkeypatch.setattr(module, "objective_of_run", objective_of_run)
    monkeypatch.setattr(module, "compare", compare)
    plan = {
        "searches": {
            source: {"seeds": 1, "settings": {"of": source}} for source in page_of_it.SOURCES
        },
        "timing": {"population_size": 3},
        "agents": 2,
        "tuning_agents": 2,
    }
    return plan, asked, kept


def test_what_a_report_has_is_not_measured_again(tiny, tmp_path):
    plan, asked, kept = tiny
    plan["runs"], report = str(tmp_path / "runs"), {"preset": "tiny"}
    module.measure(plan, report, lambda: None)
    both = ("LPO (bandit) 0", "LPO (environment) 0")
    compared = ("ppo", "ppo-0.5", "dpo", *both)
    judged = [("Pendulum-v1", scale, *x) for scale in (1.0, 0.01) for x in (module.CLIPS, compared)]
    assert asked == [3, "bandit-0", "environment-0", *judged]  # timed before anything runs
    assert {entry["steps_to_judge"] for entry in report["searches"].values()} == {7}
    table = report["evaluations"]["Pendulum, small last layer"]
    assert table["finals"]["ppo-0.5"] == [[-3.0, -4.0]]
    assert table["finals"]["LPO (bandit)"] == [[-14.0, -15.0]]
    # Every table keeps its agents in a file of its own: two of them train under one name with other settings.
    assert len(set(kept)) == len(kept) == 4 and {path.parent for path in kept} == {
        tmp_path / "runs" / "tiny"
    }

    asked.clear()
    module.measure(plan, report, lambda: None)
    assert asked == []

    plan["searches"]["environment"]["seeds"] = 2
    module.measure(plan, report, lambda: None)
    second = "LPO (environment) 1"
    assert asked == ["environment-1", *(("Pendulum-v1", scale, second) for scale in (1.0, 0.01))]
    finals = report["evaluations"]["Pendulum, small last layer"]["finals"]
    assert finals["LPO (environment)"] == [[-14.0, -15.0]] * 2
    assert list(finals) == ["ppo", "ppo-0.5", "dpo", "LPO (bandit)", "LPO (environment)"]
    assert [len(x["curves"]) for x in report["searches"].values()] == [1, 2]


def test_a_report_of_other_searches_is_refused(tiny, tmp_path):
    plan, *_ = tiny
    plan["runs"], report = str(tmp_path / "runs"), {"preset": "tiny"}
    module.measure(plan, report, lambda: None)
    plan["searches"]["bandit"]["settings"] = {"of": "something else"}
    with pytest.raises(UserError, match="what was measured with settings"):
        module.measure(plan, report, lambda: None)


def test_the_settings_of_every_preset_are_those_of_the_command():
    for preset in module.EXPERIMENT.presets.values():
        for search in preset["searches"].values():
            config = meta_training(search["settings"]).config
            assert config.validation
            assert config.evolution.num_generations == search["settings"]["generations"]
