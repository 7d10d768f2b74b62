"""`scb explain`: what a bandit says about its environment, as one figure and one JSON file."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from gymnax.environments import spaces

from scb.analysis.importance import reward_variance
from scb.analysis.optimal_actions import first_action, optimal_actions, optimal_policy
from scb.analysis.planes import observation_names, plane_for
from scb.analysis.states import bandit_states, follow, thinned
from scb.console import console
from scb.environments.synthetic import SyntheticBandit
from scb.environments.zoo import load_bandit
from scb.errors import at_least
from scb.files import make_folder, write_json
from scb.judgement import evaluation_place
from scb.keys import root_key, split_key
from scb.measurement import Place, check_seeds
from scb.spaces import flat_bounds
from scb.statistics import estimate

STATES = 2000  # of either distribution, as in the paper


def explain(
    bandit: SyntheticBandit, place: Place, episodes: int, seed: int
) -> tuple[dict[str, Any], dict[str, Any]]:
    """What a bandit knows, in numbers and as `scb.analysis.figures.explained` draws it.

    Args:
      bandit: with weights of its own.
      place: the evaluation environment, where the bandit's optimal policy acts.
      episodes: of the optimal policy.
      seed: decides episodes, contexts and what is varied.

    Returns:
      (numbers for JSON, parts for the figure).
    """
    key_context, key_vary, key_episode = split_key(root_key(seed), 3)
    space = bandit.action_space()
    contexts = bandit_states(bandit, key_context, STATES)
    importance = np.asarray(reward_variance(bandit, jnp.asarray(contexts), key_vary))
    names = observation_names(place.name, bandit.observation_size)
    trajectories = follow(place.env, place.params, optimal_policy(bandit), key_episode, episodes)
    returns = trajectories.returns()
    earned = estimate(returns)
    best = jax.jit(jax.vmap(optimal_actions(bandit)))
    num_actions, bounds = first_action(space)

    def drawn(observations: np.ndarray) -> np.ndarray:
        actions = np.asarray(best(jnp.asarray(observations)))
        return actions.reshape(len(observations), -1)[:, 0]

    mean_reward = jax.jit(jax.vmap(partial(bandit.mean_reward, params=bandit.default_params)))
    several = num_actions is None and bandit.num_actions > 1

    def rewards(observations: np.ndarray, firsts: Sequence[float]) -> list[np.ndarray]:
        # The best actions are what takes long: once for all values.
        actions = np.array(best(jnp.asarray(observations)))
        found = [mean_reward(jnp.asarray(observations), jnp.asarray(actions.copy()))]
        for first in firsts:
            actions.reshape(len(actions), -1)[:, 0] = first
            found.append(mean_reward(jnp.asarray(observations), jnp.asarray(actions.copy())))
        return [np.asarray(x) for x in found]

    visited = trajectories.states()
    shown = thinned(visited, STATES)
    usual = int(np.argsort(returns)[len(returns) // 2])  # the episode to draw: of median return
    numbers = {
        "bandit": bandit.name,
        "environment": place.name,
        "episodes": episodes,
        "seed": seed,
        "return_of_optimal_policy": earned.as_dict(),
        "importance": {n: round(float(x), 4) for n, x in zip(names, importance, strict=True)},
        "context_std": dict(zip(names, np.round(contexts.std(0), 4).tolist(), strict=True)),
        "visited_std": dict(zip(names, np.round(visited.std(0), 4).tolist(), strict=True)),
    }
    everything = np.concatenate([contexts, shown])
    space = place.env.observation_space(place.params)
    box = None
    if isinstance(space, spaces.Box):
        low, high = flat_bounds(space)
        box = np.asarray(low), np.asarray(high)
    parts = {
        "name": bandit.name,
        "summary": f"its optimal policy earns {earned} in {place.name}",
        "plane": None
        if bandit.observation_size < 2
        else plane_for(place.name, everything, importance.tolist(), box),
        "best": drawn,
        "rewards": rewards,
        "num_actions": num_actions,
        "bounds": bounds,
        "episode": trajectories.observations[usual][trajectories.active[usual]],
        "contexts": contexts,
        "visited": shown,
        "names": names,
        "importance": importance.tolist(),
        "action": "action" + (" (first dimension)" if several else ""),
    }
    return numbers, parts


def explain_command(
    bandit: tyro.conf.Positional[str],
    out: Path | None = None,
    evaluation_environment: str | None = None,
    backend: str | None = None,
    episodes: int = 20,
    seed: int = 0,
    html: bool = False,
) -> None:
    """Show what a bandit knows: its best actions, its states, and what its reward depends on.

    Args:
      bandit: a zoo name such as Synthetic-Pendulum-v1, or path.npz.
      out: folder for explain.png, explain.json and explain.html; runs/explain/NAME where left out.
      evaluation_environment: where the bandit's optimal policy acts; the bandit's own where left out.
      backend: Brax's physics: generalized, positional, spring or mjx; those that the bandit was found with where left
        out.
      episodes: of the optimal policy.
      seed: decides everything.
      html: also write a page where the reward's surface can be turned and the action moved (extra `html`).
    """
    from scb import interactive, plotting
    from scb.analysis import figures, page

    at_least(1, episodes=episodes)
    check_seeds([seed])
    if html:
        interactive.plotly()  # before the work, not after it
    loaded = load_bandit(bandit)
    place = evaluation_place(loaded, bandit, evaluation_environment, backend)
    folder = Path("runs") / "explain" / loaded.name if out is None else out
    make_folder(folder)
    numbers, parts = explain(loaded, place, episodes, seed)
    write_json(folder / "explain.json", numbers)
    printer = console()
    earned = numbers["return_of_optimal_policy"]
    printer.print(
        f"The bandit's optimal policy earns {earned['value']:.1f} in {place} "
        f"({episodes} episode{'s' * (episodes > 1)})."
    )
    shares = sorted(numbers["importance"].items(), key=lambda item: -item[1])
    for name, share in shares[: figures.BARS]:
        printer.print(f"  {share:6.1%} of the reward's variance, alone or with others: {name}")
    if more := shares[figures.BARS :]:
        printer.print(f"  {more[0][1]:6.1%} or less: {len(more)} more, in explain.json")
    plotting.save(figures.explained(parts), folder / "explain.png")
    if html and parts["plane"] is None:
        printer.print("It has a single observation: there is no surface to turn, and no page.")
    elif html:
        page.save_bandit_page(folder / "explain.html", parts)
    printer.print(f"written to {folder}", soft_wrap=True)
