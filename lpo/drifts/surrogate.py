"""Objectives of one's own: what PPO is to maximise, as a function of the ratio and the advantage."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from lpo.drifts.contract import Array, Drift
from scb.errors import UserError, first_line

# What a function raises that is to be traced, and asks for a value.
_TRACED = (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError)
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
        try:
            parameters = inspect.signature(self.function).parameters.values()
        except (TypeError, ValueError) as error:  # of what is written in C
            raise UserError(
                f"the surrogate {self.called} does not say what it takes: give a function of ratio and advantage."
            ) from error
        strange = [x.name for x in parameters if x.kind in (x.POSITIONAL_ONLY, x.VAR_POSITIONAL)]
        strange += [name for name in self._takes if name not in ARGUMENTS]
        if strange or "advantage" not in self._takes:
            taken = ", ".join(x.name for x in parameters) or "nothing"
            raise UserError(
                f"the surrogate {self.called} takes {taken}: let it take advantage, and what it needs of "
                f"{', '.join(ARGUMENTS)}, by these names."
            )

    @property
    def called(self) -> str:
        """The function's name."""
        function: Any = self.function
        while isinstance(function, partial):
            function = function.func
        return str(getattr(function, "__name__", type(function).__name__))

    @cached_property  # a training loop in PyTorch calls this for every minibatch
    def _takes(self) -> list[str]:
        parameters = inspect.signature(self.function).parameters.values()
        by_name = (x for x in parameters if x.kind in (x.POSITIONAL_OR_KEYWORD, x.KEYWORD_ONLY))
        return [x.name for x in by_name if x.default is x.empty or x.name in ARGUMENTS]

    def _refused(self, error: Exception, xp: Any) -> UserError:
        where = {"jax.numpy": "in JAX", "numpy": "with NumPy", "torch": "with PyTorch"}[xp.__name__]
        said = first_line(error)
        advice = ""
        if isinstance(error, _TRACED) or "truth value" in said:
            advice = ": use xp.where in place of if, and xp in place of numpy"
        elif xp.__name__ != "torch" and isinstance(error, AttributeError):
            advice = (
                ": let it take xp, and call xp.clip and the like in place of what tensors can do"
            )
        elif xp.__name__ == "torch" and "xp" in self._takes:
            advice = "; its minimum and maximum take tensors alone, and xp.clip takes numbers"
        elif xp.__name__ == "torch":
            advice = ": let it take xp, and call xp.minimum and the like"
        return UserError(f"the surrogate {self.called} does not compute {where} ({said}){advice}.")

    @property
    def temporal(self) -> bool:
        return "progress" in self._takes

    def init(self, key: jax.Array, scale: float = 1.0) -> jax.Array:
        return jnp.zeros(())

    def check_slope(self) -> None:
        """Raises a UserError where agents would learn nothing by it, or the opposite: by its slope in the ratio, at 1.

        That is 0, or no number, or, as a loss's, against the sign of the advantage wherever it is not 0.
        """
        advantage = jnp.asarray([-2.0, -0.5, 0.5, 2.0])

        def total(log_ratio: jax.Array, progress: jax.Array) -> jax.Array:
            progress = jnp.full_like(advantage, progress)
            penalty = self(jnp.zeros(()), log_ratio, advantage, progress)
            return (jnp.exp(log_ratio) * advantage - penalty).sum()

        slope = jax.jit(jax.grad(total))  # traced, as in a training
        slopes = np.stack([slope(jnp.zeros_like(advantage), x) for x in (0.0, 0.5, 1.0)])
        if not np.isfinite(slopes).all():
            raise UserError(
                f"the surrogate {self.called} has a slope in the ratio that is no number where that is 1, as every "
                "update begins: let it be differentiable there."
            )
        along = slopes * np.asarray(advantage)
        if not along.any():
            raise UserError(
                f"the surrogate {self.called} does not change with the ratio where that is 1, and agents would learn "
                "nothing: let it take ratio, or log_ratio, and compute with it."
            )
        if (along <= 0).all():
            raise UserError(
                f"the surrogate {self.called} falls with the ratio where the advantage is positive, as a loss does: "
                "return its negative, which PPO maximises."
            )

    def __call__(
        self, parameters: Any, log_ratio: Array, advantage: Array, progress: Array, xp: Any = jnp
    ) -> Array:
        ratio = xp.exp(log_ratio)
        values = (ratio, log_ratio, advantage, progress, xp)
        given = dict(zip(ARGUMENTS, values, strict=True))
        try:
            surrogate = self.function(**{name: given[name] for name in self._takes})
        # Whatever a function does that is not ours.
        except Exception as error:
            raise self._refused(error, xp) from error
        if getattr(surrogate, "shape", None) != log_ratio.shape:
            raise UserError(
                f"the surrogate {self.called} returns the shape {getattr(surrogate, 'shape', surrogate)} for "
                f"{tuple(log_ratio.shape)} ratios: return a number for each, of which PPO takes the mean."
            )
        if "complex" in str(surrogate.dtype):
            raise UserError(
                f"the surrogate {self.called} returns complex numbers: return their real part, which PPO maximises."
            )
        return ratio * advantage - surrogate
