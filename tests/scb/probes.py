"""Environments whose values and optima are known, for the tests of everything that trains or evaluates."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from gymnax.environments import environment, spaces

from scb.agents.spec import ALGORITHMS
from scb.environments.spec import Family, Made
from scb.environments.synthetic import BanditConfig, SyntheticBandit
from scb.evolution import EnvironmentSteps
from scb.experts import Expert


@struct.dataclass
class CorridorState(environment.EnvState):
    cell: jax.Array


@struct.dataclass
class CorridorParams(environment.EnvParams):
    """All traced: corridors of different lengths and rewards are one program.

    Attributes:
      rewards: [C, A] reward of an action in a cell.
      last: the cell after which the episode terminates; C or more for a corridor that goes on from
        cell 0.
      random_start: 1 to start in a uniformly random cell (up to `last`), 0 to start in cell 0.
      single_step: 1 for an episode to terminate after its first step, wherever that is.
    """

    rewards: Any = struct.field(default_factory=lambda: jnp.ones((3, 2)))
    last: Any = 2
    random_start: Any = 0
    single_step: Any = 0
    max_steps_in_episode: Any = 100


class Corridor(environment.Environment[CorridorState, CorridorParams]):
    """Walks through `cells` cells, whatever the agent does; the observation is the cell, one-hot."""

    def __init__(self, cells: int = 3, num_actions: int = 2) -> None:
        self.cells, self._num_actions = cells, num_actions

    @property
    def default_params(self) -> CorridorParams:
        return CorridorParams(
            rewards=jnp.ones((self.cells, self._num_actions)), last=self.cells - 1
        )

    @property
    def num_actions(self) -> int:
        return self._num_actions

    def reset_env(self, key: jax.Array, params: CorridorParams) -> tuple[jax.Array, CorridorState]:
        end = jnp.minimum(params.last + 1, self.cells)
        start = jax.random.randint(key, (), 0, end) * params.random_start
        state = CorridorState(time=jnp.int32(0), cell=jnp.int32(start))
        return self.get_obs(state), state

    def step_env(
        self, key: jax.Array, state: CorridorState, action: jax.Array, params: CorridorParams
    ) -> tuple[jax.Array, CorridorState, jax.Array, jax.Array, dict[str, Any]]:
        reward = self.reward(state, action, params)
        terminated = (state.cell >= params.last) | (jnp.asarray(params.single_step) > 0)
        state = CorridorState(time=state.time + 1, cell=(state.cell + 1) % self.cells)
        return self.get_obs(state), state, reward, terminated, {}

    def reward(self, state: CorridorState, action: jax.Array, params: CorridorParams) -> jax.Array:
        return params.rewards[state.cell, action]

    def get_obs(self, state: CorridorState, params: Any = None, key: Any = None) -> jax.Array:
        return jax.nn.one_hot(state.cell, self.cells)

    def action_space(self, params: CorridorParams | None = None) -> spaces.Discrete:
        return spaces.Discrete(self._num_actions)

    def observation_space(self, params: CorridorParams | None = None) -> spaces.Box:
        return spaces.Box(0.0, 1.0, (self.cells,), jnp.float32)


class Corridors(Family):
    """All that a new family of environments is, but for its line in `scb/environments/__init__.py`."""

    name = "corridors"
    suite = ("Corridor-v0", "LongCorridor-v0")

    def names(self) -> Sequence[str]:
        return self.suite

    def make(self, name: str, **arguments: Any) -> Made:
        env = Corridor(**{"cells": 3 if name == "Corridor-v0" else 9} | arguments)
        return env, env.default_params


class ContinuousCorridor(Corridor):
    """A corridor whose cells pay (height, curvature, target) = `rewards[cell]`: height - curvature * |a - target|^2.

    Actions lie in [-1, 2], which is neither symmetric nor of width 2: what forgets to scale is found
    out.
    """

    @property
    def default_params(self) -> CorridorParams:
        return CorridorParams(
            rewards=jnp.tile(jnp.array([1.0, 1.0, 0.5]), (self.cells, 1)), last=self.cells - 1
        )

    def reward(self, state: CorridorState, action: jax.Array, params: CorridorParams) -> jax.Array:
        height, curvature, target = params.rewards[state.cell]
        return height - curvature * jnp.sum((action - target) ** 2)

    def action_space(self, params: CorridorParams | None = None) -> spaces.Box:
        return spaces.Box(-1.0, 2.0, (1,), jnp.float32)


# For two cells, which pay 1 - (a - t)^2 with t = -0.5 and 1.5: 2 at best. The best constant action,
# 0.5, earns 0, and so do uniform actions or less.
TWO_TARGETS = CorridorParams(
    rewards=jnp.array([[1.0, 1.0, -0.5], [1.0, 1.0, 1.5]]), last=1, max_steps_in_episode=2
)


def assert_solves_two_targets(expert: Expert) -> None:
    assert expert.mean_return > 1.8
    first, second = (expert.policy(cell) for cell in jnp.eye(2))
    assert first.shape == (1,)
    assert float(first[0]) == pytest.approx(-0.5, abs=0.4)
    assert float(second[0]) == pytest.approx(1.5, abs=0.4)
    # Far outside of what it has seen, an action is still within the bounds.
    far = np.asarray(jax.vmap(expert.policy)(1e3 * jnp.eye(2)))
    assert far.min() >= -1.0 and far.max() <= 2.0


def context_bandit() -> SyntheticBandit:
    """A bandit with weights by hand: the context is uniform in [0, 1], the reward is -|action - context|.

    initial_state: relu(1 z) * 1, z the uniform latent. reward: -relu(a - c) - relu(c - a).
    """
    weights = {
        "initial_state": {
            "Dense_0": {"kernel": jnp.array([[1.0, 0.0]]), "bias": jnp.zeros(2)},
            "Dense_1": {"kernel": jnp.array([[1.0], [0.0]]), "bias": jnp.zeros(1)},
        },
        "reward": {
            "Dense_0": {"kernel": jnp.array([[-1.0, 1.0], [1.0, -1.0]]), "bias": jnp.zeros(2)},
            "Dense_1": {"kernel": jnp.array([[-1.0], [-1.0]]), "bias": jnp.zeros(1)},
        },
    }
    return SyntheticBandit(
        observation_size=1,
        action_space=spaces.Box(-1.0, 2.0, (1,), jnp.float32),
        config=BanditConfig(hidden_size=2, activation="relu", latent="uniform"),
        weights=weights,
        name="Synthetic-Context",
    )


class Parabola:
    """An evolution problem: fitness -|x - 3|^2 of a candidate {"x": [2]}, plus noise that all candidates share.

    Attributes:
      noise: its standard deviation.
    """

    def __init__(self, noise: float = 0.0) -> None:
        self.noise = noise

    def initial_solution(self, key: jax.Array) -> dict[str, jax.Array]:
        return {"x": jnp.zeros(2)}

    def evaluate(
        self, candidate: dict[str, jax.Array], key: jax.Array, generation: jax.Array
    ) -> dict[str, jax.Array]:
        fitness = -jnp.sum((candidate["x"] - 3.0) ** 2) + self.noise * jax.random.normal(key)
        return {"fitness": fitness, "x0": candidate["x"][0]}

    def evaluate_mean(
        self, candidate: dict[str, jax.Array], key: jax.Array
    ) -> dict[str, jax.Array]:
        return {"fitness": self.evaluate(candidate, key, jnp.int32(0))["fitness"]}

    def steps(self, generation: int = 0) -> EnvironmentSteps:
        return EnvironmentSteps(training=10, evaluation=3)

    def judgement_steps(self) -> EnvironmentSteps:
        return EnvironmentSteps(training=7, evaluation=2)


class Slope(Parabola):
    """Fitness is the sum of x, or what that is with the other sign."""

    def __init__(self, sign: float = 1.0) -> None:
        super().__init__()
        self.sign = sign

    def evaluate(
        self, candidate: dict[str, jax.Array], key: jax.Array, generation: jax.Array
    ) -> dict[str, jax.Array]:
        return {"fitness": self.sign * candidate["x"].sum()}


@contextmanager
def small_agents() -> Iterator[None]:
    """The paper's tables with 16 steps and networks of four units; numbers, lists and limits as they are."""
    off_policy = {"buffer_size": 16, "prefill": 8, "batch_size": 4, "gradient_steps": 1}
    sizes = {"num_envs": 2, "total_steps": 16, "hidden_sizes": (4,)}
    with pytest.MonkeyPatch.context() as patch:
        for name, tables in ALGORITHMS.items():
            traced = {f.name for f in fields(tables.algorithm.hyperparameters())}

            def numbers(row: Any, traced: set[str] = traced) -> Any:
                return replace(row, values={k: x for k, x in row.values.items() if k in traced})

            on_policy = {"num_steps": 8, "num_epochs": 1, "num_minibatches": 1}
            config = partial(
                tables.algorithm.config, **sizes, **(on_policy if name == "ppo" else off_policy)
            )
            small = replace(
                tables,
                algorithm=replace(tables.algorithm, config=config),
                general=numbers(tables.general),
                families={x: {} for x in tables.families},
                environments={x: numbers(row) for x, row in tables.environments.items()},
            )
            patch.setitem(ALGORITHMS, name, small)
        yield
