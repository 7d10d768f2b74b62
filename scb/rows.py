"""Tidy rows: what a measurement keeps, agent by agent, in memory or in a file that survives a kill.

A file of rows is JSON Lines: `pandas.read_json("rows.jsonl", lines=True)`. Under which configuration a
row was measured is in the .json beside it, by the digest in its column `configuration`.
"""

import hashlib
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scb.configurations import first_difference
from scb.errors import UserError
from scb.files import make_folder, write_json, write_text

Row = dict[str, Any]
_DIGEST = re.compile("[0-9a-f]{12}")  # of a configuration
_AGENT = ("environment", "backend", "trained_in", "algorithm", "objective", "seed", "agent")
# All other columns are numbers, or None where one is not known.
_WHOLE = ("seed", "agent", "step")
_TEXTS = (*_AGENT[:5], "actions", "configuration")


def _row(line: str, where: str) -> Row:
    try:
        row = dict(json.loads(line))
        for name, value in row.items():
            if name in _TEXTS:
                right = value is None or isinstance(value, str)
            else:
                right = isinstance(value, int if name in _WHOLE else int | float | None)
            if not right or isinstance(value, bool):
                raise ValueError(f"{name} is {value!r}")
        return row
    except (TypeError, ValueError) as error:
        raise UserError(
            f"{where}, is damaged ({error}): take the line out, and its agent is measured again, or choose another "
            "file."
        ) from error


class Rows:
    """Tidy rows, in memory or in a file that grows an agent at a time.

    Args:
      path: of a .jsonl file, new or with rows to go on from; the half line that a kill left at its end
        is dropped. None: memory alone.

    Raises:
      UserError: the file cannot be read, or holds something else.
    """

    def __init__(self, path: str | Path | None = None) -> None:
        self.path = None if path is None else Path(path)
        if self.path is not None and self.path.suffix != ".jsonl":
            raise UserError(
                f"rows are kept in a .jsonl file, and {path} is none: choose another name."
            )
        self.rows: list[Row] = []
        self._configurations: dict[str, Any] = {}
        if self.path is None:
            return
        if not self.path.exists():
            if not self._own(self._described):
                raise UserError(
                    f"rows in {path} would replace {self._described}, which is of something else: choose another name."
                )
            return
        try:
            self._configurations = dict(json.loads(self._described.read_text()))
            lines = self.path.read_text().split("\n")
            for number, line in enumerate(lines[:-1], 1):
                self.rows.append(_row(line, f"{self.path}, line {number}"))
            complete = all(
                row.keys() >= {*_AGENT, "step", "configuration"}
                and row["configuration"] in self._configurations
                for row in self.rows
            )
        except (OSError, TypeError, ValueError, AttributeError) as error:
            raise UserError(
                f"{self.path} cannot be read, with the .json beside it ({error}): choose another file."
            ) from error
        if not complete:
            raise UserError(f"{self.path} holds no rows of a measurement: choose another file.")
        if lines[-1]:
            self._write()

    @property
    def _described(self) -> Path:
        assert self.path is not None
        return self.path.with_suffix(".json")

    @staticmethod
    def _own(described: Path) -> bool:
        """Whether nothing is lost where configurations are written there, as before a first agent."""
        if not described.exists():
            return True
        try:
            there = json.loads(described.read_text())
        except (OSError, ValueError):
            return False
        return isinstance(there, dict) and all(_DIGEST.fullmatch(name) for name in there)

    def cell(self, columns: Mapping[str, Any], configuration: Any, number: int) -> "Cell":
        """What is there of agents with these columns, each of `number` rows; a part of an agent is dropped.

        Of what was measured twice, as by two processes that had one file, the first is kept.
        """
        described = json.loads(json.dumps(configuration, default=_description, sort_keys=True))
        digest = hashlib.sha256(json.dumps(described, sort_keys=True).encode()).hexdigest()[:12]
        there = [row for row in self.rows if all(row[n] == x for n, x in columns.items())]
        for other in {row["configuration"] for row in there} - {digest}:
            stored = self._configurations[other]
            # What an earlier version did not write down is not compared.
            known = {name: described.get(name) for name in stored}
            if any(stored.get(x) != known.get(x) for x in ("objective", "objective_code")):
                raise UserError(
                    f"{self.path or 'the rows'} hold another objective with the name {columns['objective']}: give this "
                    "one a name of its own, or choose another file."
                )
            difference = first_difference(stored, known)
            if difference:
                raise UserError(
                    f"{self.path or 'the rows'} were measured under another configuration: it differs at "
                    f"{difference}; choose another file, or measure as then."
                )
        if digest not in self._configurations:
            self._configurations[digest] = described
            if self.path is not None:
                self._described.parent.mkdir(parents=True, exist_ok=True)
                write_json(self._described, self._configurations)
        done: dict[tuple[int, int], list[Row]] = {}
        for row in there:
            done.setdefault((row["seed"], row["agent"]), []).append(row)
        points = {
            name: {(row["step"], row.get("actions")): row for row in reversed(of_it)}
            for name, of_it in done.items()
        }
        if other := {
            name: of_it
            for name, of_it in done.items()
            if not len(of_it) == len(points[name]) == number
        }:
            dropped = set()
            for name, of_it in other.items():
                kept = [x for x in of_it if x is points[name][x["step"], x.get("actions")]]
                done[name] = kept if len(kept) == number else []
                dropped |= {id(row) for row in of_it} - {id(row) for row in done[name]}
            done = {name: of_it for name, of_it in done.items() if of_it}
            self.rows = [row for row in self.rows if id(row) not in dropped]
            self._write()
        return Cell(self, {**columns}, digest, done)

    def expect_writable(self) -> None:
        """Raises a UserError where nothing can be added, before it is measured."""
        if self.path is not None:
            make_folder(self.path.parent, "place")

    def add(self, rows: Sequence[Row]) -> None:
        """Appends an agent's rows."""
        if self.path is not None:
            with self.path.open("a") as file:
                file.write("".join(_line(row) for row in rows))
        self.rows += rows

    def _write(self) -> None:
        if self.path is not None:
            write_text(self.path, "".join(map(_line, self.rows)))


