"""Versions of what an artefact's .json says, and how an older one is read as the newest.

A file keeps the version that it was written in. Whoever changes what entries mean raises `VERSION` and adds to
`UPGRADES` how the version before says the same; readers elsewhere know the newest version alone.
"""

from collections.abc import Callable, Mapping
from typing import Any

VERSION = 2


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
