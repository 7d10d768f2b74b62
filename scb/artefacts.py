"""Artefacts: what was discovered, as two files that can be checked and need no trust.

NAME.npz holds the weights and is read without pickle, so that opening one runs no code, but for what a file names of
one's own: of a drift or an environment package.module:Class the module is imported, and it is called. NAME.json
beside it says what they are and where they came from: schema version, kind, name, config, seeds,
package versions, measured results, cost, the command, and the SHA-256 of the .npz. Equal input
gives equal bytes.
"""

import contextlib
import dataclasses
import hashlib
import io
import json
import os
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import jax
import numpy as np
from flax import traverse_util

from scb import schema
from scb.errors import UserError, first_line, unknown_name
from scb.files import make_folder, strict_json, write_together
from scb.keys import root_key
from scb.machine import package_versions

# numpy.ndarray leaves under any depth of dictionaries: {"reward": {"Dense_0": {"kernel": ...}}}.
ArrayTree: TypeAlias = "dict[str, np.ndarray | ArrayTree]"

# In a run's folder: what its search starts from, and not what it finds.
_BEGINNINGS = {"warm_start", "refinement"}


@dataclasses.dataclass(frozen=True)
class Artefact:
    """A checked artefact: its name, its weights as nested dictionaries, and all of NAME.json in the newest version."""

    name: str
    arrays: ArrayTree
    metadata: dict[str, Any]


def save(path: str | Path, arrays: Mapping[str, Any], metadata: Mapping[str, Any]) -> Path:
    """Writes NAME.npz, then NAME.json, each all at once.

    A reader never sees half a file, nor one of two with another's. If the process dies between the two, there is
    no .json, and `load` says so.

    Args:
      path: NAME or NAME.npz in any folder, which is made if it is missing.
      arrays: finite arrays of numbers, in dictionaries nested to any depth.
      metadata: `kind`, `config`, `seeds`, `results`, `cost` and `command`, and whatever else
        belongs; JSON types, NumPy numbers and arrays, and dataclasses. The schema version, the
        name, the package versions and the checksum are filled in; what else is left out, is empty.

    Returns:
      The path of NAME.npz.

    Raises:
      UserError: metadata is missing or not finite, or an array could not be loaded again.
    """
    npz_path, json_path = _paths(path)
    flat = expect_numbers(path, arrays)
    data = _npz_bytes(flat)

    written = {
        **schema.UNTOLD,
        **metadata,
        "schema_version": schema.VERSION,
        "name": npz_path.name.removesuffix(".npz"),
        # What is saved anew was found with those that it says.
        "versions": metadata.get("versions", package_versions()),
        "sha256": hashlib.sha256(data).hexdigest(),
    }
    written = {key: written[key] for key in (*schema.FIELDS, *written) if key in written}
    try:
        text = json.dumps(written, indent=2, ensure_ascii=False, allow_nan=False, default=_as_json)
    except (TypeError, ValueError, RecursionError) as error:
        raise UserError(
            f"the metadata of {npz_path} cannot be written as JSON ({error}): give finite numbers "
            "(None where one is unknown), text, lists and dictionaries."
        ) from error
    # As a reader will see it: a mapping or tuple of the caller's is a plain dict or list by now.
    schema.check(json_path, json.loads(text))

    make_folder(npz_path.parent, "path")
    write_together({npz_path: data, json_path: (text + "\n").encode()})
    return npz_path


def names_in(folder: Path) -> list[str]:
    """Names of the artefacts in a folder."""
    return sorted(path.stem for path in folder.glob("*.npz"))


def is_file(name: str) -> bool:
    """Whether a name stands for a file, as path.npz does, or for one that is there by its name without .npz."""
    return name.endswith(".npz") or os.path.isfile(f"{name}.npz")


def named(name: str | Path, folder: Path, what: str, others: Sequence[str] = ()) -> Path:
    """The file of an artefact: by its name in a folder of those that ship, or itself, path.npz.

    Args:
      name: also the file's without its ending.
      what: it is, for the message.
      others: names that the caller knows besides.

    Raises:
      UserError: neither, with near matches, or with the folder's files where it is a folder.
    """
    if not isinstance(name, str | os.PathLike):
        raise UserError(f"a {what} is {name!r}: give a name, or a file, path.npz.")
    text, names = os.path.expanduser(name), names_in(folder)
    if text in names:
        return folder / f"{text}.npz"
    if is_file(text):
        return Path(text if text.endswith(".npz") else f"{text}.npz")
    if os.path.isdir(text):  # which no name is too long for
        there = names_in(Path(text))
        if {*there} <= _BEGINNINGS and os.path.isdir(os.path.join(text, "checkpoints")):
            raise UserError(
                f"{text} is a run whose search has not ended: go on with it by --resume {text}, for one generation "
                "more at least."
            )
        raise UserError(
            f"{text} is a folder: give the {what}'s file"
            + (f" in it, such as {Path(text) / there[0]}.npz." if there else ", a path.npz.")
        )
    raise unknown_name(what, text, [*others, *names, f"path/to/{what}.npz"])


