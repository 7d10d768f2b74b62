"""Kills and mutations: what is counted as what, and that a few of each do no harm."""

import json
import random
import signal

import pytest

from experiments import reliability
from scb.errors import UserError


def test_damaged_files_of_every_kind_are_refused_or_taken(tmp_path):
    options = reliability.Options(mutations=70)
    found = reliability.mutate_all(tmp_path, options)
    assert found["failures"] == []
    assert {sum(counts.values()) for counts in found["outcomes"].values()} == {10}
    assert sum(counts.get("refused", 0) for counts in found["outcomes"].values()) > 20
    # The same again.
    again = reliability.mutate_all(tmp_path / "again", options)
    assert again["outcomes"] == found["outcomes"]


@pytest.mark.parametrize(
    ("error", "outcome"),
    [
        (UserError("no."), "refused"),
        (SystemExit(2), "refused"),
        (UserError("no.\nand no."), "several lines: no.\nand no."),
        (SystemExit(1), "exit 1"),
    ],
)
def test_only_a_sentence_is_a_refusal(error, outcome):
    def read():
        raise error

    assert reliability.read_mutated(read) == outcome
    assert reliability.read_mutated(lambda: None) == "taken"
    assert "ZeroDivisionError" in reliability.read_mutated(lambda: print(1 / 0))


def test_mutations_change_something_and_leave_the_original():
    tree = {"a": [1, {"b": 2}], "c": "d"}
    text = json.dumps(tree)
    changed = 0
    for seed in range(50):
        found, _ = reliability.mutated(tree, random.Random(seed))
        assert json.dumps(tree) == text
        changed += json.dumps(found) != text
    assert changed > 45


@pytest.mark.slow
@pytest.mark.parametrize("name", reliability.COMMANDS)
def test_runs_that_are_ended_at_random_end_with_the_same_bytes(tmp_path, name):
    killed = []
    options = reliability.Options(kills=2, seed=1)
    command = reliability.COMMANDS[name]
    reliability.torment(tmp_path, name, command, options, killed, lambda: None)
    assert [(x["status"], x["same"]) for x in killed] == [(0, True)] * 2


def test_a_run_is_ended_as_it_is_asked_and_resumed_where_it_can_be(tmp_path, monkeypatch):
    started = []

    class Process:
        def __init__(self, command, **_):
            started.append(command[3:])

        def wait(self, after=None):
            if after is not None:
                raise reliability.subprocess.TimeoutExpired("", after)
            return 143

        def send_signal(self, how):
            started.append(how)

    monkeypatch.setattr(reliability.subprocess, "Popen", Process)
    run = tmp_path / "run"
    command = ["scb", "discover", "--flag"]
    assert reliability.ended(command, run, 1.0, signal.SIGTERM) == 143
    judge = "--judge-agents=0"
    assert started == [["discover", "--flag", f"--out={run}", judge], signal.SIGTERM]
    run.mkdir()  # and nothing in it: there is nothing to resume
    reliability.ended(command, run)
    assert started[2] == ["discover", "--flag", f"--out={run}", judge] and not run.exists()
    run.mkdir()
    (run / "config.json").write_text("{}")
    reliability.ended(command, run)
    assert started[3] == ["discover", f"--resume={run}", judge]
