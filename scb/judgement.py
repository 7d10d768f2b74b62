"""What agents of a synthetic environment are worth in the environment that it stands for."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from scb.agents.spec import AgentSpec, algorithms_for, bandit_agent
from scb.console import console, progress_console
from scb.environments.registry import environment_spec
from scb.environments.synthetic import SyntheticBandit, Weights
from scb.environments.synthetic_mdp import SyntheticMDP
from scb.environments.zoo import bandit_metadata
from scb.errors import UserError
from scb.measurement import MODE, SAMPLED, Agents, Place, as_random, measure
from scb.rows import Rows, pivot
from scb.seeds import VALIDATING
from scb.spaces import shapes
from scb.statistics import estimate

EPISODES, BRAX_EPISODES = 50, 5  # of each agent that judges a bandit; Brax's physics are slow


def check_fits(bandit: SyntheticBandit | SyntheticMDP, place: Place) -> None:
    """Raises a UserError where a bandit has other observation or action shapes than an environment."""
    ours, theirs = shapes(bandit, None), shapes(place.env, place.params)
    if ours != theirs:
        raise UserError(
            f"bandit {bandit.name} has {ours}, {place.name} has {theirs}: take the bandit of that environment."
        )


def evaluation_place(
    bandit: SyntheticBandit | SyntheticMDP, name: str, environment: str | None, backend: str | None
) -> Place:
    """Where agents of a bandit, opened by this name, are judged: in what it stands for where no other is named.

    There the physics are those that it was found with, where no others are named.

    Raises:
      UserError: it stands for none, or does not fit the environment.
    """
    config = bandit_metadata(name).get("config", {})
    target = environment or environment_spec(name).evaluation_environment
    if backend is None and environment in (None, config.get("evaluation_environment")):
        backend = config.get("backend")
    place = Place.named(target, backend)
    check_fits(bandit, place)
    return place


def judge(
    spec: AgentSpec,
    synthetic: SyntheticBandit | SyntheticMDP,
    weights: Weights,
    judge_in: Place,
    seed: int,
    num_agents: int = 20,
    num_episodes: int = EPISODES,
    mode: bool | None = None,
    rows: Rows | None = None,
) -> dict[str, np.ndarray]:
    """[num_agents] mean returns in the evaluation environment of agents trained in a synthetic one.

    Args:
      spec: the agents'; what it has lists for is drawn.
      synthetic, weights: where they train.
      judge_in: the evaluation environment.
      seed: decides hyperparameters, training and evaluation.
      rows: where agents are kept and found; None for memory.

    Returns:
      {"sampled_actions": [N], "mode_actions": [N]} of the same agents; with `mode` given, only that
      one.
    """
    actions = (SAMPLED, MODE) if mode is None else (MODE if mode else SAMPLED,)
    found = measure(
        spec,
        Place(synthetic.name, synthetic, synthetic.params(weights)),
        judge_in,
        Agents.drawn_from(spec, seed, num_agents),
        episodes=num_episodes,
        actions=actions,
        rows=rows,
    )
    returns = pivot(found, "actions", "agent")
    return {f"{kind}_actions": of_it for kind, of_it in zip(actions, returns, strict=True)}


def judge_all(
    synthetic: SyntheticBandit | SyntheticMDP,
    weights: Weights,
    judge_in: Place,
    sampled: bool = True,
    num_agents: int = 20,
    num_episodes: int = EPISODES,
) -> dict[str, Any]:
    """What agents of every fitting algorithm earn, by name of the algorithm in capitals, printed as it comes."""
    algorithms = algorithms_for(judge_in.env.action_space(judge_in.params))
    names = ", ".join(map(str.upper, algorithms))
    progress_console(quiet=False).print(f"judging by {num_agents} agents each of {names}")
    results = {}
    for algorithm in algorithms:
        spec = bandit_agent(algorithm, judge_in.name, sampled)
        found = judge(
            spec, synthetic, weights, judge_in, VALIDATING.start, num_agents, num_episodes
        )
        returns, failed = counted(found, judge_in)
        results[algorithm.upper()] = {
            "agents": num_agents,
            "episodes": num_episodes,
            "hyperparameters": "sampled from the paper's lists" if spec.lists else "fixed",
            **({"failed": failed} if failed else {}),
            **{actions: estimate(x).as_dict() for actions, x in returns.items()},
        }
        line = "; ".join(
            f"{actions.replace('_', ' ')} IQM {estimate(x)}" for actions, x in returns.items()
        )
        console().print(f"{algorithm.upper()} on {judge_in.name}: {line}{told(failed)}")
    return results


def counted(
    returns: Mapping[str, np.ndarray], judge_in: Place
) -> tuple[dict[str, np.ndarray], int]:
    """(what `judge` found, where an agent that diverged counts as random actions do; how many agents did)."""
    found = {name: as_random(x, judge_in) for name, x in returns.items()}
    values = {name: x for name, (x, _) in found.items()}
    return values, max(int(failed.sum()) for _, failed in found.values())


def told(failed: int) -> str:
    """How many agents failed, as the end of a sentence; empty for none."""
    return f"; {failed} diverged, counted as random actions" if failed else ""
