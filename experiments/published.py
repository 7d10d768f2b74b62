"""Puts a published bandit into this project's format, so that every command takes it by file.

    python -m experiments.published DIRECTORY --out runs/published

DIRECTORY holds the paper's bandits as arrays (pendulum.npz). The result is for comparison; it is not this project's.
"""

import argparse
import sys
from pathlib import Path

from experiments.bandit_comparison import published_bandit


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("directory", type=Path)
    parser.add_argument("--out", type=Path, default=Path("runs/published"))
    arguments = parser.parse_args()

    from scb.environments.zoo import save_bandit

    bandit = published_bandit(arguments.directory / "pendulum.npz", "Pendulum-v1")
    path = save_bandit(
        arguments.out / "Synthetic-Pendulum-v1.npz",
        bandit,
        bandit.default_params.weights,
        {
            "config": {"evaluation_environment": "Pendulum-v1"},
            "seeds": {},
            "results": {},
            "cost": {},
            "command": "published by Liesen et al. (2024)",
        },
    )
    print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
