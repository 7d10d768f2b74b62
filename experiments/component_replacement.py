"""What of Pendulum's bandit is needed: its reward and its contexts, each replaced by an expert's.

    python -m experiments component_replacement

Four ways to learn (the bandit's reward, online behavioural cloning of a SAC expert, its action as the
reward, its Q-function as the reward) on two distributions of states (the bandit's, the expert's). What
is learned depends on the expert, so there are several.
"""

from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from experiments.claims import OF_THE_WAY, TENTH, Claim, of_searches
from experiments.harness import Experiment, Save
from experiments.reports import Report, bandit_of, finite
from scb import plotting
from scb.agents.spec import bandit_agent
from scb.analysis import components
from scb.analysis.states import follow
from scb.judgement import judge
from scb.keys import key_at, root_key, split_key
from scb.measurement import Place
from scb.seeds import ILLUSTRATING, REPORTING
from scb.statistics import (
    Estimate,
    iqm,
    normalized_score,
    pooled_estimate,
)

ENVIRONMENT = "Pendulum-v1"
BANDIT, CLONING, ACTION, Q = REWARDS = (
    "reward of the bandit",
    "cloning the expert",
    "closeness to the expert's action",
    "Q of the expert",
)
SYNTHETIC, EXPERT = STATES = ("contexts of the bandit", "states of the expert")
# Every combination that an expert has a part in.
REPLACED = tuple((r, s) for r in REWARDS for s in STATES if (r, s) != (BANDIT, SYNTHETIC))
WITH = {
    BANDIT: "the bandit's reward",
    CLONING: "cloning",
    ACTION: "closeness to the expert's action",
}


def cell(reward: str, states: str) -> str:
    """The name of a combination in the report."""
    return f"{reward} | {states}"


def measure(plan: Mapping[str, Any], report: dict[str, Any], save: Save) -> None:
    """The bandit itself, then an expert at a time: each is trained again where the experiment goes on."""
    found = report.setdefault("experts", {})
    unfinished = [
        number
        for number in range(plan["experts"])
        if len(found.get(str(number), {}).get("returns", ())) < len(REPLACED)
    ]
    place = Place.named(ENVIRONMENT)
    env, env_params = place.env, place.params
    space = env.action_space(env_params)
    bandit, digest = bandit_of(ENVIRONMENT)
    spec = bandit_agent("ppo", ENVIRONMENT)
    key_random, key_experts = split_key(root_key(ILLUSTRATING.start))

    def counted(returns: Any) -> list[float]:
        """Two digits of each; what is no number counts as random actions'."""
        values, failed = finite(returns, place)
        report["failed"] = report.get("failed", 0) + failed
        return values

    def learn(reward: Any, states: Any) -> list[float]:
        """Returns of agents trained in the bandit with these parts replaced."""
        replaced = components.ReplacedBandit(bandit, reward, states)
        (returns,) = judge(
            spec,
            replaced,
            bandit.default_params.weights,
            place,
            REPORTING.start,
            plan["agents"],
            plan["episodes"],
            mode=True,
        ).values()
        return counted(returns)

    def imitate(expert: Any, states: Any) -> list[float]:
        """Returns of policies cloned from the expert in these states."""
        source = components.ReplacedBandit(bandit, states=states)
        key_draw, key_agents = split_key(root_key(REPORTING.start))
        returns = components.judge_cloning(
            expert,
            lambda key: source.reset_env(key, source.default_params)[0],
            env,
            env_params,
            key_agents,
            spec.sample(key_draw, plan["agents"]).learning_rate,
            plan["episodes"],
            spec.config.activation,
        )
        return counted(returns)

    if "bandit" not in report:
        random = follow(
            env, env_params, lambda _, key: space.sample(key), key_random, plan["expert_episodes"]
        )
        report["sha256"] = digest
        report["random"] = float(np.round(random.returns().mean(), 2))
        report["bandit"] = learn(None, None)
        save()
    for number in unfinished:
        key_train, key_follow, key_judge = split_key(key_at(key_experts, number), 3)
        expert = components.train_sac_expert(
            ENVIRONMENT, env, env_params, key_train, plan["candidates"]
        )
        visited = follow(env, env_params, expert.policy(), key_follow, plan["expert_episodes"])
        judged = follow(env, env_params, expert.policy(), key_judge, plan["expert_episodes"])
        entry = found.setdefault(str(number), {"returns": {}})
        entry["own"] = np.round(judged.returns(), 2).tolist()
        rewards = {
            BANDIT: None,
            ACTION: components.action_reward(expert, space),
            Q: components.q_reward(expert, space),
        }
        for reward, kind in REPLACED:
            name = cell(reward, kind)
            if name in entry["returns"]:
                continue
            states = None if kind == SYNTHETIC else jnp.asarray(visited.states())
            entry["returns"][name] = (
                imitate(expert, states) if reward == CLONING else learn(rewards[reward], states)
            )
            save()


