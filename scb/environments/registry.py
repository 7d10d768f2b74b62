"""Environments by name: synthetic ones, gymnax's and Brax's, all behind gymnax 1.x's interface.

A new family of environments touches two files: a module with its `scb.environments.spec.Family`, and the list in
`scb/environments/__init__.py`, which registers it. Everything else asks `environment_spec`; what it has no
settings for is trained with general ones.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from scb import artefacts
from scb.environments.spec import EnvironmentSpec, Family, Made
from scb.errors import UserError, unknown_name

_FAMILIES: dict[str, Family] = {}


def register(family: Family) -> None:
    """Adds a family; of several that own a name, the one that was registered first has it."""
    _FAMILIES[family.name] = family


def families() -> dict[str, Family]:
    """{name: family}."""
    return dict(_FAMILIES)


def environment_names() -> list[str]:
    """Every name that `make` takes."""
    return list(dict.fromkeys(name for family in _FAMILIES.values() for name in family.names()))


def environment_spec(name: str | Path) -> EnvironmentSpec:
    """What is known of an environment.

    Args:
      name: "Synthetic-Pendulum-v1", "CartPole-v1", "hopper", ..., the file.npz (or file) of a bandit or of a
        synthetic MDP, or "package.module:factory" (see `scb.environments.custom`).

    Raises:
      UserError: unknown name (with near matches), a file that is none of these, or no name.
    """
    given: object = name
    if not isinstance(given, str | Path):
        raise UserError(
            f"the environment is of the class {type(given).__name__}: give a name, such as Pendulum-v1, or of one of "
            "your own package.module:factory, where the attribute may be the environment itself."
        )
    name = str(name)
    for family in _FAMILIES.values():
        if family.owns(name):
            return family.spec(name)
    if artefacts.is_file(name):  # by its name, of a bandit or a synthetic MDP, and no environment's
        return environment_spec(f"{name}.npz")
    if ":" in name or "." in name:
        raise UserError(
            f"unknown environment {name!r}: one of your own is package.module:factory, such as my_package.arms:make; a "
            "bandit's file ends with .npz."
        )
    raise unknown_name("environment", name, environment_names())


def check_backend(backend: str | None, names: Iterable[str]) -> None:
    """Raises a UserError for physics that none of these environments has."""
    names = list(names)
    specs = [environment_spec(name) for name in names]
    known = {x for spec in specs for x in spec.backends}
    its_own = any(spec.has_choice and not spec.backends for spec in specs)
    if backend is not None and backend not in known and not its_own:
        raise UserError(
            f"the backend is {backend!r}, and of {', '.join(names)} "
            + (
                f"those with a choice take {', '.join(sorted(known))}."
                if known
                else "none has a choice: leave it out."
            )
        )


def make(name: str | Path, backend: str | None = None, **arguments: Any) -> Made:
    """An environment and its default parameters.

    Args:
      name: as `environment_spec` takes it.
      backend: "generalized", "positional", "spring" or "mjx" for Brax environments; None for their own, and
        for every other environment.
      arguments: for the environment's constructor.

    Raises:
      UserError: unknown name (with near matches), or arguments that the environment doesn't take.
    """
    return environment_spec(name).make(backend, **arguments)
