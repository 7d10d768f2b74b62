"""Synthetic environments as files, and the bandits that ship with the library.

A bandit is NAME.npz (its weights) with NAME.json (its shapes, how it was found, what it is worth),
and so is a synthetic MDP. The bandits in `scb/zoo` are registered with gymnax when `scb` is
imported, and read when one is made.
"""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import gymnax
import jax
import jax.numpy as jnp
import numpy as np
from gymnax.environments import spaces

from scb import artefacts
from scb.environments.registry import environment_names, environment_spec, make
from scb.environments.spec import BANDIT, SYNTHETIC_MDP, Family, Made
from scb.environments.synthetic import BanditConfig, SyntheticBandit, Weights
from scb.environments.synthetic_mdp import MDPConfig, SyntheticMDP
from scb.errors import UserError
from scb.own import code_of_names
from scb.spaces import flat_bounds

PREFIX = "Synthetic-"
_ZOO = Path(__file__).parents[1] / "zoo"
_KINDS = {BANDIT: "bandit", SYNTHETIC_MDP: "synthetic MDP"}


def zoo_names() -> list[str]:
    """Names of the bandits that ship with the library, as registered with gymnax."""
    return artefacts.names_in(_ZOO)


class SyntheticFamily(Family):
    """Bandits and synthetic MDPs, by the zoo's name or file; what one stands for is in its metadata."""

    name = "synthetic"

    def names(self) -> Sequence[str]:
        return zoo_names()

    def owns(self, name: str) -> bool:
        return name.endswith(".npz") or super().owns(name)

    def make(self, name: str, **arguments: Any) -> Made:
        synthetic = load_synthetic(name, **arguments)  # which takes none, and says so
        return synthetic, synthetic.default_params

    def facts(self, name: str) -> Mapping[str, Any]:
        metadata = bandit_metadata(name)
        return {"family": metadata["kind"], "stands_for": _evaluation_environment(metadata)}


def _evaluation_environment(metadata: Mapping[str, Any]) -> str | None:
    """What the metadata of a synthetic environment says; in files without it, what its name said when it was saved."""
    stated = metadata["config"].get("evaluation_environment")
    named = str(metadata["name"]).removeprefix(PREFIX)
    if stated is None and named in environment_names():
        return named
    if not isinstance(stated, str | None):
        raise UserError(
            f'{metadata["name"]} stands for {stated!r}, which is no name: mend "evaluation_environment" in its .json.'
        )
    return stated


def register_zoo() -> None:
    """Registers every bandit of the zoo, so that `gymnax.make("Synthetic-Pendulum-v1")` works."""
    for name in zoo_names():
        if name not in gymnax.registered_envs:
            gymnax.register(name, partial(load_bandit, name))


def bandit_metadata(name: str | Path) -> Mapping[str, Any]:
    """What the .json of a bandit or synthetic MDP (a zoo name, or path.npz) says: config, seeds, results, cost."""
    return _read(name, BANDIT, SYNTHETIC_MDP)[1].metadata


def digests(names: Iterable[str]) -> dict[str, str]:
    """{name: SHA-256} of what environments' names do not tell: weights of synthetic ones, code of somebody's own."""
    names = list(names)
    weights = {x: bandit_metadata(x)["sha256"] for x in names if environment_spec(x).synthetic}
    return weights | code_of_names(names)


def load_bandit(name: str | Path) -> SyntheticBandit:
    """A bandit by the zoo's name, or from its file path.npz; a UserError says what is wrong with it."""
    bandit = _load(name, BANDIT)
    assert isinstance(bandit, SyntheticBandit)
    return bandit


def load_synthetic(name: str | Path) -> SyntheticBandit | SyntheticMDP:
    """A bandit by the zoo's name, or a bandit or synthetic MDP from its file; a UserError says what is wrong with it.

    An MDP that starts in its evaluation environment's start states makes that environment by name.
    """
    return _load(name, BANDIT, SYNTHETIC_MDP)


def _read(name: str | Path, *kinds: str) -> tuple[Path, artefacts.Artefact]:
    path = artefacts.named(name, _ZOO, "bandit")
    return path, artefacts.load(path, *kinds)


def _load(name: str | Path, *kinds: str) -> SyntheticBandit | SyntheticMDP:
    path, artefact = _read(name, *kinds)
    config, kind = artefact.metadata["config"], artefact.metadata["kind"]
    weights = jax.tree.map(jnp.asarray, dict(artefact.arrays))
    made: SyntheticBandit | SyntheticMDP
    with artefacts.described(path, _KINDS[kind]):
        shape = config["observation_size"], _space(config["action_space"])
        if kind == BANDIT:
            made = SyntheticBandit(*shape, BanditConfig(**config["bandit"]), weights, artefact.name)
        else:
            mdp_config = MDPConfig(**config["mdp"])
            start = _start(config["start"]) if mdp_config.parameterization == "T" else (None, None)
            made = SyntheticMDP(*shape, mdp_config, weights, artefact.name, *start)
        shapes = made.weight_shapes()
    artefacts.expect_shapes(artefact, shapes)
    return made


