"""What of Pendulum's bandit is needed: its reward and its contexts, each replaced by an expert's.

    python -m experiments.component_replacement

Four ways to learn (the bandit's reward, online behavioural cloning of a SAC expert, its action as the
reward, its Q-function as the reward) on two distributions of states (the bandit's, the expert's).
"""

import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.page import Experiment, Save, table, text
from experiments.page import main as run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ENVIRONMENT = "Pendulum-v1"
BANDIT, CLONING, ACTION, Q = REWARDS = (
    "reward of the bandit",
    "cloning the expert",
    "closeness to the expert's action",
    "Q of the expert",
)
SYNTHETIC, EXPERT = STATES = ("contexts of the bandit", "states of the expert")
EXPERT_SEED, REPORTING_SEED = 40_000, 10_000


def cell(reward: str, states: str) -> str:
    """The name of a combination in the report."""
    return f"{reward} | {states}"


def measure(plan: Mapping[str, Any], report: dict[str, Any], save: Save) -> None:
    """The expert, which is trained again where the experiment goes on, then a combination at a time."""
    missing = [
        (r, s) for r in REWARDS for s in STATES if cell(r, s) not in report.get("returns", {})
    ]
    if not missing:
        return
    import jax
    import jax.numpy as jnp

    import scb
    from scb.agents.hyperparameters import inner_loop
    from scb.analysis import components
    from scb.analysis.states import follow
    from scb.discovery import SyntheticTraining, judge
    from scb.environments.zoo import bandit_metadata, open_bandit

    env, env_params = scb.make(ENVIRONMENT)
    space = env.action_space(env_params)
    bandit = open_bandit(f"Synthetic-{ENVIRONMENT}")
    key_train, key_follow, key_judge, key_random = jax.random.split(jax.random.key(EXPERT_SEED), 4)
    expert = components.train_sac_expert(ENVIRONMENT, env, env_params, key_train, plan["experts"])
    visited = follow(env, env_params, expert.policy(), key_follow, plan["expert_episodes"])
    random = follow(
        env, env_params, lambda _, key: space.sample(key), key_random, plan["expert_episodes"]
    )
    judged = follow(env, env_params, expert.policy(), key_judge, 200)
    report["sha256"] = bandit_metadata(bandit.name)["sha256"]
    report["expert"] = np.round(judged.returns(), 2).tolist()
    report["random"] = float(np.round(random.returns().mean(), 2))
    report["agents"], report["episodes"] = plan["agents"], plan["episodes"]
    states = jnp.asarray(visited.states())
    inner = inner_loop("ppo", ENVIRONMENT, space)
    rewards = {
        BANDIT: None,
        ACTION: components.action_reward(expert, space),
        Q: components.q_reward(expert, space),
    }
    for reward, kind in missing:
        shown = None if kind == SYNTHETIC else states
        if reward == CLONING:
            source = components.ReplacedBandit(bandit, states=shown)
            key_draw, key_agents = jax.random.split(jax.random.key(REPORTING_SEED))
            rates = inner.sample(key_draw, plan["agents"]).learning_rate

            def contexts(key: Any, source: Any = source) -> Any:
                return source.reset_env(key, source.default_params)[0]

            returns = components.judge_cloning(
                expert,
                contexts,
                env,
                env_params,
                key_agents,
                rates,
                plan["episodes"],
                inner.config.activation,
            )
        else:
            replaced = components.ReplacedBandit(bandit, rewards[reward], shown)
            training = SyntheticTraining(replaced, env, env_params, inner)
            weights = bandit.default_params.weights
            (returns,) = judge(
                training, weights, REPORTING_SEED, plan["agents"], plan["episodes"], mode=True
            ).values()
        report.setdefault("returns", {})[cell(reward, kind)] = np.round(returns, 2).tolist()
        save()


def scores(report: Mapping[str, Any]) -> dict[str, Any]:
    """{combination: Estimate of the normalised score}: 0 is the random policy, 1 the expert."""
    from scb.statistics import estimate, iqm, normalized_score

    ceiling = float(iqm(report["expert"]))
    return {
        name: estimate(normalized_score(returns, report["random"], ceiling))
        for name, returns in report["returns"].items()
    }


