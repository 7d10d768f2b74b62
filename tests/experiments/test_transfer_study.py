"""The transfer study's variations are commands that exist, and its page says what was measured."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from experiments import transfer_study as module
from experiments.searches import meta_training
from lpo.objectives import load_objective
from scb.errors import UserError
from scb.statistics import estimate


def test_every_variation_is_a_meta_training_that_differs_from_the_default():
    configs = {
        name: meta_training(module.settings_of(name, 0, 30, 32)).config
        for name in module.VARIATIONS
    }
    default = configs.pop("default")
    assert all(config != default for config in configs.values())
    assert len({repr(config) for config in configs.values()}) == len(configs)


@pytest.fixture
def report():
    names = [e.name for e in module.EVALUATIONS]

    def returns(**values):
        agents = {seed: [v, v + 1.0, v + 2.0, v + 3.0] for seed, v in values.items()}
        return {name: {seed.strip("_"): x for seed, x in agents.items()} for name in names}

    return {
        "searches": {"generations": 30, "population_size": 32},
        "evaluations": [module.asdict(e) for e in module.EVALUATIONS],
        "machine": {"cores": 2, "processor": "a processor"},
        "objectives": {
            "ppo": {"returns": returns(**{module.NO_SEARCH: -500.0})},
            "default": {
                "returns": returns(_0=-200.0, _1=-220.0),
                "seconds": 120.0,
                "command": "lpo meta-train",
            },
            "no reward noise": {
                "returns": returns(_0=-700.0, _2=-700.0),
                "seconds": 90.0,
                "command": "lpo meta-train --reward-noise=0.0",
            },
        },
    }


def test_the_page_says_returns_and_differences(report):
    page = module.EXPERIMENT.page(report)
    lines = [line for line in page.splitlines() if line.startswith("| no reward noise |")]
    row, difference, _ = lines
    # The search of seed 2 has no counterpart; the difference is that of seed 0, and one search has no interval.
    assert difference == "| no reward noise | \u2212500 | \u2212500 | \u2212500.00 |"
    assert row.endswith("| 2 | 1.5 |")
    assert "| no reward noise | `lpo meta-train --reward-noise=0.0` |" in page
    assert (
        "| shown to be worse, references included | none | none |" in page
    )  # of two searches of the default
    (figure,) = module.EXPERIMENT.figures(report).values()
    assert len(figure.axes) == len(module.EVALUATIONS)


def test_one_search_decides_nothing_and_several_do(report):
    entries = report["objectives"]
    entries["no gate"] = {"returns": {}, "command": "", "seconds": 1.0}
    for evaluation in entries["default"]["returns"]:
        entries["no gate"]["returns"][evaluation] = {"0": [-9000.0] * 4}
    found = module.facts(report)
    assert not found["worse"]
    for name, level in (("no gate", -9000.0), ("default", -200.0)):
        for returns in entries[name]["returns"].values():
            returns |= {str(seed): [level - seed] * 4 for seed in range(5)}
    found = module.facts(report)
    places = [e["name"] for e in report["evaluations"]]
    assert found["worse"] == {place: ["ppo", "no gate"] for place in places}
    # Two searches without noise are none that decide, and a reference is no variation.
    assert found["behind"] == {place: ["no gate"] for place in places}
    said = (
        "**Behind the default end, by their whole intervals over 5 searches of either: no gate on P"
    )
    assert said in module.EXPERIMENT.page(report)


def test_what_an_earlier_search_found_is_measured_again(tmp_path, monkeypatch, report):
    # As after a change of the library: seed 0 finds another objective than the report's, and seed 1 the same.
    asked = []
    entry = report["objectives"]["default"] | {"digests": {"0": "before", "1": "now"}}
    report["objectives"]["default"] = entry
    del entry["returns"]["Pendulum"]
    learned = {"command": "lpo meta-train", "seconds": 1.0}
    monkeypatch.setattr(
        module,
        "_learned",
        lambda name, seed, _: (None, {**learned, "digests": {str(seed): "now"}}),
    )
    monkeypatch.setattr(
        module, "_earned", lambda objective, place, at, _: asked.append(at.name) or np.zeros(2)
    )
    monkeypatch.setattr(module, "REFERENCES", ())
    for wrong, message in ((-1,), "a seed is -1"), ((), "no seeds: give at least one"):
        with pytest.raises(UserError, match=message):
            module.Options(meta_seeds=wrong)
    options = module.Options(variations=("default",), meta_seeds=(0, 1))
    for part in module.parts(options, report):
        part.add(part.measured(), report)
    everywhere = [e.name for e in module.EVALUATIONS for _ in e.environments]
    assert asked == [*everywhere, "Pendulum"]
    small = entry["returns"]["Pendulum, small last layer"]
    assert small["0"] == [0.0, 0.0] and small["1"][0] == -220.0
    assert entry["digests"] == {"0": "now", "1": "now"}


def test_objectives_of_one_name_have_rows_of_their_own(tmp_path, monkeypatch):
    kept = []

    def compared(*arguments, rows, **named):
        kept.append(rows.path.name)
        return SimpleNamespace(curves=[SimpleNamespace(final=np.zeros(2))])

    monkeypatch.setattr(module, "compare", compared)
    at, options = module.EVALUATIONS[0], module.Options(runs=tmp_path)
    for digest in ("a" * 64, "b" * 64):
        found = replace(load_objective("ppo"), name="default-0", metadata={"sha256": digest})
        module._earned(found, "Pendulum-v1", at, options)
    module._earned(load_objective("ppo"), "Pendulum-v1", at, options)
    assert kept == [
        "default-0-aaaaaaaa-Pendulum-v1.rows.jsonl",
        "default-0-bbbbbbbb-Pendulum-v1.rows.jsonl",
        "ppo-Pendulum-v1.rows.jsonl",
    ]


def test_a_references_agents_are_one_set_however_many_searches_it_is_compared_with():
    # Searches that hardly scatter, so that the reference's 20 agents make the interval: as wide as theirs alone.
    # Copies of the 20 for each search would count as 60, in an interval of three fifths.
    generator = np.random.default_rng(0)
    agents = generator.normal(-900.0, 300.0, 20)
    searches = {str(seed): [float(-200 - i / 100) for i in range(20)] for seed in range(5)}
    report = {
        "objectives": {
            "ppo": {"returns": {"Pendulum": {"-": agents.tolist()}}},
            "default": {"returns": {"Pendulum": searches}},
        }
    }
    found, alone = module.difference(report, "ppo", "Pendulum")(), estimate(agents)
    assert found.value == pytest.approx(alone.value + 200, abs=1) and found.n == 20
    assert found.high - found.low > 0.9 * (alone.high - alone.low)
