import numpy as np
import pytest

from experiments import lemma
from experiments.lemma import ANY, EVERY, HALF, MDP, ONE


def corridor() -> MDP:
    """Three states in a row, worth 1 at the right end: left, right; starts at the left; discount 0.5."""
    transition = np.zeros((3, 2, 3))
    for s in range(3):
        transition[s, 0, max(0, s - 1)] = 1.0
        transition[s, 1, min(2, s + 1)] = 1.0
    reward = np.zeros((3, 2))
    reward[2, 1] = 1.0
    return MDP(transition, reward, np.array([1.0, 0.0, 0.0]), 0.5)


def test_values_of_a_corridor_worked_out_by_hand():
    # Always right: 1 + 0.5 + 0.25 + ... = 2 at the right end, halved with every step away from it.
    q = corridor().optimal_q()
    np.testing.assert_allclose(q.max(axis=1), [0.5, 1.0, 2.0])
    np.testing.assert_allclose(q[:, 0], [0.25, 0.25, 0.5])
    right = lemma.one_hot(np.array([1, 1, 1]), 2)
    np.testing.assert_array_equal(corridor().visited(right), [True, True, True])
    left = lemma.one_hot(np.array([0, 1, 1]), 2)
    np.testing.assert_array_equal(corridor().visited(left), [True, False, False])


@pytest.mark.parametrize("construction", lemma.COVERED)
def test_the_bandit_of_a_corridor_has_its_optimum(construction):
    rng = np.random.default_rng(0)
    for contexts in (ONE, ANY, EVERY):
        assert abs(lemma.regret(corridor(), construction, contexts, rng, 10)) < 1e-9


def test_a_bandit_that_hides_states_or_rewards_the_moment_loses():
    rng = np.random.default_rng(0)
    assert lemma.regret(corridor(), "Q*", HALF, rng, 20) > 0.01
    # Every action is worth the same at once but at the right end, so the policy dawdles.
    assert lemma.regret(corridor(), "immediate reward", EVERY, rng, 20) > 0.01


def test_a_tied_action_leads_where_the_bandit_shows_nothing():
    # From 0 both actions are worth the same; 0 -> 1 -> end by action 0, 0 -> 2 -> end by action 1.
    transition = np.zeros((4, 2, 4))
    transition[0, 0, 1] = transition[0, 1, 2] = 1.0
    transition[1:, :, 3] = 1.0
    reward = np.zeros((4, 2))
    reward[1], reward[2] = (1.0, 0.0), (1.0, 0.0)
    mdp = MDP(transition, reward, np.array([1.0, 0, 0, 0]), 0.9)
    rng = np.random.default_rng(0)
    assert lemma.regret(mdp, "Q*", ONE, rng, 50) > 0.1
    assert abs(lemma.regret(mdp, "Q*", ANY, rng, 50)) < 1e-9
    assert abs(lemma.regret(mdp, "1 where a = a*", ONE, rng, 50)) < 1e-9


def test_random_mdps_have_ties_for_the_best_action_that_lead_elsewhere():
    ties = 0
    for seed in range(10):
        mdp = lemma.random_mdp(np.random.default_rng(seed), 12, 4)
        np.testing.assert_allclose(mdp.transition.sum(axis=2), 1.0)
        q = mdp.optimal_q()
        best = q >= q.max(axis=1, keepdims=True) - lemma.TIE
        for s in np.flatnonzero(best.sum(axis=1) > 1):
            first, second = np.flatnonzero(best[s])[:2]
            ties += not np.array_equal(mdp.transition[s, first], mdp.transition[s, second])
    assert ties > 10


def test_the_experiment_finds_the_lemma_and_its_gap(tmp_path):
    report = {}
    lemma.measure({"mdps": 12, "seed": 1}, report, lambda: None)
    regrets = report["regrets"]
    for construction in lemma.COVERED:
        for contexts in (ANY, EVERY):
            assert regrets[f"{construction} | {contexts}"]["optimal"] == 1.0
    assert regrets[f"1 where a = a* | {ONE}"]["optimal"] == 1.0
    assert regrets[f"Q* | {ONE}"]["optimal"] < 1.0
    assert regrets[f"immediate reward | {EVERY}"]["optimal"] < 0.6
    (judged,) = lemma.EXPERIMENT.judged(report)
    assert judged.outcome == "holds"
    assert ", all of 20 policies" in lemma.EXPERIMENT.block("verdict", report)
    regrets[f"Q* | {EVERY}"]["optimal"] = 0.9
    (judged,) = lemma.EXPERIMENT.judged(report)
    assert judged.outcome == "does not hold"
    assert ", not all of 20" in lemma.EXPERIMENT.block("verdict", report)
    assert "immediate reward" in lemma.EXPERIMENT.block("body", report)
    assert len(lemma.draw(report).axes[0].patches) == len(regrets)


def test_every_construction_and_set_of_contexts_meets_the_same_mdps(monkeypatch):
    met = []

    def drawing(mdp, construction, contexts, rng, policies):
        met.append(mdp.reward)
        rng.random(len(met))  # as different policies take different numbers
        return 0.0

    monkeypatch.setattr(lemma, "regret", drawing)
    lemma.measure({"mdps": 3, "seed": 1}, {}, lambda: None)
    assert len(met) == 3 * len(lemma.REWARDS) * len(lemma.CONTEXTS)
    for i, reward in enumerate(met):
        np.testing.assert_array_equal(reward, met[i % 3])
    assert met[0].shape != met[1].shape or not np.array_equal(met[0], met[1])
