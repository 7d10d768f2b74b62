"""Several processes are started, timed and put into a table, and what fails is told."""

import pytest

from experiments import scaling
from scb.errors import UserError


@pytest.mark.slow
def test_processes_gather_together_and_the_first_says_how_long_it_took():
    assert 0 < scaling._gathering(2, scaling.Options(candidates=4)) < 1000


def test_a_process_that_fails_is_told():
    with pytest.raises(UserError, match="a process of 1 failed: ValueError: no"):
        scaling.together(1, ["raise ValueError('no')"])


def test_drawing_and_learning_are_timed_for_both_kinds():
    for kind in ("objective", "bandit"):
        found = scaling._strategy(kind, 4)
        assert found["parameters"] > 100 and found["milliseconds"] > 0


def report(gathering):
    times = {str(n): {"parameters": 10, "milliseconds": n / 1000} for n in scaling.POPULATIONS}
    return {
        "candidates": 16,
        "devices": 1000,
        "machine": {"cores": 2, "processor": "one"},
        "versions": {"jax": "1"},
        "generations": {"1": [2.0, 2.0, 2.2], "2": [2.5, 2.5, 2.5], "4": [4.0, 4.0, 4.0]},
        "gathering": gathering,
        "strategy": {"objective": times, "bandit": times},
    }


def test_the_page_says_what_a_core_is_worth_and_from_where_gathering_costs():
    # 1 ms for each process: a twentieth of 2 s from 100 processes on.
    page = scaling.EXPERIMENT.page(report({"2": 2.0, "4": 4.0}))
    assert "2 times the candidates in 1.25 times the seconds" in page
    assert "50 % of a generation, and 5 % from 100 on" in page
    assert "| 4 | 64 | 4.00 | 4.00, 4.00 | 100 % | 4.00 |" in page
    assert "at no number of processes" in scaling.EXPERIMENT.page(report({"2": 2.0, "4": 2.0}))


def test_the_page_of_one_process_compares_nothing():
    alone = {**report({}), "generations": {"1": [2.0, 2.0, 2.2]}}
    assert "**One process is all that was measured.**" in scaling.EXPERIMENT.page(alone)


def test_a_report_that_was_cut_off_says_so():
    found = report({"2": 2.0})
    for times in found["strategy"].values():
        times.popitem()
    with pytest.raises(UserError, match="the report of scaling is not complete: leave out"):
        scaling.EXPERIMENT.page(found)


def test_processes_are_in_their_order_whatever_was_measured_first():
    found = report({"2": 2.0, "4": 4.0})
    found["generations"] = dict(reversed(found["generations"].items()))
    assert "2 times the candidates in 1.25 times" in scaling.EXPERIMENT.page(found)


@pytest.mark.parametrize("processes", [["0", "1", "2"], ["1"], ["2", "3"]])
def test_processes_that_cannot_be_compared_are_refused(processes, capsys):
    assert scaling.EXPERIMENT.main(["--processes", *processes]) == 2
    assert (
        "give 1, which the others are compared with, and larger numbers" in capsys.readouterr().err
    )


def test_gathering_that_falls_is_level_and_costs_from_one_process_on():
    assert scaling.grown([(2, 5.0), (3, 4.0), (4, 3.0)]) == (0.0, 4.0)
    assert scaling.grown([(2, 5.0), (4, 9.0)]) == pytest.approx((2.0, 1.0))
    # A twentieth of 2 s is less than it takes anywhere.
    page = scaling.EXPERIMENT.page(report({"2": 130.0, "4": 132.0}))
    assert "5 % from 1 on" in page


def test_generations_of_another_number_are_not_among_these():
    found = {}
    next(scaling.parts(scaling.Options(generations=8), found))
    with pytest.raises(UserError, match="measured with searched 8, and 20 is asked for"):
        next(scaling.parts(scaling.Options(generations=20), found))
