"""Objectives of one's own: what PPO is to maximise, as a function of the ratio and the advantage."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from lpo.drifts.contract import Array, Drift
from scb import own
from scb.errors import UserError, first_line

ARGUMENTS = ("ratio", "log_ratio", "advantage", "progress", "xp")


@dataclass(frozen=True)
class SurrogateDrift(Drift):
    """The drift of a surrogate objective: ratio * advantage less what a function of one's own returns.

    Attributes:
      function: what PPO maximises the mean of, [B]. It is given what it names of ratio [B], log_ratio [B], advantage
        [B], normalised over the minibatch, progress [B], the fraction of training done, and xp, which is `jax.numpy`,
        `numpy` or `torch`: one that computes with xp can be had in all three.

    Raises:
      UserError: it is no function of these.
    """

    name: ClassVar[str] = "surrogate"

    function: Callable[..., Array]

    def __post_init__(self) -> None:
        # Of an object that can be called nothing says what it holds.
        if own.plain_function(self.function) is None:
            raise UserError(
                f"the surrogate is of the class {type(self.function).__name__}: give a function of ratio and "
                "advantage, or a functools.partial of one."
            )
        strange = [name for name in self._takes if name not in ARGUMENTS]
        if strange or "advantage" not in self._takes:
            raise UserError(
                f"the surrogate {self.called} takes {', '.join(self._takes) or 'nothing'}: let it take advantage, and "
                f"what it needs of {', '.join(ARGUMENTS)}, by these names."
            )

    @property
    def called(self) -> str:
        """The function's name."""
        return str(getattr(own.plain_function(self.function), "__name__", "surrogate"))

    @property
    def _takes(self) -> list[str]:
        parameters = inspect.signature(self.function).parameters.values()
        return [x.name for x in parameters if x.default is x.empty or x.name in ARGUMENTS]

    @property
    def temporal(self) -> bool:
        return "progress" in self._takes

    def init(self, key: jax.Array, scale: float = 1.0) -> jax.Array:
        return jnp.zeros(())

    def __call__(
        self, parameters: Any, log_ratio: Array, advantage: Array, progress: Array, xp: Any = jnp
    ) -> Array:
        ratio = xp.exp(log_ratio)
        values = (ratio, log_ratio, advantage, progress, xp)
        given = dict(zip(ARGUMENTS, values, strict=True))
        try:
            surrogate = self.function(**{name: given[name] for name in self._takes})
        except TypeError as error:
            if xp is jnp:
                raise
            raise UserError(
                f"the surrogate {self.called} does not compute with {xp.__name__} ({first_line(error)}): let it take "
                "xp, and call xp.minimum and the like."
            ) from error
        if getattr(surrogate, "shape", None) != log_ratio.shape:
            raise UserError(
                f"the surrogate {self.called} returns the shape {getattr(surrogate, 'shape', surrogate)} for "
                f"{tuple(log_ratio.shape)} ratios: return a number for each, of which PPO takes the mean."
            )
        return ratio * advantage - surrogate
