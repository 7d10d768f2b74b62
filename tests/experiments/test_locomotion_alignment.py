"""Regimes of bandits are held against what objectives earn in an environment of Brax."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from experiments import locomotion_alignment as module
from lpo.fitness import LABELS
from scb.environments.registry import environment_spec

EARNED = {"ppo": 3.0, "ppo-0.1": 1.0, "dpo": 4.0, "lpo-pendulum": 2.0}


def curve(level):
    agents = level + np.linspace(-0.1, 0.1, 4)
    return SimpleNamespace(area=agents, late=-agents, seeds=range(4))


@pytest.fixture
def environment(monkeypatch):
    """Objectives with agents in it: the levels over the training, and the reverse over the last quarter."""
    known = {name: curve(level) for name, level in EARNED.items()}
    monkeypatch.setattr(module, "validated", lambda name: known if name == "hopper" else {})
    monkeypatch.setattr(module, "full_size", lambda name: None)
    return known


@pytest.fixture(autouse=True)
def elsewhere(monkeypatch):
    """What was trained in other environments: Pendulum's agents rank as hopper's do, and CartPole's the other way."""
    asked = []

    def compare(environment, objectives, seeds):
        asked.append((environment, list(objectives), list(seeds)))
        sign = 100 if environment == "Pendulum-v1" else -1
        curves = [curve(sign * EARNED.get(name, 9.0)) for name in objectives]
        for name, of_it in zip(objectives, curves, strict=True):
            of_it.objective = name
        return SimpleNamespace(curves=curves)

    monkeypatch.setattr(module, "compare", compare)
    return asked


@pytest.fixture
def trained(monkeypatch):
    """What regimes were asked for; the environment's own rank as it does, the others the other way round."""
    asked = []

    def fitness(regime, objectives, seeds):
        asked.append((regime, [o.name for o in objectives], seeds))
        sign = 1 if regime.bandit == "Synthetic-hopper" else -1
        return {
            o.name: {
                label: sign * EARNED.get(o.name, 9.0) + np.linspace(-0.1, 0.1, len(seeds))
                for label in LABELS
            }
            for o in objectives
        }

    monkeypatch.setattr(module, "regime_fitness", fitness)
    return asked


def run(folder, *flags):
    out = folder / "report.json"
    flags = ["--others", "Pendulum-v1", "CartPole-v1", *flags]
    assert module.EXPERIMENT.main([*flags, "--out", str(out)]) == 0
    return json.loads(out.read_text()), (folder / "locomotion_alignment.md").read_text()


def test_a_regime_that_ranks_as_the_environment_is_told_from_one_that_does_not(
    tmp_path, environment, trained
):
    report, page = run(tmp_path)
    found = module.aligned(report)["hopper"]
    for outcome, sign in (("area", 1), ("late", -1)):
        assert found[outcome]["its own"][module.FITNESS].spearman == pytest.approx(sign)
        assert found[outcome]["Pendulum's"][module.FITNESS].spearman == pytest.approx(-sign)
    assert "Of 8 regimes 4 are shown to rank 4 objectives" in page
    assert "its own, a tenth of the batches" in page.split("\n")[2]
    assert "fewer than 10 agents of each decide nothing" in page
    # Of the 5120 on Hopper, and of the swimmer's 640.
    found = [
        module.regime(x, "its own, a tenth of the batches").iterations
        for x in ("hopper", "swimmer")
    ]
    assert found == [512, 64]
    assert "as the other half does with 1.00 over the training" in page
    assert "| dpo | 4 | 4 | \N{MINUS SIGN}4 |" in page
    regimes = [regime for regime, *_ in trained]
    assert [r.reward_noise for r in regimes] == [5.0, 2.0, 0.0, 5.0, 5.0, 0.0, 5.0, 0.0]
    assert all(x[1:] == (list(EARNED), list(range(700, 708))) for x in trained)


def test_only_objectives_that_are_new_in_the_environment_are_measured(
    tmp_path, environment, trained
):
    run(tmp_path)
    before = len(trained)
    environment["none"] = curve(0.0)
    report, page = run(tmp_path)
    assert [names for _, names, *_ in trained[before:]] == [["none"]] * len(module.REGIMES)
    # Where it was trained it earns most, and in the environment least.
    assert module.aligned(report)["hopper"]["area"]["its own"][module.FITNESS].spearman == 0.0
    assert "rank 5 objectives" in page


def test_another_environment_ranks_as_it_does_or_not(tmp_path, environment, trained, elsewhere):
    report, page = run(tmp_path)
    seeds = list(range(700, 708))
    assert elsewhere == [(x, list(EARNED), seeds) for x in ("Pendulum-v1", "CartPole-v1")]
    found = module.ranked_elsewhere(report)["hopper"]
    assert [x["area"].spearman for x in found.values()] == pytest.approx([1, -1, 1])
    assert [x["late"].spearman for x in found.values()] == pytest.approx([1, -1, 1])
    assert (
        f"Shown to over the training: Pendulum-v1; {module.TOGETHER}, of 2 and their mean;" in page
    )
    assert "| Pendulum-v1 | 1.00 [" in page and "| CartPole-v1 | −1.00 [" in page
    environment["none"] = curve(0.0)
    run(tmp_path)
    assert [names for _, names, _ in elsewhere[2:]] == [["none"]] * 2


