"""An objective that a longer training turns against its agents is named, with the length."""

import json

import numpy as np
import pytest

from experiments import horizons as module
from scb.environments.registry import environment_spec
from scb.errors import UserError
from scb.files import packed_row

NOISE = np.random.default_rng(0).normal(size=(2, 40)) / 10


def entry(*means):
    returns = {h: packed_row(m + NOISE[0]) for h, m in zip(("1", "8"), means, strict=True)}
    return {"sha256": "", "objective_sha256": "", "returns": returns}


@pytest.fixture
def report():
    objectives = {"ppo": entry(2.0, 5.0), "dpo": entry(2.5, 5.5), "ta-lpo": entry(3.0, 4.0)}
    return {"agents": 40, "horizons": [1.0, 8.0], "objectives": objectives}


def test_leads_are_of_the_same_agents(report):
    found = module.leads(report)
    # The noise is the same with either, to the four digits that are kept.
    assert found["dpo"]["8"].value == pytest.approx(0.5, abs=1e-3)
    assert found["ta-lpo"]["8"].low == pytest.approx(-1.0, abs=2e-2)
    shuffled = packed_row(5.5 + NOISE[1])
    report["objectives"]["dpo"]["returns"]["8"] = shuffled
    assert module.leads(report)["dpo"]["8"].low < 0.49


def test_the_page_says_who_is_ahead_and_from_where_on_not(report):
    page = module.EXPERIMENT.page(report)
    assert "ahead at every length are dpo; behind are ta-lpo at 8 times the length" in page
    assert "| ta-lpo | +1.00 [" in page and "0.25, 0.5, 1 and 2 (ta-lpo) |" in page
    (axes,) = module.EXPERIMENT.figures(report)["horizons"].axes
    assert axes.get_legend_handles_labels()[1] == ["dpo", "ta-lpo"]


def test_agents_are_trained_for_as_long_as_is_asked(monkeypatch, tmp_path):
    lengths = []

    class Task:
        env_params = None

        def __init__(self, config, name):
            assert config.horizons == (0.5, 2.0) and name == "Synthetic-Pendulum-v1"
            self.env = self

        def reward_scale(self, params, key):
            return 2.0

        def fitness(self, parameters, key, number, horizon):
            lengths.append(number)
            return np.array([np.nan, *range(1, 10)]) * horizon

    monkeypatch.setattr(module, "TaskTraining", Task)
    out, report = module.Options(("dpo",), (0.5, 2.0), agents=10), {}
    module.measure(out, report, lambda: None)
    # One that diverged counts as random actions do.
    diverged, *others = report["objectives"]["dpo"]["returns"]["2"].split()
    random = environment_spec("Synthetic-Pendulum-v1").random_return()
    assert float(diverged) == pytest.approx(random / 2, rel=1e-3)
    assert others == ["1", "2", "3", "4", "5", "6", "7", "8", "9"]
    assert list(report["objectives"]) == ["ppo", "dpo"] and set(lengths) == {10}
    assert json.loads(json.dumps(report))["horizons"] == [0.5, 2.0]
    # What is there is not measured again, but for an objective or a bandit that has become another.
    for digest in ("objective_sha256", "sha256"):
        report["objectives"]["dpo"][digest] = "of another"
        lengths.clear()
        module.measure(out, report, lambda: None)
        assert len(lengths) == 1  # traced once for all lengths
    for wrong in ({"horizons": ()}, {"horizons": (0.0,)}, {"agents": 3}):
        with pytest.raises(UserError):
            module.Options(**wrong)


def test_the_clip_alone_leads_nowhere(report):
    del report["objectives"]["dpo"], report["objectives"]["ta-lpo"]
    assert module.leads(report) == {}
    assert "at every length none is ahead" in module.EXPERIMENT.page(report)
    module.EXPERIMENT.figures(report)


def test_all_names_are_read_before_the_first_is_measured():
    report = {}
    with pytest.raises(UserError, match="unknown objective 'nope'"):
        next(module.parts(module.Options(("dpo", "nope")), report))
    assert not report.get("objectives")


def test_all_that_another_bandit_taught_is_forgotten_also_of_what_is_not_asked_for(report):
    report["objectives"]["dpo"]["sha256"] = module.bandit_metadata(module.TASK)["sha256"]
    report["horizons"] = [1.0, 8.0]
    asked = module.Options(("dpo",), agents=40, horizons=(1.0, 8.0))
    next(module.parts(asked, report))
    assert [*report["objectives"]] == ["dpo"]
