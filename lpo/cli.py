"""The command line `lpo`."""

import sys
from collections.abc import Sequence
from typing import Any

from scb.cli import run_program


def _commands() -> dict[str, Any]:
    from lpo import align_command, commands, listing, pipeline, showing, training_commands

    return {
        "run": pipeline.RunAll,
        "meta-train": commands.MetaTrain,
        "train": training_commands.Train,
        "evaluate": training_commands.Evaluate,
        "align": align_command.Align,
        "certify": commands.certify_command,
        "distill": commands.distill_command,
        "list": listing.list_command,
        "show": showing.show_command,
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """`lpo`: learn an objective on a bandit, train PPO with it, judge it."""
    return run_program(
        "lpo",
        "Learned policy optimisation: learn an objective on a bandit, train PPO with it, judge it.",
        _commands,
        arguments,
    )


if __name__ == "__main__":
    sys.exit(main())