def arrays_digest(arrays: Mapping[str, Any]) -> str:
    """SHA-256 of arrays by name, whatever their order and however they are packed."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.asarray(arrays[name])
        digest.update(f"{name}:{array.dtype}:{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def load(path: str | Path, *kinds: str) -> Artefact:
    """Reads and checks an artefact.

    Args:
      path: NAME, NAME.npz or NAME.json.
      kinds: of `schema.KINDS`, what the caller can use.

    Raises:
      UserError: one sentence that says which file is missing, damaged, changed since it was saved,
        of another kind or a newer schema, or holds something other than finite numbers.
    """
    npz_path, json_path = _paths(path)
    # The bytes that are checked are the bytes that are used: each file is read once.
    data, text = _read(npz_path), _read(json_path)
    metadata = _parse_metadata(json_path, text)
    schema.check(json_path, metadata)
    if metadata["kind"] not in kinds:
        raise UserError(f"{npz_path} is a {metadata['kind']}: give a {' or '.join(kinds)} here.")
    if hashlib.sha256(data).hexdigest() != metadata["sha256"]:
        raise UserError(
            f"{npz_path} is not the file that {json_path.name} describes (its SHA-256 differs): it "
            "was changed, or saving it was interrupted; fetch or save both again."
        )
    arrays = unflatten(npz_path, _parse_npz(npz_path, data))
    return Artefact(metadata["name"], arrays, schema.upgraded(metadata))


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Arrays by flat name from any .npz of finite numbers; no .json is looked for, no pickle is run.

    Raises:
      UserError: the file cannot be read, is damaged, or holds something other than finite numbers.
    """
    return _parse_npz(path, _read(path))


@contextlib.contextmanager
def described(path: str | Path, what: str, entry: str = "a config entry") -> Iterator[None]:
    """Within it something is made as the .json of an artefact describes it, by which it may be misled to anything.

    Raises:
      UserError: the description is not one of `what`, such as "bandit"; also in the place of what it led to.
    """
    try:
        yield
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    except KeyError as error:
        raise UserError(
            f"{path} does not describe a {what}: its .json lacks config entry {error}."
        ) from error
    except Exception as error:
        raise UserError(
            f"{path} does not describe a {what}: its .json garbles {entry} ({first_line(error)})."
        ) from error


