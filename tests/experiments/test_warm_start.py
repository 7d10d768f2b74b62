"""The table of the warm-start study says what the report says."""

import json

import pytest

from experiments import warm_start
from experiments.harness import DOCS
from scb.errors import UserError


def report(values):
    arms = {}
    for arm, value in zip(warm_start.ARMS, values, strict=True):
        iqm = {"value": value, "low": value - 10, "high": value + 10, "n": 16}
        arms[arm] = {"fit": {}, "fit_seconds": 1.0, "ppo": {"mode_actions": {"iqm": iqm}}}
    return {"environments": {"MountainCar-v0": {"expert_return": -97.0, "returns": arms}}}


def test_the_best_construction_is_in_bold():
    row = warm_start.markdown(report([-190.0, -146.0, -125.0, -166.0])).splitlines()[-1]
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells[:2] == ["MountainCar-v0 (−97)", "PPO"]
    assert cells[2:] == [
        "−190 [−200, −180]",
        "−146 [−156, −136]",
        "**−125 [−135, −115]**",
        "−166 [−176, −156]",
    ]
    assert "**" not in warm_start.markdown(report([-140.0, -146.0, -125.0, -166.0]))
    assert "**" in warm_start.markdown(report([-146.0, -146.0, -125.0, -126.0]))  # stretched alone


def test_the_committed_table_is_that_of_the_committed_report(committed):
    assert warm_start.markdown(committed("warm_start")) in (DOCS / "fits.md").read_text()


def test_what_was_measured_is_kept(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(warm_start, "find_expert", None)  # nobody looks for one
    settings = {"seed": warm_start.SEED, "agents": 16, "episodes": 20}
    kept = {**report([-190.0, -146.0, -125.0, -166.0]), **settings, "experiment": "warm_start"}
    out = tmp_path / "report.json"
    out.write_text(json.dumps(kept))
    assert warm_start.EXPERIMENT.main([f"--out={out}"]) == 0
    assert json.loads(out.read_text())["environments"] == kept["environments"]
    with pytest.raises(UserError, match="unknown algorithm 'pop'"):
        warm_start.Options(algorithms=("pop",))
