"""Fit a bandit to an expert before evolving it.

The paper's lemma: a bandit whose reward is the expert's Q-function, on contexts that cover the
expert's states, has the expert's policy as its optimum. Regression finds such a bandit in a minute;
what it cannot know is which of them *trains* well, and that is what evolution is for.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from gymnax.environments import spaces
from jax.tree_util import Partial

from scb.agents.spec import (
    ALGORITHMS,
    AgentSpec,
    check_algorithms,
    environment_agent,
    has_values_for,
    kind_of_actions,
)
from scb.agents.tables import WARM_START
from scb.aggregation import TRAJECTORIES, Learners, Visited, best_round, trajectory
from scb.console import progress_console
from scb.curriculum import paper_curriculum
from scb.environments.registry import environment_spec
from scb.environments.synthetic import SyntheticBandit, Weights
from scb.errors import UserError, at_least, one_of, positive
from scb.experts import Expert, PolicySearchConfig, evolve_expert, train_expert
from scb.fitting import CONSTRUCTIONS, ExpertDataset, fit_bandit
from scb.keys import named_key, split_key
from scb.linear_expert import LinearSearchConfig, Worth, erring, noisy, search_linear_expert
from scb.measurement import Place
from scb.runs import Stopwatch

PUPILS_EPISODES = 3  # by which each of an expert's pupils is judged


def _evolved(
    place: Place, key: jax.Array, config: "WarmStartConfig", quiet: bool, _: Worth | None
) -> Expert:
    search, generations = PolicySearchConfig(), config.expert_generations
    search = replace(
        search,
        curriculum=paper_curriculum(place.name, generations),
        evolution=replace(search.evolution, num_generations=generations),
    )
    return evolve_expert(place.env, place.params, search, key, quiet)


def _linear(
    place: Place, key: jax.Array, config: "WarmStartConfig", quiet: bool, worth: Worth | None
) -> Expert:
    standing = environment_spec(place.name).standing_still(place.backend) or 0.0
    bonus = standing / place.params.max_steps_in_episode
    search = LinearSearchConfig(
        config.expert_generations, episode_steps=config.expert_episode_steps
    )
    if config.erring:
        # Where actions err anyway a larger step is no more noise, and finds gains that bear errors.
        search = replace(
            search,
            sigma=0.15,
            learning_rate=0.09,
            action_noise=config.expert_noise,
            action_errors=config.expert_errors,
        )
    return search_linear_expert(place.env, place.params, key, search, bonus, quiet, worth)


class _Search(NamedTuple):
    """What finds experts that are no agents: in words, how, and what it needs and knows."""

    what: str
    find: Callable[[Place, jax.Array, "WarmStartConfig", bool, Worth | None], Expert]
    linear: bool = False  # for continuous actions; cuts episodes and asks pupils where told to


SEARCHES = {
    "evolution": _Search("evolution", _evolved),
    "linear": _Search("a linear search", _linear, linear=True),
}


@dataclass(frozen=True)
class WarmStartConfig:
    """How the expert is trained and the bandit is fitted.

    Attributes:
      construction: the reward's target. "advantage": (Q(s, a) - max_a Q(s, a)) / std; "q": (Q -
        mean) / std; "action_distance": -||a - a*|| (discrete: 1 where a = a*), a* the expert's mode
        action.
      expert: the algorithm that finds it: one of the agents' ("ppo", "sac", ...), "evolution" of a
        small policy network, or "linear", augmented random search for a linear policy, which a bandit
        holds better than a network. "auto" takes PPO where the environment has a setting of its own
        for it, and evolution elsewhere.
      num_experts: agents trained on the environment; the best of them is the expert.
      expert_steps: environment steps of each; the environment's own setting where None.
      expert_generations: of the evolution or the linear search, where that finds the expert.
      expert_noise: standard deviation of Gaussian noise on the expert's actions, as a share of half their
        range: where a linear search looks for it, so that it bears the errors of agents that learn
        from the bandit, and on the trajectories whose states the bandit's contexts are fitted to. With 0
        those mix expert and random actions.
      expert_errors: the scale of errors that are a function of the observation, as a share of half the
        actions' range: where a linear search looks for the expert, and on the same trajectories. Each
        episode has a function of its own, an untrained network of an agent's size. An agent that learned
        too little errs so, and not anew at every step.
      expert_pupils: agents of each algorithm of the inner loop that train in a bandit fitted to each policy
        which the linear search judges: the expert is then the one whose agents earn most on average. With 0
        it is the one that earns most itself, under its noise and errors.
      expert_episode_steps: at which a linear search cuts its episodes; the environment's own limit where None.
      min_spread: entries of the observation whose standard deviation is smaller are stretched about
        their mean until they have it, and the expert says what it does there; 0 for the states as
        they are. Agents learn little from an entry as small as a car's velocity. For
        "action_distance" only: Q-values cannot be simulated from states that don't exist.
      stretch: factor on the states' deviations from their mean, after that; the expert says what it does
        there. Agents that meet more than they need learn better what they need. For
        "action_distance" only.
      jitter: standard deviation of independent noise on every entry of the states, in deviations of the
        entry, after that; the expert says what it does there. Entries hang together along the expert's
        trajectories, and agents that err leave these. For "action_distance" only.
      discount: of the Q-function.
      num_states: states that the dataset holds.
      num_actions: actions that are tried in each of them, uniform but for the expert's.
      near_actions: of those, how many lie about the expert's, with a standard deviation of 0.15 of
        their range.
      horizon: steps after which a Monte-Carlo return is cut off.
      fit_steps: Adam steps of each regression.
      aggregation_rounds: of dataset aggregation (Ross et al., 2011): agents train in the fit, states that
        they visit join the dataset with what the expert does there, and all is fitted again. The fit
        whose agents earn most is kept: rounds scatter.
      aggregation_agents: of each algorithm of the inner loop, in every round and after the last.
    """

    construction: str = "action_distance"
    expert: str = "auto"
    num_experts: int = 8
    expert_steps: int | None = None
    expert_generations: int = 80
    expert_noise: float = 0.0
    expert_errors: float = 0.0
    expert_pupils: int = 0
    expert_episode_steps: int | None = None
    min_spread: float = 0.0
    stretch: float = 1.0
    jitter: float = 0.0
    discount: float = 0.95
    num_states: int = 4096
    num_actions: int = 16
    near_actions: int = 0
    horizon: int = 100
    fit_steps: int = 4000
    aggregation_rounds: int = 0
    aggregation_agents: int = 8

    def __post_init__(self) -> None:
        one_of("warm-start construction", self.construction, CONSTRUCTIONS)
        experts = ("auto", *SEARCHES, *ALGORITHMS)
        one_of("expert", self.expert, experts)
        at_least(0, self, "min_spread", "jitter", "expert_noise", "expert_errors")
        at_least(0, self, "expert_pupils", "near_actions", "aggregation_rounds")
        if not 0 <= self.discount <= 1:
            raise UserError(f"discount is {self.discount}: it must be between 0 and 1.")
        positive(self, "stretch")
        for field, none in (("min_spread", 0), ("stretch", 1), ("jitter", 0)):
            value = getattr(self, field)
            if value != none and self.construction != "action_distance":
                raise UserError(
                    f"{field} is {value}, which the construction {self.construction} cannot use: "
                    f"take action_distance, or a {field} of {none}."
                )
        at_least(1, self, "num_experts", "num_states", "num_actions")
        at_least(1, self, "horizon", "fit_steps", "expert_generations", "expert_episode_steps")
        at_least(1, self, "aggregation_agents")
        if self.near_actions >= self.num_actions:
            raise UserError(
                f"near_actions is {self.near_actions} of {self.num_actions} actions, one of them the expert's: take "
                f"at most {self.num_actions - 1}."
            )

    @property
    def erring(self) -> bool:
        """Whether the expert's trajectories are of its own actions with errors."""
        return self.expert_noise > 0 or self.expert_errors > 0