def expect_numbers(path: str | Path, arrays: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """The arrays by their flat names, ready to be written to `path`.

    Raises:
      UserError: one could not be loaded again, or has numbers that are not finite.
    """
    flat = flatten(arrays)
    for name, array in flat.items():
        if problem := _problem(array):
            raise UserError(f"{_paths(path)[0]} was not written, since array {name!r} {problem}.")
    return flat


def expect_shapes(artefact: Artefact, shapes: Mapping[str, Sequence[int]]) -> None:
    """Checks that the artefact holds exactly these arrays.

    Args:
      artefact: what was loaded.
      shapes: shape by flat name, {"reward/Dense_0/kernel": (4, 32)}.

    Raises:
      UserError: names the first array that is missing, of another shape, or not expected.
    """
    flat = flatten(artefact.arrays)
    title = f"{artefact.metadata['kind']} {artefact.name!r}"
    for name, shape in shapes.items():
        expected = tuple(shape)
        if name not in flat:
            raise UserError(
                f"{title} has no array {name!r}, which should have shape {expected}: it was made "
                "for another architecture than its config says."
            )
        if flat[name].shape != expected:
            raise UserError(
                f"array {name!r} of {title} has shape {flat[name].shape} where {expected} is "
                "expected: it was made for another architecture or another environment."
            )
    for name, array in flat.items():
        if name not in shapes:
            raise UserError(
                f"{title} has an array {name!r} of shape {array.shape} where none is expected: it "
                "was made for another architecture than its config says."
            )


def flatten(arrays: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """{"a": {"b": x}} as {"a/b": x}, in the order of the names.

    Raises:
      UserError: a name is empty, is no text or holds a "/", a dictionary is empty, or none is given: none of
        these would come back from a file.
    """
    if not isinstance(arrays, Mapping):
        raise UserError(f"the arrays are a {type(arrays).__name__}: give a dictionary of them.")
    flat = {}
    for path, array in traverse_util.flatten_dict({"": arrays}, keep_empty_nodes=True).items():
        wrong = [x for x in path[1:] if not isinstance(x, str) or not x or "/" in x]
        if wrong:
            raise UserError(
                f"{wrong[0]!r} cannot name an array: use text that is not empty and has no '/'."
            )
        name = "/".join(path[1:])
        if array is traverse_util.empty_node:
            raise UserError(f"the group {name!r} holds no arrays: leave it out.")
        flat[name] = np.asarray(array)
    return dict(sorted(flat.items()))


def shapes_of(init: Callable[[jax.Array], Any]) -> dict[str, tuple[int, ...]]:
    """{"reward/Dense_0/kernel": (O + A, hidden), ...} of what is made of a key, without making it.

    Raises:
      UserError: it is no dictionary of arrays and of such dictionaries.
    """
    made = jax.eval_shape(init, root_key(0))
    for path, _ in jax.tree_util.tree_flatten_with_path(made)[0]:
        if other := [x for x in path if not isinstance(x, jax.tree_util.DictKey)]:
            raise UserError(
                f"the arrays are kept in a list, a tuple or a class (at {other[0]}): give dictionaries of arrays alone."
            )
    return {
        name: array.shape
        for name, array in flatten(
            jax.tree.map(lambda x: np.broadcast_to(0.0, x.shape), made)
        ).items()
    }


def unflatten(path: Path, flat: Mapping[str, np.ndarray]) -> ArrayTree:
    """The inverse of `flatten`.

    Raises:
      UserError: a name is both an array and the dictionary of others; `path` is for the message.
    """
    for name in flat:
        if any(other.startswith(f"{name}/") for other in flat):
            raise _damaged(path, f"{name!r} is both an array and a group of arrays")
    tree: ArrayTree = traverse_util.unflatten_dict(dict(flat), sep="/")
    return tree


def _paths(path: str | Path) -> tuple[Path, Path]:
    path = Path(path).expanduser()
    # Not with_suffix: it would take the ".5" of "hopper-0.5" for a suffix.
    name = path.name.removesuffix(".npz").removesuffix(".json")
    if not name:
        raise UserError(f"{str(path)!r} names no artefact: give NAME or NAME.npz.")
    return path.with_name(f"{name}.npz"), path.with_name(f"{name}.json")


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        # A run that names files is perhaps continued from elsewhere.
        here = "" if path.is_absolute() else f", seen from {Path.cwd()}"
        raise UserError(
            f"{path} does not exist{here}: an artefact is a .npz file with a .json file of the same name "
            "beside it."
        ) from error
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read: {error}.") from error


def _npz_bytes(flat: Mapping[str, np.ndarray]) -> bytes:
    # numpy.savez stamps the time into the archive; compression differs between zlib versions.
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, array in flat.items():
            entry = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            entry.create_system = 3  # Unix, on every system
            entry.external_attr = 0o644 << 16
            content = io.BytesIO()
            np.lib.format.write_array(content, np.asarray(array, order="C"), allow_pickle=False)
            archive.writestr(entry, content.getvalue())
    return buffer.getvalue()


def _parse_npz(path: Path, data: bytes) -> dict[str, np.ndarray]:
    try:
        if not zipfile.is_zipfile(io.BytesIO(data)):
            raise zipfile.BadZipFile("no zip archive")
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            flat = {name: archive[name] for name in archive.files}
    except Exception as error:  # zipfile and NumPy raise a dozen kinds for damaged files
        raise _damaged(path, f"{error or type(error).__name__}") from error
    if not flat:
        raise _damaged(path, "it holds no arrays")
    for name, array in flat.items():
        problem = _problem(array)
        if problem:
            raise UserError(f"{path} cannot be used, since array {name!r} {problem}.")
    return flat


def _problem(array: np.ndarray | bytes) -> str | None:
    # A member that does not start like a .npy comes out of np.load as bytes.
    if not isinstance(array, np.ndarray):
        return "is in no format that NumPy writes"
    if array.dtype.kind not in "biuf":
        return f"is of type {array.dtype}, where only NumPy's integers, floats and booleans fit"
    number_bad = array.size - int(np.isfinite(array).sum())
    if number_bad:
        return f"has {number_bad} NaN or infinite among its {array.size} numbers"
    if array.dtype.kind == "f" and array.size and np.abs(array).max() > np.finfo(np.float32).max:
        return "has numbers that are infinite in 32 bits"
    return None


def _damaged(path: Path, what: str) -> UserError:
    return UserError(f"{path} is not a usable .npz ({what}): fetch or save it again.")


def _parse_metadata(path: Path, text: bytes) -> dict[str, Any]:
    try:
        metadata = strict_json(text)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path} is not valid JSON ({error}): fetch or save it again.") from error
    if not isinstance(metadata, dict):
        raise UserError(f"{path} holds a {type(metadata).__name__}: a JSON object is expected.")
    return metadata


def _as_json(value: object) -> object:
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray | jax.Array):
        return np.asarray(value).tolist()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        # Not asdict, which copies what it cannot convert: json comes back here for every field.
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError(f"a {type(value).__name__} is no JSON")
