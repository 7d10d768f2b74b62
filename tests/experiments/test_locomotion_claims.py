"""Claims on locomotion that were stated first are decided by their own agents, once, when all are there."""

import json

import numpy as np
import pytest

from experiments import claims, locomotion_claims
from experiments import locomotion as module
from lpo import full_size
from tests.experiments.hoppers import report


def shown(made):
    """The lines of the page's first table."""
    page = module.EXPERIMENT.page(made)
    assert page.index("stated first, and confirmed") < page.index("![Learning curves")
    return page.partition("![Learning curves")[0].splitlines()


def test_a_confirmation_is_decided_by_its_own_agents_when_all_are_there(monkeypatch):
    asked = full_size.Confirmation("hopper", "dpo", range(4, 14))
    monkeypatch.setattr(full_size, "CONFIRMATIONS", (asked,))
    made = report(13)
    for seed in range(4):  # which say the opposite, and are not asked
        made["environments"]["hopper"]["agents"]["dpo"][str(seed)]["returns"] = "0 0 -9000"
    assert locomotion_claims.confirmed(made) == [(asked, 9, None)]
    assert "9 of 10 pairs are trained" in module.EXPERIMENT.page(made)
    # Until then they are in nothing else: of the seeds 0 to 3 the difference is below.
    assert [len(c.seeds) for c in module.facts(made)["comparisons"]["hopper"].curves] == [4, 4, 13]
    assert {x.estimate.n for x in claims.judge(locomotion_claims.claims(made)) if x.estimate} == {4}
    monkeypatch.setattr(full_size, "_kept", lambda: made)
    assert [len(c.seeds) for c in full_size.full_size("hopper").curves] == [4, 4, 13]
    more = report(14)["environments"]["hopper"]["agents"]
    for name, agents in made["environments"]["hopper"]["agents"].items():
        agents["13"] = more[name]["13"]
    ((_, pairs, judged),) = locomotion_claims.confirmed(made)
    assert (pairs, judged.outcome) == (10, claims.HOLDS)
    assert "| +100 [100, 100] | −5 | confirmed |" in module.EXPERIMENT.page(made)
    made["environments"]["hopper"]["agents"].pop("dpo")
    assert locomotion_claims.confirmed(made) == []


def test_where_all_agents_wait_for_a_claim_the_page_says_so(monkeypatch, tmp_path):
    asked = full_size.Confirmation("hopper", "dpo", range(20), "area")
    monkeypatch.setattr(full_size, "CONFIRMATIONS", (asked,))
    made = report(13)
    assert module.EXPERIMENT.pages(made).keys() == {"locomotion"}
    assert "**Nothing is compared yet**" in module.EXPERIMENT.page(made)
    (tmp_path / "report.json").write_text(json.dumps({"experiment": "locomotion", **made}))
    flags = [f"--out={tmp_path / 'report.json'}", "--only-render"]
    assert module.EXPERIMENT.main(flags) == 0


def test_what_pairs_say_that_were_trained_after_a_claim_stands_beside_it(monkeypatch):
    asked = full_size.Confirmation("hopper", "dpo", range(4, 14), "area")
    made = report(23)
    assert locomotion_claims.since(made, asked) is None  # nine are too few
    made = report(24)
    seeds, found = locomotion_claims.since(made, asked)
    assert seeds == list(range(14, 24))
    # (200 - 100) / 2 over the second half of the training.
    assert found.value == pytest.approx(50.0)


def test_what_only_all_pairs_together_show_is_not_said_to_be_shown(monkeypatch):
    asked = full_size.Confirmation("hopper", "dpo", range(30, 40), "area")
    monkeypatch.setattr(full_size, "CONFIRMATIONS", (asked,))
    made = report(40)
    agents = made["environments"]["hopper"]["agents"]
    row = "dpo earns more over the training"
    known = "ends no lower than PPO; earns no less over the last quarter than PPO"
    assert f"| hopper: dpo | earns more over the training than PPO | {known} |  |" in shown(made)
    for seed in asked.seeds:  # the new pairs are level
        agents["dpo"][str(seed)] = agents["ppo"][str(seed)]
    page = module.EXPERIMENT.page(made)
    assert f"| hopper: dpo |  | {known} |  |" in shown(made)
    assert "all pairs together have an interval above: dpo on hopper earns more over the" in page
    (line,) = [x for x in page.splitlines() if x.startswith("| hopper: dpo | 40 |")]
    assert line.endswith(" not confirmed |") and line.count("**") == 2 * 2
    (stated,) = [x for x in page.splitlines() if x.startswith(f"| hopper: {row}")]
    assert "| not confirmed: " in stated


