"""What ships of full-size trainings is compared as a report compares what was just measured."""

import json

from lpo.full_size import PATH, as_comparison, full_size, looked_at, validated
from lpo.objectives import load_objective
from scb.seeds import VALIDATING


def test_what_ships_can_be_shown_beside_a_short_run():
    report = json.loads(PATH.read_text())
    shown = looked_at(report)
    assert {"hopper", "walker2d", "halfcheetah", "swimmer"} <= shown.keys()
    # All agents of another entry are for a claim that is not decided yet.
    assert not any(full_size(environment) for environment in report["environments"].keys() - shown)
    for environment in shown:
        whole = full_size(environment)
        assert whole.curves[0].objective == "ppo"
        others = {curve.objective for curve in whole.curves[1:]}
        assert whole.as_dict()["paired_differences"].keys() == others, environment


def test_the_order_in_which_agents_ended_does_not_matter():
    def agents(*seeds):
        return {seed: {"returns": f"0 {seed}", "length": None, "speed": None} for seed in seeds}

    entry = {"backend": "generalized", "steps": [0, 10], "episodes": 2}
    found = as_comparison(
        "hopper", {**entry, "agents": {"dpo": agents("2"), "ppo": agents("9", "10")}}
    )
    assert [curves.objective for curves in found.curves] == ["ppo", "dpo"]
    assert found.curves[0].seeds == [9, 10] and found.curves[0].final.tolist() == [9.0, 10.0]


def test_objectives_are_compared_on_the_seeds_that_both_have():
    def agents(earned):
        return {seed: {"returns": f"0 {x}", "length": None, "speed": None} for seed, x in earned}

    # The first has agents that the second lacks, in another order.
    ppo, other = agents([("3", 7), ("1", 1), ("2", 2)]), agents([("1", 4), ("2", 5)])
    entry = {"backend": "generalized", "steps": [0, 10], "episodes": 2}
    found = as_comparison(
        "hopper", {**entry, "agents": {"ppo": ppo, "a": other, "b": agents([("9", 1)])}}
    )
    differences = found.as_dict()["paired_differences"]
    assert (differences["a"]["value"], differences["a"]["n"]) == (3.0, 2)
    assert "b" not in differences


def test_agents_that_report_nothing_are_apart_from_those_that_do():
    found = validated("hopper")
    assert len(found) >= 3 and {"ppo", "ppo-1", "none"} <= found.keys()
    for name, curve in found.items():
        assert load_objective(name).name == name
        assert curve.seeds and set(curve.seeds) <= set(VALIDATING), name
        assert curve.returns.shape == (len(curve.seeds), len(full_size("hopper").curves[0].steps))
    assert validated("walker2d") == {} and validated("Pendulum-v1") == {}