def expert_agent(
    name: str, space: spaces.Box | spaces.Discrete, config: WarmStartConfig
) -> AgentSpec | None:
    """How the expert of an environment is trained; None where a search finds it.

    Raises:
      UserError: an expert that doesn't fit the action space, or steps that it can't be trained for.
    """
    if isinstance(space, spaces.Discrete) and (config.erring or config.near_actions):
        raise UserError(
            "expert_noise, expert_errors and near_actions are of continuous actions, and "
            f"{name} has discrete ones: leave them out."
        )
    algorithm = _chosen(name, config)
    for field, instead in (
        ("expert_episode_steps", "has whole episodes"),
        ("expert_pupils", "asks no pupils"),
    ):
        value = getattr(config, field)
        if value and not (algorithm in SEARCHES and SEARCHES[algorithm].linear):
            raise UserError(
                f"{field} is {value}, and the expert of {name} is found by {algorithm}, which {instead}: leave it out, "
                "or choose linear."
            )
    if algorithm in SEARCHES:
        search = SEARCHES[algorithm]
        if search.linear and isinstance(space, spaces.Discrete):
            raise UserError(
                f"the expert of {search.what} has continuous actions and {name} discrete ones: choose evolution, or "
                "an algorithm."
            )
        if config.expert_steps is not None:
            raise UserError(
                f"expert_steps is {config.expert_steps}, but {search.what} finds the expert of {name} "
                "and trains no agent: leave it out, or choose an algorithm for the expert."
            )
        return None
    check_algorithms([algorithm], kind_of_actions(space))
    spec = environment_agent(algorithm, name).with_values(**WARM_START.get((algorithm, name), {}))
    return spec.with_values(total_steps=config.expert_steps)