def test_what_is_shown_stands_in_one_table_whether_it_was_stated_first_or_not(monkeypatch):
    monkeypatch.setattr(full_size, "CONFIRMATIONS", ())
    said = ["ends no lower", "earns no less over the last quarter", "earns more over the training"]
    words = "; ".join(f"{x} than PPO" for x in said)
    lines = shown(report(10))
    assert lines[2].startswith(
        "**By all pairs together, and not stated first, this is shown:** PPO"
    )
    assert lines[-3:-1] == [
        f"| hopper: dpo |  | {words} |  |",
        f"| hopper: lpo-pendulum |  |  | {words} |",
    ]
    level = report(10)
    agents = level["environments"]["hopper"]["agents"]
    agents["dpo"] = agents["lpo-pendulum"] = {
        seed: agents["ppo"][str(9 - int(seed))] for seed in agents["ppo"]
    }
    page = module.EXPERIMENT.page(level)
    assert "**Not shown: no objective is shown to differ from PPO's clip, by 10 agents" in page
    assert "stated first, and confirmed" not in page


def test_a_claim_stated_of_another_rate_is_of_its_agents_alone(monkeypatch):
    asked = full_size.Confirmation("hopper at 0.0005", "dpo", range(10), "area")
    monkeypatch.setattr(full_size, "CONFIRMATIONS", (asked,))
    made = report(13)
    assert locomotion_claims.confirmed(made) == []
    entry = {**report(9)["environments"]["hopper"], "environment": "hopper"}
    made["environments"]["hopper at 0.0005"] = {
        **entry,
        "hyperparameters": {"learning_rate": 0.0005},
    }
    assert [pairs for _, pairs, _ in locomotion_claims.confirmed(made)] == [9]
    # Without PPO's agents there is nothing that others could be compared with.
    assert [*module.facts(made)["comparisons"]] == ["hopper"]
    entry["agents"].update(report(10)["environments"]["hopper"]["agents"])
    ((_, pairs, judged),) = locomotion_claims.confirmed(made)
    assert (pairs, judged.outcome) == (10, claims.HOLDS)
    assert judged.claim.text == "hopper at 0.0005: dpo earns more over the training than PPO"


def test_of_a_pending_confirmation_whose_reference_was_known_the_objective_alone_is_left_out(
    monkeypatch,
):
    asked = full_size.Confirmation(
        "hopper", "dpo", range(4, 14), "late", known="ppo", suggested="seen"
    )
    monkeypatch.setattr(full_size, "CONFIRMATIONS", (asked,))
    made = report(13)
    counts = {c.objective: len(c.seeds) for c in module.facts(made)["comparisons"]["hopper"].curves}
    assert counts == {"ppo": 13, "dpo": 4, "lpo-pendulum": 13}
    row = "| hopper: dpo earns no less over the last quarter than PPO | seen | 10, seeds 4 to 13; ppo known before | "
    assert row in module.EXPERIMENT.page(made)


def test_what_was_known_before_is_one_of_both():
    with pytest.raises(ValueError, match="known is one of both objectives, or None"):
        full_size.Confirmation("hopper", "ta-lpo", range(4, 14), "area", "dpo", known="ppo")


def test_a_confirmation_may_ask_of_the_clip_beside_another(monkeypatch):
    asked = full_size.Confirmation("hopper", "ppo", range(4, 14), "area", "dpo")
    monkeypatch.setattr(full_size, "CONFIRMATIONS", (asked,))
    ((_, _, judged),) = locomotion_claims.confirmed(report(14))
    assert judged.claim.text == "hopper: ppo earns more over the training than dpo"
    assert (
        judged.estimate.value < 0 and judged.outcome == claims.FAILS
    )  # dpo has more in the report


