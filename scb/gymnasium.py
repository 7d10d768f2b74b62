"""Bandits and synthetic MDPs as Gymnasium's environments, in NumPy: JAX draws the start states of a "T", and no more.

import gymnasium, scb
env = gymnasium.make("scb/Synthetic-Pendulum-v1")  # or "scb:scb/Synthetic-Pendulum-v1", which imports scb
envs = gymnasium.make_vec("scb/Synthetic-Pendulum-v1", num_envs=1024)
env = gymnasium.make("scb/Synthetic", file="path/to/bandit.npz")
"""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from scb.environments.in_numpy import InNumpy
from scb.environments.zoo import load_synthetic, space_description, zoo_names
from scb.errors import UserError, count_at_least, one_of

NAMESPACE = "scb"
_BLOCK = 256  # first observations that are drawn together, which costs hardly more than one


def register() -> None:
    """Registers every bandit of the zoo with Gymnasium, and `scb/Synthetic` for files."""
    names = {f"{NAMESPACE}/{name}": {"file": name} for name in zoo_names()}
    for identifier, arguments in {**names, f"{NAMESPACE}/Synthetic": {}}.items():
        if identifier not in gymnasium.registry:
            gymnasium.register(
                identifier,
                entry_point=f"{__name__}:SyntheticEnv",
                vector_entry_point=f"{__name__}:SyntheticVectorEnv",
                kwargs=arguments,
            )


def _opened(file: str) -> tuple[InNumpy, spaces.Box, spaces.Space[Any]]:
    """(its functions, observation space, action space) of a bandit of the zoo or a file."""
    if not file:
        raise UserError(
            f"no bandit is named: give file='path/to/bandit.npz', or make {NAMESPACE}/{zoo_names()[0]} and the like."
        )
    synthetic = load_synthetic(str(file))
    observations = spaces.Box(-np.inf, np.inf, (synthetic.observation_size,), np.float32)
    described = space_description(synthetic.action_space())
    actions: spaces.Space[Any]
    if described["type"] == "discrete":
        actions = spaces.Discrete(described["n"])
    else:
        low, high = (np.array(described[x], np.float32) for x in ("low", "high"))
        actions = spaces.Box(low, high, tuple(described["shape"]), np.float32)
    return InNumpy(synthetic), observations, actions


def _check_finite(actions: np.ndarray) -> None:
    """A UserError for the first of [B, ...] actions that is not finite; a synthetic MDP may overflow by itself."""
    for action in actions:
        if not np.isfinite(action).all():
            raise UserError(
                f"an action is {action.tolist()}, which gives no reward: it must be finite."
            )


class NothingToShow(UserError, TypeError):
    """A render mode is asked for. Stable-Baselines3 asks for one, and leaves it out after a TypeError."""


class SyntheticEnv(gymnasium.Env[np.ndarray, Any]):
    """One bandit or synthetic MDP.

    A bandit's episode is one step: it terminates, and its last observation is its first. Continuous actions are
    clipped to their bounds.

    Args:
      file: NAME.npz, or the name of a bandit of the zoo.
      render_mode: None, as many scripts say it.

    Raises:
      UserError: the file cannot be read, or is none of them; another render mode, which is a TypeError too.
    """

    def __init__(self, file: str = "", render_mode: None = None) -> None:
        _check_shown(render_mode)
        self._functions, self.observation_space, self.action_space = _opened(file)
        self._observation: np.ndarray | None = None
        self._starts = np.empty((0, 0), np.float32)
        self._drawn_by: np.random.Generator | None = None
        self._next = self._time = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        rng = self.np_random
        # Another generator came with a seed, and what the last one drew is not of it.
        if self._drawn_by is not rng or self._next == len(self._starts):
            self._starts = self._functions.start(rng, _BLOCK)
            self._drawn_by, self._next = rng, 0
            self._prepare()
        self._observation = self._starts[self._next : self._next + 1]
        self._next, self._time = self._next + 1, 0
        return self._observation[0].copy(), {}

    def _prepare(self) -> None:
        """Computes what rewards need of the first observations that are there."""
        if self._functions.one_step and len(self._starts):
            self._reward = self._functions.rewards_of(self._starts)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_reward"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._prepare()

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        if self._observation is None:
            raise UserError("the episode has not begun, or is over: call reset first.")
        if self._functions.one_step:
            earned = self._reward(self._next - 1, np.asarray(action))
            if earned != earned:
                _check_finite(np.asarray(action)[None])
            observation, self._observation = self._observation[0].copy(), None
            return observation, earned, True, False, {}
        after, reward, terminations = self._functions.step(
            self._observation, np.asarray(action)[None]
        )
        if reward[0] != reward[0]:
            _check_finite(np.asarray(action)[None])
        self._time += 1
        terminated = bool(terminations[0])
        truncated = not terminated and self._time >= self._functions.max_steps
        self._observation = None if terminated or truncated else after
        return after[0].copy(), float(reward[0]), terminated, truncated, {}


