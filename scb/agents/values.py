"""Which numbers an agent can take as its hyperparameters."""

from dataclasses import fields
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from scb.errors import UserError

# Of 32 bits, which is what an agent calculates with.
_LARGEST = float(jnp.finfo(jnp.float32).max)
# What is a factor or a share, of which more than 1 makes no sense.
_SHARES = (
    "discount",
    "gae_lambda",
    "polyak",
    "epsilon_start",
    "epsilon_end",
    "epsilon_decay",
    "target_entropy_ratio",
)


def check_value(name: str, value: Any) -> None:
    """Raises a UserError for a value that the hyperparameter cannot have."""
    value = value.item() if isinstance(value, np.generic) else value
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or not abs(value) <= _LARGEST:
        raise UserError(
            f"{name} has the value {value!r}, which is no number that an agent can take: give finite numbers only."
        )
    if value < 0 or (name in _SHARES and value > 1):
        allowed = "between 0 and 1" if name in _SHARES else "0 or larger"
        raise UserError(f"{name} has the value {value!r}: it must be {allowed}.")


def check_values(hyperparameters: Any) -> None:
    """As `check_value`, of every field; of what is traced its shape alone is known. A drift's are its own."""
    for field in fields(hyperparameters):
        name, value = field.name, getattr(hyperparameters, field.name)
        if name == "drift" or (value is None and field.default is None):
            continue
        if shape := getattr(value, "shape", ()):
            raise UserError(
                f"{name} has the shape {shape}: give one number; each agent's is drawn from a spec's lists."
            )
        if not isinstance(value, jax.core.Tracer):
            check_value(name, value.item() if hasattr(value, "item") else value)
