"""The paper's lemma, checked by exact dynamic programming over random Markov decision processes.

    python -m experiments lemma

For every finite MDP M there is a contextual bandit B such that each policy that is optimal in B is
optimal in M: the reward is M's optimal Q-function, or any function with the same maximisers, and the
contexts are the states that an optimal policy of M visits. "Each" is the point: a bandit says
nothing about states that it never shows, and does not choose among actions that tie. So the policy
tested is drawn at random among B's optima, ties included, and acts at random where B shows nothing.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from experiments.claims import Claim
from experiments.harness import Experiment
from experiments.parts import InParts, Part
from experiments.reports import Report
from scb import plotting

Floats = NDArray[np.floating]
TIE = 1e-9  # below this, two values of an exact solution are equal
POLICIES = 20  # optimal policies drawn of every bandit


@dataclass(frozen=True)
class MDP:
    """A finite MDP: [S, A, S] transition probabilities, [S, A] rewards, [S] start distribution, discount."""

    transition: Floats
    reward: Floats
    start: Floats
    discount: float

    def values(self, policy: Floats) -> Floats:
        """[S] values of a stochastic policy [S, A]: the Bellman equation, solved."""
        transition = np.einsum("sa,sat->st", policy, self.transition)
        reward = np.einsum("sa,sa->s", policy, self.reward)
        identity = np.eye(len(self.start))
        return np.linalg.solve(identity - self.discount * transition, reward)

    def q(self, values: Floats) -> Floats:
        """[S, A] action values, given the values of what follows."""
        following: Floats = np.einsum("sat,t->sa", self.transition, values)
        return self.reward + self.discount * following

    def optimal_q(self) -> Floats:
        """[S, A] by policy iteration, which ends after finitely many steps at an exact solution."""
        choice = np.zeros(len(self.start), int)
        while True:
            q = self.q(self.values(one_hot(choice, self.reward.shape[1])))
            # Only a strict improvement counts: otherwise tied actions could take turns for ever.
            better = q.max(axis=1) > np.take_along_axis(q, choice[:, None], 1)[:, 0] + TIE
            if not better.any():
                return q
            choice = np.where(better, q.argmax(axis=1), choice)

    def visited(self, policy: Floats) -> NDArray[np.bool_]:
        """[S] the states that a policy can reach from the start distribution."""
        reached = self.start > 0
        step = np.einsum("sa,sat->st", policy, self.transition) > 0
        for _ in range(len(self.start)):
            reached = reached | (step[reached].any(axis=0))
        return reached


def one_hot(choice: NDArray[np.integer], size: int) -> Floats:
    """[S] -> [S, size]."""
    return np.eye(size)[choice]


def random_mdp(rng: np.random.Generator, states: int, actions: int) -> MDP:
    """Sparse transitions, so that some states are never visited; actions that tie for the best and lead elsewhere."""
    transition = np.zeros((states, actions, states))
    for s in range(states):
        for a in range(actions):
            successors = rng.choice(states, size=min(2, states), replace=False)
            transition[s, a, successors] = rng.dirichlet(np.ones(len(successors)))
    start = np.zeros(states)
    start[rng.choice(states, size=max(1, states // 5), replace=False)] = 1.0
    reward, discount = rng.normal(size=(states, actions)), float(rng.uniform(0.5, 0.99))
    mdp = MDP(transition, reward, start / start.sum(), discount)
    q = mdp.optimal_q()
    # A reward that makes another action as good as the best leaves the optimal values as they are.
    tied = np.flatnonzero(rng.random(states) < 0.3)
    other = (q.argmax(axis=1) + rng.integers(1, actions, size=states)) % actions
    reward = reward.copy()
    reward[tied, other[tied]] += (q.max(axis=1) - q[np.arange(states), other])[tied]
    return replace(mdp, reward=reward)


# What the bandit's reward may be: the same maximisers as Q* in three forms, and two that the lemma does
# not cover.
REWARDS: dict[str, Callable[[MDP, Floats], Floats]] = {
    "Q*": lambda mdp, q: q,
    "Q* - max Q*": lambda mdp, q: q - q.max(axis=1, keepdims=True),
    "1 where a = a*": lambda mdp, q: one_hot(q.argmax(axis=1), q.shape[1]),
    "immediate reward": lambda mdp, q: mdp.reward,
    "Q of the random policy": lambda mdp, q: mdp.q(mdp.values(np.full(q.shape, 1 / q.shape[1]))),
}
COVERED = ("Q*", "Q* - max Q*", "1 where a = a*")
ONE, ANY, EVERY, HALF = CONTEXTS = (
    "visited by one optimal policy",
    "visited by any optimal policy",
    "every state",
    "half of those that one visits",
)


def optimal_in_bandit(rng: np.random.Generator, reward: Floats, shown: NDArray[np.bool_]) -> Floats:
    """[S, A] one of the bandit's optimal policies: random among tied actions, anything where it shows nothing."""
    best = reward >= reward.max(axis=1, keepdims=True) - TIE
    allowed = np.where(shown[:, None], best, True)
    weights = rng.dirichlet(np.ones(reward.shape[1]), size=len(reward)) * allowed
    return weights / weights.sum(axis=1, keepdims=True)


