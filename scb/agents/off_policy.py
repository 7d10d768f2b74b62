"""What SAC, DQN, DDPG and TD3 share: act, store, draw from the buffer, learn.

In an environment whose episodes are one step long nothing is ever bootstrapped: the target of every
Q-value is the reward. Such environments are known by their `one_step`, and what only serves
bootstrapping (target networks, the next state's action) is left out of their program.
"""

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct
from gymnax.environments import spaces
from jax.typing import ArrayLike

from scb.agents import replay
from scb.agents.agent import Agent, AgentConfig, clipped_adam
from scb.agents.normalization import RunningStatistics, update_statistics
from scb.errors import UserError
from scb.keys import key_at, split_key
from scb.spaces import kind_of_actions


@dataclass(frozen=True)
class OffPolicyConfig(AgentConfig):
    """Defaults are the paper's inner loop.

    Attributes:
      num_envs: environments that step side by side between gradient steps.
      buffer_size: transitions that the replay buffer holds.
      prefill: random ones that it starts with.
      prefill_hold: steps for which each of those random actions is held, so that they lead somewhere
        (Dabney et al., 2021, "Temporally-extended epsilon-greedy exploration"); without effect in
        one-step environments.
      batch_size: transitions of a gradient step.
      gradient_steps: after each step of the environments.
      total_steps: as for all agents, the prefill included.
    """

    buffer_size: int = 2000
    prefill: int = 1000
    prefill_hold: int = 1
    batch_size: int = 100
    gradient_steps: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.prefill % self.num_envs:
            raise UserError(
                f"prefill is {self.prefill}, which {self.num_envs} environments side by side cannot "
                f"collect in whole steps: choose a multiple of {self.num_envs}."
            )
        if self.prefill > self.buffer_size:
            raise UserError(
                f"prefill is {self.prefill}, more than the replay buffer's {self.buffer_size}."
            )
        if self.prefill >= self.total_steps:
            raise UserError(
                f"prefill is {self.prefill}, which leaves nothing of {self.total_steps} steps to learn in."
            )

    @property
    def num_iterations(self) -> int:
        return -(-(self.total_steps - self.prefill) // self.num_envs)

    def steps_after(self, num_iterations: int) -> int:
        return self.prefill + num_iterations * self.num_envs


class Transition(NamedTuple):
    """Of one step, or of [B] steps. `next_observation` is taken before any automatic reset."""

    observation: jax.Array  # [O]
    action: jax.Array  # [] integer, or [A] within the action space's bounds
    reward: jax.Array  # []
    terminated: jax.Array  # [] 1.0 where nothing follows
    next_observation: jax.Array  # [O]


@struct.dataclass
class Learner:
    """What an agent learned; `targets` are those of its networks that have one, None in one-step environments."""

    params: dict[str, Any]  # {network, or number: what is learned of it}
    targets: Any
    optimizer: dict[str, optax.OptState]

    def replaced(self, name: str, params: Any, optimizer_state: Any) -> "Learner":
        """With other parameters of one network."""
        params, state = {**self.params, name: params}, {**self.optimizer, name: optimizer_state}
        return Learner(params, self.targets, state)

    def stepped(
        self, name: str, optimizer: optax.GradientTransformation, gradient: Any
    ) -> "Learner":
        """After one step of one network."""
        state = self.optimizer[name], self.params[name]
        return self.replaced(name, *gradient_update(optimizer, gradient, *state))


@struct.dataclass
class OffPolicyState:
    """An agent: what it learned, its buffer, where its environments stand."""

    learner: Learner
    buffer: replay.ReplayBuffer
    statistics: RunningStatistics
    environment: Any  # [N] states and [N, O] observations; None in one-step environments
    iteration: jax.Array
    key: jax.Array


class Moment(NamedTuple):
    """What an agent explores and learns under: everything but what it learned and what it meets."""

    hyperparameters: Any
    env_params: Any
    progress: jax.Array | float = 0.0  # share of the environment steps taken
    step: jax.Array | int = 0  # gradient steps taken


@dataclass(frozen=True, eq=False)
class OffPolicyAgent(Agent):
    """The loop; a subclass says how to act and how to learn."""

    config: OffPolicyConfig
    with_targets: ClassVar[tuple[str, ...]]  # what has a target network

    @abstractmethod
    def init_params(self, key: jax.Array, env_params: Any) -> dict[str, Any]:
        """What is learned, by name."""

    def optimizer(self, hyperparameters: Any) -> optax.GradientTransformation:
        """Of everything that is learned."""
        return clipped_adam(hyperparameters)

    def init_learner(self, key: jax.Array, hyperparameters: Any, env_params: Any) -> Learner:
        """Networks, target networks and optimisers."""
        params, optimizer = self.init_params(key, env_params), self.optimizer(hyperparameters)
        targets = None if self.one_step else {name: params[name] for name in self.with_targets}
        return Learner(params, targets, {name: optimizer.init(p) for name, p in params.items()})

    @abstractmethod
    def explore(
        self, learner: Learner, observation: jax.Array, key: jax.Array, moment: Moment
    ) -> jax.Array:
        """[N, O] normalised observations -> [N, ...] actions to gather experience with."""

    @abstractmethod
    def learn(self, learner: Learner, batch: Transition, key: jax.Array, moment: Moment) -> Learner:
        """One gradient step on [B] transitions with normalised observations."""

    def update_targets(
        self, learner: Learner, hyperparameters: Any, iteration: jax.Array
    ) -> Learner:
        """Moves the target networks, once an iteration; not called in one-step environments."""
        online = {name: learner.params[name] for name in self.with_targets}
        targets = polyak_average(learner.targets, online, hyperparameters.polyak)
        return replace(learner, targets=targets)

    @abstractmethod
    def greedy(
        self, learner: Learner, observation: jax.Array, key: jax.Array, env_params: Any, mode: bool
    ) -> jax.Array:
        """[O] normalised observation -> the trained agent's action."""

    def init(self, key: jax.Array, hyperparameters: Any, env_params: Any) -> OffPolicyState:
        """A fresh agent with its buffer prefilled by uniformly random actions."""
        self.check_inputs(hyperparameters, env_params)
        key_learner, key_reset, key_prefill, key_train = split_key(key, 4)
        config, space = self.config, self.env.action_space(env_params)
        size = self.observation_size(env_params)
        standing = None
        if not self.one_step:
            standing = self._reset(key_reset, config.num_envs, env_params)
        action = jax.eval_shape(space.sample, key)
        if not isinstance(space, spaces.Discrete):
            # Whatever its own type is, actions between its bounds are taken.
            action = jax.ShapeDtypeStruct(action.shape, jnp.float32)
        observation, number = jnp.zeros(size), jnp.zeros(())
        example = Transition(observation, action, number, number, observation)
        state = OffPolicyState(
            learner=self.init_learner(key_learner, hyperparameters, env_params),
            buffer=replay.empty_buffer(example, config.buffer_size),
            statistics=RunningStatistics.start(size),
            environment=standing,
            iteration=jnp.int32(0),
            key=key_train,
        )

        def random_actions(observation: jax.Array, key: jax.Array) -> jax.Array:
            return jax.vmap(space.sample)(split_key(key, observation.shape[0]))

        if self.one_step:
            # Contexts are independent: all of them at once.
            _, transitions = self._transition(
                None, config.prefill, random_actions, key_prefill, env_params
            )
        else:
            steps = config.prefill // config.num_envs
            held = jnp.arange(steps) // config.prefill_hold
            keys = split_key(key_prefill, steps + 1)

            def step(standing: Any, inputs: tuple[jax.Array, jax.Array]) -> tuple[Any, Transition]:
                key, choice = inputs

                def hold(observation: jax.Array, _: jax.Array) -> jax.Array:
                    return random_actions(observation, key_at(keys[-1], choice))

                actions = random_actions if config.prefill_hold == 1 else hold
                return self._transition(standing, config.num_envs, actions, key, env_params)

            standing, transitions = jax.lax.scan(step, standing, (keys[:-1], held))
            transitions = jax.tree.map(
                lambda x: jnp.reshape(x, (config.prefill, *x.shape[2:])), transitions
            )
        return self._remember(replace(state, environment=standing), transitions)

    def iterate(
        self, state: OffPolicyState, hyperparameters: Any, env_params: Any
    ) -> OffPolicyState:
        config = self.config
        key, key_step, *keys_learn = split_key(state.key, 2 + config.gradient_steps)
        progress = (config.prefill + state.iteration * config.num_envs) / config.total_steps

        def explore(observation: jax.Array, key: jax.Array) -> jax.Array:
            moment = Moment(hyperparameters, env_params, progress=progress)
            return self.explore(state.learner, self._inputs(state, observation), key, moment)

        standing, transitions = self._transition(
            state.environment, config.num_envs, explore, key_step, env_params
        )
        state = self._remember(replace(state, key=key, environment=standing), transitions)

        def gradient_step(learner: Any, inputs: tuple[jax.Array, jax.Array]) -> tuple[Any, None]:
            key, number = inputs
            key_sample, key_learn = split_key(key)
            batch = replay.sample(state.buffer, key_sample, config.batch_size)
            batch = batch._replace(
                observation=self._inputs(state, batch.observation),
                next_observation=self._inputs(state, batch.next_observation),
            )
            step = state.iteration * config.gradient_steps + number
            moment = Moment(hyperparameters, env_params, step=step)
            return self.learn(learner, batch, key_learn, moment), None

        learner, _ = jax.lax.scan(
            gradient_step,
            state.learner,
            (jnp.stack(keys_learn), jnp.arange(config.gradient_steps)),
            unroll=config.gradient_steps <= 4,
        )
        if not self.one_step:
            learner = self.update_targets(learner, hyperparameters, state.iteration)
        return replace(state, learner=learner, iteration=state.iteration + 1)

    def learned(self, state: OffPolicyState) -> Any:
        return state.learner.params

    def choose(
        self,
        state: OffPolicyState,
        observation: jax.Array,
        key: jax.Array,
        env_params: Any,
        mode: bool,
    ) -> jax.Array:
        return self.greedy(state.learner, self._inputs(state, observation), key, env_params, mode)

    def _transition(
        self, standing: Any, number: int, policy: Any, key: jax.Array, env_params: Any
    ) -> tuple[Any, Transition]:
        """One step of `number` environments; one-step environments start afresh."""
        key_reset, key_act, key_step = split_key(key, 3)
        if self.one_step:
            standing = self._reset(key_reset, number, env_params)
        action = policy(standing[1], key_act)
        standing, step = self._step(standing, action, key_step, env_params)
        terminated = step.terminated.astype(jnp.float32)
        return standing, Transition(
            step.observation, step.action, step.reward, terminated, step.final_observation
        )

    def _remember(self, state: OffPolicyState, transitions: Transition) -> OffPolicyState:
        if self.config.normalize_observations:
            statistics = update_statistics(state.statistics, transitions.observation)
            state = replace(state, statistics=statistics)
        return replace(state, buffer=replay.add(state.buffer, transitions))


def target_values(batch: Transition, next_value: jax.Array, discount: ArrayLike) -> jax.Array:
    """[B] r + discount * V(s'), without V where the episode terminated (a truncation is no termination)."""
    # Chosen and not multiplied: 0 times what is no number is none.
    return batch.reward + discount * jnp.where(batch.terminated > 0, 0.0, next_value)


def polyak_average(target: Any, online: Any, polyak: ArrayLike) -> Any:
    """Polyak * target + (1 - polyak) * online: the paper's convention, in which 0.99 moves slowly."""
    # optax.incremental_update is the same sum the other way round, and rounds its last bit otherwise.
    return jax.tree.map(lambda t, o: polyak * t + (1.0 - polyak) * o, target, online)


def gradient_update(
    optimizer: optax.GradientTransformation, gradient: Any, optimizer_state: Any, params: Any
) -> tuple[Any, Any]:
    """(new params, new optimiser state)."""
    updates, optimizer_state = optimizer.update(gradient, optimizer_state, params)
    return optax.apply_updates(params, updates), optimizer_state


def require_actions(algorithm: str, space: spaces.Box | spaces.Discrete, needed: str) -> None:
    """Raises a UserError where an algorithm needs "discrete" or "continuous" actions, and the space has others."""
    has = kind_of_actions(space)
    if has != needed:
        raise UserError(
            f"{algorithm} needs {needed} actions, and this environment has {has} ones: use an algorithm for "
            "those, such as ppo or sac."
        )
