"""Each objective's learning rate is chosen by agents that are not reported, and compared by those that are."""

import json

import numpy as np
import pytest

from experiments import claims
from experiments import learning_rates as module
from lpo.comparison import Comparison, LearningCurves
from scb.environments.registry import environment_spec
from scb.files import packed_row
from scb.seeds import REPORTING, VALIDATING

RATES = (0.0003, 0.003, 0.01)


def packed_scores(environment, scores, number, seed):
    """{objective: {rate: returns}} of agents whose mean scores are these, scattered alike for all objectives."""
    spec = environment_spec(environment)
    random, best = spec.random_return(), spec.reference_return()
    scatter = np.random.default_rng(seed).normal(scale=0.3, size=number)
    scatter -= scatter.mean()
    own = np.random.default_rng(seed + 1).normal(scale=0.01, size=(len(scores), number))
    own -= own.mean(axis=1, keepdims=True)
    return {
        name: {
            str(rate): packed_row(random + (best - random) * (x + scatter + little))
            for rate, x in zip(RATES, of_it, strict=True)
        }
        for (name, of_it), little in zip(scores.items(), own, strict=True)
    }


def entry(environment, choosing, reported, number=20):
    return {
        "own": 0.003,
        "steps": 1000,
        "learned_on": {"lpo-pendulum": ["Pendulum-v1"]},
        "failed": {"ppo": {"0.01": 1}},
        module.CHOOSING: packed_scores(environment, choosing, 10, 1),
        module.REPORTED: packed_scores(environment, reported, number, 2),
    }


CHOOSING = {"ppo": (0.1, 0.5, 0.2), "dpo": (0.1, 0.2, 0.6), "lpo-pendulum": (0.1, 0.2, 0.9)}
REPORTED = {"ppo": (0.3, 0.4, 0.9), "dpo": (0.3, 0.5, 0.5), "lpo-pendulum": (0.2, 0.8, 0.8)}


@pytest.fixture
def report():
    at_home = {"lpo-pendulum": (0.0, 0.0, 0.2)}
    slow = {"ppo": (0.9, 0.5, 0.2)}
    return {
        "agents": 20,
        "choosing": 10,
        "rates": list(RATES),
        "environments": {
            "Pendulum-v1": entry("Pendulum-v1", CHOOSING | slow, REPORTED | at_home),
            "Acrobot-v1": entry("Acrobot-v1", CHOOSING, REPORTED),
            "MountainCar-v0": entry("MountainCar-v0", CHOOSING, REPORTED),
        },
        "machine": {"cores": 2, "processor": "a processor"},
    }


def judged(report):
    return {
        x.claim.text: (x.outcome, x.estimate and round(x.estimate.value, 2))
        for x in claims.judge(module.claims(report))
    }


def test_others_choose_the_rate_of_an_environment_than_those_that_are_reported(report):
    chosen = module.chosen(report)
    assert [chosen[place]["ppo"] for place in chosen] == [[0.0003], [0.003], [0.003]]
    assert all(chosen[place]["dpo"] == [0.01] for place in chosen)
    (row, *_) = module.facts(report)["rows"]
    # Of the reported agents the largest rate is better, which nobody may know.
    assert [round(x, 1) for x in row["in"].values()] == [0.3, 0.4, 0.4]
    # Of equal rates the smallest.
    ppo = report["environments"]["Acrobot-v1"][module.CHOOSING]["ppo"]
    ppo["0.01"] = ppo["0.0003"] = ppo["0.003"]
    assert module.chosen(report)["Acrobot-v1"]["ppo"] == [0.0003]


def test_objectives_are_compared_where_they_were_not_learned_at_the_same_rates_and_at_the_chosen(
    report,
):
    best = "each at the rate chosen for it"
    assert judged(report) == {
        "dpo earns more than ppo, at rates of 0.003 and more, over 3 environments": (
            claims.FAILS,
            -0.15,
        ),
        "dpo earns more than ppo, at rates of 0.0003 and less, over 3 environments": (
            claims.UNDECIDED,
            0.0,
        ),
        f"dpo earns more than ppo, {best}, over 3 environments": (claims.HOLDS, 0.13),
        "lpo-pendulum earns more than ppo, at rates of 0.003 and more, over 2 environments": (
            claims.HOLDS,
            0.15,
        ),
        "lpo-pendulum earns more than ppo, at rates of 0.0003 and less, over 2 environments": (
            claims.FAILS,
            -0.1,
        ),
        f"lpo-pendulum earns more than ppo, {best}, over 2 environments": (claims.HOLDS, 0.4),
        f"lpo-pendulum earns more than ppo, {best}, on Pendulum-v1": (claims.FAILS, -0.1),
        f"lpo-pendulum earns more than dpo, {best}, over 2 environments": (claims.HOLDS, 0.3),
        f"lpo-pendulum earns more than dpo, {best}, on Pendulum-v1": (claims.FAILS, -0.3),
    }
    page = module.EXPERIMENT.page(report)
    assert (
        "**Shown to earn more than PPO's clip at rates of 0.003 and more: lpo-pendulum; at rates of 0.0003 and less: "
        f"none; {best}: dpo, lpo-pendulum. Shown to earn less at rates of 0.003 and more: dpo; at rates of 0.0003 and "
        f"less: lpo-pendulum; {best}: lpo-pendulum on Pendulum-v1.** PPO has"
    ) in page
    assert "| dpo |  | 0.01: 0.50 | 0.01: 0.50 | 0.01: 0.50 | 0.50 [" in page
    assert "3 agents of all ended in NaN" in page
    figure = module.EXPERIMENT.figures(report)["learning_rates"]
    assert len([axes for axes in figure.axes if axes.axison]) == 4