def regret(
    mdp: MDP, construction: str, contexts: str, rng: np.random.Generator, policies: int
) -> float:
    """How much the worst of the bandit's optimal policies that were drawn loses in the MDP."""
    q = mdp.optimal_q()
    best = mdp.start @ q.max(axis=1)
    reward = REWARDS[construction](mdp, q)
    shown = mdp.visited(one_hot(q.argmax(axis=1), q.shape[1]))
    if contexts == ANY:
        shown = mdp.visited((q >= q.max(axis=1, keepdims=True) - TIE).astype(float))
    elif contexts == EVERY:
        shown = np.ones_like(shown)
    elif contexts == HALF:
        states = np.flatnonzero(shown)
        hidden = rng.choice(states, size=max(1, len(states) // 2), replace=False)
        shown = shown.copy()
        shown[hidden] = False
    found = [mdp.start @ mdp.values(optimal_in_bandit(rng, reward, shown)) for _ in range(policies)]
    return float(best - min(found))


def parts(plan: Mapping[str, Any], report: dict[str, Any]) -> Iterator[Part]:
    """Every construction with every set of contexts."""
    report["mdps"], report["policies"] = plan["mdps"], POLICIES
    for construction in REWARDS:
        for contexts in CONTEXTS:
            path = ("regrets", f"{construction} | {contexts}")
            yield Part(path, partial(_regrets, construction, contexts, plan))


measure = InParts(parts)


def _regrets(construction: str, contexts: str, plan: Mapping[str, Any]) -> dict[str, float]:
    """Over random MDPs, the same for each, however many numbers their policies take."""
    regrets = []
    for number in range(plan["mdps"]):
        rng, rng_policies = np.random.default_rng([plan["seed"], number]).spawn(2)
        states, actions = int(rng.integers(3, 30)), int(rng.integers(2, 6))
        mdp = random_mdp(rng, states, actions)
        regrets.append(regret(mdp, construction, contexts, rng_policies, POLICIES))
    return {"optimal": float(np.mean(np.asarray(regrets) < 1e-6)), "largest": max(regrets)}


def claims(report: Report) -> list[Claim]:
    """Every bandit has the MDP's optima that shows every optimal policy's states, or singles one out."""
    found = report["regrets"]
    enough = [f"{c} | {x}" for c in COVERED for x in (ANY, EVERY)] + [f"1 where a = a* | {ONE}"]
    text = "every bandit that shows every optimal policy's states, or singles one out, has the MDP's optima"
    return [Claim(text, all(found[x]["optimal"] == 1.0 for x in enough))]


def draw(report: Mapping[str, Any]) -> Figure:
    """The share of MDPs where every optimum of the bandit is optimal."""
    found = report["regrets"]
    palette = (plotting.VERMILLION, plotting.BLUE, plotting.GREEN, plotting.GREY)
    colors = dict(zip(CONTEXTS, palette, strict=True))
    figure = Figure(figsize=(plotting.WIDTH, 4.6))
    axes = figure.subplots()
    for i, contexts in enumerate(CONTEXTS):
        shares = [found[f"{c} | {contexts}"]["optimal"] for c in REWARDS]
        positions = np.arange(len(REWARDS)) + (i - 1.5) * 0.2
        axes.barh(positions, shares, height=0.18, color=colors[contexts], label=contexts)
        for x, y in zip(shares, positions, strict=True):
            axes.text(x + 0.01, y, f"{x:.1%}", va="center", fontsize=7)
    plotting.name_rows(axes, REWARDS)
    axes.set_xlim(0, 1.1)
    axes.set_xlabel("share of MDPs where every optimal policy of the bandit is optimal")
    plotting.figure_title(figure, f"The lemma on {report['mdps']:,} random MDPs")
    handles, names = axes.get_legend_handles_labels()
    plotting.legend_below(figure, (handles, [f"contexts: {n}" for n in names]), columns=2)
    return figure


EXPERIMENT = Experiment.of_the_paper("lemma", measure, draw, claims)