def _check_shown(render_mode: str | None) -> None:
    if render_mode is not None:
        raise NothingToShow(
            f"render_mode is {render_mode!r}, and a bandit has nothing to show: leave it out."
        )


class SyntheticVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Many of one bandit or synthetic MDP, stepped together.

    Args:
      file: NAME.npz, or the name of a bandit of the zoo.
      num_envs: how many.
      autoreset_mode: SameStep, NextStep or Disabled, see `gymnasium.vector.AutoresetMode`. With NextStep,
        Gymnasium's usual one, every other step of a bandit is a reset, which pays nothing; but its wrappers of
        many environments need it: in SameStep RecordEpisodeStatistics records zeros from the second step on, and
        those of observations are refused.
      render_mode: None, as many scripts say it.

    Raises:
      UserError: the file cannot be read, or is none of them; an unknown mode; another render mode.
    """

    def __init__(
        self,
        file: str = "",
        num_envs: int = 1,
        autoreset_mode: str | AutoresetMode = AutoresetMode.SAME_STEP,
        render_mode: None = None,
    ) -> None:
        _check_shown(render_mode)
        count_at_least(1, num_envs=num_envs)
        mode = autoreset_mode.value if isinstance(autoreset_mode, AutoresetMode) else autoreset_mode
        one_of("autoreset mode", mode, [x.value for x in AutoresetMode])
        self._mode, self.num_envs = AutoresetMode(mode), num_envs
        self.metadata = {"autoreset_mode": self._mode}
        self._functions, self.single_observation_space, self.single_action_space = _opened(file)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._observations = np.zeros(self.observation_space.shape or (), np.float32)
        self._times = np.zeros(num_envs, int)
        self._over = np.ones(num_envs, bool)
        self._begun = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begins new episodes; of `options`, "reset_mask" [num_envs] says where, all being left out.

        Raises:
          UserError: a seed for each, where all draw from one generator; a mask of another shape or type.
        """
        given: object = seed
        if isinstance(given, list | tuple | np.ndarray):
            raise UserError(
                f"the seed is {given!r}: these environments draw from one generator, so give one whole number, or make "
                "them with vectorization_mode='sync', each with its own."
            )
        super().reset(seed=seed)
        self._begun = True
        mask = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, bool)))
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise UserError(
                f"the reset_mask has the shape {mask.shape} and the type {mask.dtype}: give a bool for each of the "
                f"{self.num_envs} environments."
            )
        self._begin(mask)
        return self._observations.copy(), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        waiting = self._over.copy()
        if waiting.any() and not (self._begun and self._mode is AutoresetMode.NEXT_STEP):
            raise UserError(
                f"{waiting.sum()} of {self.num_envs} episodes have not begun, or are over: call reset first."
            )
        actions = np.asarray(actions)
        if (number := len(actions) if actions.ndim else 0) != self.num_envs:
            raise UserError(f"there are {number} actions for {self.num_envs} environments.")
        if waiting.any():  # what they are given is not looked at, and loops give what they like
            actions = actions.copy()
            actions[waiting] = 0
        after, rewards, terminated = self._functions.step(self._observations, actions)
        if np.isnan(rewards).any():
            _check_finite(actions)
        self._times += 1
        truncated = ~terminated & (self._times >= self._functions.max_steps)
        rewards = rewards.astype(np.float64)
        if waiting.any():  # the step that only begins an episode
            rewards[waiting], terminated[waiting], truncated[waiting] = 0.0, False, False
        self._observations, self._over = np.array(after), terminated | truncated
        infos: dict[str, Any] = {}
        if self._mode is AutoresetMode.SAME_STEP and self._over.any():
            final = np.full(self.num_envs, None, object)
            for i in np.flatnonzero(self._over):
                final[i] = after[i]
            infos = {"final_obs": final, "_final_obs": self._over.copy()}
            infos |= {"final_info": {}, "_final_info": self._over.copy()}
            self._begin(self._over)
        elif waiting.any():
            self._begin(waiting)
        return self._observations.copy(), rewards, terminated, truncated, infos

    def _begin(self, where: np.ndarray) -> None:
        self._observations[where] = self._functions.start(self.np_random, int(where.sum()))
        self._times[where], self._over = 0, self._over & ~where
