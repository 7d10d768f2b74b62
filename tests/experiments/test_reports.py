from dataclasses import replace

import pytest

from experiments.parts import Part
from experiments.reports import (
    finite,
    forget_other,
    forget_replaced,
    lost,
    same_objectives,
    settled,
)
from lpo.objectives import load_objective
from scb.environments.zoo import bandit_metadata
from scb.errors import UserError
from scb.measurement import Place


def test_what_is_of_a_bandit_that_was_replaced_is_measured_again():
    ours = bandit_metadata("Synthetic-CartPole-v1")["sha256"]
    kept = {"a": {"sha256": ours, "x": 1}, "b, published": {"sha256": "other"}, "c": {"x": 1}}
    report = {"of": {"d": {"sha256": "replaced"}, **kept}, "published": {"sha256": "other"}}
    forget_replaced(report)
    assert report == {"of": {"d": None, **kept}, "published": {"sha256": "other"}}
    again = Part(("of", "d"), lambda: {"x": 2})
    assert not again.there(report)
    again.add(again.measured(), report)
    assert list(report["of"]) == ["d", "a", "b, published", "c"] and again.there(report)
    # A report of a single bandit.
    report["sha256"] = "replaced"
    forget_replaced(report)
    assert report == {}


def test_returns_that_are_no_number_count_as_random_actions():
    returns, failed = finite([1.234, float("nan"), float("inf")], Place.named("MountainCar-v0"))
    assert (returns, failed) == ([1.23, -200.0, -200.0], 2)  # the limit of 200 steps at -1 each


def test_what_a_report_is_measured_with_stays():
    report = {}
    settled(report, seeds=(1, 2))
    settled(report, seeds=[1, 2], steps=3)
    assert report == {"seeds": [1, 2], "steps": 3}
    with pytest.raises(UserError, match=r"with steps 3, and 4 is asked for: choose another --out"):
        settled(report, steps=4)


def test_an_entry_of_another_bandit_is_forgotten_and_no_other_one():
    entries = {"a": {"sha256": "old"}, "b": {"sha256": "old"}, "c": {"objective": "old"}}
    for name in ("a", "none"):
        forget_other(entries, name, "new")
    forget_other(entries, "b", "old")
    forget_other(entries, "c", "new", of="objective")
    assert entries == {"b": {"sha256": "old"}}


def test_lost_agents_are_counted_at_any_depth_and_nothing_else_is():
    assert lost({"a": {"failed": 2, "agents": 8}, "b": {"failed": {"sac": 1, "ppo": 3}}}) == 6


def test_a_name_stands_for_one_objective_in_a_report():
    report = {}
    ppo, learned = load_objective("ppo"), load_objective("lpo-pendulum")
    same_objectives(report, [ppo, learned])
    same_objectives(report, [learned])
    assert report == {"digests": {"lpo-pendulum": learned.sha256}}
    other = replace(learned, metadata={**learned.metadata, "sha256": "another"})
    with pytest.raises(UserError, match="another objective with the name lpo-pendulum: choose ano"):
        same_objectives(report, [other])
