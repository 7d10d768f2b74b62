"""What ships with the library, as a table or as JSON: `lpo list`."""

import json as json_format
from collections.abc import Mapping
from typing import Any

from lpo.objectives import KNOWN, load_objective, zoo_names
from scb.listing import made_by, print_table

PLACES = {
    "Pendulum-v1, policy_output_scale 0.01": "Pendulum, small last layer",
    "Pendulum-v1": "Pendulum, Flax's initialisation",
}


def list_command(json: bool = False) -> None:
    """List the objectives that ship with the library: what PPO earns with them, where they were learned, at what cost.

    Args:
      json: print JSON, with intervals and the command that learned each.
    """
    learned = [entry(name) for name in zoo_names()]
    # Formulas were measured beside each, on the same seeds.
    beside = load_objective("lpo-pendulum").metadata["results"]
    known = [{"name": name, "learned_on": [], "results": _results(beside, name)} for name in KNOWN]
    if json:
        print(json_format.dumps([*known, *learned], indent=2))
        return
    print_table(
        "IQM of 20 agents of PPO after 150 000 steps with each as its objective. --json has intervals and commands.",
        ("objective", *PLACES.values(), "learned on", "minutes"),
        [
            (
                x["name"],
                *(_cell(x["results"].get(place)) for place in PLACES),
                ", ".join(x["learned_on"]) or "nothing: a formula",
                f"{x['minutes']:.0f}" if "minutes" in x else "",
            )
            for x in (*known, *learned)
        ],
    )


def entry(name: str) -> dict[str, Any]:
    """What `lpo list --json` says of a learned objective."""
    objective = load_objective(name)
    metadata = objective.metadata
    return {
        "name": name,
        "learned_on": list(objective.learned_on),
        "minutes": round(metadata["cost"]["seconds"] / 60, 2),
        "results": _results(metadata["results"], name),
        "certificate": metadata.get("certificate"),
        **made_by(metadata),
    }


def _results(measured: Mapping[str, Any], name: str) -> dict[str, Any]:
    """{place: estimate} of the objective in the table of an artefact."""
    tables = {place: measured[place]["final_iqm"] for place in PLACES if place in measured}
    return {place: table[name] for place, table in tables.items() if name in table}


def _cell(result: Mapping[str, Any] | None) -> str:
    return "" if result is None else f"{result['value']:.0f}"
