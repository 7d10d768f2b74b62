"""What every drift is, and the shape that learned ones and formulas share: a correction of a base."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Self, TypeAlias

import chex
import jax
import jax.numpy as jnp
import numpy as np

from lpo.drifts.bases import BASES
from scb import artefacts, own
from scb.agents.drift import USUAL_CLIP, relu
from scb.errors import UserError, at_least, first_line, one_of, positive

# Any: an array of JAX, NumPy or PyTorch; `xp` below is its library.
Array: TypeAlias = Any


class Drift(ABC):
    """A family of drifts: a frozen dataclass, which is static, and parameters, traced, so that a population vmaps.

    Attributes:
      name: of the family; of one's own the class's, where it says none. The dataclass's fields are its settings.
      learned: whether `lpo meta-train` evolves it.
      always_holds: whether the conditions of mirror learning hold by construction, whatever the
        parameters are, as long as they are finite.
    """

    name: ClassVar[str]
    learned: ClassVar[bool] = False
    always_holds: ClassVar[bool] = False

    def __init_subclass__(cls) -> None:
        if "name" not in vars(cls) and not cls.__module__.startswith("lpo."):
            cls.name = cls.__name__

    @property
    def temporal(self) -> bool:
        """Whether it changes with the fraction of training done.

        Where it does and this does not say so, it is certified, shown and exported as it is at the start.
        """
        return False

    @abstractmethod
    def init(self, key: jax.Array, scale: float = 1.0) -> Any:
        """Parameters: a pytree of float arrays, and a dict of them where they are to be saved.

        Args:
          key: decides what is random.
          scale: of what a search starts with, beside the drift that it starts from.
        """

    @abstractmethod
    def __call__(
        self, parameters: Any, log_ratio: Array, advantage: Array, progress: Array, xp: Any = jnp
    ) -> Array:
        """The penalty.

        Args:
          parameters: as from `init`, as arrays of `xp`.
          log_ratio: [B] log pi(a|s) - log pi_behaviour(a|s), in nats.
          advantage: [B] advantage, normalised over the minibatch.
          progress: [B] fraction of training done, in [0, 1].
          xp: `jax.numpy`, `numpy` or `torch`. What the three have alike is enough to write a formula
            once: functions of the array API standard, and `relu` of `scb.agents.drift`.

        Returns:
          [B] penalty.
        """

    def to_config(self) -> dict[str, Any]:
        """What a file says of it: the family and its settings.

        Raises:
          UserError: one's own family, which no import finds, or a function among its settings.
        """
        settings = {name: getattr(self, name) for name in self.settings()}
        for name, value in settings.items():
            if callable(value):
                raise UserError(
                    f"the setting {name} of the drift {self.name} is a function, which no file holds: make it a "
                    "part of the class."
                )
        return {"family": self.family(), **settings}

    @classmethod
    def family(cls) -> str:
        """Its name in files and after `--drift`: package.module:Class of one's own."""
        return cls.name if cls.__module__.startswith("lpo.") else own.reference(cls, "drift")

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        """The inverse of `to_config`; a KeyError names an entry that is missing."""
        return cls(**{name: config[name] for name in cls.settings()})

    @classmethod
    def settings(cls) -> list[str]:
        """Names of its fields."""
        return [field.name for field in fields(cls)]  # type: ignore[arg-type]

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Of the parameters, by name; "network/kernel" of those inside of another dictionary.

        Raises:
          UserError: they are no dictionaries of arrays, which alone a file holds.
        """
        return artefacts.shapes_of(self.init)

    def with_parameters(self, parameters: Any) -> Self:
        """The same drift with settings that say these parameters, where settings say any."""
        return self


def with_defaults(family: type[Drift], name: str, advice: str) -> Drift:
    """The drift that a family starts with; a UserError, which ends with the advice, where a setting has no default."""
    try:
        return family()
    except TypeError as error:
        raise UserError(
            f"the drift {name} cannot be made as it is ({first_line(error)}): {advice}."
        ) from error


def check_static(drift: Drift) -> None:
    """A UserError for a drift by which programs cannot be told apart: no frozen dataclass, or not to be hashed."""
    name, settings = type(drift).__name__, getattr(drift, "__dataclass_params__", None)
    if settings is None or not settings.frozen:
        raise UserError(
            f"the drift {name} is no frozen dataclass, as which programs are told apart: "
            "write @dataclasses.dataclass(frozen=True) above it."
        )
    try:
        hash(drift)
    except TypeError as error:
        raise UserError(
            f"the drift {name} cannot be told from others ({first_line(error)}): its settings must be hashable, tuples "
            "in place of lists and arrays; a function of a class of one's own is a frozen dataclass."
        ) from error


@dataclass(frozen=True, kw_only=True)
class CorrectedDrift(Drift):
    """relu(base + gate * correction - xi), for a correction that vanishes at ratio 1.

    The conditions of mirror learning hold then: base and correction are continuous and vanish at
    ratio 1, and relu(. - xi) is flat around 0. What they do not bound is the slope just outside that
    flat zone. There a correction acts like a penalty on |log r|, and updates whose advantages correlate with
    no direction more than that slope never leave ratio 1: found with an objective learned on
    minibatches of 20, which held a policy still on minibatches of 1000. The gate fades the correction
    out there.

    Attributes:
      base: what the correction is added to: ppo (the clip's drift, so that no correction is PPO), dpo
        (the same of DPO, with its constants), or none.
      clip: epsilon of the PPO base.
      xi: half-width of the dead zone, in units of the penalty; the original code has 1e-4.
      gate: width, in nats of log-ratio, of the region around ratio 1 where the correction is faded out,
        by 1 - exp(-(log r / gate)^2). 0 leaves it as it is, as in the original.
    """

    always_holds: ClassVar[bool] = True

    base: str = "ppo"
    clip: float = USUAL_CLIP
    xi: float = 1e-6
    gate: float = 0.1

    def __post_init__(self) -> None:
        at_least(0, self, "gate")
        one_of("drift base", self.base, BASES)
        positive(clip=+self.clip, xi=+self.xi)  # + takes numbers alone

    @abstractmethod
    def correction(
        self, parameters: Any, log_ratio: Array, advantage: Array, progress: Array, xp: Any
    ) -> Array:
        """[B] what is added to the base; arguments as for `__call__`."""

    def __call__(
        self, parameters: Any, log_ratio: Array, advantage: Array, progress: Array, xp: Any = jnp
    ) -> Array:
        chex.assert_equal_shape([log_ratio, advantage, progress])
        penalty = self.correction(parameters, log_ratio, advantage, progress, xp)
        if self.gate:
            penalty = penalty * self.gate_factor(log_ratio, xp)
        penalty = penalty + self.base_penalty(log_ratio, advantage, progress, xp)
        return relu(penalty - self.xi, xp)

    def base_penalty(
        self, log_ratio: Array, advantage: Array, progress: Array, xp: Any = np
    ) -> Array | float:
        """[B] what the base charges, or 0.0 where there is none."""
        base = BASES[self.base]
        return 0.0 if base is None else base(self.clip, log_ratio, advantage, progress, xp)

    def gate_factor(self, log_ratio: Array, xp: Any = np) -> Array:
        """[B] 1 - exp(-(log r / gate)^2), where there is a gate."""
        return -xp.expm1(-((log_ratio / self.gate) ** 2))
