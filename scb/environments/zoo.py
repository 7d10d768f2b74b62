"""Synthetic environments as files, and the bandits that ship with the library.

A bandit is NAME.npz (its weights) with NAME.json (its shapes, how it was found, what it is worth),
and so is a synthetic MDP. The bandits in `scb/zoo` are registered with gymnax when `scb` is
imported, and read when one is made.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial
from importlib import resources
from pathlib import Path
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
from scb.errors import UserError, unknown_name

PREFIX = "Synthetic-"


def zoo_names() -> list[str]:
    """Names of the bandits that ship with the library, as registered with gymnax."""
    folder = resources.files("scb") / "zoo"
    return sorted(p.name.removesuffix(".npz") for p in folder.iterdir() if p.name.endswith(".npz"))


class SyntheticFamily(Family):
    """Bandits and synthetic MDPs, by the zoo's name or file; what one stands for is in its metadata."""

    name = "synthetic"

    def names(self) -> Sequence[str]:
        return zoo_names()

    def owns(self, name: str) -> bool:
        return name.endswith(".npz") or super().owns(name)

    def make(self, name: str, **arguments: Any) -> Made:
        synthetic = open_synthetic(name, **arguments)  # which takes none, and says so
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
    return stated


def register_zoo() -> None:
    """Registers every bandit of the zoo, so that `gymnax.make("Synthetic-Pendulum-v1")` works."""
    for name in zoo_names():
        if name not in gymnax.registered_envs:
            gymnax.register(name, partial(_make_zoo_bandit, name))


def _make_zoo_bandit(name: str) -> SyntheticBandit:
    with resources.as_file(resources.files("scb") / "zoo") as folder:
        return load_bandit(folder / f"{name}.npz")


def bandit_metadata(name: str) -> Mapping[str, Any]:
    """What the .json of a bandit or synthetic MDP (a zoo name, or path.npz) says: config, seeds, results, cost."""
    if name.endswith(".npz"):
        return artefacts.load(name, BANDIT, SYNTHETIC_MDP).metadata
    with resources.as_file(resources.files("scb") / "zoo") as folder:
        return artefacts.load(folder / f"{name}.npz", BANDIT).metadata


def load_bandit(path: str | Path) -> SyntheticBandit:
    """A bandit from its file; a UserError says what is wrong with it."""
    return _bandit(artefacts.load(path, BANDIT), path)


def _bandit(artefact: artefacts.Artefact, path: str | Path) -> SyntheticBandit:
    config = artefact.metadata["config"]
    try:
        bandit = SyntheticBandit(
            observation_size=config["observation_size"],
            action_space=_space(config["action_space"]),
            config=BanditConfig(**config["bandit"]),
            weights=jax.tree.map(jnp.asarray, dict(artefact.arrays)),
            name=artefact.name,
        )
        shapes = bandit.weight_shapes()
    except (KeyError, TypeError) as error:
        raise UserError(
            f"{path} does not describe a bandit: its .json lacks or garbles a config entry ({error})."
        ) from error
    artefacts.expect_shapes(artefact, shapes)
    return bandit


def load(path: str | Path) -> SyntheticBandit | SyntheticMDP:
    """A bandit or a synthetic MDP from its file; a UserError says what is wrong with it.

    An MDP that starts in its evaluation environment's start states makes that environment by name.
    """
    artefact = artefacts.load(path, BANDIT, SYNTHETIC_MDP)
    if artefact.metadata["kind"] == BANDIT:
        return _bandit(artefact, path)
    config = artefact.metadata["config"]
    try:
        mdp_config = MDPConfig(**config["mdp"])
        start = _start(config["start"]) if mdp_config.parameterization == "T" else (None, None)
        mdp = SyntheticMDP(
            config["observation_size"],
            _space(config["action_space"]),
            mdp_config,
            jax.tree.map(jnp.asarray, dict(artefact.arrays)),
            artefact.name,
            *start,
        )
        shapes = mdp.weight_shapes()
    except (KeyError, TypeError) as error:
        raise UserError(
            f"{path} does not describe a synthetic MDP: its .json lacks or garbles a config entry ({error})."
        ) from error
    artefacts.expect_shapes(artefact, shapes)
    return mdp


def _start(description: Mapping[str, Any]) -> Made:
    return make(description["environment"], **description["arguments"])


