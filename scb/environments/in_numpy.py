"""A synthetic environment's functions in NumPy, for loops outside JAX, where a JAX call a step would cost the most."""

from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import jax
import numpy as np
from gymnax.environments import spaces

from scb.environments.linear import PolicyDistanceParts
from scb.environments.synthetic import SyntheticBandit
from scb.environments.synthetic_mdp import SyntheticMDP
from scb.errors import UserError
from scb.keys import root_key, split_key
from scb.spaces import flat_bounds, misfit

Array: TypeAlias = np.ndarray
Generator: TypeAlias = np.random.Generator

_ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, 0.0),
    "swish": lambda x: x / (1.0 + np.exp(-x)),
}


def _one_hot_latents(logits: Array, rng: Generator, number: int) -> Array:
    shares = np.exp(logits - logits.max())
    chosen = rng.choice(logits.size, number, p=shares / shares.sum())
    return np.eye(logits.size, dtype=np.float32)[chosen]


_LATENTS: dict[str, Callable[[Generator, int, int], Array]] = {
    "normal": lambda rng, number, size: rng.standard_normal((number, size), np.float32),
    "uniform": lambda rng, number, size: rng.random((number, size), np.float32),
    "categorical": lambda rng, number, size: _one_hot_latents(np.zeros(size), rng, number),
    "softmax_categorical": lambda rng, number, size: _one_hot_latents(
        np.arange(1.0, size + 1.0), rng, number
    ),
}


class _Network:
    """[B, I] -> [B, O] of an `MLP` with these weights."""

    def __init__(self, weights: Mapping[str, Any], activation: str) -> None:
        layers = [weights[f"Dense_{i}"] for i in range(len(weights))]
        (self._first, self._bias), *self._others = [(x["kernel"], x["bias"]) for x in layers]
        self._activation = _ACTIVATIONS[activation]

    def __call__(self, inputs: Array) -> Array:
        # `dot` takes half as long as @ where matrices are this small.
        return self._rest(inputs.dot(self._first) + self._bias)

    def _rest(self, units: Array) -> Array:
        for kernel, bias in self._others:
            units = self._activation(units).dot(kernel) + bias
        return units

    def of_rows(self, inputs: Array) -> Callable[[int, Array], Array]:
        """[B, J] of the inputs -> a function of a row and the other [I - J], which computes only what is of these."""
        given, others = inputs.shape[1], self._first[inputs.shape[1] :]
        shares = inputs.dot(self._first[:given]) + self._bias
        return lambda row, rest: self._rest(shares[row] + rest.dot(others))


