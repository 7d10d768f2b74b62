"""Both ways are timed in turn, and the page says the ratios."""

import itertools
import json

import pytest

from experiments import gymnasium_speed


def test_steps_a_second_are_counted(monkeypatch):
    clock = itertools.count()
    monkeypatch.setattr(gymnasium_speed.time, "perf_counter", lambda: next(clock))
    calls = []
    # A call a tick: seven of them fit, and the clock is read once more at the end.
    rate = gymnasium_speed.steps_a_second(lambda: calls.append(0), 100, 8)
    assert len(calls) == 1 + 7 and rate == pytest.approx(700 / 9)


def test_a_bandit_is_timed_alone_and_among_others(tmp_path):
    flags = ["--repeats", "2", "--seconds", "0.02", "--num-envs", "8"]
    flags += ["--bandits", "Synthetic-Pendulum-v1", "--out", str(tmp_path / "speed.json")]
    assert gymnasium_speed.EXPERIMENT.main(flags) == 0
    (kinds,) = json.loads((tmp_path / "speed.json").read_text())["bandits"].values()
    # Another bandit joins it.
    assert gymnasium_speed.EXPERIMENT.main([*flags, "--bandits", "Synthetic-CartPole-v1"]) == 0
    assert len(json.loads((tmp_path / "speed.json").read_text())["bandits"]) == 2
    for kind in ("one", "many"):
        assert len(kinds[kind]["ratios"]) == 2 and min(kinds[kind]["ratios"]) > 0
    page = (tmp_path / "gymnasium_speed.md").read_text()
    assert "| Synthetic-Pendulum-v1 | " in page and "8 together: scb" in page