def open_bandit(name: str) -> SyntheticBandit:
    """A bandit by zoo name or file."""
    if name.endswith(".npz"):
        return load_bandit(name)
    if name not in zoo_names():
        raise unknown_name("bandit", name, [*zoo_names(), "path/to/bandit.npz"])
    return _make_zoo_bandit(name)


def open_synthetic(name: str) -> SyntheticBandit | SyntheticMDP:
    """A bandit by zoo name, or a bandit or synthetic MDP by file."""
    return load(name) if name.endswith(".npz") else open_bandit(name)


def save(
    path: str | Path,
    synthetic: SyntheticBandit | SyntheticMDP,
    weights: Weights,
    metadata: Mapping[str, Any],
) -> Path:
    """Writes a bandit or a synthetic MDP: `save_bandit` or `save_synthetic_mdp`."""
    if isinstance(synthetic, SyntheticMDP):
        return save_synthetic_mdp(path, synthetic, weights, metadata)
    return save_bandit(path, synthetic, weights, metadata)


def save_bandit(
    path: str | Path, bandit: SyntheticBandit, weights: Weights, metadata: Mapping[str, Any]
) -> Path:
    """Writes a bandit.

    Args:
      path: NAME.npz; NAME.json is written beside it, and NAME is the bandit's name.
      bandit: whose shapes are stored.
      weights: as in `BanditParams.weights`.
      metadata: config (of the discovery), seeds, results, cost, command.
    """
    config = {
        **metadata.get("config", {}),
        "observation_size": bandit.observation_size,
        "action_space": space_description(bandit.action_space()),
        "bandit": {
            "hidden_size": bandit.config.hidden_size,
            "activation": bandit.config.activation,
            "latent": bandit.config.latent,
            "latent_size": bandit.latent_size,
        },
    }
    full = {**metadata, "kind": BANDIT, "config": config}
    return artefacts.save(path, jax.device_get(weights), full)


def save_synthetic_mdp(
    path: str | Path, mdp: SyntheticMDP, weights: Weights, metadata: Mapping[str, Any]
) -> Path:
    """Writes a synthetic MDP.

    Args:
      path: NAME.npz; NAME.json is written beside it, and NAME is the MDP's name.
      mdp: whose shapes, parameterisation and maximum episode length are stored.
      weights: as in `MDPParams.weights`.
      metadata: as for `save_bandit`; `config["evaluation_environment"]` is the name by which to make
        the environment in whose start states a "T" starts, where it isn't the environment's own.

    Raises:
      UserError: a "T" whose evaluation environment would not come back the same.
    """
    config = {
        **metadata.get("config", {}),
        "observation_size": mdp.observation_size,
        "action_space": space_description(mdp.action_space()),
        "mdp": {**dataclasses.asdict(mdp.config), "latent_size": mdp.latent_size},
    }
    if mdp.env is not None:
        name = config.setdefault("evaluation_environment", mdp.env.name)
        # What has physics to choose from says which it has.
        backend = {"backend": mdp.env.backend} if environment_spec(name).backends else {}
        config["start"] = {"environment": name, "arguments": backend}
        made, params = _start(config["start"])
        if type(made) is not type(mdp.env) or not _equal(params, mdp.env_params):
            raise UserError(
                f"{path} was not written, since {name!r} by its name is not the environment that the MDP "
                "starts in: give its own name and default parameters."
            )
    full = {**metadata, "kind": SYNTHETIC_MDP, "config": config}
    return artefacts.save(path, jax.device_get(weights), full)


def _equal(params: Any, others: Any) -> bool:
    leaves, others_leaves = jax.tree.leaves(params), jax.tree.leaves(others)
    same_type = type(params) is type(others) and len(leaves) == len(others_leaves)
    return same_type and all(map(np.array_equal, leaves, others_leaves))


def space_description(space: spaces.Box | spaces.Discrete) -> dict[str, Any]:
    """An action space as JSON."""
    if isinstance(space, spaces.Discrete):
        return {"type": "discrete", "n": int(space.n)}
    low, high = (
        np.broadcast_to(np.asarray(x, np.float32), space.shape).tolist()
        for x in (space.low, space.high)
    )
    return {"type": "box", "shape": list(space.shape), "low": low, "high": high}


def _space(description: Mapping[str, Any]) -> spaces.Box | spaces.Discrete:
    if description["type"] == "discrete":
        return spaces.Discrete(description["n"])
    low, high = (jnp.asarray(description[x], jnp.float32) for x in ("low", "high"))
    return spaces.Box(low, high, tuple(description["shape"]), jnp.float32)