def _chosen(name: str, config: WarmStartConfig) -> str:
    if config.expert != "auto":
        return config.expert
    return "ppo" if has_values_for("ppo", name) else "evolution"


def warm_start(
    bandit: SyntheticBandit,
    specs: Mapping[str, AgentSpec],
    place: Place,
    key: jax.Array,
    config: WarmStartConfig,
    quiet: bool = True,
) -> tuple[Weights, dict[str, float]]:
    """A bandit's weights fitted to an expert of an environment, and how the fit came about.

    Args:
      bandit: whose weights.
      specs: of the agents that train in the bandit, for rounds of aggregation.
      place: the environment.
      key: decides everything.
      config: how.
      quiet: no progress on the terminal.

    Raises:
      UserError: the expert earns less than random actions.
    """
    watch = Stopwatch()
    key_expert, key_data, key_fit = split_key(key, 3)
    fit = partial(fit_bandit, bandit, construction=config.construction, steps=config.fit_steps)
    worth = None
    if config.expert_pupils:
        pupils = Learners(bandit, specs, place, config.expert_pupils, PUPILS_EPISODES)

        def worth(policy: Partial, key: jax.Array) -> tuple[float, int]:
            key_data, key_fit, key_agents = split_key(key, 3)
            dataset, steps = expert_dataset(Expert(policy, 0.0, 0), place, key_data, config)
            earned, *_ = pupils(fit(dataset, key_fit)[0], key_agents)
            return earned, steps + pupils.steps

    expert = find_expert(place, key_expert, config, quiet, worth)
    random = environment_spec(place.name).random_return(place.backend)
    if expert.mean_return < random:
        raise UserError(
            f"the expert of {place.name} earns {expert.mean_return:.4g} and random actions {random:.4g}: give it more "
            "steps or generations, or choose another expert."
        )
    dataset, steps = expert_dataset(expert, place, key_data, config)
    found = fit(dataset, key_fit)
    if config.aggregation_rounds:

        def improve(latest: Weights, visited: Visited, learned: Any, key: jax.Array) -> Any:
            nonlocal dataset
            key_pick, key_label, key_fit = split_key(key, 3)
            more, taken = labelled(expert, place, visited, key_pick, key_label, config)
            dataset = jax.tree.map(lambda *x: jnp.concatenate(x), dataset, more)
            return fit(dataset, key_fit), taken

        rounds = config.aggregation_rounds
        learners = Learners(bandit, specs, place, config.aggregation_agents)
        key_rounds = named_key(key, "rounds")
        progress_console(quiet).print("aggregating a dataset, what agents of each fit earn:")
        found, taken = best_round(found, learners, rounds, key_rounds, improve, quiet)
        steps += taken
    weights, report = found
    return weights, {
        "expert_return": expert.mean_return,
        "environment_steps": expert.environment_steps + steps,
        "seconds": round(watch.lap(), 1),
        **report,
    }