def verdict(report: Mapping[str, Any]) -> str:
    """Each part of the claim, with its figures; "less" where the paired difference's interval excludes zero."""
    from scb.statistics import paired_difference

    found = scores(report)

    def of(reward: str, states: str) -> str:
        return text(found[cell(reward, states)], 2)

    def worse(reward: str) -> bool:
        """Whether the same agents learn less from it than from the bandit itself."""
        both = (report["returns"][cell(r, SYNTHETIC)] for r in (reward, BANDIT))
        difference = paired_difference(*both)
        return difference.high is not None and difference.high < 0

    needed = all(
        found[cell(r, EXPERT)].value < found[cell(r, SYNTHETIC)].value
        for r in (BANDIT, CLONING, ACTION)
    )
    return (
        "Normalised scores (0 a random policy, 1 the expert). On the expert's states instead of the bandit's "
        f"contexts: {of(BANDIT, EXPERT)} instead of {of(BANDIT, SYNTHETIC)} with the bandit's reward, "
        f"{of(CLONING, EXPERT)} instead of {of(CLONING, SYNTHETIC)} with cloning; the contexts "
        f"{'are' if needed else 'are not always'} what matters. "
        f"The expert's Q-function as the reward gives {of(Q, SYNTHETIC)}: "
        f"{'it does work badly' if worse(Q) else 'it is not clearly worse here'}. "
        f"Closeness to its action gives {of(ACTION, SYNTHETIC)}, which is "
        f"{'less than' if worse(ACTION) else 'not clearly less than'} the bandit's own reward does, and cloning is "
        f"{'worse than' if worse(CLONING) else 'as good as'} the bandit's reward."
    )


def body(report: Mapping[str, Any]) -> list[str]:
    """The table."""
    from scb.statistics import estimate

    found = scores(report)
    rows = [
        [name.split(" | ")[0], name.split(" | ")[1], text(estimate(returns)), text(found[name], 2)]
        for name, returns in report["returns"].items()
    ]
    return [
        f"{report['agents']} PPO agents (ReLU, hyperparameters drawn from the paper's lists, 10 000 steps) a "
        f"combination, the same draws for each; {report['episodes']} episodes of most likely actions; reporting seed "
        "10 000. Cloning takes as many states and as many gradient steps, with PPO's learning rates. The expert is "
        "SAC, trained on the environment, "
        f"the best of several on other episodes: {text(estimate(report['expert']))} over 200 episodes; a random policy "
        f"earns {report['random']:.0f}. Interquartile means with 95 % intervals.".replace(
            "earns -", "earns \u2212"
        ),
        "",
        *table(["learning from", "states", "return", "normalised score"], rows),
    ]


def draw(report: Mapping[str, Any]) -> "Figure":
    """A line a combination: the score with its interval, each agent a dot."""
    from matplotlib.figure import Figure

    from scb import plotting
    from scb.statistics import iqm, normalized_score

    found = scores(report)
    ceiling = float(iqm(report["expert"]))
    with plotting.figure_style():
        figure = Figure(figsize=(plotting.WIDTH, 3.6))
        axes = figure.subplots()
        for i, reward in enumerate(REWARDS):
            for states, offset, color in (
                (SYNTHETIC, -0.15, plotting.VERMILLION),
                (EXPERT, 0.15, plotting.BLUE),
            ):
                name = cell(reward, states)
                values = normalized_score(report["returns"][name], report["random"], ceiling)
                plotting.estimate_row(axes, i + offset, values, found[name], color)
        axes.axvline(1.0, color=plotting.BLACK, linestyle=":", linewidth=1.2)
        axes.set_yticks(range(len(REWARDS)), list(REWARDS))
        axes.invert_yaxis()
        axes.set_xlabel("normalised score on Pendulum (0: random policy, 1: the SAC expert)")
        plotting.figure_title(
            figure, f"Learning in a bandit with replaced parts: {report['agents']} agents each"
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
        "quick": {"experts": 4, "expert_episodes": 64, "agents": 20, "episodes": 20},
        "paper": {"experts": 10, "expert_episodes": 256, "agents": 20, "episodes": 50},
    },
    minutes={"quick": "3", "paper": "6"},
    measure=measure,
    verdict=verdict,
    body=body,
    draw=draw,
)


if __name__ == "__main__":
    sys.exit(run(EXPERIMENT))
