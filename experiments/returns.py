"""What random and zero actions earn, measured anew into the library's table.

python -m experiments returns CartPole-v1 hopper:spring
"""

import json
from dataclasses import dataclass
from typing import Any

import tyro

from experiments.harness import Experiment, Save
from scb.environments import returns
from scb.environments.registry import environment_spec
from scb.files import write_json


@dataclass(frozen=True)
class Options:
    """Where."""

    places: tyro.conf.Positional[tuple[str, ...]]
    """NAME or NAME:BACKEND"""


def measure(options: Options, report: dict[str, Any], save: Save) -> None:
    """Measures at each place, and writes the table."""
    for place in options.places:
        name, _, backend = place.partition(":")
        spec = environment_spec(name)
        made = spec.make(backend or None)
        measured = {returns.RANDOM: returns.random_return(*made)}
        if spec.backends:
            measured[returns.IDLE] = returns.idle_return(*made)
        print(f"{place}: {measured}")
        kept = json.loads(returns.TABLE.read_text())
        for kind, value in measured.items():
            kept[kind] = dict(sorted({**kept[kind], place: value}.items()))
        write_json(returns.TABLE, kept)


EXPERIMENT = Experiment(
    "returns", "What random actions earn", measure, options=Options, reports=False
)