def find_expert(
    place: Place,
    key: jax.Array,
    config: WarmStartConfig,
    quiet: bool = True,
    worth: Worth | None = None,
) -> Expert:
    """An expert for an environment of the registry; `worth` is what a linear search judges its policies by."""
    spec = expert_agent(place.name, place.env.action_space(place.params), config)
    if spec is None:
        search = SEARCHES[_chosen(place.name, config)]
        progress_console(quiet).print(f"looking for an expert of {place.name} by {search.what}")
        return search.find(place, key, config, quiet, worth)
    progress_console(quiet).print(f"training {config.num_experts} experts of {place.name}")
    return train_expert(place.env, place.params, spec, key, config.num_experts)


def expert_dataset(
    expert: Expert, place: Place, key: jax.Array, config: WarmStartConfig
) -> tuple[ExpertDataset, int]:
    """What an expert does, and what actions are worth, in states of trajectories that it takes part in.

    They mix expert and random actions, each with its own proportion, so that they cover what an agent
    meets on its way to becoming an expert, or are the expert's with its noise and errors.

    Returns:
      (the dataset, environment steps it took).
    """
    key_roll, key_pick, _, key_label = split_key(key, 4)
    policy = expert.policy if isinstance(expert.policy, Partial) else Partial(expert.policy)
    visited = _trajectories(place, config)(policy, split_key(key_roll, TRAJECTORIES))
    return labelled(expert, place, visited, key_pick, key_label, config)


@lru_cache(maxsize=2)  # physics take long to compile, and a search asks it of many policies
def _trajectories(place: Place, config: WarmStartConfig) -> Callable[[Partial, jax.Array], Visited]:
    """(policy, [N] keys) -> [N, T, ...] states that it takes part in visiting."""
    space = place.env.action_space(place.params)
    size = math.prod(place.env.observation_space(place.params).shape)

    def roll(policy: Partial, key: jax.Array) -> Visited:
        key_reset, key_skill, key_steps = split_key(key, 3)
        skill = jax.random.uniform(key_skill)
        if config.erring:
            assert not isinstance(space, spaces.Discrete)
            off = erring(policy, size, space, config.expert_errors, key)
            off_each_step = noisy(off, space, config.expert_noise)

        def act(observation: jax.Array, keys: jax.Array) -> jax.Array:
            if config.erring:
                return off_each_step(observation, keys[0])
            return jnp.where(
                jax.random.uniform(keys[1]) < skill,
                policy(jnp.ravel(observation)),
                space.sample(keys[0]),
            )

        return trajectory(place, act, key_reset, key_steps)

    return jax.jit(jax.vmap(roll, in_axes=(None, 0)))


