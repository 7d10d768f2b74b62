"""What a report holds and what is asked of it: a JSON object that a measurement goes on filling in."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from experiments.parts import file_name
from lpo.objectives import Objective
from scb.environments.registry import environment_spec
from scb.environments.synthetic import SyntheticBandit
from scb.environments.zoo import bandit_metadata, load_bandit, zoo_names
from scb.errors import UserError
from scb.files import as_json, read_object
from scb.measurement import Place, as_random
from scb.rows import Rows

Report = Mapping[str, Any]


def read(path: Path, missing_is_new: bool = False, keys: Iterable[str] = ()) -> dict[str, Any]:
    """A report from its file, with these keys at least; a UserError where there is none."""
    if missing_is_new and not path.exists():
        return {}
    try:
        return read_object(path, keys)
    except (OSError, ValueError) as error:
        raise UserError(
            f"{path} is no report of this command ({error}): measure first, or choose another --out."
        ) from error


def complete(report: Report) -> bool:
    """Whether everything that the report is about was measured."""
    return bool(report.get("complete"))


def settled(report: dict[str, Any], **settings: Any) -> None:
    """Notes in a report what it is measured with.

    Raises:
      UserError: what it holds was measured with something else.
    """
    for name, value in settings.items():
        value = as_json(value)
        if report.setdefault(name, value) != value:
            raise UserError(
                f"the report holds what was measured with {name} {report[name]}, and {value} is asked for: choose "
                "another --out."
            )


def same_objectives(report: dict[str, Any], objectives: Iterable[Objective]) -> None:
    """Notes in a report what its objectives' names do not tell: what is in their files, and code of somebody's own.

    Raises:
      UserError: it holds agents of another objective with such a name.
    """
    noted = report.setdefault("digests", {})
    for objective in objectives:
        for name, digest in objective.digests.items():
            if noted.setdefault(name, digest) != digest:
                raise UserError(
                    f"the report holds agents of another objective with the name {name}: choose another --out, or give "
                    "this one another name."
                )


def bandit_of(environment: str) -> tuple[SyntheticBandit, str]:
    """The zoo's bandit of an environment, and the checksum of its weights."""
    name = environment_spec(environment).bandit
    return load_bandit(name), bandit_metadata(name)["sha256"]


def forget_replaced(report: dict[str, Any]) -> None:
    """Takes out of a report what is of bandits that the zoo has replaced since, so that it is measured again.

    An entry's "sha256" says which bandit it is of; "published" ends the names of entries of other people's. None
    keeps the entry's place.
    """
    ours = {bandit_metadata(name)["sha256"] for name in zoo_names()}

    def replaced(entry: Any) -> bool:
        digest = entry.get("sha256") if isinstance(entry, dict) else None
        return isinstance(digest, str) and digest not in ours

    def forget(tree: dict[str, Any]) -> None:
        for name, entry in tree.items():
            if name.endswith("published"):
                continue
            if replaced(entry):
                tree[name] = None
            elif isinstance(entry, dict):
                forget(entry)

    if replaced(report):
        report.clear()
    forget(report)


def forget_other(entries: dict[str, Any], name: str, digest: str, of: str = "sha256") -> None:
    """Takes out an entry that is of another bandit, or objective, than the one with this checksum; `of` is its key."""
    if name in entries and entries[name].get(of) != digest:
        del entries[name]


def rows_in(folder: Path | None, *names: str) -> Rows:
    """Where agents of this name are kept until the report has them: in a file of the folder, or in memory."""
    return Rows(folder and folder / f"{file_name(*names)}.jsonl")


def lost(report: Any, of_them: bool = False) -> int:
    """How many agents of a report, or of a part of it, earned no number: what is under "failed", at any depth."""
    if isinstance(report, Mapping):
        return sum(lost(x, of_them or name == "failed") for name, x in report.items())
    return report if of_them else 0


def finite(returns: Any, place: Place) -> tuple[list[float], int]:
    """([N] returns to two digits, of less than 1 to six, how many were no number): those count as random actions."""
    values, failed = as_random(np.asarray(returns, np.float64), place)
    rounded = [round(x, 2) if abs(x) >= 1 else float(f"{x:.6g}") for x in values.tolist()]
    return rounded, int(failed.sum())