def _start(description: Mapping[str, Any]) -> Made:
    arguments = dict(description["arguments"])
    backend = arguments.pop("backend", None)
    # Whose function it may be, and a file is perhaps somebody else's.
    if arguments:
        raise UserError(
            f"its .json starts {description['environment']!r} with the arguments {arguments}, where only a backend may "
            "be: take them out."
        )
    return make(description["environment"], backend)


def save_bandit(
    path: str | Path,
    synthetic: SyntheticBandit | SyntheticMDP,
    weights: Weights,
    metadata: Mapping[str, Any] = MappingProxyType({}),
) -> Path:
    """Writes a bandit or a synthetic MDP.

    Args:
      path: NAME.npz; NAME.json is written beside it, and NAME is the bandit's name.
      synthetic: whose shapes are stored, and of an MDP parameterisation and maximum episode length.
      weights: as in its parameters.
      metadata: config (of the discovery), seeds, results, cost, command, what of it there is to tell; a config's
        "evaluation_environment" is the name of what the bandit stands for, by which a "T" makes the environment in
        whose states it starts; of a "T" the environment's own name where it is left out.

    Raises:
      UserError: weights of other shapes than the environment's; a "T" whose evaluation environment would not come
        back the same.
    """
    if not isinstance(synthetic, SyntheticBandit | SyntheticMDP):
        raise UserError(
            f"something of the class {type(synthetic).__name__} is no bandit: give save_bandit the path, the bandit or "
            "synthetic MDP, and its weights."
        )
    if not isinstance(weights, Mapping):
        raise UserError(
            f"the weights of {synthetic.name} are of the class {type(weights).__name__}: give a dict of arrays, as the "
            "weights of its parameters are."
        )
    if not isinstance(metadata, Mapping):
        raise UserError(
            f"the metadata of {synthetic.name} are of the class {type(metadata).__name__}: give a dict, {{}} for none."
        )
    kind = SYNTHETIC_MDP if isinstance(synthetic, SyntheticMDP) else BANDIT
    config = {
        **metadata.get("config", {}),
        "observation_size": synthetic.observation_size,
        "action_space": space_description(synthetic.action_space()),
        "bandit" if kind == BANDIT else "mdp": {
            **dataclasses.asdict(synthetic.config),
            "latent_size": synthetic.latent_size,
        },
    }
    if isinstance(synthetic, SyntheticMDP) and synthetic.env is not None:
        env = synthetic.env
        name = config.setdefault("evaluation_environment", env.name)
        # What has physics to choose from says which it has.
        backend = {"backend": env.backend} if environment_spec(name).backends else {}
        config["start"] = {"environment": name, "arguments": backend}
        made, params = _start(config["start"])
        same = type(made) is type(env) and (made == env or not _comparable(env))
        if not same or not _equal(params, synthetic.env_params):
            raise UserError(
                f"{path} was not written, since {name!r} by its name is not the environment that the MDP "
                "starts in: give its own name and default parameters."
            )
    own = artefacts.Artefact(synthetic.name, dict(weights), {"kind": kind})
    artefacts.expect_shapes(own, synthetic.weight_shapes())
    full = {**metadata, "kind": kind, "config": config}
    return artefacts.save(path, jax.device_get(weights), full)


def _comparable(env: Any) -> bool:
    """Whether two environments made alike are equal, of which most are not."""
    return "__eq__" in vars(type(env))


def _equal(params: Any, others: Any) -> bool:
    leaves, others_leaves = jax.tree.leaves(params), jax.tree.leaves(others)
    same_type = type(params) is type(others) and len(leaves) == len(others_leaves)
    return same_type and all(map(np.array_equal, leaves, others_leaves))


def space_description(space: spaces.Box | spaces.Discrete) -> dict[str, Any]:
    """An action space as JSON."""
    if isinstance(space, spaces.Discrete):
        return {"type": "discrete", "n": int(space.n)}
    low, high = (x.reshape(space.shape).tolist() for x in flat_bounds(space, np))
    return {"type": "box", "shape": list(space.shape), "low": low, "high": high}


def _space(description: Mapping[str, Any]) -> spaces.Box | spaces.Discrete:
    """What was described; a ValueError where that is no space."""
    if description["type"] == "discrete":
        number = description["n"]
        if type(number) is not int or number < 1:
            raise ValueError(f"{number!r} is no number of actions")
        return spaces.Discrete(number)
    shape = tuple(description["shape"])
    low, high = (np.asarray(description[x], np.float32) for x in ("low", "high"))
    # As it was written: a shape that the bounds don't have might be of any size.
    if not all(type(x) is int for x in shape) or not low.shape == high.shape == shape:
        raise ValueError(f"bounds of actions are not of shape {shape}")
    if not (low <= high).all():
        raise ValueError("an action's lower bound is above its upper one")
    return spaces.Box(_bound(low), _bound(high), shape, jnp.float32)


def _bound(values: np.ndarray) -> float | jax.Array:
    """One number where all are alike, as gymnax's own environments have it and its wrappers need it."""
    alike = values.size > 0 and (values == values.flat[0]).all()
    return float(values.flat[0]) if alike else jnp.asarray(values)