def test_what_is_decided_over_several_is_told_without_each_of_them(report):
    best = "each at the rate chosen for it"
    found = {
        (x.claim.of.name, x.claim.of.other, x.claim.of.words): {
            place: round(e.value, 2) for place, e in without.items()
        }
        for x, without in module.facts(report)["without_one"]
    }
    # Neither what is undecided nor what is of one environment.
    assert ("dpo", "ppo", "at rates of 0.0003 and less") not in found
    assert found["dpo", "ppo", best] == {
        "Pendulum-v1": 0.1,
        "Acrobot-v1": 0.15,
        "MountainCar-v0": 0.15,
    }
    # Not where it was learned.
    assert found["lpo-pendulum", "ppo", best] == {"Acrobot-v1": 0.4, "MountainCar-v0": 0.4}
    page = module.EXPERIMENT.page(report)
    assert "| dpo minus ppo, each at the rate chosen for it | +0.10 [" in page
    assert "not shown without one of them" not in page
    # All of its lead is of one environment now.
    for place in ("Acrobot-v1", "MountainCar-v0"):
        reported = report["environments"][place][module.REPORTED]
        reported["ppo"]["0.003"] = reported["dpo"]["0.01"]
    assert f"not shown without one of them: dpo over ppo, {best}, without Pendulum-v1." in page_of(
        report
    )


def page_of(report):
    return module.EXPERIMENT.page(report)


def test_a_rate_at_an_end_of_those_that_were_tried_is_told(report):
    assert module.at_the_ends(report) == {
        ("Pendulum-v1", 0.0003): ["ppo"],
        **{(place, 0.01): ["dpo", "lpo-pendulum"] for place in report["environments"]},
    }
    assert "0.01 on Acrobot-v1 by dpo and lpo-pendulum" in page_of(report)
    for role in (module.CHOOSING, module.REPORTED):
        for place in report["environments"].values():
            for of_it in place[role].values():
                of_it |= dict.fromkeys(("1e-05", "0.1"), of_it["0.0003"])
            place[role]["ppo"] |= dict.fromkeys(("1e-05", "0.1"), place[role]["dpo"]["0.0003"])
    report["beyond"] = [1e-05, 0.1]
    assert module.at_the_ends(report) == {}
    assert "No choice is at an end of the rates that were tried." in page_of(report)


def test_rates_beyond_the_others_may_be_chosen_and_are_in_no_other_claim(report):
    before = judged(report)
    best = "dpo earns more than ppo, each at the rate chosen for it, over 3 environments"
    for place in report["environments"].values():
        for role in (module.CHOOSING, module.REPORTED):
            for name, of_it in place[role].items():
                # Where it is not best at 0.0003 the clip is best at the smallest of all.
                at = {"ppo": "0.01", "dpo": "0.0003", "lpo-pendulum": "0.0003"}[name]
                of_it["1e-05"] = of_it[at]
            place[role]["ppo"]["1e-05"] = place[role]["lpo-pendulum"]["0.003"]
        place[module.CHOOSING]["ppo"]["1e-05"] = place[module.CHOOSING]["lpo-pendulum"]["0.01"]
    report["beyond"] = [1e-05]
    assert module.chosen(report)["Acrobot-v1"] == {
        "ppo": [1e-05],
        "dpo": [0.01],
        "lpo-pendulum": [0.01],
    }
    after = judged(report)
    assert before[best][0] == claims.HOLDS and after[best] == (claims.FAILS, -0.13)
    at_rates = {text: x for text, x in before.items() if " at rates of " in text}
    assert len(at_rates) == 4 and at_rates.items() <= after.items()
    page = page_of(report)
    assert "0.00001: 0." in page and "0.00001 on Acrobot-v1 by ppo" in page
    assert (
        "| rates | 0.0003, 0.003, 0.01; to choose from and in nothing else 0.00001, added" in page
    )
    assert "`python -m experiments learning_rates --beyond 0.00001`" in page


def test_an_objective_that_an_environment_lacks_is_drawn_and_named_where_it_is(report):
    for role in (module.CHOOSING, module.REPORTED):
        for name in ("dpo", "lpo-pendulum"):
            del report["environments"]["Acrobot-v1"][role][name]
    found = judged(report)
    assert (
        "lpo-pendulum earns more than ppo, at rates of 0.003 and more, over 1 environment" in found
    )
    (row,) = [x for x in module.EXPERIMENT.page(report).splitlines() if x.startswith("| dpo | ")]
    assert row.endswith("0.01: 0.50 |  | 0.01: 0.50 |  |")
    (legend,) = module.EXPERIMENT.figures(report)["learning_rates"].legends
    assert [text.get_text() for text in legend.get_texts()] == ["ppo", "dpo", "lpo-pendulum"]


