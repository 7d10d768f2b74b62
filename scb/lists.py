"""Lists of hyperparameters to draw from, as the command line writes them."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from scb.agents.spec import check_lists, tables_of
from scb.agents.tables import Lists
from scb.command_line import numbers
from scb.errors import UserError
from scb.files import strict_json

_WANTED = 'give {"ppo": {"learning_rate": [0.001, 0.005]}, ...}'


def read_lists(words: str) -> dict[str, Lists]:
    """{algorithm: {hyperparameter: values}} from a JSON file or its content; what is wrong with it is a UserError."""
    source, content = "the text", words
    if not words.lstrip().startswith("{"):
        source = words
        try:
            content = Path(words).read_bytes().decode()
        except OSError as error:
            raise UserError(f"cannot read {source} ({error.strerror}): {_WANTED}.") from error
        except ValueError as error:
            raise UserError(f"{source} is no JSON ({error}): {_WANTED}.") from error
    try:
        lists = strict_json(content)
    except ValueError as error:
        raise UserError(f"{source} is no JSON ({error}): {_WANTED}.") from error
    if words == "{}":
        return {}
    if not isinstance(lists, dict) or not lists or not all(map(_is_filled, lists.values())):
        raise UserError(f"{source} holds no hyperparameter lists: {_WANTED}.")
    for algorithm, values in lists.items():
        try:
            check_lists(values, tables_of(algorithm).algorithm.hyperparameters())
        except UserError as error:
            raise UserError(f"{source}, {algorithm}: {error}") from error
    return {a: {n: tuple(v) for n, v in values.items()} for a, values in lists.items()}


def write_lists(lists: Mapping[str, Lists]) -> str:
    """What `read_lists` reads."""
    return json.dumps(lists)


def read_values(words: str) -> dict[str, tuple[float, ...]]:
    """{hyperparameter: values} from "learning_rate=0.0003,0.001 policy_output_scale=1,0.01"."""
    values = {}
    for part in words.split():
        name, equals, listed = part.partition("=")
        if not equals:
            raise UserError(
                f"hyperparameters {words!r} have the part {part!r}, which is no NAME=VALUE,VALUE: write such as "
                "learning_rate=0.0003,0.001."
            )
        values[name] = numbers(listed, name)
    return values


def write_values(values: Mapping[str, Sequence[float]]) -> str:
    """What `read_values` reads."""
    return " ".join(f"{name}={','.join(map(str, listed))}" for name, listed in values.items())


def _is_filled(lists: Any) -> bool:
    return isinstance(lists, dict) and bool(lists)
