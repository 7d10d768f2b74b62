"""Drifts that are known in closed form: PPO's clip, DPO, and none."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import chex
import jax
import jax.numpy as jnp
import numpy as np

from lpo.drifts.bases import DPO_ALPHA, DPO_BETA, discovered_drift
from lpo.drifts.contract import Array, Drift
from scb.agents.drift import USUAL_CLIP, clipped_surrogate_drift
from scb.errors import UserError, positive
from scb.keys import root_key


@dataclass(frozen=True)
class ClipDrift(Drift):
    """PPO's clipped surrogate as a drift; its parameter is the clip epsilon."""

    name: ClassVar[str] = "clip"

    clip: float = USUAL_CLIP

    def __post_init__(self) -> None:
        _check(clip=self.clip)

    def init(self, key: jax.Array, scale: float = 1.0) -> jax.Array:
        return jnp.float32(self.clip)

    def with_parameters(self, parameters: Any) -> "ClipDrift":
        return replace(self, clip=_shortest(parameters))

    def __call__(
        self, parameters: Any, log_ratio: Array, advantage: Array, progress: Array, xp: Any = jnp
    ) -> Array:
        return clipped_surrogate_drift(parameters, log_ratio, advantage, progress, xp)


@dataclass(frozen=True)
class DPODrift(Drift):
    """Discovered policy optimisation (Lu et al., 2022, eq. 6): the closed form read off a learned drift."""

    name: ClassVar[str] = "dpo"

    alpha: float = DPO_ALPHA
    beta: float = DPO_BETA

    def __post_init__(self) -> None:
        _check(alpha=self.alpha, beta=self.beta)

    def init(self, key: jax.Array, scale: float = 1.0) -> dict[str, jax.Array]:
        return {"alpha": jnp.float32(self.alpha), "beta": jnp.float32(self.beta)}

    def with_parameters(self, parameters: Any) -> "DPODrift":
        given, own = (
            {name: _shortest(x) for name, x in of.items()}
            for of in (parameters, self.init(root_key(0)))
        )
        return self if given == own else replace(self, **given)

    def __call__(
        self, parameters: Any, log_ratio: Array, advantage: Array, progress: Array, xp: Any = jnp
    ) -> Array:
        return discovered_drift(
            parameters["alpha"], parameters["beta"], log_ratio, advantage, progress, xp
        )


@dataclass(frozen=True)
class NoDrift(Drift):
    """No penalty at all: the plain policy-gradient surrogate."""

    name: ClassVar[str] = "none"

    def init(self, key: jax.Array, scale: float = 1.0) -> jax.Array:
        return jnp.zeros(())

    def __call__(
        self, parameters: Any, log_ratio: Array, advantage: Array, progress: Array, xp: Any = jnp
    ) -> Array:
        chex.assert_equal_shape([log_ratio, advantage, progress])
        # Not zeros_like, which PyTorch refuses to differentiate.
        return log_ratio - log_ratio


def _check(**constants: float) -> None:
    """Raises a UserError for what is not positive, or would be 0 or infinite as the 32 bits of a parameter."""
    positive(**{name: +x for name, x in constants.items()})  # + takes numbers alone
    single = np.finfo(np.float32)
    for name, x in constants.items():
        if not float(single.tiny) <= x <= float(single.max):
            raise UserError(
                f"{name} is {x:g}, and parameters have 32 bits: give a number from {single.tiny:.2g} to "
                f"{single.max:.2g}."
            )


def _shortest(number: Any) -> float:
    """With no more decimals than tell it from its neighbours in 32 bits: 0.3, and not 0.30000001192092896."""
    return float(str(np.float32(number)))
