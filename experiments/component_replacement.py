"""What of Pendulum's bandit is needed: its reward and its contexts, each replaced by an expert's.

    python -m experiments.component_replacement

Four ways to learn (the bandit's reward, online behavioural cloning of a SAC expert, its action as the
reward, its Q-function as the reward) on two distributions of states (the bandit's, the expert's). What
is learned depends on the expert, so there are several.
"""

import sys
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import scb
from experiments.page import Experiment, Save, finite, table, text
from experiments.page import main as run
from scb import plotting
from scb.agents.spec import bandit_agent
from scb.analysis import components
from scb.analysis.states import follow
from scb.discovery import SyntheticTraining, judge
from scb.environments.registry import environment_spec
from scb.environments.zoo import bandit_metadata, open_bandit
from scb.keys import key_at, root_key, split_key
from scb.seeds import ILLUSTRATING, REPORTING
from scb.statistics import iqm, normalized_score, pooled_estimate

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
    if not unfinished:
        return

    env, env_params = scb.make(ENVIRONMENT)
    space = env.action_space(env_params)
    bandit = open_bandit(environment_spec(ENVIRONMENT).bandit)
    spec = bandit_agent("ppo", ENVIRONMENT)
    key_random, key_experts = split_key(root_key(ILLUSTRATING.start))

    def counted(returns: Any) -> list[float]:
        """Two digits of each; what is no number counts as a random policy's."""
        values, failed = finite(returns, report["random"])
        report["failed"] = report.get("failed", 0) + failed
        return values

    def learn(reward: Any, states: Any) -> list[float]:
        """Returns of agents trained in the bandit with these parts replaced."""
        replaced = components.ReplacedBandit(bandit, reward, states)
        training = SyntheticTraining(replaced, env, env_params, spec)
        weights = bandit.default_params.weights
        (returns,) = judge(
            training, weights, REPORTING.start, plan["agents"], plan["episodes"], mode=True
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
        report["sha256"] = bandit_metadata(bandit.name)["sha256"]
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


def _less(report: Mapping[str, Any], combination: tuple[str, str], than: tuple[str, str]) -> bool:
    """Whether agents clearly earn less: the paired difference's interval lies below zero."""
    difference = pooled_estimate(
        scores_of(report, *combination), scores_of(report, *than), paired_groups=True
    )
    return difference.high is not None and difference.high < 0


def parts(report: Mapping[str, Any]) -> list[bool]:
    """Whether each way to learn needs the contexts, Q works badly, and the other two ways do as well."""
    itself = (BANDIT, SYNTHETIC)
    return [
        *(_less(report, (r, EXPERT), (r, SYNTHETIC)) for r in (BANDIT, CLONING, ACTION)),
        _less(report, (Q, SYNTHETIC), itself),
        *(not _less(report, (r, SYNTHETIC), itself) for r in (CLONING, ACTION)),
    ]


def verdict(report: Mapping[str, Any]) -> str:
    """Each part of the claim, with its figures."""

    def of(reward: str, states: str) -> str:
        return text(pooled_estimate(scores_of(report, reward, states)), 2)

    ways = (BANDIT, CLONING, ACTION)
    *needed, q_is_less, cloning_is_as_good, closeness_is_as_good = parts(report)
    needing = [r for r, needs in zip(ways, needed, strict=True) if needs]
    return (
        f"Normalised scores (0 a random policy, 1 the expert) with {len(report['experts'])} experts; intervals over "
        "experts and agents. On the expert's states instead of the bandit's contexts: "
        + ", ".join(f"{of(r, EXPERT)} instead of {of(r, SYNTHETIC)} with {WITH[r]}" for r in ways)
        + "; "
        + (
            "clearly less with each of them. "
            if len(needing) == 3
            else f"clearly less with {' and '.join(WITH[r] for r in needing)} only. "
            if needing
            else "clearly less with none of them. "
        )
        + f"The expert's Q-function as the reward gives {of(Q, SYNTHETIC)}: "
        f"{'clearly' if q_is_less else 'not clearly'} less than the bandit's own reward does. "
        "On the bandit's contexts, cloning is "
        f"{'not clearly worse than' if cloning_is_as_good else 'worse than'}, and closeness to the expert's action "
        f"{'not clearly worse than' if closeness_is_as_good else 'worse than'}, the bandit's own reward "
        f"({of(BANDIT, SYNTHETIC)})."
    )


def body(report: Mapping[str, Any]) -> list[str]:
    """The table: pooled, and expert by expert."""
    plan = report["plan"]
    rows = []
    for reward in REWARDS:
        for states in STATES:
            scores = scores_of(report, reward, states)
            rows.append(
                [
                    reward,
                    states,
                    text(pooled_estimate(returns_of(report, reward, states))),
                    text(pooled_estimate(scores), 2),
                    ", ".join(f"{x:z.2f}" for x in iqm(scores, axis=1)).replace("-", "\u2212"),
                ]
            )
    failed = report.get("failed", 0)
    owns = ", ".join(f"{iqm(x['own']):.0f}" for x in report["experts"].values())
    return [
        f"{plan['agents']} PPO agents (ReLU, hyperparameters drawn from the paper's lists, 10 000 steps) a combination "
        f"and expert, the same draws for each; {plan['episodes']} episodes of most likely actions; reporting seed "
        "10 000. Cloning takes as many states and as many gradient steps, with PPO's learning rates. "
        f"{len(report['experts'])} experts, each the best of {plan['candidates']} SAC agents trained on the "
        f"environment, by other episodes; they earn {owns} over {plan['expert_episodes']} episodes, a random policy "
        f"{report['random']:.0f}. Interquartile means with 95 % intervals that draw experts, and agents; the last "
        "column is the score with each expert.".replace("-", "\u2212")
        + (f" Agents whose return is no number, counted as random: {failed}." if failed else ""),
        "",
        *table(["learning from", "states", "return", "normalised score", "expert by expert"], rows),
    ]


def draw(report: Mapping[str, Any]) -> Figure:
    """A line a combination: the score with its interval, each expert a dot."""

    number = len(report["experts"])
    with plotting.figure_style():
        figure = Figure(figsize=(plotting.WIDTH, 3.6))
        axes = figure.subplots()
        for i, reward in enumerate(REWARDS):
            for states, offset, color in (
                (SYNTHETIC, -0.15, plotting.VERMILLION),
                (EXPERT, 0.15, plotting.BLUE),
            ):
                scores = scores_of(report, reward, states)
                plotting.estimate_row(
                    axes, i + offset, iqm(scores, axis=1), pooled_estimate(scores), color
                )
        axes.axvline(1.0, color=plotting.BLACK, linestyle=":", linewidth=1.2)
        axes.set_yticks(range(len(REWARDS)), list(REWARDS))
        axes.invert_yaxis()
        axes.set_xlabel("normalised score on Pendulum (0: random policy, 1: the SAC expert)")
        plotting.figure_title(
            figure,
            f"Learning in a bandit with replaced parts: {number} experts (dots), "
            f"{report['plan']['agents']} agents each",
        )
        handles: list[Any] = [
            axes.plot([], [], "o", color=color)[0] for color in (plotting.VERMILLION, plotting.BLUE)
        ]
        plotting.legend_below(figure, (handles, list(STATES)), columns=2)
    return figure


EXPERIMENT = Experiment(
    name="component_replacement",
    title="What of a bandit is needed: its reward and its contexts replaced by an expert's",
    paper="figure 12, appendix on replacing components",
    claim="on Pendulum the bandit's contexts are needed to learn well within 10 000 steps; an expert's Q-function as "
    "the reward does not work well; cloning the expert, or rewarding closeness to its action, on the bandit's contexts "
    "does as well as the bandit's reward.",
    presets={
        "quick": {
            "experts": 3,
            "candidates": 2,
            "expert_episodes": 64,
            "agents": 20,
            "episodes": 20,
        },
        "paper": {
            "experts": 10,
            "candidates": 4,
            "expert_episodes": 256,
            "agents": 20,
            "episodes": 50,
        },
    },
    minutes={"quick": "3", "paper": "16"},
    measure=measure,
    parts=parts,
    verdict=verdict,
    body=body,
    draw=draw,
)


if __name__ == "__main__":
    sys.exit(run(EXPERIMENT))
