"""What is known of an environment, and what a family of environments is.

A specification says how an environment is made and what its returns mean: what random actions earn, what an
expert does, what standing still does. Whatever of it depends on the physics is kept by backend; for
environments without a choice of physics the backend is None.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from gymnax.environments import environment
from numpy.typing import ArrayLike, NDArray

from scb.environments.returns import RANDOM, Returns, random_return, table
from scb.errors import UserError
from scb.statistics import normalized_score

Made: TypeAlias = tuple[environment.Environment[Any, Any], Any]

# The families that a file or a bandit's name stands for.
BANDIT, SYNTHETIC_MDP = "bandit", "synthetic_mdp"


@dataclass(frozen=True)
class Reference:
    """A published return: its interquartile mean, where it is from, and its 95 % interval if that is stated."""

    value: float
    source: str
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class EnvironmentSpec:
    """An environment: how to make it, and what is known of it.

    Attributes:
      name: as `scb.make` takes it.
      family: the family's name, by which settings are kept; a synthetic environment's is "bandit" or
        "synthetic_mdp".
      maker: (constructor's arguments) -> (environment, default parameters).
      backends: the physics to choose from; empty where there is no choice.
      default_backend: what is taken where none is chosen.
      stands_for: of a synthetic environment its evaluation environment, None where its file doesn't
        say; None for all others.
      random_returns: {backend: return of uniformly random actions}, as far as it was measured before.
      experts: {backend: {algorithm: what its agents trained in the environment earn}}; an
        environment's `reference` is the first.
      standing: {backend: return of an episode of full length without a fall and without moving}.
    """

    name: str
    family: str
    maker: Callable[..., Made] = field(repr=False, compare=False)
    backends: tuple[str, ...] = ()
    default_backend: str | None = None
    stands_for: str | None = None
    random_returns: Returns = field(default_factory=dict, repr=False, compare=False)
    experts: Mapping[str | None, Mapping[str, Reference]] = field(
        default_factory=dict, repr=False, compare=False
    )
    standing: Returns = field(default_factory=dict, repr=False, compare=False)

    def make(self, backend: str | None = None, **arguments: Any) -> Made:
        """The environment and its default parameters.

        Args:
          backend: one of `backends`; None for the default.
          arguments: for the environment's constructor.

        Raises:
          UserError: arguments, or a choice of physics, that the environment doesn't take.
        """
        if backend is not None:
            if not self.has_choice:
                raise UserError(
                    f"the backend is {backend!r}, and {self.name} has no choice of physics: leave it out."
                )
            arguments["backend"] = backend
        try:
            return self.maker(**arguments)
        except TypeError as error:
            if not arguments:  # then it is a mistake of the maker's own
                raise
            raise UserError(
                f"environment {self.name!r} does not take {arguments}: {error}."
            ) from error

    @property
    def has_choice(self) -> bool:
        """Whether it may have a choice of physics; a custom environment's maker knows its own."""
        return bool(self.backends) or self.family == "custom"

    def physics(self, backend: str | None = None) -> str | None:
        """The physics where `backend` is chosen for several environments: None where this one has no choice."""
        return (backend or self.default_backend) if self.has_choice else None

    @property
    def bandit(self) -> str:
        """What a bandit for this environment is called; a file may have this name."""
        name = Path(self.name).stem if self.name.endswith(".npz") else self.name
        return f"Synthetic-{name.replace(':', '-')}"

    @property
    def synthetic(self) -> bool:
        """Whether it stands for another environment: a bandit or a synthetic MDP."""
        return self.family in (BANDIT, SYNTHETIC_MDP)

    @property
    def is_bandit(self) -> bool:
        """Whether it is a synthetic contextual bandit."""
        return self.family == BANDIT

    @property
    def evaluation_environment(self) -> str:
        """Where agents trained here are judged: what a synthetic environment stands for, else itself.

        Raises:
          UserError: a synthetic environment that doesn't say.
        """
        if not self.synthetic:
            return self.name
        if self.stands_for is None:
            raise UserError(
                f"{self.name} does not say which environment it stands for: name that (--evaluation-environment), or "
                'write "evaluation_environment" into "config" of the .json beside it.'
            )
        return self.stands_for

    @property
    def episode_limit(self) -> int:
        """Steps after which an episode is cut."""
        return int(self.make()[1].max_steps_in_episode)

    def random_return(self, backend: str | None = None) -> float:
        """Mean return of uniformly random actions; measured, once in a process, where the table lacks it.

        Raises:
          UserError: it is no number, or actions have no bounds.
        """
        physics = self.physics(backend)
        known = self.random_returns.get(physics)
        return _measured(self, physics) if known is None else known

    def reference(
        self, backend: str | None = None, algorithm: str | None = None
    ) -> Reference | None:
        """What a published expert earns, if one is known with this physics; None for the algorithm takes the first."""
        experts = self.experts.get(self.physics(backend), {})
        return experts.get(next(iter(experts), "") if algorithm is None else algorithm)

    def reference_return(self, backend: str | None = None) -> float:
        """The reference's value.

        Raises:
          UserError: none is known.
        """
        reference = self.reference(backend)
        if reference is None:
            physics = f" with {self.physics(backend)} physics" if self.backends else ""
            raise UserError(f"no reference return of {self.name}{physics} is known: measure one.")
        return reference.value

    def score(self, returns: ArrayLike, backend: str | None = None) -> NDArray[np.floating]:
        """Returns, of any shape, as scores: 0 for random actions and 1 for the reference.

        Raises:
          UserError: as for `random_return`, `reference_return` and `scb.statistics.normalized_score`.
        """
        return normalized_score(
            returns, self.random_return(backend), self.reference_return(backend)
        )

    def standing_still(self, backend: str | None = None) -> float | None:
        """What an episode of full length without a fall and without moving earns; None where that means nothing."""
        return self.standing.get(self.physics(backend))


@cache
def _measured(spec: EnvironmentSpec, backend: str | None) -> float:
    found = random_return(*spec.make(backend))
    if not math.isfinite(found):
        raise UserError(
            f"random actions earn {found:g} in {spec.name}: see that its rewards are finite."
        )
    return found


class Family(ABC):
    """Environments of one kind: their names, how they are made, and what is known of them.

    Attributes:
      name: of the family, by which settings are kept.
      suite: those of its environments over which scores are aggregated; empty where it has no suite.
    """

    name: str
    suite: tuple[str, ...] = ()

    @abstractmethod
    def names(self) -> Sequence[str]:
        """Of its environments."""

    @abstractmethod
    def make(self, name: str, **arguments: Any) -> Made:
        """(environment, default parameters); a TypeError for arguments that it doesn't take."""

    def owns(self, name: str) -> bool:
        """Whether a name is of this family."""
        return name in self.names()

    def facts(self, name: str) -> Mapping[str, Any]:
        """Further fields of an environment's `EnvironmentSpec`."""
        return {}

    def spec(self, name: str) -> EnvironmentSpec:
        """What is known of one of its environments."""
        fields: dict[str, Any] = {
            "name": name,
            "family": self.name,
            "maker": partial(self.make, name),
            "random_returns": table(RANDOM).get(name, {}),
        }
        return EnvironmentSpec(**fields | dict(self.facts(name)))