def test_a_confirmation_has_a_reference_of_its_own(monkeypatch):
    asked = full_size.Confirmation(
        "hopper", "lpo-pendulum", range(4, 14), "late", "dpo", "lpo-pendulum"
    )
    monkeypatch.setattr(full_size, "CONFIRMATIONS", (asked,))
    made = report(13)
    counts = {c.objective: len(c.seeds) for c in module.facts(made)["comparisons"]["hopper"].curves}
    assert counts == {"ppo": 13, "dpo": 4, "lpo-pendulum": 13}
    made = report(14)
    ((_, pairs, judged),) = locomotion_claims.confirmed(made)
    agents = made["environments"]["hopper"]["agents"]
    ours, theirs = (
        [float(agents[name][str(seed)]["returns"].split()[-1]) for seed in asked.seeds]
        for name in ("lpo-pendulum", "dpo")
    )
    assert pairs == 10 and judged.claim.text == (
        "hopper: lpo-pendulum earns no less over the last quarter than dpo"
    )
    assert judged.estimate.value == pytest.approx(np.subtract(ours, theirs).mean())
    assert "a twentieth of what dpo earns" in judged.claim.reason
    row = "than dpo |  | 10, seeds 4 to 13; lpo-pendulum known before | "
    assert row in module.EXPERIMENT.page(made)
    for agents in made["environments"]["hopper"]["agents"]["lpo-pendulum"].values():
        agents["returns"] = "0 50 9000"
    page = module.EXPERIMENT.page(made)
    said = "| hopper: lpo-pendulum | earns no less over the last quarter than dpo | "
    assert sum(line.startswith(said) for line in shown(made)) == 1
    verdict = "**In part: of the claims that were stated first 1 of 1 are confirmed.** PPO has"
    assert verdict in page


def test_a_lead_that_is_asked_of_one_objective_alone_has_no_margin_and_stands_beside_what_is_asked_of_all(
    monkeypatch,
):
    asked = full_size.Confirmation("hopper", "lpo-pendulum", range(4, 14), "late lead")
    monkeypatch.setattr(full_size, "CONFIRMATIONS", (asked,))
    made = report(14)
    for agents in made["environments"]["hopper"]["agents"]["lpo-pendulum"].values():
        agents["returns"] = "0 50 9000"
    ((_, _, judged),) = locomotion_claims.confirmed(made)
    assert judged.claim.least == 0 and judged.estimate.low > 0
    (row,) = [line for line in shown(made) if line.startswith("| hopper: lpo-pendulum | ")]
    # Who earns more earns no less, which is not said again.
    stated, pooled = row.split(" | ")[1:3]
    assert stated == "earns more over the last quarter than PPO"
    assert "ends no lower" in pooled and "last quarter" not in pooled
    texts = {claim.text for claim in locomotion_claims.claims(made)}
    assert not any("more over the last quarter" in text for text in texts)


def test_a_confirmation_may_ask_of_agents_that_were_trained_otherwise(monkeypatch):
    other = "hopper at 0.001, annealed"
    asked = full_size.Confirmation(
        "hopper", "dpo", range(4, 14), "area", known="dpo", reference_in=other
    )
    assert asked.trained == [(other, "ppo")]
    monkeypatch.setattr(full_size, "CONFIRMATIONS", (asked,))
    made = report(20)
    assert locomotion_claims.confirmed(made) == []  # nothing there to hold it against
    entry = {**report(13)["environments"]["hopper"], "environment": "hopper"}
    made["environments"][other] = {**entry, "hyperparameters": {"learning_rate": 0.001}}
    assert [pairs for _, pairs, _ in locomotion_claims.confirmed(made)] == [9]
    # The agents that wait are those of the reference, where it is trained, and no others.
    left = full_size.looked_at(made)
    counts = {
        name: {objective: len(agents) for objective, agents in x["agents"].items()}
        for name, x in left.items()
    }
    assert counts["hopper"] == {"ppo": 20, "dpo": 20, "lpo-pendulum": 20}
    assert counts[other] == {"ppo": 4, "dpo": 13, "lpo-pendulum": 13}
    for agent in entry["agents"]["ppo"].values():
        agent["returns"] = "0 50 190"
    entry["agents"]["ppo"]["13"] = entry["agents"]["ppo"]["12"]
    ((_, pairs, judged),) = locomotion_claims.confirmed(made)
    # dpo's end at 200 and the seed's last digit, in the second of two evaluations.
    expected = np.mean([(200 + seed % 10 - 190) / 2 for seed in asked.seeds])
    assert pairs == 10 and judged.estimate.value == pytest.approx(expected)
    assert judged.claim.text == f"hopper: dpo earns more over the training than PPO on {other}"
    assert f"| hopper: dpo earns more over the training than PPO on {other} |" in (
        module.EXPERIMENT.page(made)
    )
    assert locomotion_claims.since(made, asked) is None  # of the reference there are no more
    entry["agents"]["ppo"] |= {str(s): entry["agents"]["ppo"]["12"] for s in range(14, 24)}
    assert locomotion_claims.since(made, asked) is None  # nor of six both
    made["environments"]["hopper"]["agents"]["dpo"] |= {
        str(s): made["environments"]["hopper"]["agents"]["dpo"]["12"] for s in range(20, 24)
    }
    seeds, later = locomotion_claims.since(made, asked)
    assert seeds == list(range(14, 24)) and later.value > 0