def test_rates_that_an_objective_lacks_yet_are_compared_for_none(report):
    for role in (module.CHOOSING, module.REPORTED):
        del report["environments"]["Acrobot-v1"][role]["dpo"]["0.0003"]
    small = "lpo-pendulum earns more than ppo, at rates of 0.0003 and less, over 2 environments"
    assert judged(report)[small] == (claims.UNTESTED, None)
    assert "| not tested at this size |" in module.EXPERIMENT.page(report)


def test_where_an_objective_was_learned_its_lead_is_told_at_each_rate_that_ppo_has(report):
    found = module.at_home(report)
    # Of no formula, and nowhere else.
    assert list(found) == [("lpo-pendulum", "Pendulum-v1")]
    leads = {rate: x.value for rate, x in found["lpo-pendulum", "Pendulum-v1"].items()}
    assert leads == pytest.approx({0.0003: -0.3, 0.003: -0.4, 0.01: -0.7}, abs=1e-3)
    assert "| lpo-pendulum, Pendulum-v1 | −0.30 [" in module.EXPERIMENT.page(report)
    del report["environments"]["Pendulum-v1"][module.REPORTED]["ppo"]["0.01"]
    assert list(module.at_home(report)["lpo-pendulum", "Pendulum-v1"]) == [0.0003, 0.003]


def test_rates_that_nobody_was_trained_at_are_not_said_to_show_nothing(report):
    everywhere = module.facts(report)["more"]
    for place in report["environments"].values():
        for part in (module.CHOOSING, module.REPORTED):
            for name, of_it in place[part].items():
                place[part][name] = {rate: x for rate, x in of_it.items() if rate == "0.003"}
    asked = module.facts(report)["more"]
    assert asked.keys() < everywhere.keys()


def test_few_agents_decide_nothing(report):
    for place in report["environments"]:
        report["environments"][place] = entry(place, CHOOSING, REPORTED, number=9)
    assert {outcome for outcome, _ in judged(report).values()} == {claims.UNDECIDED}


def test_a_measurement_that_was_cut_off_goes_on_and_keeps_to_its_agents(
    tmp_path, monkeypatch, capsys
):
    asked = []

    def compare(environment, objectives, seeds, spec, points, rows, tell):
        if len(asked) == 3:
            raise ConnectionError
        asked.append((objectives[0].name, float(spec.hyperparameters.learning_rate), seeds))
        returns = np.array([[0.0, seed % 7] for seed in seeds])
        steps = np.array([0, 10])
        made = LearningCurves(
            environment, None, objectives[0].name, steps, returns, seeds, 20, mode_actions=True
        )
        return Comparison([made])

    monkeypatch.setattr(module, "compare", compare)
    out = tmp_path / "rates.json"
    flags = ["--environments", "Pendulum-v1", "--objectives", "dpo", "--rates", "0.001", "0.01"]
    flags += ["--agents=3", "--choosing=2", f"--out={out}"]
    with pytest.raises(ConnectionError):
        module.EXPERIMENT.main(flags)
    asked.clear()
    assert module.EXPERIMENT.main(flags) == 0
    seeds = [*VALIDATING[:2], *REPORTING[module.OFFSET : module.OFFSET + 3]]
    assert asked == [("dpo", 0.01, seeds)]
    kept = json.loads(out.read_text())["environments"]["Pendulum-v1"]
    assert kept[module.REPORTED]["dpo"]["0.01"] == " ".join(str(seed % 7) for seed in seeds[2:])
    asked.clear()
    further = [*flags, "--beyond", "0.03", "0.01"]
    assert module.EXPERIMENT.main(further) == module.EXPERIMENT.main(flags) == 0
    assert asked == [("ppo", 0.03, seeds), ("dpo", 0.03, seeds)]
    assert json.loads(out.read_text())["beyond"] == [0.03]
    assert module.EXPERIMENT.main([*flags, "--agents=4"]) == 2
    assert "measured with agents 3, and 4 is asked for" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--environments", "Breakout-MinAtar"], "nobody published an expert of Breakout-MinAtar"),
        (["--rates"], "no environments or no learning rates"),
        (["--rates", "0.001", "-1"], "learning_rate has the value -1.0: it must be 0 or larger"),
        (["--choosing=10001"], "10001 validation seeds are asked for"),
        (["--objectives", "nothing"], "nothing"),
    ],
)
def test_a_mistake_is_one_sentence_before_anybody_is_trained(
    flags, message, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(module, "compare", None)
    assert module.EXPERIMENT.main([*flags, f"--out={tmp_path / 'rates.json'}"]) == 2
    assert message in capsys.readouterr().err
