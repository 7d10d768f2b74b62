"""What all agents share: the contract, training in segments, acting, evaluation.

An agent is static configuration; its hyperparameters are traced numbers. `init`, `train`, `act` and
`evaluate` are pure, to be jitted once and vmapped over keys, hyperparameters and environments by
the caller.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from gymnax.environments import environment
from jax.typing import ArrayLike

from scb.agents import networks
from scb.agents.normalization import normalize
from scb.agents.values import check_values
from scb.errors import UserError, at_least, count_at_least, counted, one_of
from scb.evaluation import Episodes, evaluate
from scb.keys import split_key
from scb.spaces import clip_to_space, flat_size, shapes


@dataclass(frozen=True)
class AgentConfig(ABC):
    """What decides shapes and program: a change recompiles. Defaults are the paper's inner loop.

    Attributes:
      num_envs: environments that step side by side.
      total_steps: environment steps of the whole training, rounded up to whole iterations.
      hidden_sizes: of all networks, which share nothing.
      activation: between their layers.
      normalize_observations: by running mean and variance, frozen with the agent for evaluation.
    """

    num_envs: int = 1
    total_steps: int = 10_000
    hidden_sizes: tuple[int, ...] = (64, 64)
    activation: str = "tanh"
    normalize_observations: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.hidden_sizes, tuple):
            raise UserError(
                f"hidden_sizes is {self.hidden_sizes!r}: give one size a layer, (64, 64) in Python, and [64,64] in "
                "words."
            )
        sizes = tuple(
            counted(f"hidden_sizes[{i}]", size) for i, size in enumerate(self.hidden_sizes)
        )
        counts = {
            f.name: counted(f.name, getattr(self, f.name)) for f in fields(self) if f.type is int
        }
        at_least(1, **counts, **{f"hidden_sizes[{i}]": size for i, size in enumerate(sizes)})
        # Python's own numbers: NumPy's have no bit_length, and are none of JSON's.
        for name, value in {**counts, "hidden_sizes": sizes}.items():
            object.__setattr__(self, name, value)
        for name in (f.name for f in fields(self) if f.type is bool):
            if not isinstance(getattr(self, name), bool):
                raise UserError(f"{name} is {getattr(self, name)!r}: it must be true or false.")
        one_of("activation", self.activation, networks.ACTIVATIONS)

    @property
    @abstractmethod
    def num_iterations(self) -> int:
        """Of a training: as often is a batch of experience collected, and learned from."""

    @abstractmethod
    def steps_after(self, num_iterations: int) -> int:
        """Environment steps after so many iterations."""

    @property
    def num_environment_steps(self) -> int:
        """Steps that a training takes: `total_steps` rounded up."""
        return self.steps_after(self.num_iterations)


class Step(NamedTuple):
    """A step of N environments side by side.

    Attributes:
      observation: [N, O] of the states in which the actions were taken.
      action: [N, ...] as they were taken, within the space's bounds.
      reward: [N].
      terminated, truncated: [N] whether the episode ended with it, and whether it was cut off.
      final_observation: [N, O] of the states that it led to, before any reset.
    """

    observation: jax.Array
    action: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    final_observation: jax.Array


def evaluated_after(iterations: int, every: int) -> list[int]:
    """Iterations after which an agent is evaluated: none, every `every`-th, and the last."""
    return [*range(0, iterations, every), iterations]


def _check_environment(env: Any) -> None:
    if not isinstance(env, environment.Environment):
        raise UserError(
            f"the environment is a {type(env).__name__}: give a gymnax 1.x environment, such as the first of "
            "scb.make(NAME), and make a subclass of one for what a wrapper would do."
        )


def _check_params(env: environment.Environment[Any, Any], params: Any) -> None:
    try:
        wanted = type(env.default_params)
    except UserError:  # a synthetic one without weights, whose parameters hold some
        return
    # One of somebody's own may come with parameters of a class that it does not name.
    if wanted is not environment.EnvParams and not isinstance(params, wanted):
        given, own = type(params).__name__, wanted.__name__
        if given == own:  # gymnax calls those of every environment EnvParams
            given, own = (f"{x.__module__}.{x.__name__}" for x in (type(params), wanted))
        raise UserError(
            f"the environment's parameters are of the class {given}, and those of {env.name} of {own}: give the second "
            "of scb.make(NAME), of the same environment."
        )


@dataclass(frozen=True, eq=False)
class Agent(ABC):
    """An algorithm in one environment.

    Args:
      env: a gymnax 1.x environment.
      config: static configuration.
    """

    takes: ClassVar[type] = object  # the class of its hyperparameters
    env: environment.Environment[Any, Any]
    config: AgentConfig

    def __post_init__(self) -> None:
        _check_environment(self.env)
        (wanted,) = (field.type for field in fields(self) if field.name == "config")
        if isinstance(wanted, type) and not isinstance(self.config, wanted):
            raise UserError(
                f"the configuration is a {type(self.config).__name__}, and {type(self).__name__} takes a "
                f"{wanted.__name__}."
            )

    def check_inputs(self, hyperparameters: Any, env_params: Any) -> None:
        """Raises a UserError for hyperparameters of another algorithm, or parameters of another environment.

        And for values that an agent cannot take, unless they are traced, as what is given to a jitted `train` is.
        """
        if not isinstance(hyperparameters, self.takes):
            raise UserError(
                f"the hyperparameters are of the class {type(hyperparameters).__name__}: give (key, "
                f"{self.takes.__name__}, the environment's parameters), in this order."
            )
        check_values(hyperparameters)
        _check_params(self.env, env_params)

    @property
    def one_step(self) -> bool:
        """Whether every episode is a single step, so that there is never anything to bootstrap."""
        return bool(getattr(self.env, "one_step", False))

    @abstractmethod
    def init(self, key: jax.Array, hyperparameters: Any, env_params: Any) -> Any:
        """A fresh agent, its environments at their first observation."""

    @abstractmethod
    def iterate(self, state: Any, hyperparameters: Any, env_params: Any) -> Any:
        """Collects a batch of experience and learns from it, once."""

    @abstractmethod
    def choose(
        self, state: Any, observation: jax.Array, key: jax.Array, env_params: Any, mode: bool
    ) -> jax.Array:
        """[O] observation -> action, not yet clipped to the action space."""

    def train(self, key: jax.Array, hyperparameters: Any, env_params: Any) -> Any:
        """Initialises and trains for `config.num_iterations`."""
        state = self.init(key, hyperparameters, env_params)
        return self.train_iterations(state, hyperparameters, env_params, self.config.num_iterations)

    def train_iterations(
        self, state: Any, hyperparameters: Any, env_params: Any, num_iterations: int | jax.Array
    ) -> Any:
        """`num_iterations` times: collect, then learn. A segment of a longer training.

        A traced number makes one program for all lengths; where a population shares it, only as many
        iterations are computed.
        """
        if isinstance(num_iterations, jax.Array):
            return jax.lax.fori_loop(
                0,
                num_iterations,
                lambda _, state: self.iterate(state, hyperparameters, env_params),
                state,
            )

        def iteration(state: Any, _: None) -> tuple[Any, None]:
            return self.iterate(state, hyperparameters, env_params), None

        state, _ = jax.lax.scan(iteration, state, None, num_iterations)
        return state

    def train_with_evaluations(
        self,
        key: jax.Array,
        hyperparameters: Any,
        env_params: Any,
        evaluation: Callable[[Any, jax.Array], Any],
        every: int,
    ) -> tuple[Any, Any]:
        """Trains, and evaluates before the first and after every `every`-th iteration, and at the end.

        Args:
          evaluation: (state, key) -> pytree of what is wanted of the agent at that point.
          every: iterations between evaluations; the last are fewer where it does not divide
            `config.num_iterations`.

        Returns:
          The trained agent, and the evaluations stacked along a new first axis, after the iterations that
          `evaluated_after` names.
        """
        if every < 1:
            raise UserError(f"evaluation every {every} iterations: give a number from 1 on.")
        at = evaluated_after(self.config.num_iterations, every)
        lengths = np.diff(at)
        key_train, key_evaluate = split_key(key)
        state = self.init(key_train, hyperparameters, env_params)

        def segment(state: Any, inputs: tuple[jax.Array, jax.Array]) -> tuple[Any, Any]:
            key, length = inputs
            outcome = evaluation(state, key)
            # A fixed length is a little faster, and a traced one makes one program of two lengths.
            number = every if lengths[-1] == every else length
            return self.train_iterations(state, hyperparameters, env_params, number), outcome

        keys = split_key(key_evaluate, len(at))
        state, outcomes = jax.lax.scan(segment, state, (keys[:-1], jnp.asarray(lengths)))
        last = evaluation(state, keys[-1])
        return state, jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), outcomes, last)

    def act(
        self,
        state: Any,
        observation: jax.Array,
        key: jax.Array,
        env_params: Any = None,
        mode: bool = False,
    ) -> jax.Array:
        """The agent's action for one observation, within the action space's bounds.

        Args:
          mode: the most likely action instead of a sampled one.
        """
        env_params = self.env.default_params if env_params is None else env_params
        action = self.choose(state, jnp.ravel(observation), key, env_params, mode)
        return clip_to_space(action, self.env.action_space(env_params))

    def evaluate(
        self,
        state: Any,
        key: jax.Array,
        num_episodes: int,
        env: environment.Environment[Any, Any] | None = None,
        env_params: Any = None,
        mode: bool = False,
        horizon: ArrayLike | None = None,
    ) -> Episodes:
        """Episodes of the frozen agent, in its own environment or in another of the same shapes.

        Args:
          env: where the episodes are; None for the agent's environment. In another, the agent's actions are
            scaled to the bounds of its own environment with its default parameters.
          env_params: None for the environment's default parameters.
          horizon: steps after which an episode is cut; None for the environment's own limit.

        Returns:
          Episodes of shape [num_episodes], with returns of NaN where the agent diverged.

        Raises:
          UserError: the other environment has other observations or actions, or a horizon is shorter than a step.
        """
        env = self.env if env is None else env
        _check_environment(env)
        count_at_least(1, num_episodes=num_episodes)
        if isinstance(horizon, int | np.integer):  # and no array, which may be traced
            at_least(1, horizon=int(horizon))
        env_params = env.default_params if env_params is None else env_params
        _check_params(env, env_params)
        own_params = env_params
        if env is not self.env:
            own_params = self._default_params()
            ours, theirs = shapes(self.env, own_params), shapes(env, env_params)
            if ours != theirs:
                raise UserError(
                    f"{self.env.name} has {ours}, {env.name} has {theirs}: evaluate an agent where these are the same."
                )

        def policy(observation: jax.Array, key: jax.Array) -> jax.Array:
            action = self.choose(state, jnp.ravel(observation), key, own_params, mode)
            return clip_to_space(action, env.action_space(env_params))

        episodes = evaluate(env, env_params, policy, key, num_episodes, horizon)
        # Of what is no number the largest is discrete action 0, which would earn something.
        leaves = jax.tree.leaves(self.learned(state))
        sound = jnp.all(jnp.stack([jnp.isfinite(x).all() for x in leaves])) if leaves else True
        return episodes._replace(returns=jnp.where(sound, episodes.returns, jnp.nan))

    def learned(self, state: Any) -> Any:
        """A pytree of all numbers that were learned, of which an agent that diverged has some that are not finite."""
        return ()

    def _reset(self, key: jax.Array, number: int, env_params: Any) -> tuple[Any, jax.Array]:
        """Where `number` environments stand at the start of an episode: (their states, [N, O] observations)."""
        reset = self.env.reset_env if self.one_step else self.env.reset
        observation, env_state = jax.vmap(reset, in_axes=(0, None))(
            split_key(key, number), env_params
        )
        return env_state, _flatten(observation)

    def _step(
        self, standing: tuple[Any, jax.Array], action: jax.Array, key: jax.Array, env_params: Any
    ) -> tuple[tuple[Any, jax.Array] | None, Step]:
        """Environments take a step from where they stand, and reset where it ends an episode.

        Args:
          action: [N, ...], not yet clipped to the action space.

        Returns:
          (where they stand then, or None where every episode is one step; the step).
        """
        env_state, observation = standing
        number, space = observation.shape[0], self.env.action_space(env_params)
        action = jax.vmap(lambda a: clip_to_space(a, space))(action)
        inputs = (split_key(key, number), env_state, action, env_params)
        after = None
        if self.one_step:
            step = jax.vmap(self.env.step_env, in_axes=(0, 0, 0, None))
            _, _, reward, terminated, _ = step(*inputs)
            truncated, final = jnp.zeros_like(terminated), observation
        else:
            step = jax.vmap(self.env.step, in_axes=(0, 0, 0, None))
            following, env_state, reward, terminated, truncated, info = step(*inputs)
            after = (env_state, _flatten(following))
            final = _flatten(info["final_observation"])
        reward = jnp.reshape(reward, (number,)).astype(jnp.float32)
        terminated = jnp.reshape(terminated, (number,))
        return after, Step(observation, action, reward, terminated, truncated, final)

    def _default_params(self) -> Any:
        """Of the agent's environment; None of a synthetic one without weights, whose spaces depend on none."""
        try:
            return self.env.default_params
        except UserError:
            return None

    def _inputs(self, state: Any, observation: jax.Array) -> jax.Array:
        """[..., O] what the networks are given of an observation."""
        if self.config.normalize_observations:
            return normalize(state.statistics, observation)
        return observation

    def observation_size(self, env_params: Any) -> int:
        """Of the flattened observation."""
        return flat_size(self.env.observation_space(env_params))


def clipped_adam(hyperparameters: Any, eps: float = 1e-8) -> optax.GradientTransformation:
    """Adam with `learning_rate`, of gradients clipped to the global norm `max_grad_norm`."""
    return optax.chain(
        optax.clip_by_global_norm(hyperparameters.max_grad_norm),
        optax.adam(hyperparameters.learning_rate, eps=eps),
    )


@dataclass(frozen=True)
class Algorithm:
    """An algorithm as its module exports it and the tables name it.

    Attributes:
      name: as the command line takes it.
      agent: its class, called with (environment, configuration).
      config, hyperparameters: called without arguments for the defaults, which are the paper's inner
        loop.
      actions: the kinds of actions that it fits.
    """

    name: str
    agent: type[Agent]
    config: Callable[[], AgentConfig]
    hyperparameters: Callable[[], Any]
    actions: tuple[str, ...] = ("discrete", "continuous")


def _flatten(observation: jax.Array) -> jax.Array:
    """[N, ...] -> [N, O] floats: some grid worlds observe integers."""
    return jnp.reshape(observation, (observation.shape[0], -1)).astype(jnp.float32)
