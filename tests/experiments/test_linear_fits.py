"""Searches under errors, noise and neither are told apart by what agents of their fits earn."""

import numpy as np
import pytest

from experiments import linear_fits as module
from experiments.claims import FAILS, HOLDS, UNDECIDED, UNTESTED
from scb.errors import UserError
from scb.files import packed_row

FIVE = range(20, 25)


def entry(seeds, ppo):
    """Searches whose PPO agents earn this in jittered contexts, give or take a little, and half of it in others."""
    little = np.linspace(-20.0, 20.0, 12)

    def found(level):
        return {
            "expert": 3000.0,
            "steps": 9,
            "returns": {
                contexts: {
                    "ppo": packed_row(level * share + little),
                    "td3": packed_row(2500 + little[:4]),
                }
                for contexts, share in zip(module.CONTEXTS, (0.5, 0.5, 1.0), strict=True)
            },
        }

    return {name: {str(s): found(x) for s in seeds} for name, x in ppo.items()}


def report(*seeds, **ppo):
    levels = {"no errors": 200.0, "noise": 600.0, "errors": 1500.0}
    levels |= {"errors, longer": 1600.0, "errors, longer, less normalized": 2000.0, **ppo}
    machine = {"cores": 1, "processor": "a processor"}
    settings = {"generations": 40, "ppo": 12, "td3": 4, "episodes": 3}
    return {"environments": {"hopper": entry(seeds, levels)}, "machine": machine, **settings}


def outcomes(found):
    return [x.outcome for x in module.EXPERIMENT.judged(found)]


def test_what_earns_agents_more_is_shown_by_five_searches():
    assert outcomes(report(*FIVE)) == [HOLDS] * 5
    # Errors earn less than noise in the same contexts, but more than noise had in contexts without jitter.
    assert outcomes(report(*FIVE, errors=500.0)) == [HOLDS, FAILS, HOLDS, HOLDS, HOLDS]
    less = {"errors, longer, less normalized": 1200.0}
    assert outcomes(report(*FIVE, **less)) == [HOLDS] * 4 + [FAILS]
    assert outcomes(report(*FIVE[:4])) == [UNDECIDED] * 5


def test_searches_are_paired_by_seed_in_whatever_order_they_ended():
    found = report(*FIVE)
    entry = found["environments"]["hopper"]
    for level, seed in enumerate(FIVE):
        for kind in entry.values():
            arms = kind[str(seed)]["returns"]
            arms["stretched and jittered"]["ppo"] = packed_row(np.full(12, 100.0 * level))
    before = [x.estimate for x in module.EXPERIMENT.judged(found)]
    entry["errors"] = dict(reversed(entry["errors"].items()))
    assert [x.estimate for x in module.EXPERIMENT.judged(found)] == before
    assert before[1].low == before[1].high == 0.0


def test_the_page_has_a_row_for_every_expert_and_contexts():
    page = module.EXPERIMENT.page(report(*FIVE))
    assert "| errors | stretched and jittered | 3000 | 1500 [" in page and page.count("| 5 |") == 15
    assert "| hopper | 40 generations of 64" in page and "12 agents of PPO and 4 of" in page
    assert "standing still earns 1000 |" in page
    assert "Shown: on hopper, PPO's agents earn more with errors and jitter than with noise" in page
    few = module.EXPERIMENT.page(report(1))
    assert "**Not shown yet: no difference whose interval decides.** *Errors*" in few
    worse = module.EXPERIMENT.page(report(*FIVE, errors=100.0))
    assert "Not so: on hopper, PPO's agents earn more with errors and jitter than" in worse
    assert "Not shown yet" not in worse


def test_an_interrupted_measurement_has_a_page_and_another_size_is_refused():
    found = report(*FIVE)
    del found["environments"]["hopper"]["errors"]
    assert "| errors | stretched and jittered" not in module.EXPERIMENT.page(found)
    assert outcomes(found) == [UNTESTED] * 4 + [HOLDS]
    (figure,) = module.EXPERIMENT.figures(found).values()
    assert len(figure.axes[0].get_xticks()) == 4
    with pytest.raises(UserError, match="measured with ppo 12, and 48 is asked for"):
        next(module.parts(module.Options(generations=40, ppo=48, td3=4), found))


def test_the_figure_has_an_interval_for_every_expert_and_contexts():
    (figure,) = module.EXPERIMENT.figures(report(*FIVE)).values()
    ppo, td3 = figure.axes
    # Agents, an interval and an estimate each; and what standing still earns.
    assert len(ppo.lines) == len(td3.lines) == 15 * 3 + 1


@pytest.mark.slow
def test_experts_are_found_and_agents_of_their_fits_judged(monkeypatch, small_agents):
    # Pendulum stands in for Brax, whose physics compile for long.
    monkeypatch.setattr(module, "EXPERTS", {"errors": module.EXPERTS["errors"]})
    options = module.Options(("Pendulum-v1",), seeds=1, generations=1, ppo=2, td3=1, episodes=1)
    found = {}
    module.EXPERIMENT.measure(options, found, lambda: None)
    (one,) = found["environments"]["Pendulum-v1"]["errors"].values()
    assert set(one["returns"]) == set(module.CONTEXTS)
    assert all(len(x["ppo"].split()) == 2 for x in one["returns"].values())
    again = {"environments": {"Pendulum-v1": {"errors": {"20": one}}}}
    monkeypatch.setattr(module, "_searched", lambda *_: pytest.fail("it is measured already"))
    module.EXPERIMENT.measure(options, again, lambda: None)
