"""Curricula: how many steps an evaluation episode may take, as a function of the generation.

Liesen et al. (2024): evaluated for all of its 1000 steps from the start, a hopper's bandit converges
to one that teaches balance; short episodes that grow longer reward moving forward. For MountainCar
it is the other way round: long episodes that grow shorter let an agent reach the goal at all.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax.typing import ArrayLike

from scb.errors import UserError, at_least, one_of

Schedule = Callable[[jax.Array], jax.Array]

# transition -> a schedule of the share of (initial - final) that is left, from 1 at step 0 to 0 at
# step `transition`. "exponential" is none of them: it changes by a constant factor, not towards 0.
_REMAINDERS: dict[str, Callable[[int], Schedule]] = {
    "linear": lambda transition: optax.linear_schedule(1.0, 0.0, transition),
    "quadratic": lambda transition: optax.polynomial_schedule(1.0, 0.0, 2, transition),
    "cosine": lambda transition: optax.cosine_decay_schedule(1.0, transition),
    "step": lambda transition: optax.piecewise_constant_schedule(1.0, {transition / 2: 0.0}),
}
SHAPES = ("constant", "linear", "quadratic", "cosine", "exponential", "step")


@dataclass(frozen=True)
class CurriculumConfig:
    """How an evaluation episode's length goes from `initial` to `final`.

    Attributes:
      shape: "linear"; "quadratic", fast at first; "cosine", slow at both ends; "exponential", by
        the same factor in every generation; "step", one jump in the middle of the transition;
        "constant".
      initial: steps until generation `begin`.
      final: steps from generation `begin + transition` on.
      begin: the last generation with the initial length.
      transition: generations from the initial length to the final one.
    """

    shape: str
    initial: int
    final: int
    begin: int = 0
    transition: int = 1

    def __post_init__(self) -> None:
        one_of("curriculum shape", self.shape, SHAPES)
        at_least(0, **{"the generation at which the curriculum begins": self.begin})
        lengths = {"initial length": self.initial, "final length": self.final}
        for name, value in {**lengths, "transition": self.transition}.items():
            at_least(1, **{f"the curriculum's {name}": value})
        if self.shape == "constant" and self.initial != self.final:
            raise UserError(
                f"a constant curriculum cannot go from {self.initial} to {self.final} steps: give "
                "one length for both, or another shape."
            )

    def __str__(self) -> str:
        return f"{self.shape}:{self.initial}:{self.final}:{self.begin}:{self.transition}"

    @property
    def longest(self) -> int:
        """Steps of its longest episodes, which the environment's limit must not cut."""
        return max(self.initial, self.final)

    def rescaled(self, from_generations: int, to_generations: int) -> "CurriculumConfig":
        """The same curriculum for a search of another length.

        `begin` and `transition` are rounded down, so that the transition does not end later in the
        search than it did; it keeps at least one generation.
        """
        at_least(1, from_generations=from_generations, to_generations=to_generations)
        return replace(
            self,
            begin=self.begin * to_generations // from_generations,
            transition=max(1, self.transition * to_generations // from_generations),
        )


def read_curriculum(words: str) -> CurriculumConfig | str | None:
    """A curriculum from the command line: paper, none, or SHAPE:INITIAL:FINAL:BEGIN:TRANSITION."""
    if words in ("none", "paper"):
        return None if words == "none" else words
    shape, *lengths = words.split(":")
    try:
        initial, final, begin, transition = (int(length) for length in lengths)
    except ValueError as error:
        raise UserError(
            f"the curriculum {words!r} is not understood: give paper, none, or "
            "SHAPE:INITIAL:FINAL:BEGIN:TRANSITION such as linear:100:1000:20:160."
        ) from error
    return CurriculumConfig(shape, initial, final, begin, transition)


# Table "Hyperparameters for evaluation length curricula".
_MOUNTAIN_CAR = CurriculumConfig("linear", initial=1000, final=200, begin=200, transition=600)
_BRAX = CurriculumConfig("linear", initial=100, final=1000, begin=200, transition=1600)
# HumanoidStandup is missing in the paper's table of generations but has results, so it is taken for a fifth
# environment of 2000 beside Ant, which has no results.
_LONG = ("hopper", "walker2d", "swimmer", "halfcheetah", "ant", "humanoidstandup")
# Brax's other environments search for 30 to 300 generations, which a transition of 1600 does not fit.
PAPER_CURRICULA = {"MountainCar-v0": _MOUNTAIN_CAR, **dict.fromkeys(_LONG, _BRAX)}
_GENERATIONS = {
    "MountainCar-v0": 1000,
    "Pendulum-v1": 1000,
    "reacher": 30,
    "pusher": 100,
    **dict.fromkeys(_LONG, 2000),
}


def paper_generations(environment_name: str) -> int:
    """How long the paper searches: its table "Number of generations for each environment", 300 elsewhere."""
    return _GENERATIONS.get(environment_name, 300)


def paper_curriculum(
    environment_name: str, num_generations: int | None = None
) -> CurriculumConfig | None:
    """The paper's curriculum for an evaluation environment; None where it uses none.

    Args:
      environment_name: as `scb.make` takes it.
      num_generations: rescales it to a search of this length; None leaves it as in the paper.
    """
    if environment_name not in PAPER_CURRICULA:
        return None
    curriculum = PAPER_CURRICULA[environment_name]
    if num_generations is None:
        return curriculum
    return curriculum.rescaled(paper_generations(environment_name), num_generations)


def horizon(config: CurriculumConfig) -> Callable[[ArrayLike], jax.Array]:
    """Maps a generation to the int32 steps after which an evaluation episode is cut, rounded to the nearest.

    The generation may be traced, so that one program serves a whole search.
    """

    def schedule(generation: ArrayLike) -> jax.Array:
        # Not optax's transition_begin, which its cosine does not have.
        count = jnp.clip(jnp.asarray(generation) - config.begin, 0, config.transition)
        return jnp.round(_length(config)(count)).astype(jnp.int32)

    return schedule


def _length(config: CurriculumConfig) -> Schedule:
    if config.shape == "constant":
        return lambda count: jnp.full_like(count, config.final, dtype=jnp.float32)
    if config.shape == "exponential":
        decay: Schedule = optax.exponential_decay(
            float(config.initial), config.transition, config.final / config.initial
        )
        return decay
    remainder = _REMAINDERS[config.shape](config.transition)
    return lambda count: config.final + (config.initial - config.final) * remainder(count)


def check_curriculum(config: CurriculumConfig, limit: int, environment_name: str) -> None:
    """Raises a UserError where a curriculum ends with longer episodes than the environment has.

    Longer ones on the way are allowed, as in MountainCar, where `with_limit` makes room for them.
    """
    if config.final > limit:
        raise UserError(
            f"the curriculum ends with episodes of {config.final} steps, but one of "
            f"{environment_name} takes at most {limit}: give a final length up to that."
        )


class EpisodeLengths:
    """How long a search's evaluation episodes are: the environment's own, or as its curriculum says.

    Attributes:
      params: the environment's, which leave all cutting to `limit` where there is a curriculum.
    """

    def __init__(self, config: CurriculumConfig | None, env_params: Any) -> None:
        self._horizon, self.params = None, env_params
        if config is not None:
            self._horizon, self.params = horizon(config), with_limit(env_params, config.longest)

    def limit(self, generation: ArrayLike) -> jax.Array | None:
        """[] after how many steps an episode of this generation is cut; None where the environment alone says."""
        return None if self._horizon is None else self._horizon(generation)

    def steps(self, generation: int) -> int:
        """Of the longest episode of this generation."""
        limit = self.limit(generation)
        return int(self.params.max_steps_in_episode if limit is None else limit)


def with_limit(env_params: Any, limit: ArrayLike) -> Any:
    """An environment's parameters with another time limit, in steps.

    A curriculum's horizon only ever cuts an episode that the environment would let go on:
    `with_limit(env_params, config.longest)` leaves all cutting to the horizon.
    """
    return env_params.replace(max_steps_in_episode=limit)
