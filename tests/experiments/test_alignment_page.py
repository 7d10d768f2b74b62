import shutil
from pathlib import Path

import pytest

import lpo
from experiments import alignment, rendering
from experiments.harness import command_of
from scb.errors import UserError


def recommended(report):
    return rendering.block("alignment", "recommendation", alignment.recommendation(report))


def stage(environment, correlations, bandit="Synthetic-Pendulum-v1"):
    regimes = [
        {
            "name": name,
            "bandit": bandit,
            "reward_noise": 0.0 if name == "reward noise 0.0" else 5.0,
            "alignment": {alignment.FITNESS: {"spearman": value}},
        }
        for name, value in correlations.items()
    ]
    return {"environment": environment, "regimes": regimes}


def test_the_recommendation_is_the_best_over_both_initialisations():
    plain = {"reward noise 0.0": 0.2, "default": 0.9, "epochs 1": 0.95}
    small = {"reward noise 0.0": 0.1, "default": 0.8, "epochs 1": 0.5}
    report = {
        "stages": {
            "pendulum": stage("Pendulum-v1", plain),
            "pendulum_small_last_layer": stage("Pendulum-v1", small),
        }
    }
    said = recommended(report)
    assert "the best of 3 regimes is *default* with 0.85; the default has 0.85, the best." in said
    own = stage("CartPole-v1", {"default": -0.3, "reward noise 0.0": 0.1}, "Synthetic-CartPole-v1")
    own["regimes"] += stage("CartPole-v1", {"default": 0.6})["regimes"]
    report["stages"]["CartPole-v1"] = own
    said = recommended(report)
    assert (
        "as the environment does by a correlation of: CartPole-v1 \u22120.30 (without noise 0.10)."
        in said
    )
    assert said.endswith("On Pendulum's bandit instead: CartPole-v1 0.60.")
    report["stages"]["pendulum_small_last_layer"] = stage("Pendulum-v1", small | {"epochs 1": 0.9})
    said = recommended(report)
    assert "*epochs 1* with 0.93" in said and "1 regime is above it" in said


def test_the_files_of_a_stage_have_no_spaces_in_their_names():
    assert alignment.figure_name(alignment.HELD_OUT) == "alignment_Pendulum-v1_held_out"


def test_a_reports_command_says_what_is_measured_and_not_where_it_is_written():
    options = alignment.Options(agents=8, held_out=(Path("a.npz"),), skip_confirmation=True)
    command = "python -m experiments alignment --agents=8 --held-out a.npz --skip-confirmation"
    assert command_of("alignment", options) == command


def test_what_is_held_out_is_not_in_the_family_under_another_name(tmp_path, capsys):
    zoo = Path(lpo.__file__).parent / "zoo"
    for suffix in ("npz", "json"):
        shutil.copy(zoo / f"ta-lpo.{suffix}", tmp_path / f"other.{suffix}")
    out = tmp_path / "alignment.json"
    arguments = ["--held-out", str(tmp_path / "other.npz"), "--out", str(out)]
    assert alignment.EXPERIMENT.main(arguments) == 2
    assert "the family has it as ta-lpo: leave it out" in capsys.readouterr().err
    assert not out.exists()


def test_what_was_interrupted_is_not_recommended_from():
    whole = stage("Pendulum-v1", {"default": 0.9, "reward noise 0.0": 0.1})
    half = stage("Pendulum-v1", {"default": 0.9})
    report = {"stages": {"pendulum": whole, "pendulum_small_last_layer": half}}
    with pytest.raises(UserError, match="are not all measured: the same command goes on"):
        alignment.recommendation(report)
    with pytest.raises(UserError, match="are not all measured: the same command goes on"):
        alignment.recommendation({"stages": {"pendulum": whole}})
    report["stages"] |= {"pendulum_small_last_layer": whole, "CartPole-v1": half}
    assert alignment.recommendation(report)["confirmed"] == {}
