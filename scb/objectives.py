"""What may take the place of an agent's own objective, and which of several one program can train.

The objectives themselves are `lpo`'s: here they are drifts with parameters.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import jax
import jax.numpy as jnp


class Objective(Protocol):
    """What may take the place of an agent's own: a drift and its parameters, under a name."""

    @property
    def name(self) -> str: ...
    @property
    def drift(self) -> Any: ...
    @property
    def parameters(self) -> Any: ...


AnyObjective = TypeVar("AnyObjective", bound=Objective)


def families(objectives: Sequence[AnyObjective]) -> list[list[AnyObjective]]:
    """Objectives that differ in their drifts' parameters alone stand together: one program trains them all."""
    found: list[list[AnyObjective]] = []
    for objective in objectives:
        family = next((f for f in found if f[0].drift == objective.drift), None)
        if family is None:
            found.append([objective])
        else:
            family.append(objective)
    return found


@dataclass(frozen=True)
class _OneOf:
    """Several drifts as one, whose parameters are (number of the one that counts, parameters of each)."""

    drifts: tuple[Callable[..., jax.Array], ...]

    def __call__(
        self, parameters: Any, log_ratio: jax.Array, advantage: jax.Array, progress: jax.Array
    ) -> jax.Array:
        number, each = parameters
        penalty = jnp.zeros_like(log_ratio)
        for i, (drift, own) in enumerate(zip(self.drifts, each, strict=True)):
            # The others see a ratio of 1, where all are finite and flat: 0 times what they say is 0.
            seen = jnp.where(number == i, log_ratio, 0.0)
            penalty += jnp.where(number == i, drift(own, seen, advantage, progress), 0.0)
        return penalty


def programs_for(objectives: Sequence[Objective], shared: bool) -> list[tuple[Any, dict[str, Any]]]:
    """[(drift, {objective: its parameters})] of the programs that train the objectives; one program where `shared`."""
    groups = families(objectives)
    if not groups:
        return [(None, {})]
    if not shared or len(groups) == 1:
        return [(group[0].drift, {o.name: o.parameters for o in group}) for group in groups]
    of_each = [group[0].parameters for group in groups]
    parameters = {
        o.name: (jnp.int32(i), (*of_each[:i], o.parameters, *of_each[i + 1 :]))
        for i, group in enumerate(groups)
        for o in group
    }
    return [(_OneOf(tuple(group[0].drift for group in groups)), parameters)]
