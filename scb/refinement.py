"""A linear bandit's policy, searched for further under the errors of the agents that learn from it.

What an agent does differs from the bandit's best action, by most where the agent learned least, and how much a policy
earns says little of what its agents will. Retraining them for every candidate is what evolution of the bandit does.
Here agents are trained once a round, and augmented random search moves the policy while what each agent adds to it is
held fixed: that changes little while the policy does, and a candidate costs an episode and no training.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from evosax.algorithms import ARS

from scb.agents.agent import Agent
from scb.agents.spec import AgentSpec
from scb.aggregation import Fit, Learned, Learners, best_round
from scb.console import progress_console
from scb.environments.linear import PolicyDistanceParts, units, with_states
from scb.environments.synthetic import SyntheticBandit, Weights
from scb.errors import agents_at_least, at_least, unused
from scb.evaluation import evaluate
from scb.keys import key_at, split_key
from scb.linear_expert import noisy
from scb.measurement import Place
from scb.population import map_population
from scb.stopwatch import Stopwatch

DIRECTIONS = 32  # perturbations of a generation, each tried both ways for one episode
SIGMA = 0.1  # of the perturbations, in the weights' units
LEARNING_RATE = 0.025
EPISODES = 4  # by which the agents of a round are judged
Change = dict[str, jax.Array]  # {"kernel": [O, A], "bias": [A]}, in the weights' units


@dataclass(frozen=True)
class RefinementConfig:
    """Refinement of a linear bandit's policy before the evolution.

    Attributes:
      rounds: in each of which agents train in the bandit, and the linear search goes on under their errors. The
        round whose agents earn most is kept.
      generations: of the search in each round.
      agents: of each algorithm of the inner loop, in every round and after the last. A generation takes 32 of them,
        in turn.
      visits: whether half of the contexts come to be where the agents went, in every round. It undoes what
        stretching and jittering the contexts did.
      noise: standard deviation of Gaussian noise on the actions in the search, in half their range: for agents that
        act by sampled ones.
    """

    rounds: Annotated[int, tyro.conf.arg(name="refinement-rounds")] = 0
    generations: Annotated[int, tyro.conf.arg(name="refinement-generations")] = 20
    agents: Annotated[int, tyro.conf.arg(name="refinement-agents")] = 16
    visits: Annotated[bool, tyro.conf.arg(name="refinement-visits")] = True
    noise: Annotated[float, tyro.conf.arg(name="refinement-noise")] = 0.0

    def __post_init__(self) -> None:
        at_least(0, self, "rounds", "noise")
        at_least(1, self, "generations")
        agents_at_least(1, self, "agents")
        if not self.rounds:
            unused(
                self,
                "there are no refinement rounds",
                ("generations", "agents", "visits", "noise"),
                "take at least 1",
            )


def refined(
    bandit: SyntheticBandit,
    weights: Weights,
    specs: Mapping[str, AgentSpec],
    place: Place,
    key: jax.Array,
    config: RefinementConfig,
    quiet: bool = True,
) -> tuple[Weights, dict[str, float]]:
    """A linear bandit's weights after rounds of refinement, and how they came about.

    Args:
      bandit: of these shapes.
      weights: to start from.
      specs: of the agents that train in it.
      place: the environment.
      key: decides everything.
      config: of the rounds.
      quiet: nothing on the terminal.
    """
    watch = Stopwatch()
    learners = Learners(bandit, specs, place, config.agents, EPISODES)
    refine = Refinement(bandit, learners.agents, place, config.generations, config.noise)

    def improve(latest: Weights, learned: Mapping[str, Learned], key: jax.Array) -> Any:
        better, taken = refine(latest, learned, key)
        if not config.visits:
            return (better, {}), taken
        states = learners.visits(latest, learned).observation
        went = np.reshape(states, (states.shape[0] * states.shape[1], -1))
        return (with_states(better, went), {}), taken + len(went)

    progress_console(quiet).print(
        f"refining the policy of a bandit for {place.name}, what its agents earn:"
    )
    start: Fit = (weights, {})
    (weights, report), steps = best_round(start, learners, config.rounds, key, improve, quiet)
    return weights, {
        "refinement": report["round"],
        "refined_return": report["agents_return"],
        "environment_steps": steps,
        "seconds": round(watch.lap(), 1),
    }


def moved(weights: Weights, change: Change) -> Weights:
    """The bandit whose policy is changed; its contexts are the same."""
    reward, unit = weights["reward"], units(weights)["reward"]
    return {
        **weights,
        "reward": {**reward, **{k: reward[k] + unit[k] * change[k] for k in ("kernel", "bias")}},
    }


class Refinement:
    """A search that goes on from a linear bandit's policy, with its agents' errors.

    Args:
      bandit: of these shapes.
      agents: by algorithm, which trained in it.
      place: the environment.
      generations: of a round, which the algorithms have in turn.
      noise: on the actions.
    """

    def __init__(
        self,
        bandit: SyntheticBandit,
        agents: Mapping[str, Agent],
        place: Place,
        generations: int,
        noise: float = 0.0,
    ) -> None:
        self._generations = generations
        low, high = bandit.bounds
        space = place.env.action_space(place.params)

        def program(agent: Agent) -> Any:
            def one(
                change: Change, which: Any, key: jax.Array, start: Change, states: Any, weights: Any
            ) -> Any:
                state = jax.tree.map(lambda x: x[which], states)
                learned, candidate = (
                    PolicyDistanceParts.of(w["reward"], low, high)
                    for w in (weights, moved(weights, jax.tree.map(jnp.add, start, change)))
                )

                def policy(seen: jax.Array) -> jax.Array:
                    # The most likely action, which takes no key.
                    action = agent.act(state, seen, key, place.params, mode=True)
                    share = learned.share(jnp.ravel(action))
                    share = jnp.clip(share + candidate.best(seen) - learned.best(seen), -1, 1)
                    return learned.action(share)

                act = noisy(policy, space, noise)
                episodes = evaluate(place.env, place.params, act, key, 1)
                return episodes.returns[0], episodes.lengths[0]

            return map_population(one, 2 * DIRECTIONS, (0, 0, 0, None, None, None))

        self._programs = {name: program(agent) for name, agent in agents.items()}

    def __call__(
        self, weights: Weights, learned: Mapping[str, Learned], key: jax.Array
    ) -> tuple[Weights, int]:
        """A round: the moved bandit, and the environment steps that it took.

        Args:
          weights: of the bandit that the agents learned from.
          learned: by algorithm, the agents.
        """
        kernel, bias = (jnp.zeros_like(weights["reward"][k]) for k in ("kernel", "bias"))
        zero: Change = {"kernel": kernel, "bias": bias}
        search = ARS(
            2 * DIRECTIONS,
            zero,
            optimizer=optax.sgd(LEARNING_RATE),
            std_schedule=optax.constant_schedule(SIGMA),
        )
        search.elite_ratio = 1.0
        params, steps = search.default_params, 0
        key_start, key_search = split_key(key)
        state = search.init(key_start, zero, params)
        ask, tell = jax.jit(search.ask), jax.jit(search.tell)
        for number in range(self._generations):
            algorithm = list(learned)[number % len(learned)]
            states = learned[algorithm].states
            key_ask, key_roll, key_tell = split_key(key_at(key_search, number), 3)
            population, state = ask(key_ask, state, params)
            mean = search.get_mean(state)
            # Both ways with the same agent from the same start state.
            turn = number // len(learned)
            which = (turn * DIRECTIONS + np.arange(DIRECTIONS)) % len(learned[algorithm].returns)
            earned, lengths = self._programs[algorithm](
                jax.tree.map(lambda x, m: x - m, population, mean),
                np.tile(which, 2),
                jnp.tile(split_key(key_roll, DIRECTIONS), 2),
                mean,
                states,
                weights,
            )
            state, _ = tell(key_tell, population, -paired_ranks(earned), state, params)
            steps += int(lengths.sum())
        change: Any = search.get_mean(state)
        return jax.tree.map(np.asarray, moved(weights, change)), steps


def paired_ranks(returns: np.ndarray) -> np.ndarray:
    """[2 D] the rank of how much one way earns more than the other, the sign with it; -1 to 1.

    Agents differ by more than what they follow does: by their returns alone the best agents would decide. A pair in
    which one has no finite return says nothing.
    """
    ahead, back = np.split(np.asarray(returns, float), 2)
    known = np.isfinite(ahead) & np.isfinite(back)
    difference = np.where(known, np.where(known, ahead, 0) - np.where(known, back, 0), 0.0)
    ranks = np.argsort(np.argsort(np.abs(difference))) + 1
    signed = np.sign(difference) * ranks / len(ranks)
    return np.concatenate([signed, -signed])
