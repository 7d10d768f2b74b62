"""Objectives by name or file: PPO's clip, DPO, no drift, the learned ones of the zoo, and formulas."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lpo.certificate import Certificate, certify
from lpo.drift import TEMPORAL_FEATURES, ClipDrift, DPODrift, Drift, LearnedDrift, NoDrift
from lpo.formula import ClosedFormDrift
from scb import artefacts
from scb.errors import UserError, unknown_name
from scb.keys import root_key

KIND = "drift"
_CLIP_NAME = re.compile(r"ppo-(\d*\.?\d+)$")


@dataclass(frozen=True)
class Objective:
    """A drift with its parameters: what `PPO` takes as its objective.

    Attributes:
      name: as on the command line.
      drift: the family, passed to `PPO(env, config, drift)`.
      parameters: traced, passed as `PPOHyperparameters.drift`.
      metadata: of a learned objective, what its artefact says.
    """

    name: str
    drift: Drift
    parameters: Any
    metadata: Mapping[str, Any] = field(default_factory=dict)


def zoo_names() -> list[str]:
    """Names of the learned objectives that ship with the library."""
    folder = resources.files("lpo") / "zoo"
    return sorted(p.name.removesuffix(".npz") for p in folder.iterdir() if p.name.endswith(".npz"))


def objective_names() -> list[str]:
    """Every name that `load_objective` takes, files apart; "ppo-0.3" is PPO with clip 0.3."""
    return ["ppo", "dpo", "none", *zoo_names()]


def load_objective(name: str | Path) -> Objective:
    """An objective by name ("ppo", "ppo-0.3", "dpo", "none", a zoo name) or file (path.npz).

    Raises:
      UserError: unknown name (with near matches), or a file that is no learned objective.
    """
    text = str(name)
    clip = _CLIP_NAME.match(text)
    if text == "ppo":
        return _closed_form(text, ClipDrift())
    if clip:
        return _closed_form(text, ClipDrift(float(clip.group(1))))
    if text == "dpo":
        return _closed_form(text, DPODrift())
    if text == "none":
        return _closed_form(text, NoDrift())
    if text in zoo_names():
        with resources.as_file(resources.files("lpo") / "zoo") as folder:
            return _from_file(folder / f"{text}.npz")
    if text.endswith(".npz"):
        return _from_file(Path(text))
    raise unknown_name("objective", text, [*objective_names(), "path/to/objective.npz"])


def _closed_form(name: str, drift: Drift) -> Objective:
    # A closed form's parameters are not random.
    return Objective(name, drift, drift.init(root_key(0)))


def _from_file(path: Path) -> Objective:
    artefact = artefacts.load(path, KIND)
    try:
        family = artefact.metadata["config"]["drift"]
        if "expression" in family:
            return _formula(path, artefact, family)
        features = tuple(family["features"])
        drift = LearnedDrift(
            base=family["base"],
            hidden_size=family["hidden_size"],
            clip=family["clip"],
            xi=family["xi"],
            temporal=features == TEMPORAL_FEATURES,
            gate=family.get("gate", 0.0),  # what was learned before there was one has none
        )
    except KeyError as error:
        raise UserError(
            f"{path} does not describe a drift: its .json lacks config entry {error}."
        ) from error
    except TypeError as error:
        raise UserError(
            f"{path} does not describe a drift: its .json garbles config entry 'drift' ({error})."
        ) from error
    if features != drift.features:
        raise UserError(
            f"{path} was learned on other features ({', '.join(map(str, features))}) than this version computes "
            f"({', '.join(drift.features)}): use the version that made it."
        )
    artefacts.expect_shapes(artefact, drift.weight_shapes())
    parameters = jax.tree.map(jnp.asarray, dict(artefact.arrays))
    return Objective(artefact.name, drift, parameters, artefact.metadata)


def _formula(path: Path, artefact: artefacts.Artefact, family: Mapping[str, Any]) -> Objective:
    drift = ClosedFormDrift(
        expression=str(family["expression"]),
        base=family["base"],
        clip=family["clip"],
        xi=family["xi"],
        gate=family.get("gate", 0.0),
    )
    parameters = drift.init(root_key(0))
    artefacts.expect_shapes(artefact, {"constants": parameters["constants"].shape})
    # The text is what a reader sees, so it must be what is computed.
    if not np.array_equal(np.asarray(artefact.arrays["constants"]), parameters["constants"]):
        raise UserError(
            f"{path} holds other numbers than the expression in its .json: fetch or save both again."
        )
    return Objective(artefact.name, drift, parameters, artefact.metadata)


def save_objective(
    path: str | Path,
    drift: LearnedDrift | ClosedFormDrift,
    parameters: Any,
    metadata: Mapping[str, Any],
) -> tuple[Path, Certificate]:
    """Writes a learned objective, or a formula, with its certificate.

    Args:
      path: NAME.npz; NAME.json is written beside it.
      drift, parameters: the drift.
      metadata: config (of the meta-training), seeds, results, cost, command.
    """
    if isinstance(drift, ClosedFormDrift) and not np.array_equal(
        drift.init(root_key(0))["constants"], parameters["constants"]
    ):
        # Trained on: its text must say the numbers that it is saved with.
        drift = drift.with_parameters(parameters)
        parameters = drift.init(root_key(0))
    certificate = certify(drift, parameters)
    config = dict(metadata.get("config", {}))
    own: dict[str, Any]
    if isinstance(drift, ClosedFormDrift):
        own = {"expression": drift.expression}
    else:
        own = {
            "hidden_size": drift.hidden_size,
            "features": list(drift.features),
        }
    shared = {"base": drift.base, "clip": drift.clip, "xi": drift.xi, "gate": drift.gate}
    config["drift"] = {**shared, **own}
    full = {
        **metadata,
        "kind": KIND,
        "config": config,
        "certificate": certificate.as_dict(),
    }
    return artefacts.save(path, jax.device_get(parameters), full), certificate