class InNumpy:
    """What a bandit or a synthetic MDP does, [B] at a time; but for rounding the same numbers as in JAX.

    Args:
      synthetic: with weights of its own.

    Attributes:
      one_step: whether every step ends its episode.
      max_steps: of an episode.
    """

    def __init__(self, synthetic: SyntheticBandit | SyntheticMDP) -> None:
        self._synthetic = synthetic
        params: Any = synthetic.default_params
        self.one_step, self.max_steps = synthetic.one_step, int(params.max_steps_in_episode)
        self._space = synthetic.action_space()
        self._encode = _encoding(self._space)
        self._draw, self._latent_size = _LATENTS[synthetic.config.latent], synthetic.latent_size
        weights = jax.tree.map(np.asarray, params.weights)
        self._networks = {
            name: _Network(of_it, synthetic.config.activation)
            for name, of_it in weights.items()
            if "Dense_0" in of_it
        }
        self._distance = None
        if isinstance(synthetic, SyntheticBandit) and synthetic.linear:
            parts = PolicyDistanceParts.of(weights["reward"], *synthetic.bounds, np)
            # Arrays of no axis are slow.
            self._distance = parts._replace(
                offset=float(parts.offset),
                scale=float(parts.scale),
                half_power=float(parts.half_power),
            )
        self._starts = None
        if isinstance(synthetic, SyntheticMDP) and synthetic.env is not None:
            reset = jax.vmap(synthetic.reset, (0, None))
            self._starts = jax.jit(lambda keys: reset(keys, params)[0])

    # It holds functions that cannot be pickled, and has no state.
    def __reduce__(self) -> tuple[Any, ...]:
        return InNumpy, (self._synthetic,)

    def __deepcopy__(self, memo: Any) -> "InNumpy":
        return self

    def start(self, rng: Generator, number: int) -> Array:
        """[number, O] first observations of episodes."""
        if self._starts is None:
            return self._networks["initial_state"](self._draw(rng, number, self._latent_size))
        # Of the environment that it stands for, which is JAX's: compiled for powers of two, not for every number.
        keys = split_key(root_key(int(rng.integers(2**32))), 1 << (number - 1).bit_length())
        return np.array(self._starts(keys))[:number]

    def rewards_of(self, contexts: Array) -> Callable[[int, Any], float]:
        """[B, O] contexts of a bandit -> the reward of an action in a row of them, but for the action computed now."""
        space = self._space
        if isinstance(space, spaces.Discrete):
            actions = range(space.n)
            each = [self.step(contexts, np.full(len(contexts), action))[1] for action in actions]
            table = np.stack(each, axis=1).tolist()

            def of_table(row: int, action: Any) -> float:
                if action.shape or action.dtype.kind not in "iu":
                    raise misfit(action.shape, action.dtype, space)
                if not 0 <= action < len(actions):
                    raise _outside(action, len(actions))
                return float(table[row][action])

            return of_table
        if (distance := self._distance) is not None:
            best = distance.best(contexts)

            def of_distance(row: int, action: Any) -> float:
                difference = distance.share(self._encode(action[None])[0]) - best[row]
                return float(distance.reward(float(difference.dot(difference))))

            return of_distance
        reward = self._networks["reward"].of_rows(contexts)
        return lambda row, action: float(reward(row, self._encode(action[None])[0])[0])

    def step(self, observation: Array, action: Array) -> tuple[Array, Array, Array]:
        """[B, O] observations and [B, ...] actions -> [B, O] next ones, [B] rewards, [B] whether episodes terminate."""
        encoded = self._encode(action)
        if self._distance is not None:
            return observation, self._distance(observation, encoded), np.ones(len(encoded), bool)
        inputs = np.concatenate([observation, encoded], axis=1)
        reward = self._networks["reward"](inputs)[:, 0]
        if self.one_step:
            return observation, reward, np.ones(len(reward), bool)
        terminated = self._networks["termination"](inputs)[:, 0] > 0.0
        return self._networks["transition"](inputs), reward, terminated


def _outside(action: Any, number: int) -> UserError:
    return UserError(f"an action is {action}: it must be 0 or larger, and below {number}.")


def _encoding(space: spaces.Box | spaces.Discrete) -> Callable[[Array], Array]:
    """[B, ...] actions -> [B, A] as networks take them, see `scb.environments.synthetic.encode_action`."""
    if isinstance(space, spaces.Discrete):
        choices = np.eye(space.n, dtype=np.float32)

        def one_hot(action: Array) -> Array:
            if action.ndim != 1 or action.dtype.kind not in "iu":
                raise misfit(action.shape[1:], action.dtype, space)
            outside = (action < 0) | (action >= space.n)
            if outside.any():
                raise _outside(action[outside][0], space.n)
            return choices[action]

        return one_hot
    low, high = (x.reshape(space.shape) for x in flat_bounds(space, np))

    # minimum and maximum are quicker than clip, of which there is one a step.
    def clipped(action: Array) -> Array:
        try:
            numbers = np.asarray(action, np.float32)
        except (TypeError, ValueError) as error:  # a text, for instance
            raise misfit(action.shape[1:], action.dtype, space) from error
        if numbers.shape[1:] != space.shape:
            raise misfit(numbers.shape[1:], numbers.dtype, space)
        return np.minimum(np.maximum(numbers, low), high).reshape(len(numbers), -1)

    return clipped
