"""Objectives meet the same drawn hyperparameters, and failures are counted."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lpo
from experiments import robustness as module
from experiments.claims import FAILS, HOLDS, UNDECIDED
from lpo.comparison import ppo_spec
from lpo.objectives import load_objective
from scb.environments.registry import environment_spec
from scb.errors import UserError
from scb.files import packed_row, unpacked_row
from scb.measurement import Agents
from scb.seeds import REPORTING, VALIDATING

KEY = "20 of num_epochs 4"


def entry(environment, learned_on=(), **scores):
    """Returns of 20 draws each that are these scores, give or take a little."""
    spec = environment_spec(environment)
    random, best = spec.random_return(), spec.reference_return()
    little = np.linspace(-0.01, 0.01, 20)
    return {
        "returns": {
            name.replace("_", "-"): {KEY: packed_row(random + (best - random) * (x + little))}
            for name, x in scores.items()
        },
        "failed": {name.replace("_", "-"): {KEY: 0} for name in scores},
        "draws": {KEY: {}},
        "learned_on": {"lpo-pendulum": list(learned_on)},
    }


@pytest.fixture
def report():
    learned = ["Pendulum-v1"]
    scores = {"ppo": np.repeat([0.0, 0.5], 10), "dpo": 0.8, "lpo_pendulum": 0.6}
    return {
        "environments": {
            "Pendulum-v1": entry("Pendulum-v1", learned, **{**scores, "lpo_pendulum": -9.0}),
            "Acrobot-v1": entry("Acrobot-v1", learned, **scores),
        },
        "machine": {"cores": 2, "processor": "a processor"},
        "first_seed": 22000,
        "lists": module._PLAN["lists"],
    }


def test_an_objective_is_judged_where_it_was_not_learned(report):
    judged = {x.claim.text: x.outcome for x in module.EXPERIMENT.judged(report)}
    assert judged == {
        "lpo-pendulum: a higher mean than ppo": HOLDS,
        "lpo-pendulum: a higher worst decile than ppo": HOLDS,
        "lpo-pendulum: a higher mean than dpo": FAILS,
        "lpo-pendulum: a higher worst decile than dpo": FAILS,
    }


def test_failures_are_counted_and_draws_are_compared_in_pairs(report):
    ppo, dpo, learned = module.facts(report)["rows"]
    # Half of PPO's agents are at the level of random actions; of the learned one all of Pendulum's.
    assert ppo["fails"].value == 0.5 and dpo["fails"].value == 0.0 and learned["fails"].value == 0.5
    # Pendulum, which the learned one was learned for, is not among those where it is better.
    assert dpo["improves"].value == 1.0 and learned["improves"].value == 1.0
    assert (dpo["improves"].n, learned["improves"].n) == (40, 20)
    assert learned["in"]["Acrobot-v1"] == pytest.approx(0.6, abs=1e-3)
    page = module.EXPERIMENT.page(report)
    assert "**Shown: lpo-pendulum: a higher mean than ppo; lpo-pendulum: a higher worst" in page
    (figure,) = module.EXPERIMENT.figures(report).values()
    assert len(figure.axes) == 3


def test_settings_are_paired_by_their_seeds_whatever_ended_first():
    words = list(module.settings_of("Pendulum-v1"))
    keys = [f"17 of {x}" for x in words]
    assert len(keys) == 3 and module.in_order("Pendulum-v1", reversed(keys)) == keys


def test_without_ppos_clip_there_is_nothing_to_compare_with(tmp_path):
    options = module.Options(("CartPole-v1",), ("dpo",), draws=2, rows=tmp_path)
    names = [x.names[0][1] for x in module.parts(options, {})]
    assert names == ["ppo", "dpo"] * 3


def test_an_objective_with_fewer_draws_is_left_out_until_it_has_them(report):
    acrobot = report["environments"]["Acrobot-v1"]["returns"]
    acrobot["ppo"]["20 of num_epochs 10"] = acrobot["ppo"][KEY]
    assert list(module.scores(report)["Acrobot-v1"]) == ["ppo"]


def test_without_a_published_expert_the_best_agents_are_the_scale(report):
    games = {"returns": {"ppo": {KEY: packed_row(np.arange(101))}}}
    report["environments"] = {"Asterix-MinAtar": games}
    found = module.scores(report)["Asterix-MinAtar"]["ppo"]
    random = environment_spec("Asterix-MinAtar").random_return()
    assert found.max() == pytest.approx((100 - random) / (95 - random))


def test_where_nothing_was_learned_there_are_no_scores(report):
    random = environment_spec("Asterix-MinAtar").random_return()
    games = {"returns": {"ppo": {KEY: packed_row(np.full(20, random / 2))}}, "learned_on": {}}
    games["failed"] = games["draws"] = {}
    report["environments"]["Asterix-MinAtar"] = games
    assert [*module.scores(report)] == ["Pendulum-v1", "Acrobot-v1"]
    assert "Asterix" not in module.EXPERIMENT.page(report)


def test_few_draws_decide_nothing(report):
    for environment in report["environments"].values():
        for lines in environment["returns"].values():
            lines[KEY] = packed_row(unpacked_row(lines[KEY])[:9])
    judged = module.EXPERIMENT.judged(report)
    assert {x.outcome for x in judged} == {UNDECIDED}
    assert all(x.estimate.low is None for x in judged)


def test_draws_of_another_number_are_not_added(report):
    options = module.Options(draws=17, environments=("Acrobot-v1",))
    next(module.parts(options, report))
    with pytest.raises(UserError, match="measured with draws 17, and 34 is asked for"):
        next(module.parts(replace(options, draws=34), report))
    with pytest.raises(UserError, match="no environments: give at least one"):
        module.Options(environments=())


def test_all_objectives_meet_the_same_draws(tmp_path, monkeypatch):
    asked = []

    def measure(spec, place, agents, objectives, rows):
        asked.append((place.name, [o.name for o in objectives], spec.config.num_epochs, agents))
        numbers = [
            {n: float(getattr(agents.hyperparameters, n)[i]) for n in agents.drawn} for i in (0, 1)
        ]
        return [{"return": r, **drawn} for r, drawn in zip((None, 9.0), numbers, strict=True)]

    monkeypatch.setattr(module, "measure", measure)
    out = tmp_path / "report.json"
    flags = ["--draws", "2", "--environments", "CartPole-v1", "--objectives"]
    module.EXPERIMENT.main([*flags, "ppo", "ppo-drawn", "--out", str(out)])
    module.EXPERIMENT.main([*flags, "ppo", "ppo-drawn", "lpo-multi", "--out", str(out)])
    assert [(name, epochs) for _, name, epochs, _ in asked] == [
        *((name, epochs) for epochs in (4, 10, 10) for name in (["ppo"], [])),
        *((["lpo-multi"], epochs) for epochs in (4, 10, 10)),
    ]
    for first, second in zip(asked[:6:2], asked[6:], strict=True):
        for name in first[-1].drawn:
            np.testing.assert_array_equal(
                *(getattr(x[-1].hyperparameters, name) for x in (first, second))
            )
    found = json.loads(out.read_text())["environments"]["CartPole-v1"]
    assert found["learned_on"]["lpo-multi"] == ["CartPole-v1", "Pendulum-v1"]
    key = "2 of num_epochs 4, num_minibatches 4"
    # What ends in NaN counts as random actions.
    random = environment_spec("CartPole-v1").random_return()
    assert found["returns"]["ppo"][key] == packed_row([random, 9.0])
    assert found["failed"]["ppo"][key] == 1
    assert load_objective("lpo-multi").name in found["returns"]


def test_an_environment_of_another_family_has_the_settings_of_classic_control():
    options = module.Options(environments=("Reacher-misc",), objectives=("ppo",), draws=2)
    parts = list(module.parts(options, {}))
    assert ("returns", "ppo", "2 of num_epochs 10, num_minibatches 25") in parts[-1].names
    assert len(parts) == 3


@pytest.mark.parametrize("objective", [None, pytest.param("dpo", marks=pytest.mark.slow)])
def test_a_part_trains_agents_with_the_draws_that_it_says(tmp_path, objective):
    size = {"total_steps": 64, "num_envs": 2, "num_steps": 8, "num_minibatches": 2}
    small = ppo_spec("CartPole-v1").with_values(**size)
    spec = replace(small, lists={"drift": (0.1, 0.3), "learning_rate": (0.01, 0.001)})
    drawn = Agents.drawn_from(spec, 20_000, 2)
    of = None if objective is None else load_objective(objective)
    found = module._trained("CartPole-v1", "some", "2 of", of, spec, drawn, tmp_path)
    assert {x.split() and len(x.split()) for x in found["draws"]["2 of"].values()} == {2}
    assert set(found["draws"]["2 of"]) == {"drift", "learning_rate"}
    assert len(found["returns"]["some"]["2 of"].split()) == 2


def test_validation_is_on_other_seeds_and_in_a_report_of_its_own(report, tmp_path, capsys):
    report |= {"experiment": "robustness", "first_seed": module.FIRST_SEED}
    out = tmp_path / "report.json"
    out.write_text(json.dumps(report))
    assert module.EXPERIMENT.main(["--validation", "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert f"measured with first_seed {module.FIRST_SEED}, and" in error
    assert module.FIRST_SEED in REPORTING and module.FIRST_TO_CHOOSE in VALIDATING
    assert json.loads(out.read_text()) == report


def test_two_objectives_of_one_name_are_refused(tmp_path, capsys):
    for suffix in (".npz", ".json"):
        shipped = Path(lpo.__file__).parent / "zoo/lpo-multi"
        shutil.copy(shipped.with_suffix(suffix), tmp_path)
    flags = ["--objectives", "lpo-multi", str(tmp_path / "lpo-multi.npz")]
    assert module.EXPERIMENT.main([*flags, "--out", str(tmp_path / "report.json")]) == 2
    assert "objective 'lpo-multi' is there twice" in capsys.readouterr().err


@pytest.fixture
def stated(monkeypatch):
    of_it = {
        "objective": "lpo-pendulum",
        "environments": ["CartPole-v1", "Acrobot-v1"],
        "draws": 20,
        "more_than": ["ppo", "dpo"],
        "objective_sha256": load_objective("lpo-pendulum").metadata["sha256"],
        "suggested": {x: {"value": 0.1, "low": 0.0, "high": 0.2} for x in ("ppo", "dpo")},
    }
    monkeypatch.setattr(module, "STATED", of_it)
    monkeypatch.setitem(module._PLAN["settings"], "classic", [{"num_epochs": 4}])
    return of_it


def test_what_was_stated_is_decided_when_all_of_its_agents_are_there(report, stated):
    assert module.confirmed(report) == [] and module.facts(report)["stated"] is None
    scored = {"ppo": 0.1, "dpo": 0.4, "lpo_pendulum": 0.3}
    entries = {name: entry(name, **scored) for name in stated["environments"]}
    later = entries["Acrobot-v1"]["returns"].pop("dpo")
    report["confirmation"] = {"environments": entries, "first_seed": 7}
    assert module.confirmed(report) == []
    assert "stated first" not in module.EXPERIMENT.page(report)
    entries["Acrobot-v1"]["returns"]["dpo"] = later
    assert [x.outcome for x in module.confirmed(report)] == [HOLDS, FAILS]
    page = module.EXPERIMENT.page(report)
    assert (
        "lpo-pendulum has a higher mean than ppo, which was stated first, and confirmed by 20 "
        in page
    )
    assert (
        "draws in each of 2 tasks. That lpo-pendulum has a higher mean than dpo was stated" in page
    )
    assert "too, and does not hold. " in page and "seeds from 7 on" in page
    assert "no lead is shown" not in page.split("\n\n")[1]
    # The claims of the first report are judged without it.
    assert len(module.claims(report)) == 4


def test_a_confirmation_is_of_what_was_stated_and_stands_apart_in_the_report(stated, tmp_path):
    report, options = {}, module.Options(confirmation=True, rows=tmp_path)
    parts = list(module.parts(options, report))
    assert [x.path[:3] for x in parts[::3]] == [
        ("confirmation", "environments", name) for name in stated["environments"]
    ]
    assert [x.names[0][1] for x in parts] == ["ppo", "dpo", "lpo-pendulum"] * 2
    assert report == {"confirmation": report["confirmation"]}
    assert report["confirmation"]["first_seed"] == module.FIRST_TO_CONFIRM
    assert module.FIRST_TO_CONFIRM in REPORTING
    with pytest.raises(UserError, match="either choose or confirm"):
        module.Options(confirmation=True, validation=True)
    with pytest.raises(UserError, match="draws is 18, and what is confirmed was stated before"):
        module.Options(confirmation=True, draws=18)
    stated["objective_sha256"] = "of another"
    with pytest.raises(UserError, match="lpo-pendulum is not the objective that was stated"):
        next(module.parts(options, {}))


def test_a_lead_of_one_task_alone_is_said_to_be_that(report, stated):
    entries = {
        "CartPole-v1": entry("CartPole-v1", ppo=0.1, dpo=0.1, lpo_pendulum=0.9),
        "Acrobot-v1": entry("Acrobot-v1", ppo=0.1, dpo=0.1, lpo_pendulum=0.1),
    }
    report["confirmation"] = {"environments": entries, "first_seed": 7}
    tasks = module.facts(report)["stated"]["tasks"]["ppo"]
    assert {k: round(x.value, 2) for k, x in tasks["in it"].items()} == {
        "CartPole-v1": 0.8,
        "Acrobot-v1": 0.0,
    }
    assert tasks["in the others"]["Acrobot-v1"] == tasks["in it"]["CartPole-v1"]
    assert "Without CartPole-v1 no lead is shown: +0.000" in module.EXPERIMENT.page(report)
