"""A bandit of the zoo carries the results that were measured for its own weights."""

import json

import pytest

from experiments import zoo_bandit
from scb.environments.zoo import bandit_metadata, load_bandit, zoo_names

IQM = {"value": -1.0, "low": -2.0, "high": -0.5, "n": 20}


def entry(**fields):
    measured = {"iqm": IQM, "failed": 2, "agents": []}
    row = {"environment": "CartPole-v1", "algorithm": "ppo", "bandit": "ours", "sha256": "a"}
    row |= {"agents": 20, "episodes": 50, "seed": 10_000, "backend": None}
    return row | {"sampled_actions": measured, "mode_actions": measured} | fields


def test_only_what_was_measured_with_these_weights_counts():
    table = {"entries": [entry(), entry(sha256="b"), entry(algorithm="sac", bandit="published")]}
    results = zoo_bandit.results_of(table, "a")
    assert list(results) == ["PPO"]
    assert results["PPO"]["mode_actions"] == IQM and results["PPO"]["failed"] == 2
    assert results["PPO"]["hyperparameters"] == "sampled from the paper's lists"
    assert zoo_bandit.results_of({}, "a") == {}


def test_a_brax_result_says_its_backend():
    table = {"entries": [entry(backend="spring"), entry(backend="generalized")]}
    [result] = zoo_bandit.results_of(table, "a", "spring").values()
    assert zoo_bandit.results_of(table, "a") == {}
    assert (result["backend"], result["hyperparameters"]) == ("spring", "fixed")


def test_a_bandit_enters_with_its_weights_unchanged(tmp_path, capsys):
    source = "scb/zoo/Synthetic-CartPole-v1.npz"
    table = tmp_path / "table.json"
    sha256 = bandit_metadata("Synthetic-CartPole-v1")["sha256"]
    table.write_text(json.dumps({"entries": [entry(sha256=sha256)]}))
    flags = ["--table", str(table), "--folder", str(tmp_path / "zoo")]
    assert zoo_bandit.EXPERIMENT.main([source, *flags]) == 0
    assert "measured PPO" in capsys.readouterr().out
    written = bandit_metadata(str(tmp_path / "zoo" / "Synthetic-CartPole-v1.npz"))
    assert written["sha256"] == sha256
    assert written["results"]["PPO"]["sampled_actions"] == IQM
    assert load_bandit(str(tmp_path / "zoo" / "Synthetic-CartPole-v1.npz")).observation_size == 4


@pytest.mark.parametrize("name", zoo_names())
def test_the_zoo_holds_what_the_committed_table_says(committed, name):
    metadata = bandit_metadata(name)
    backend = metadata["config"].get("backend")
    measured = zoo_bandit.results_of(committed("zoo_table"), metadata["sha256"], backend)
    assert measured and metadata["results"] == measured


def test_a_table_that_is_not_there_is_told(capsys):
    assert zoo_bandit.EXPERIMENT.main(["Synthetic-CartPole-v1", "--table", "none.json"]) == 2
    assert "none.json is no report of this command" in capsys.readouterr().err
