"""Fully synthetic MDPs: environments of many steps whose weights are evolved.

The parameterisations of Liesen et al. (2024), appendix "Ablations of the Meta-Evolution Algorithm":

  T   learned transition, reward and termination; episodes start where the evaluation environment's
      do. What Ferreira et al. (2022), "Learning Synthetic Environments and Reward Networks", learn.
  TI  and a learned initial-state distribution.
  I   that distribution and the reward alone, one step long: the bandit of `synthetic.py`.

The state is the observation, a learned function of its predecessor. With ReLU it may grow beyond any
number over long episodes (with tanh it is bounded by the last layer's weights): NaN and infinities
are passed on as they are, and evolution ranks such a candidate last.
"""

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from gymnax.environments import environment, spaces
from jax.typing import ArrayLike

from scb.environments.synthetic import (
    BanditConfig,
    SyntheticBandit,
    SyntheticEnvironment,
    Weights,
    bandit_for,
)
from scb.errors import UserError, at_least, one_of
from scb.spaces import flat_size

MDP_PARAMETERIZATIONS = ("T", "TI")
PARAMETERIZATIONS = (*MDP_PARAMETERIZATIONS, "I")


@struct.dataclass
class MDPState(environment.EnvState):
    observation: jax.Array  # [O]
    terminated: jax.Array  # [] whether the step that led here ended the episode by itself


@struct.dataclass
class MDPParams(environment.EnvParams):
    """What a step may read: all traced, so weights and episode lengths vmap.

    Attributes:
      weights: {"reward": {...}, "transition": {...}, "termination": {...}}, two Dense layers each,
        and "initial_state" where that is learned.
      max_steps_in_episode: at least 1. Without effect where `MDPConfig.max_steps` is 1.
    """

    weights: Weights = struct.field(default_factory=dict)
    max_steps_in_episode: ArrayLike = 1