def returns_of(report: Mapping[str, Any], reward: str, states: str) -> np.ndarray:
    """[experts, agents] of a combination; no expert has a part in the bandit itself."""
    if (reward, states) == (BANDIT, SYNTHETIC):
        return np.tile(report["bandit"], (len(report["experts"]), 1))
    return np.array([x["returns"][cell(reward, states)] for x in report["experts"].values()])


def scores_of(report: Mapping[str, Any], reward: str, states: str) -> np.ndarray:
    """[experts, agents] normalised scores: 0 is the random policy, 1 the agent's expert."""
    ceilings = np.array([[iqm(x["own"])] for x in report["experts"].values()])
    return normalized_score(returns_of(report, reward, states), report["random"], ceilings)


def claims(report: Report) -> list[Claim]:
    """Whether each way to learn needs the contexts, Q works badly, and the other two ways do as well."""

    def more(one: tuple[str, str], than: tuple[str, str]) -> Callable[..., Estimate] | Estimate:
        scores, others = (scores_of(report, *x) for x in (one, than))
        return of_searches(scores, others, paired=True)  # and of as few experts

    itself = (BANDIT, SYNTHETIC)
    return [
        *(
            Claim(
                f"with {WITH[r]}, contexts teach more than the expert's states",
                more((r, SYNTHETIC), (r, EXPERT)),
            )
            for r in WITH
        ),
        Claim(
            "the bandit's reward teaches more than the expert's Q-function",
            more(itself, (Q, SYNTHETIC)),
        ),
        *(
            Claim(
                f"{WITH[r]} teaches no less than the bandit's reward",
                more((r, SYNTHETIC), itself),
                0.0,
                TENTH,
                OF_THE_WAY,
            )
            for r in (CLONING, ACTION)
        ),
    ]


def facts(report: Report) -> dict[str, Any]:
    """Pooled returns and scores of every combination, and the scores expert by expert."""
    rows = {
        reward: {
            states: {
                "returns": pooled_estimate(returns_of(report, reward, states)),
                "score": pooled_estimate(scores := scores_of(report, reward, states)),
                "each": iqm(scores, axis=1).tolist(),
            }
            for states in STATES
        }
        for reward in REWARDS
    }
    return {
        "rows": rows,
        "own": [float(iqm(x["own"])) for x in report["experts"].values()],
    }


def draw(report: Mapping[str, Any]) -> Figure:
    """A line a combination: the score with its interval, each expert a dot."""
    number = len(report["experts"])
    looks = {
        SYNTHETIC: {"color": plotting.VERMILLION, "marker": "o", "linestyle": ""},
        EXPERT: {"color": plotting.BLUE, "marker": "o", "linestyle": ""},
    }
    figure = Figure(figsize=(plotting.WIDTH, 3.6))
    axes = figure.subplots()
    for i, reward in enumerate(REWARDS):
        for (states, look), offset in zip(looks.items(), (-0.15, 0.15), strict=True):
            scores = scores_of(report, reward, states)
            each, pooled = iqm(scores, axis=1), pooled_estimate(scores)
            plotting.estimate_row(axes, i + offset, each, pooled, look["color"])
    axes.axvline(1.0, color=plotting.BLACK, linestyle=":", linewidth=1.2)
    plotting.name_rows(axes, REWARDS)
    axes.set_xlabel("normalised score on Pendulum (0: random policy, 1: the SAC expert)")
    plotting.figure_title(
        figure,
        f"Learning in a bandit with replaced parts: {number} experts (dots), "
        f"{report['plan']['agents']} agents each",
    )
    plotting.legend_of(figure, looks, columns=2)
    return figure


EXPERIMENT = Experiment.of_the_paper("component_replacement", measure, draw, claims, facts=facts)
