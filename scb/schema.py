"""What an artefact's .json has to say, the versions of that, and how an older one is read as the newest.

A file keeps the version that it was written in. Whoever changes what entries mean raises `VERSION` and adds to
`UPGRADES` how the version before says the same; readers elsewhere know the newest version alone.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from scb.errors import UserError

VERSION = 2
KINDS = ("bandit", "drift", "synthetic_mdp")

# What every NAME.json holds, in this order, and as what; `results` maps names to numbers with their
# intervals, `cost` says environment steps and wall-clock time.
FIELDS: dict[str, tuple[type, ...]] = {
    "schema_version": (int,),
    "kind": (str,),
    "name": (str,),
    "config": (dict,),
    "seeds": (dict, list, int),
    "versions": (dict,),
    "results": (dict,),
    "cost": (dict,),
    "command": (str,),
    "sha256": (str,),
}
# What is written of whatever nobody has told.
UNTOLD: Mapping[str, Any] = {"seeds": {}, "results": {}, "cost": {}, "command": ""}


def _named_families(metadata: dict[str, Any]) -> dict[str, Any]:
    """1 to 2: drifts name their family and their gate, bandits their form."""
    config = dict(metadata["config"])
    # An entry of another type describes nothing, which its reader says.
    if isinstance(drift := config.get("drift"), dict):
        family = "formula" if "expression" in drift else "network"
        config["drift"] = {"family": family, "gate": 0.0, **drift}
    if isinstance(bandit := config.get("bandit"), dict):
        config["bandit"] = {"form": "networks", **bandit}
    return {**metadata, "config": config}


UPGRADES: Mapping[int, Callable[[dict[str, Any]], dict[str, Any]]] = {1: _named_families}


def upgraded(metadata: dict[str, Any]) -> dict[str, Any]:
    """The same in the newest version. Its entries are there, and of their types."""
    for version in range(metadata["schema_version"], VERSION):
        metadata = UPGRADES[version](metadata)
    return {**metadata, "schema_version": VERSION}


def check(path: Path, metadata: Mapping[str, Any]) -> None:
    """Raises a UserError where a .json doesn't say what an artefact has to, in a version that is read here."""
    # The version first: another version may well have other keys.
    version = metadata.get("schema_version", VERSION)
    if type(version) is not int or not 1 <= version <= VERSION:
        raise UserError(
            f"{path} has schema version {version!r} and this installation reads 1 to {VERSION}: "
            "install a version of lpo that matches it."
        )
    missing = [key for key in FIELDS if key not in metadata]
    if missing:
        raise UserError(
            f"{path} lacks {', '.join(missing)}: an artefact says all of {', '.join(FIELDS)}."
        )
    for key, types in FIELDS.items():
        if not isinstance(metadata[key], types):
            names = " or ".join({"dict": "object"}.get(t.__name__, t.__name__) for t in types)
            raise UserError(
                f"{path} has a {type(metadata[key]).__name__} for {key}: expected is {names}."
            )
    if metadata["kind"] not in KINDS:
        raise UserError(f"{path} is of kind {metadata['kind']!r}: known are {', '.join(KINDS)}.")
