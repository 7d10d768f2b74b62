"""The benchmark gives rejax this project's settings, and keeps what was timed in one go together."""

import json

import numpy as np
import pytest

from experiments import benchmark
from experiments.benchmark import PEER, TASKS, THIS, Task
from scb.errors import UserError


@pytest.fixture
def timed(monkeypatch):
    """Who was asked; half a second an agent here and one there, and returns of which one is no number."""
    asked = []

    def last_line(command):
        who = PEER if "rejax_peer.py" in command[1] else THIS
        asked.append((who, command))
        seconds = [0.5, 0.6, 0.4] if who == THIS else [1.0, 1.2, 0.8]
        return {"seconds": seconds, "returns": [-100.0, float("nan"), -300.0, -200.0]}

    monkeypatch.setattr(benchmark, "last_line", last_line)
    return asked


@pytest.fixture
def python(tmp_path):
    program = tmp_path / "python"
    program.touch(mode=0o755)
    return str(program)


@pytest.mark.parametrize("name", TASKS)
def test_rejax_is_given_the_bandit_and_the_settings_that_agents_have_here(name, tmp_path):
    task = TASKS[name]
    job = json.loads(benchmark.write_rejax_job(tmp_path, task, 3000).read_text())
    spec = benchmark.spec_of(task, 3000)
    settings, numbers = job["settings"], spec.hyperparameters
    assert settings["total_timesteps"] == spec.config.total_steps >= 3000
    assert (settings["learning_rate"], settings["gamma"]) == (
        numbers.learning_rate,
        numbers.discount,
    )
    assert settings["num_epochs"] == getattr(
        spec.config, "num_epochs" if name == "ppo" else "gradient_steps"
    )
    if name in (
        "td3",
        "ddpg",
    ):  # rejax's unit of noise is 1, this project's half of Pendulum's range
        assert settings["exploration_noise"] == pytest.approx(2 * numbers.exploration_noise)
        assert (job["algorithm"], settings["num_critics"]) == (
            ("TD3", 2) if name == "td3" else ("DDPG", 1)
        )
    # The peer calculates the bandit from these arrays itself.
    bandit, _ = benchmark.bandit_of(task.environment)
    arrays = np.load(job["bandit"]["weights"])
    kernel = arrays["initial_state/Dense_0/kernel"]
    assert kernel.shape == (bandit.latent_size, bandit.config.hidden_size)
    assert {"reward/Dense_0/kernel", "reward/Dense_1/bias"} <= {*arrays}
    assert (job["bandit"]["activation"], job["bandit"]["latent"]) == (
        bandit.config.activation,
        bandit.config.latent,
    )


def test_a_line_has_the_ratio_of_medians_and_says_what_diverged(timed, python, tmp_path, capsys):
    out = tmp_path / "report.json"
    flags = ["--algorithms", "ppo", "--steps", "500", f"--out={out}"]
    assert benchmark.EXPERIMENT.main([*flags, "--rejax-python", python]) == 0
    assert [who for who, _ in timed] == [THIS, PEER]
    result = json.loads(out.read_text())["algorithms"]["ppo"]
    assert result["ratio"] == pytest.approx(2.0)
    assert result["seconds_per_agent"] == {THIS: [0.5, 0.6, 0.4], PEER: [1.0, 1.2, 0.8]}
    assert result["return"][THIS]["iqm"]["value"] == pytest.approx(-200.0)
    assert result["return"][PEER]["diverged"] == 1
    words = capsys.readouterr().out
    assert "0.5000" in words and "2.00" in words and words.count("1 diverged") == 2


def test_times_that_were_taken_beside_rejax_are_not_replaced_by_others(
    timed, python, tmp_path, capsys
):
    out = tmp_path / "report.json"
    flags = ["--algorithms", "ppo", f"--out={out}"]
    assert benchmark.EXPERIMENT.main([*flags, "--rejax-python", python]) == 0
    before = out.read_bytes()
    assert benchmark.EXPERIMENT.main(flags) == 2
    assert "has rejax's times of ppo" in capsys.readouterr().err
    assert out.read_bytes() == before and len(timed) == 2
    # Another algorithm has none, and is measured alone.
    assert benchmark.EXPERIMENT.main(["--algorithms", "dqn", f"--out={out}"]) == 0
    assert {*json.loads(out.read_text())["algorithms"]} == {"ppo", "dqn"}
    assert "rejax was not measured" in capsys.readouterr().out


def test_agents_that_all_diverged_have_no_mean():
    measured = {THIS: {"seconds": [1.0], "returns": [float("nan")] * 2}}
    result = benchmark.summary(Task("ppo", "Pendulum-v1"), measured)
    assert result["return"][THIS] == {"iqm": None, "diverged": 2} and "ratio" not in result
    assert "none, 2 diverged" in benchmark.row("ppo", result)


def test_what_cannot_be_timed_is_told(tmp_path):
    with pytest.raises(UserError, match=r"is no program: give another --rejax-python"):
        benchmark.Options(rejax_python=tmp_path / "nothing")
    with pytest.raises(UserError, match="algorithm"):
        benchmark.Options(algorithms="ppo,ddqn")
