"""What agents are trained with, as the command line writes it: lists to draw from, and static configurations."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from scb.agents.spec import check_lists, configured, tables_of
from scb.agents.tables import Lists, Values
from scb.command_line import numbers
from scb.errors import UserError
from scb.files import strict_json

T = TypeVar("T")
_LISTS = 'give {"ppo": {"learning_rate": [0.001, 0.005]}, ...}'
_CONFIGS = 'give {"ppo": {"num_envs": 1, "num_steps": 2048}, ...}'


def read_lists(words: str) -> dict[str, Lists]:
    """{algorithm: {hyperparameter: values}} from a JSON file or its content; what is wrong with it is a UserError."""

    def checked(algorithm: str, values: Mapping[str, Any]) -> Lists:
        check_lists(values, tables_of(algorithm).algorithm.hyperparameters())
        return {name: tuple(of_it) for name, of_it in values.items()}

    return _read(words, "hyperparameter lists", _LISTS, checked)


def read_configs(words: str) -> dict[str, Values]:
    """{algorithm: {field of its configuration: value}}, like `read_lists`."""

    def checked(algorithm: str, values: Mapping[str, Any]) -> Values:
        configured(tables_of(algorithm).algorithm.config(), values)
        return dict(values)

    return _read(words, "configurations", _CONFIGS, checked)


def _read(
    words: str, what: str, wanted: str, checked: Callable[[str, Mapping[str, Any]], T]
) -> dict[str, T]:
    source, content = "the text", words
    if not words.lstrip().startswith(("{", "[")):
        source = words
        try:
            content = Path(words).read_bytes().decode()
        except OSError as error:
            raise UserError(f"cannot read {source} ({error.strerror}): {wanted}.") from error
        except ValueError as error:
            raise UserError(f"{source} is no JSON ({error}): {wanted}.") from error
    try:
        found = strict_json(content)
    except ValueError as error:
        raise UserError(f"{source} is no JSON ({error}): {wanted}.") from error
    if words == "{}":
        return {}
    if not isinstance(found, dict) or not found or not all(map(_is_filled, found.values())):
        raise UserError(f"{source} holds no {what}: {wanted}.")
    read = {}
    for algorithm, values in found.items():
        try:
            read[algorithm] = checked(algorithm, values)
        except UserError as error:
            raise UserError(f"{source}, {algorithm}: {error}") from error
    return read


def write_lists(lists: Mapping[str, Mapping[str, Any]]) -> str:
    """What `read_lists` or `read_configs` reads."""
    return json.dumps(lists)


def read_values(words: str) -> dict[str, tuple[float, ...]]:
    """{hyperparameter: values} from "learning_rate=0.0003,0.001 policy_output_scale=1,0.01"."""
    parts = _parts(words, "NAME=VALUE,VALUE", "learning_rate=0.0003,0.001")
    return {name: numbers(listed, name) for name, listed in parts}


def write_values(values: Mapping[str, Sequence[float]]) -> str:
    """What `read_values` reads."""
    return " ".join(f"{name}={','.join(map(str, listed))}" for name, listed in values.items())


def read_settings(words: str) -> dict[str, Any]:
    """{field of an agent: value} from "learning_rate=0.001 num_envs=16 activation=relu hidden_sizes=[64,64]"."""
    form = "NAME=VALUE without a space"
    return {name: _setting(value) for name, value in _parts(words, form, "learning_rate=0.001")}


def _setting(word: str) -> Any:
    for read in (strict_json, float):
        try:
            return read(word)
        except ValueError:
            continue
    return {"True": True, "False": False}.get(word, word)


def write_settings(values: Mapping[str, Any]) -> str:
    """What `read_settings` reads."""
    written = {
        name: value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))
        for name, value in values.items()
    }
    return " ".join(f"{name}={value}" for name, value in written.items())


def _parts(words: str, form: str, example: str) -> Iterator[tuple[str, str]]:
    named = set()
    for part in words.split():
        name, equals, value = part.partition("=")
        if not equals:
            raise UserError(
                f"hyperparameters {words!r} have the part {part!r}, which is no {form}: write such as {example}."
            )
        if name in named:
            raise UserError(f"hyperparameters {words!r} have {name} twice: give it once.")
        named.add(name)
        yield name, value


def _is_filled(values: Any) -> bool:
    return isinstance(values, dict) and bool(values)
