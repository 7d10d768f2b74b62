"""Each objective's learning rate is chosen by agents that are not reported, and compared by those that are."""

import json

import numpy as np
import pytest

from experiments import claims
from experiments import learning_rates as module
from experiments.harness import packed
from lpo.comparison import Comparison, LearningCurves
from scb.environments.registry import environment_spec
from scb.errors import UserError
from scb.seeds import REPORTING, VALIDATING

RATES = ("0.0003", "0.003", "0.01")


def entry(environment, choosing, reported):
    """Returns of agents whose scores are these, give or take a little: {objective: a score at each rate}."""
    spec = environment_spec(environment)
    random, best = spec.random_return(), spec.reference_return()
    roles = {module.CHOOSING: (choosing, 10), module.REPORTED: (reported, 20)}
    return {
        "random": random,
        "own": 0.003,
        "steps": 1000,
        "learned_on": {"lpo-pendulum": ["Pendulum-v1"]},
        "failed": {"ppo": {"0.01": 1}},
        **{
            role: {
                name: {
                    rate: packed(
                        [random + (best - random) * (x + 0.01 * np.cos(np.arange(number)))]
                    )[0]
                    for rate, x in zip(RATES, of_it, strict=True)
                }
                for name, of_it in scores.items()
            }
            for role, (scores, number) in roles.items()
        },
    }


@pytest.fixture
def report():
    choosing = {"ppo": (0.1, 0.5, 0.2), "dpo": (0.1, 0.2, 0.6), "lpo-pendulum": (0.1, 0.2, 0.9)}
    reported = {"ppo": (0.3, 0.4, 0.9), "dpo": (0.3, 0.4, 0.5), "lpo-pendulum": (0.2, 0.8, 0.8)}
    return {
        "agents": 20,
        "choosing": 10,
        "environments": {
            "Pendulum-v1": entry("Pendulum-v1", choosing, reported | {"lpo-pendulum": (0, 0, 0)}),
            "Acrobot-v1": entry("Acrobot-v1", choosing, reported),
        },
        "machine": {"cores": 2, "processor": "a processor"},
    }


def test_others_choose_the_rate_than_those_that_are_reported(report):
    chosen = {"ppo": 0.003, "dpo": 0.01, "lpo-pendulum": 0.01}
    assert module.chosen(report) == dict.fromkeys(report["environments"], chosen)
    (row, *_) = module.facts(report)["rows"]
    # Of the reported agents the largest rate is better, which nobody may know.
    assert row["in"]["Acrobot-v1"] == pytest.approx(0.4, abs=0.01)


def test_objectives_are_compared_where_they_were_not_learned_at_the_same_rates_and_at_the_best(
    report,
):
    judged = {x.claim.text: x for x in claims.judge(module.claims(report))}
    assert {text: (x.outcome, round(x.estimate.value, 2)) for text, x in judged.items()} == {
        "dpo earns more than ppo at rates of 0.003 and more": (claims.FAILS, -0.2),
        "dpo earns more than ppo at rates of 0.0003 and less": (claims.UNDECIDED, 0.0),
        "dpo earns more than ppo, each at its best rate": (claims.HOLDS, 0.1),
        "lpo-pendulum earns more than ppo at rates of 0.003 and more": (claims.HOLDS, 0.15),
        "lpo-pendulum earns more than ppo at rates of 0.0003 and less": (claims.FAILS, -0.1),
        "lpo-pendulum earns more than ppo, each at its best rate": (claims.HOLDS, 0.4),
        "Pendulum-v1: lpo-pendulum earns more than ppo, each at its best rate": (
            claims.FAILS,
            -0.4,
        ),
        "lpo-pendulum earns more than dpo, each at its best rate": (claims.HOLDS, 0.3),
        "Pendulum-v1: lpo-pendulum earns more than dpo, each at its best rate": (
            claims.FAILS,
            -0.5,
        ),
    }
    page = module.EXPERIMENT.page(report)
    assert (
        "**Shown: dpo earns more than ppo, each at its best rate; lpo-pendulum earns more" in page
    )
    assert "| dpo | 0.01: 0.50 | 0.01: 0.50 | 0.50 [" in page
    assert "2 agents of all ended in NaN" in page
    assert len(module.EXPERIMENT.figures(report)["learning_rates"].axes) == 3


def test_rates_that_not_all_objectives_have_yet_are_left_out(report):
    for role in (module.CHOOSING, module.REPORTED):
        del report["environments"]["Acrobot-v1"][role]["dpo"]["0.0003"]
    assert module.scores(report)["Acrobot-v1"]["ppo"].keys() == {0.003, 0.01}
    judged = {x.claim.text: x for x in claims.judge(module.claims(report))}
    small = judged["lpo-pendulum earns more than ppo at rates of 0.0003 and less"]
    assert small.outcome == claims.UNTESTED
    assert "| not tested at this size |" in module.EXPERIMENT.page(report)


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
    seeds = [*VALIDATING[:2], *REPORTING[module.FIRST : module.FIRST + 3]]
    assert asked == [("dpo", 0.01, seeds)]
    kept = json.loads(out.read_text())["environments"]["Pendulum-v1"]
    assert kept[module.REPORTED]["dpo"]["0.01"] == " ".join(str(seed % 7) for seed in seeds[2:])
    assert module.EXPERIMENT.main([*flags, "--agents=4"]) == 2
    assert "measured with agents 3, and 4 is asked for" in capsys.readouterr().err


def test_an_environment_without_scores_is_refused():
    with pytest.raises(UserError, match="nobody published an expert of Breakout-MinAtar"):
        module.Options(environments=("Breakout-MinAtar",))
