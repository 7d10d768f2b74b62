"""The reports that the project's pages are made from."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from experiments.harness import DATA

ROOT = Path(__file__).parents[2]


@pytest.fixture
def committed() -> Callable[[str], dict[str, Any]]:
    """NAME -> an experiment's committed report, a new one each time."""
    return lambda name: json.loads((ROOT / DATA / f"{name}.json").read_text())