def test_agents_that_report_are_a_second_witness(
    tmp_path, environment, trained, elsewhere, monkeypatch
):
    # Of three objectives with the opposite levels, and of one that was trained nowhere else.
    whole = [curve(-level) for level in (*list(EARNED.values())[1:], 7.0)]
    for of_it, name in zip(whole, (*list(EARNED)[1:], "other"), strict=True):
        of_it.objective = name
    monkeypatch.setattr(module, "full_size", lambda name: SimpleNamespace(curves=whole))
    report, page = run(tmp_path)
    assert [*module.reporting_there(report, "hopper")] == list(EARNED)[1:]
    found = module.ranked_elsewhere(report)["hopper"]
    assert [x[module.REPORTED].spearman for x in found.values()] == pytest.approx([-1, 1, -1])
    assert "over the training, 3 objectives, agents that report |" in page


def test_the_mean_score_weighs_tasks_by_their_experts(tmp_path, environment, trained, elsewhere):
    report, _ = run(tmp_path)
    # A thousand points between random actions and the expert there, and about five hundred here.
    names = ("Pendulum-v1", "CartPole-v1")
    apart = [environment_spec(name).score([0.0, 100.0]) for name in names]
    assert [1 / (b - a) * 100 for a, b in apart] == pytest.approx([1077, 477], rel=0.05)
    for of_it in report["others"]["CartPole-v1"].values():
        of_it["area"] = of_it["late"] = "0 0 0 0"
    level = module.ranked_elsewhere(report)["hopper"]
    assert level["CartPole-v1"]["area"].spearman is None
    assert level[module.TOGETHER]["area"].spearman == pytest.approx(1)


def test_others_are_environments_with_an_expert(tmp_path, environment, trained, elsewhere, capsys):
    for name, said in (
        ("Synthetic-Pendulum-v1", "is synthetic"),
        ("Breakout-MinAtar", "no reference return of Breakout-MinAtar"),
    ):
        flags = ["--others", name, "--out", str(tmp_path / "report.json")]
        assert module.EXPERIMENT.main(flags) != 0
        assert said in capsys.readouterr().err and not (trained or elsewhere)


def test_regimes_are_compared_over_the_objectives_that_all_have(tmp_path, environment, trained):
    report, _ = run(tmp_path)
    del report["environments"]["hopper"]["its own"]["fitness"]["dpo"]
    found = module.facts(report)["found"]["hopper"]
    assert found["earned"].keys() == EARNED.keys() - {"dpo"}
    assert len(found["tables"]["area"]) == len(module.REGIMES)
    assert found["missing"] == []
    del report["environments"]["hopper"]["Pendulum's"]["fitness"]["ppo"]
    assert module.facts(report)["found"] == {}  # two objectives rank nothing


def test_what_was_measured_of_a_bandit_that_was_replaced_is_measured_again(
    tmp_path, environment, trained
):
    report, _ = run(tmp_path)
    before = len(trained)
    assert "not measured yet" not in module.EXPERIMENT.page(report)
    without = json.loads(json.dumps(report))
    del without["environments"]["hopper"]["Pendulum's"]
    assert "not measured yet with bandits that ship: Pendulum's.\n" in module.EXPERIMENT.page(
        without
    )
    report["environments"]["hopper"]["Pendulum's"]["sha256"] = "of another"
    (tmp_path / "report.json").write_text(json.dumps(report))
    again, _ = run(tmp_path)
    assert [regime.bandit for regime, *_ in trained[before:]] == ["Synthetic-Pendulum-v1"]
    assert again["environments"]["hopper"]["Pendulum's"]["sha256"] != "of another"


def test_an_environment_without_agents_says_what_trains_some(
    tmp_path, environment, trained, capsys
):
    flags = ["--environments", "swimmer", "--out", str(tmp_path / "report.json")]
    assert module.EXPERIMENT.main(flags) != 0
    said = capsys.readouterr().err
    assert "on swimmer 0 objectives have agents" in said
    assert "--environments swimmer --tuning-agents 4" in said and not trained


def test_the_figure_has_a_row_for_each_regime_and_environment(tmp_path, environment, trained):
    out = tmp_path / "report.json"
    assert module.EXPERIMENT.main(["--others", "Pendulum-v1", "CartPole-v1", f"--out={out}"]) == 0
    (figure,) = module.EXPERIMENT.figures(json.loads(out.read_text())).values()
    rows = [f"bandit: {name}" for name in module.REGIMES]
    rows += ["Pendulum-v1", "CartPole-v1", module.TOGETHER]
    known = {"bandit: its own": 1.0, "bandit: Pendulum's": -1.0, "Pendulum-v1": 1.0}
    for axes, sign in zip(figure.axes, (1.0, -1.0), strict=True):
        names = [text.get_text() for text in figure.axes[0].get_yticklabels()]
        assert sorted(names) == sorted(rows)
        points = {
            names[int(line.get_ydata()[0])]: line.get_xdata()[0]
            for line in axes.lines
            if line.get_marker() == "o"
        }
        # In these environments the last quarter is the training reversed, in all of them alike.
        for name, correlation in known.items():
            of_environment = not name.startswith("bandit")
            expected = correlation if of_environment else sign * correlation
            assert points[name] == pytest.approx(expected)
    assert module.attainable(0.6) == pytest.approx(0.866, abs=1e-3)