@dataclass(frozen=True)
class Cell:
    """The agents of one environment, algorithm and objective, and their rows: {(seed, number): rows}."""

    rows: Rows
    columns: Row
    digest: str
    done: dict[tuple[int, int], list[Row]]

    def add(self, agent: tuple[int, int], results: Sequence[Row]) -> None:
        """Keeps an agent's results."""
        seed, number = agent
        self.done[agent] = [
            {**self.columns, "seed": seed, "agent": number, **row, "configuration": self.digest}
            for row in results
        ]
        self.rows.add(self.done[agent])


def pivot(rows: Iterable[Row], *axes: str, value: str = "return") -> np.ndarray:
    """One column of the rows as an array with an axis for each of these columns, such as objective, seed, step.

    Along an axis labels stand as they first appear. What is no number is NaN.

    Raises:
      ValueError: two rows for one place, or none.
    """
    rows = list(rows)
    labels = [list(dict.fromkeys(row[axis] for row in rows)) for axis in axes]
    positions = [{label: i for i, label in enumerate(of_it)} for of_it in labels]
    filled = np.zeros([len(of_it) for of_it in labels], int)
    array = np.full(filled.shape, np.nan)
    for row in rows:
        place = tuple(at[row[axis]] for at, axis in zip(positions, axes, strict=True))
        filled[place] += 1
        # A file of an earlier version lacks columns.
        array[place] = np.nan if row.get(value) is None else row[value]
    if not (filled == 1).all():
        raise ValueError(f"the rows are not one for every combination of {', '.join(axes)}.")
    return array


def _line(row: Row) -> str:
    return json.dumps(row, allow_nan=False) + "\n"


def _description(value: Any) -> Any:
    """Of what JSON doesn't know: large arrays by their digest."""
    if is_dataclass(value) and not isinstance(value, type):
        parts = {field.name: getattr(value, field.name) for field in fields(value)}
        return {"class": type(value).__name__, **parts}
    if isinstance(value, Mapping):
        return dict(value)
    # A function, whose representation is another in every process.
    if callable(value):
        named = value if hasattr(value, "__qualname__") else type(value)
        return f"{named.__module__}.{named.__qualname__}"
    array = np.asarray(value)
    if array.dtype == object:
        return repr(value)
    if array.size > 8:
        return {"shape": array.shape, "sha256": hashlib.sha256(array.tobytes()).hexdigest()}
    return array.tolist()
