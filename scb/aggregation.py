"""Dataset aggregation (Ross et al., 2011): where agents of a fitted bandit go, for the expert to say what to do there.

An expert's own states do not show what to do after a mistake, and an agent that learned from a bandit
makes mistakes.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from scb.agents.agent import Agent
from scb.agents.spec import AgentSpec
from scb.console import progress_console
from scb.environments.synthetic import SyntheticBandit, Weights
from scb.errors import UserError
from scb.experts import EPISODES
from scb.keys import named_key, split_key
from scb.measurement import Judge, Place, as_random, train_and_judge
from scb.population import map_population

TRAJECTORIES = 256
LENGTH = 200


class Visited(NamedTuple):
    """States of an environment."""

    env_state: Any
    observation: jax.Array


def trajectory(
    place: Place,
    act: Callable[[jax.Array, jax.Array], jax.Array],
    key_reset: jax.Array,
    key_steps: jax.Array,
) -> Visited:
    """[T, ...] states from a start on, at most 200; `act` takes an observation and two keys."""

    def step(carry: Any, key: jax.Array) -> Any:
        env_state, observation = carry
        keys = split_key(key, 3)
        action = act(observation, keys[:2])
        next_observation, next_state, *_ = place.env.step(keys[2], env_state, action, place.params)
        return (next_state, next_observation), Visited(env_state, observation)

    observation, env_state = place.env.reset(key_reset, place.params)
    keys = split_key(key_steps, min(LENGTH, int(place.params.max_steps_in_episode)))
    return jax.lax.scan(step, (env_state, observation), keys)[1]


class Learned(NamedTuple):
    """Agents of one algorithm.

    Attributes:
      returns: [N] what each earns; one that diverged counts as random actions.
      states: of the agents, every leaf [N], to act with; keys are left as numbers.
      keys: [N] that decided them.
      failed: [N] which diverged.
    """

    returns: np.ndarray
    states: Any
    keys: jax.Array
    failed: np.ndarray


class Learners:
    """Agents that train in a bandit: what they earn in the environment, and where they go there.

    Args:
      bandit: of these shapes.
      specs: of the agents, by algorithm; what they have lists for is drawn.
      place: the environment.
      number: of agents of each algorithm.
      episodes: by which each is judged.
    """

    def __init__(
        self,
        bandit: SyntheticBandit,
        specs: Mapping[str, AgentSpec],
        place: Place,
        number: int,
        episodes: int = EPISODES,
    ) -> None:
        self._bandit, self._specs, self._place, self._number = bandit, specs, place, number
        self.agents = {name: spec.agent(bandit) for name, spec in specs.items()}
        judge = Judge(place.env, place.params, episodes, mode=True)
        self._each = each = -(-TRAJECTORIES // (number * len(specs)))

        def training(agent: Agent) -> Any:
            def one(hyperparameters: Any, key: jax.Array, params: Any) -> Any:
                state, earned = train_and_judge(
                    agent, hyperparameters, key, params, {"return": judge}
                )
                return earned["return"].returns.mean(), jax.tree.map(_as_number, state)

            return map_population(one, number, (0, 0, None))

        def visiting(agent: Agent) -> Any:
            def one(state: Any, key: jax.Array, params: Any) -> Visited:
                def act(observation: jax.Array, keys: jax.Array) -> jax.Array:
                    return agent.act(state, observation, keys[0], params, mode=True)

                def roll(key: jax.Array) -> Visited:
                    return trajectory(place, act, *split_key(key))

                return jax.vmap(roll)(split_key(named_key(key, "visits"), each))

            return map_population(one, number, (0, 0, None))

        self._training = {name: training(agent) for name, agent in self.agents.items()}
        self._visiting = {name: visiting(agent) for name, agent in self.agents.items()}
        limit = int(place.params.max_steps_in_episode)
        self.steps = number * len(specs) * episodes * limit

    def __call__(self, weights: Weights, key: jax.Array) -> tuple[float, dict[str, Learned]]:
        """(mean return of all agents, the agents by algorithm)."""
        params, learned = self._bandit.params(weights), {}
        for name, spec in self._specs.items():
            key_draw, key_agents = split_key(named_key(key, name))
            drawn, keys = spec.sample(key_draw, self._number), split_key(key_agents, self._number)
            earned, states = self._training[name](drawn, keys, params)
            returns, failed = as_random(np.asarray(earned), self._place)
            learned[name] = Learned(returns, states, keys, failed)
        mean = np.concatenate([of.returns for of in learned.values()]).mean()
        return float(mean), learned

    def visits(self, weights: Weights, learned: Mapping[str, Learned]) -> Visited:
        """[N, T, ...] states that agents of a bandit visit in the environment; as many of each that did not diverge.

        Raises:
          UserError: all did.
        """
        params = self._bandit.params(weights)
        visits = [self._visiting[name](of.states, of.keys, params) for name, of in learned.items()]
        flat = jax.tree.map(lambda x: jnp.reshape(x, (-1, *x.shape[2:])), visits)
        visited: Visited = jax.tree.map(lambda *x: jnp.concatenate(x), *flat)
        observed = np.asarray(visited.observation)
        # With discrete actions one that diverged acts on, and its states are numbers.
        failed = np.concatenate([of.failed for of in learned.values()])
        usable = np.isfinite(np.reshape(observed, (len(observed), -1))).all(axis=1)
        usable &= ~np.repeat(failed, self._each)
        if not usable.any():
            raise UserError(
                f"all agents of {self._bandit.name} diverge: lower their learning rate, or fit another bandit."
            )
        return visited if usable.all() else jax.tree.map(lambda x: x[usable], visited)


Fit = tuple[Weights, dict[str, float]]  # a bandit's weights, and how they came about
Improve = Callable[[Weights, dict[str, Learned], jax.Array], tuple[Fit, int]]


def best_round(
    start: Fit,
    learners: Learners,
    rounds: int,
    key: jax.Array,
    improve: Improve,
    quiet: bool = True,
) -> tuple[Fit, int]:
    """Of a fit and of those that are made of it round by round, the one whose agents earn most: rounds scatter.

    Args:
      rounds: how often the latest is made a better one.
      improve: takes its weights, its agents and a key; returns the next fit and the environment steps
        that it took.
      quiet: nothing on the terminal.

    Returns:
      (the fit, whose report tells its round and what its agents earn, which chose it; environment steps of all).
    """
    console = progress_console(quiet)
    (latest, report), best, kept, steps = start, -np.inf, start, 0
    for number, key_round in enumerate(split_key(key, rounds + 1)):
        key_agents, key_improve = split_key(key_round)
        earned, learned = learners(latest, key_agents)
        steps += learners.steps
        console.print(f"round {number}/{rounds}: agents earn {earned:.4g}")
        if number == 0 or earned > best:
            kept, best = (latest, {**report, "round": number, "agents_return": earned}), earned
        if number < rounds:
            (latest, report), taken = improve(latest, learned, key_improve)
            steps += taken
    return kept, steps


def _as_number(leaf: jax.Array) -> jax.Array:
    """A key as the numbers that it is made of; anything else as it is."""
    return jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf
