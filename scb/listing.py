"""What ships with the library, as a table or as JSON: `scb list`."""

import json as json_format
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rich.table import Column, Table

from scb.agents.spec import algorithms_for
from scb.console import console
from scb.environments.registry import environment_spec
from scb.environments.zoo import bandit_metadata, zoo_names

# What a search's cost calls its steps: agents train in the bandit, and are evaluated in the environment. A warm start's
# are all of the environment.
_IN_BANDIT = ("environment_steps_training", "environment_steps_judgements_training")
_IN_ENVIRONMENT = ("environment_steps_evaluation", "environment_steps_judgements_evaluation")


def list_command(json: bool = False) -> None:
    """List the bandits that ship with the library: what they are worth, how they were found, and what that cost.

    Args:
      json: print JSON, with intervals and the command that found each.
    """
    bandits = [entry(name) for name in zoo_names()]
    if json:
        print(json_format.dumps(bandits, indent=2))
        return
    algorithms = [name.upper() for name in algorithms_for()]
    print_table(
        "IQM of 20 agents with drawn hyperparameters (Brax: the paper's fixed ones) in the environment: most likely "
        "actions (sampled). --json has intervals and commands.",
        ("bandit", *algorithms, "found", "minutes"),
        [
            (
                bandit["name"],
                *(_cell(bandit["results"].get(name)) for name in algorithms),
                bandit["found"],
                f"{bandit['minutes']:.1g}" if bandit["minutes"] < 1 else f"{bandit['minutes']:.0f}",
            )
            for bandit in bandits
        ],
    )


def entry(name: str) -> dict[str, Any]:
    """What `scb list --json` says of a bandit."""
    metadata = bandit_metadata(name)
    return {
        "name": name,
        "environment": environment_spec(name).evaluation_environment,
        "found": found(metadata),
        "minutes": round(_total(metadata, "seconds") / 60, 2),
        "environment_steps": int(_total(metadata, "environment_steps", *_IN_ENVIRONMENT)),
        "bandit_steps": int(_total(metadata, *_IN_BANDIT)),
        "results": metadata["results"],
        **made_by(metadata),
    }


def made_by(metadata: Mapping[str, Any]) -> dict[str, str]:
    """The command that made what ships, and why it now makes another of its kind, where it does."""
    return {x: metadata[x] for x in ("command", "random_keys") if x in metadata}


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """A table on standard output; in a narrow terminal names are broken, and numbers are not."""
    first, *others = columns
    wide = [max(map(len, column)) for column in zip(*rows, strict=True)][1:]
    table = Table(
        Column(first, overflow="fold"),
        *(Column(name, min_width=min(size, 9)) for name, size in zip(others, wide, strict=True)),
        title=title,
    )
    for row in rows:
        table.add_row(*row)
    console().print(table)


def found(metadata: Mapping[str, Any]) -> str:
    """How a bandit was: fitted to an expert, and by what more than that, or from random weights; evolved or not."""
    discovery = metadata["config"].get("discovery")
    if discovery is None:  # not by a discovery of this library
        return "elsewhere"
    earlier = metadata["config"].get("started_from")
    if earlier:
        start = str(earlier.get("found", "from a bandit"))  # earlier versions did not write it
    elif discovery["init"] == "random":
        start = "random weights"
    else:
        aggregated = discovery["warm_start"].get("aggregation_rounds")
        start = "fitted with aggregation" if aggregated else "fitted"
    start += ", refined" if discovery.get("refinement", {}).get("rounds") else ""
    evolved = metadata["cost"].get("generation", discovery["evolution"]["num_generations"])
    return f"{start}, evolved" if evolved and not start.endswith("evolved") else start


def warm_start_cost(metadata: Mapping[str, Any]) -> Mapping[str, Any]:
    """What the expert and the fit of a bandit cost, or of what its search goes on from; empty where there were none."""
    found: Iterator[Mapping[str, Any]] = (
        x["warm_start"] for x in _costs(metadata) if "warm_start" in x
    )
    return next(found, {})


def _costs(metadata: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """Of a search, and of those that it goes on from, the last first."""
    yield metadata["cost"]
    earlier = metadata["config"].get("started_from")
    while earlier:
        yield earlier["cost"]
        earlier = earlier["started_from"]


def _total(metadata: Mapping[str, Any], *names: str) -> float:
    """Of a search, the warm start and refinement before it, and the searches that it goes on from."""
    stages = (
        stage
        for cost in _costs(metadata)
        for stage in (cost, cost.get("warm_start", {}), cost.get("refinement", {}))
    )
    return sum(stage.get(name, 0.0) for stage in stages for name in names)


def _cell(result: Mapping[str, Any] | None) -> str:
    if result is None:
        return ""
    mode, sampled = (result[x]["value"] for x in ("mode_actions", "sampled_actions"))
    return f"{mode:.1f} ({sampled:.1f})" if abs(mode - sampled) > 0.05 else f"{mode:.1f}"