def labelled(
    expert: Expert,
    place: Place,
    visited: Visited,
    key_pick: jax.Array,
    key_label: jax.Array,
    config: WarmStartConfig,
) -> tuple[ExpertDataset, int]:
    """What the expert does, and what actions are worth, in `num_states` of [N, T, ...] states.

    Q-values are by simulation: from a stored state take an action once, then follow the expert. All
    actions of a state share one key: their differences are exact where the environment is
    deterministic.

    Returns:
      (the dataset, environment steps that the states and the simulations took).
    """
    space, number = place.env.action_space(place.params), config.num_states
    total = visited.observation.shape[0] * visited.observation.shape[1]
    chosen = jax.random.choice(key_pick, total, (number,), replace=number > total)
    states = jax.tree.map(lambda x: jnp.reshape(x, (-1, *x.shape[2:]))[chosen], visited)

    def expert_policy(observation: jax.Array) -> jax.Array:
        return expert.policy(jnp.ravel(observation))

    def q_value(env_state: Any, action: jax.Array, key: jax.Array) -> jax.Array:
        def follow(carry: Any, key: jax.Array) -> Any:
            env_state, action, weight = carry
            observation, env_state, reward, terminated, _ = place.env.step_env(
                key, env_state, action, place.params
            )
            reward = jnp.reshape(reward, ()) * weight
            weight = weight * config.discount * (1.0 - terminated)
            return (env_state, expert_policy(observation), weight), reward

        start = (env_state, action, jnp.float32(1.0))
        return jax.lax.scan(follow, start, split_key(key, config.horizon))[1].sum()

    @jax.jit
    @jax.vmap
    def label(env_state: Any, observation: jax.Array, key: jax.Array) -> Any:
        key_random, key_follow = split_key(key)
        key_near = named_key(key, "near")
        best = jnp.reshape(expert_policy(observation), space.shape)
        if isinstance(space, spaces.Discrete):
            actions = jnp.arange(space.n)
        else:
            others = config.num_actions - 1
            random = jax.vmap(space.sample)(split_key(key_random, others))
            if config.near_actions:
                about = noisy(expert.policy, space, 0.3)
                near = jax.vmap(about, in_axes=(None, 0))(observation, split_key(key_near, others))
                which = jnp.arange(others) < config.near_actions
                random = jnp.where(jnp.expand_dims(which, range(1, random.ndim)), near, random)
            actions = jnp.concatenate([best[None], random])
        if config.construction == "action_distance":
            q = jnp.zeros(actions.shape[0])  # it only asks what the expert does
        else:
            q = jax.vmap(q_value, in_axes=(None, 0, None))(env_state, actions, key_follow)
        return actions, q, best

    actions, q, best = label(*states, split_key(key_label, number))
    observations = states.observation
    if config.min_spread > 0 or config.stretch != 1 or config.jitter > 0:
        key_jitter = named_key(key_label, "jitter")
        observations, best = _stretched(observations, key_jitter, config, expert_policy)
        best = jnp.reshape(best, (number, *space.shape))
        if not isinstance(space, spaces.Discrete):
            actions = actions.at[:, 0].set(best)
    dataset = ExpertDataset(jnp.reshape(observations, (number, -1)), actions, q, best)
    if config.construction != "action_distance":
        total += number * actions.shape[1] * config.horizon
    return dataset, total


def _stretched(
    observations: jax.Array,
    key: jax.Array,
    config: WarmStartConfig,
    policy: Callable[[jax.Array], jax.Array],
) -> tuple[jax.Array, jax.Array]:
    """[S, O] states whose every entry has the least deviation, stretched and jittered; what the expert does there."""
    flat = jnp.reshape(observations, (observations.shape[0], -1))
    mean, std = flat.mean(axis=0), flat.std(axis=0)
    factors = config.stretch * jnp.maximum(1.0, config.min_spread / (std + 1e-8))
    stretched = mean + (flat - mean) * factors
    if config.jitter:
        stretched += config.jitter * std * jax.random.normal(key, flat.shape)
    return stretched, jax.jit(jax.vmap(policy))(stretched)