@dataclass(frozen=True)
class MDPConfig(BanditConfig):
    """What decides an MDP's shapes and program; layers and latents are a bandit's.

    Attributes:
      parameterization: "T" or "TI". A "T" has no latent.
      max_steps: maximum episode length, the default of `MDPParams.max_steps_in_episode`. At 1 it is
        also a promise, on which agents skip all that only longer episodes need.
    """

    parameterization: str = field(default="TI", kw_only=True)
    max_steps: int = field(kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        one_of("parameterization of a synthetic MDP", self.parameterization, MDP_PARAMETERIZATIONS)
        at_least(1, self, "max_steps")


class SyntheticMDP(SyntheticEnvironment[MDPState, MDPParams]):
    """An MDP with learned dynamics, as a gymnax 1.x environment.

    With [s, a] the observation and the action, joined: s' = transition([s, a]), r = reward([s, a]),
    and the step terminates where termination([s, a]) > 0, a logit against one half; all of it
    deterministic. An episode ends there, or at `max_steps_in_episode`: that is a truncation, to be
    bootstrapped, unless the step also terminates. Only where the maximum is 1 reaching it is a
    termination, and the step ends where it began: such a "TI" is the bandit of the same weights.

    Args:
      observation_size: as of `SyntheticEnvironment`, like the action space, the weights and the name.
      config: parameterisation and maximum episode length too.
      env: the evaluation environment, with its parameters, in whose start states a "T" starts; None for a
        "TI", which has its own. It starts where the environment's automatic reset does: for Brax, in
        a pool of states (see `BraxEnvironment`).

    Raises:
      UserError: a "T" without an evaluation environment, a "TI" with one, or an environment with
        observations of another size.
    """

    config: MDPConfig
    parameters = MDPParams
    learned = ("initial_state", "reward", "transition", "termination")

    def __init__(
        self,
        observation_size: int,
        action_space: spaces.Box | spaces.Discrete,
        config: MDPConfig,
        weights: Weights | None = None,
        name: str = "SyntheticMDP",
        env: environment.Environment[Any, Any] | None = None,
        env_params: Any = None,
    ) -> None:
        super().__init__(observation_size, action_space, config, weights, name)
        self.env = env
        self.env_params = (
            env.default_params if env is not None and env_params is None else env_params
        )
        self.max_steps, self.one_step = config.max_steps, config.max_steps == 1
        if (self.env is None) == (self.config.parameterization == "T"):
            raise UserError(
                f"{self.name!r} is a synthetic MDP of parameterization {self.config.parameterization} "
                f"{'without' if self.env is None else 'with'} an evaluation environment: give one to "
                "T, which starts in its start states, and none to TI."
            )
        if self.env is not None:
            size = flat_size(self.env.observation_space(self.env_params))
            if size != self.observation_size:
                raise UserError(
                    f"{self.name!r} has observations of {self.observation_size} entries and "
                    f"{self.env.name} has {size}: give the evaluation environment it was made for."
                )

    def init_weights(self, key: jax.Array) -> Weights:
        weights = super().init_weights(key)
        if self.config.parameterization == "T":
            del weights["initial_state"]
        return weights

    def transition(self, observation: jax.Array, action: ArrayLike, params: MDPParams) -> jax.Array:
        """[O] observation, action -> [O] next observation, not bounded in any way."""
        return self._learned("transition", self._inputs(observation, action), params)

    def termination_logit(
        self, observation: jax.Array, action: ArrayLike, params: MDPParams
    ) -> jax.Array:
        """[O] observation, action -> [] logit; the step terminates where it is positive, and not where it is NaN."""
        return self._learned("termination", self._inputs(observation, action), params)[0]

    def reset_env(self, key: jax.Array, params: MDPParams) -> tuple[jax.Array, MDPState]:
        if self.env is None:
            observation = self.draw_context(key, params)
        else:
            start, _ = self.env.reset_env(key, self.env_params)
            observation = jnp.ravel(start).astype(jnp.float32)
        state = MDPState(time=jnp.int32(0), observation=observation, terminated=jnp.bool_(False))
        return observation, state

    def step_env(
        self, key: jax.Array, state: MDPState, action: ArrayLike, params: MDPParams
    ) -> tuple[jax.Array, MDPState, jax.Array, jax.Array, dict[str, Any]]:
        single = self._limit(params) <= 1
        after = self.transition(state.observation, action, params)
        # As in the bandit; and an overflow that no agent is to see cannot reach it this way either.
        after = jnp.where(single, state.observation, after)
        terminated = single | (self.termination_logit(state.observation, action, params) > 0.0)
        reward = self.mean_reward(state.observation, action, params)
        state = MDPState(time=state.time + 1, observation=after, terminated=terminated)
        return after, state, reward, terminated, {"discount": self.discount(state, params)}

    def _limit(self, params: MDPParams) -> jax.Array:
        # Written out where it is promised: the compiler then drops the networks that don't matter.
        return jnp.asarray(1 if self.one_step else params.max_steps_in_episode)

    def is_terminated(self, state: MDPState, params: MDPParams) -> jax.Array:
        return state.terminated

    def is_truncated(self, state: MDPState, params: MDPParams) -> jax.Array:
        """Whether the maximum length alone ended the episode."""
        return (state.time >= self._limit(params)) & ~state.terminated


def synthetic_for(
    env: environment.Environment[Any, Any],
    env_params: Any,
    parameterization: str,
    config: BanditConfig,
    name: str,
    max_steps: int | None = None,
) -> SyntheticBandit | SyntheticMDP:
    """An untrained synthetic environment with the (flattened) shapes of an evaluation environment.

    Args:
      env, env_params: the evaluation environment.
      parameterization: "T", "TI" or "I", as in the paper; "I" is the bandit.
      config: layers and latents; of an `MDPConfig`, nothing else is read.
      name: of what is returned.
      max_steps: maximum episode length; None: the evaluation environment's own, and 1 for "I".

    Raises:
      UserError: an unknown parameterisation, or a maximum length that is not possible with it.
    """
    one_of("parameterization", parameterization, PARAMETERIZATIONS)
    layers = (config.hidden_size, config.activation, config.latent, config.latent_size)
    if parameterization == "I":
        if max_steps not in (None, 1):
            raise UserError(
                f"max_steps is {max_steps}, and parameterization I has episodes of 1 step: leave it out, "
                "or choose TI."
            )
        return bandit_for(env, env_params, BanditConfig(*layers, config.form), name)
    if config.form != "networks":
        raise UserError(
            f"form is {config.form}, a bandit's, and parameterization {parameterization} is none: leave it out."
        )
    if max_steps is None:
        max_steps = int(env_params.max_steps_in_episode)
    mdp_config = MDPConfig(*layers, parameterization=parameterization, max_steps=max_steps)
    observation_size = flat_size(env.observation_space(env_params))
    start = {"env": env, "env_params": env_params} if parameterization == "T" else {}
    return SyntheticMDP(
        observation_size, env.action_space(env_params), mdp_config, name=name, **start
    )
