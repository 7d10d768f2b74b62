import dataclasses
import errno
import io
import json
import os
import platform
import shutil
import zipfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from scb import artefacts, schema
from scb.errors import UserError

WEIGHTS = {
    "reward": {
        "Dense_0": {
            "kernel": np.arange(6, dtype=np.float32).reshape(2, 3),
            "bias": np.zeros(3, np.float32),
        }
    },
    "scale": np.float32(0.5),
    "steps": np.array([1, 2], np.int32),
    "flag": np.array(True),
}
SHAPES = {
    "reward/Dense_0/kernel": (2, 3),
    "reward/Dense_0/bias": (3,),
    "scale": (),
    "steps": (2,),
    "flag": (),
}
METADATA = {
    "kind": "bandit",
    "config": {"hidden_size": 32, "action": {"low": -1.0}},
    "seeds": {"meta": 0, "evaluation": [1, 2]},
    "results": {"return": {"value": -205.4, "low": None, "high": None, "n": 1}},
    "cost": {"environment_steps": 1000},
    "command": "scb discover",
}


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    return artefacts.save(tmp_path / "pendulum.npz", WEIGHTS, METADATA)


def rewrite(path: Path, data: bytes) -> None:
    """Replaces the .npz and makes the checksum match, as somebody with bad intentions would."""
    import hashlib

    path.write_bytes(data)
    change_json(path, sha256=hashlib.sha256(data).hexdigest())


def change_json(path: Path, **changes: object) -> None:
    json_path = path.with_suffix(".json")
    json_path.write_text(json.dumps({**json.loads(json_path.read_text()), **changes}))


def npz(**arrays: object) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def load_error(path: Path, kind: str = "bandit") -> str:
    with pytest.raises(UserError) as error:
        artefacts.load(path, kind)
    message = str(error.value)
    assert "\n" not in message and message.endswith((".", "?"))
    return message


def test_what_was_saved_is_what_is_loaded(saved):
    artefact = artefacts.load(saved, "bandit")
    assert artefact.name == "pendulum"
    flat, expected = artefacts.flatten(artefact.arrays), artefacts.flatten(WEIGHTS)
    assert flat.keys() == expected.keys()
    for name, array in expected.items():
        np.testing.assert_array_equal(flat[name], array)
        assert (flat[name].dtype, flat[name].shape) == (array.dtype, array.shape)
    assert METADATA.items() <= artefact.metadata.items()
    assert artefact.metadata["schema_version"] == schema.VERSION
    assert artefact.metadata["versions"]["python"] == platform.python_version()


def test_what_is_saved_anew_says_the_versions_that_it_was_found_with(tmp_path):
    old = {**METADATA, "versions": {"jax": "0.4"}}
    path = artefacts.save(tmp_path / "old.npz", WEIGHTS, old)
    assert artefacts.load(path, "bandit").metadata["versions"] == {"jax": "0.4"}


@pytest.mark.parametrize("suffix", ["", ".npz", ".json"])
def test_the_suffix_of_the_path_is_optional(tmp_path, suffix):
    # A dot in the name is part of the name: pathlib's suffix of "hopper-0.5" is ".5".
    written = artefacts.save(tmp_path / "folder" / f"hopper-0.5{suffix}", WEIGHTS, METADATA)
    assert written == tmp_path / "folder" / "hopper-0.5.npz"
    assert (
        artefacts.load(tmp_path / "folder" / f"hopper-0.5{suffix}", "bandit").name == "hopper-0.5"
    )


def test_equal_input_gives_equal_bytes_whenever_and_in_whatever_order(tmp_path, monkeypatch):
    first = artefacts.save(tmp_path / "a" / "x", WEIGHTS, METADATA)
    monkeypatch.setattr("time.time", lambda: 2e9)
    second = artefacts.save(tmp_path / "b" / "x", dict(reversed(WEIGHTS.items())), METADATA)
    assert first.read_bytes() == second.read_bytes()
    assert first.with_suffix(".json").read_bytes() == second.with_suffix(".json").read_bytes()


def test_nothing_but_the_two_files_is_left_behind(saved):
    assert sorted(os.listdir(saved.parent)) == ["pendulum.json", "pendulum.npz"]


def test_a_save_that_dies_between_the_two_files_is_noticed(saved, monkeypatch):
    replace = os.replace

    def die_at_json(source, target):
        if str(target).endswith(".json"):
            raise KeyboardInterrupt
        replace(source, target)

    monkeypatch.setattr("os.replace", die_at_json)
    with pytest.raises(KeyboardInterrupt):
        artefacts.save(saved, {"other": np.ones(2)}, METADATA)
    # Not a pair that does not match, at which a resumed run would stop.
    assert os.listdir(saved.parent) == ["pendulum.npz"]
    assert "pendulum.json does not exist" in load_error(saved)


def test_where_there_is_no_room_what_was_there_stays(saved, monkeypatch):
    before = {path: path.read_bytes() for path in saved.parent.iterdir()}

    written = []

    def full(descriptor):
        written.append(descriptor)
        if len(written) == 2:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        artefacts.save(saved, {"other": np.ones(2)}, METADATA)
    assert {path: path.read_bytes() for path in saved.parent.iterdir()} == before


def test_any_numpy_reader_can_open_the_weights(saved):
    with np.load(saved, allow_pickle=False) as archive:
        assert set(archive.files) == set(SHAPES)
        np.testing.assert_array_equal(archive["steps"], [1, 2])


def test_metadata_may_hold_numpy_numbers_jax_arrays_and_dataclasses(tmp_path):
    @dataclasses.dataclass
    class Config:
        hidden_size: int
        rates: tuple[float, ...]

    metadata = {
        **METADATA,
        "config": Config(hidden_size=np.int64(32), rates=(0.5, 1.0)),
        "results": {"mean": np.float32(0.5), "all": np.arange(2), "jax": jnp.ones(2)},
    }
    loaded = artefacts.load(artefacts.save(tmp_path / "x", WEIGHTS, metadata), "bandit").metadata
    assert loaded["config"] == {"hidden_size": 32, "rates": [0.5, 1.0]}
    assert loaded["results"] == {"mean": 0.5, "all": [0, 1], "jax": [1.0, 1.0]}


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"w": np.array([1.0, np.nan, np.inf])}, "2 NaN or infinite among its 3 numbers"),
        ({"w": np.array([1e39])}, "has numbers that are infinite in 32 bits"),
        ({"w": np.array([object()])}, "is of type object"),
        ({"w": np.array(["a"])}, "is of type <U1"),
        ({"w": jnp.ones(2, jnp.bfloat16)}, "is of type bfloat16"),
        ({"a/b": np.ones(1)}, "'a/b' cannot name an array"),
        ({3: np.ones(1)}, "3 cannot name an array"),
        ({"a": {}}, "the group 'a' holds no arrays"),
    ],
)
def test_what_could_not_be_loaded_again_is_not_saved(tmp_path, arrays, message):
    with pytest.raises(UserError, match=message):
        artefacts.save(tmp_path / "x", arrays, METADATA)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"results": {"return": float("nan")}}, "cannot be written as JSON"),
        ({"config": {"path": Path("x")}}, "a PosixPath is no JSON"),
        ({"kind": "policy"}, "is of kind 'policy': known are bandit, drift"),
        ({"command": None}, "has a NoneType for command: expected is str"),
    ],
)
def test_metadata_that_could_not_be_loaded_again_is_not_saved(tmp_path, changes, message):
    with pytest.raises(UserError, match=message):
        artefacts.save(tmp_path / "x", WEIGHTS, {**METADATA, **changes})
    with pytest.raises(UserError, match="lacks config"):
        artefacts.save(tmp_path / "x", WEIGHTS, {"kind": "bandit"})
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("suffix", [".npz", ".json"])
def test_either_file_missing_is_said_by_name(saved, suffix):
    saved.with_suffix(suffix).unlink()
    message = load_error(saved)
    assert f"pendulum{suffix} does not exist" in message


def test_a_folder_is_no_artefact(tmp_path):
    (tmp_path / "x.npz").mkdir()
    assert "cannot be read" in load_error(tmp_path / "x.npz")
    with pytest.raises(UserError, match="names no artefact"):
        artefacts.load(".npz", "bandit")


def test_changed_weights_are_noticed(saved):
    data = bytearray(saved.read_bytes())
    data[len(data) // 2] ^= 1
    saved.write_bytes(data)
    assert "its SHA-256 differs" in load_error(saved)


def test_another_kind_is_refused(saved):
    assert "is a bandit: give a drift here" in load_error(saved, "drift")


def test_what_an_older_version_said_is_read_as_the_newest_says_it(saved):
    older = {"drift": {"expression": "x"}, "bandit": {"latent": "normal"}}
    change_json(saved, schema_version=1, config=older)
    metadata = artefacts.load(saved, "bandit").metadata
    assert metadata["schema_version"] == schema.VERSION
    assert metadata["config"] == {
        "drift": {"family": "formula", "gate": 0.0, "expression": "x"},
        "bandit": {"form": "networks", "latent": "normal"},
    }
    # What says it already is as it was.
    change_json(saved, config=metadata["config"])
    assert artefacts.load(saved, "bandit").metadata["config"] == metadata["config"]


def test_every_version_is_read():
    assert list(schema.UPGRADES) == list(range(1, schema.VERSION))


@pytest.mark.parametrize("version", [schema.VERSION + 1, 0, "1", None, True])
def test_another_schema_version_is_refused_before_anything_else(saved, version):
    saved.with_suffix(".json").write_text(json.dumps({"schema_version": version}))
    assert f"has schema version {version!r} and this installation reads 1 to 2" in load_error(saved)


def test_a_missing_or_mistyped_entry_is_said_by_name(saved):
    change_json(saved, results=[1])
    assert "has a list for results: expected is object" in load_error(saved)
    metadata = json.loads(saved.with_suffix(".json").read_text())
    del metadata["seeds"], metadata["cost"]
    saved.with_suffix(".json").write_text(json.dumps(metadata))
    assert "lacks seeds, cost" in load_error(saved)


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"{",
        b'{"schema_version": NaN}',
        b"\xff\xfe",
        b"[" * 100_000,
    ],
)
def test_malformed_json_is_refused(saved, text):
    saved.with_suffix(".json").write_bytes(text)
    assert "pendulum.json is not valid JSON" in load_error(saved)


def test_json_that_is_no_object_is_refused(saved):
    saved.with_suffix(".json").write_text("[1, 2]")
    assert "holds a list" in load_error(saved)


def test_what_is_no_npz_is_refused(saved):
    complete = saved.read_bytes()
    array = io.BytesIO()
    np.save(array, np.ones(3))
    for data in (b"", b"no zip", complete[: len(complete) // 2], array.getvalue()):
        rewrite(saved, data)
        assert "is not a usable .npz" in load_error(saved)


def test_an_npz_without_arrays_is_refused(saved):
    rewrite(saved, npz())
    assert "it holds no arrays" in load_error(saved)


def test_a_pickle_is_refused_and_not_run(saved, tmp_path):
    class Malicious:
        def __reduce__(self):
            return (os.mkdir, (str(tmp_path / "was-run"),))

    rewrite(saved, npz(w=np.array([Malicious()], dtype=object)))
    assert "Object arrays cannot be loaded" in load_error(saved)
    assert not (tmp_path / "was-run").exists()


def test_members_that_are_not_arrays_of_numbers_are_refused(saved):
    rewrite(saved, npz(w=np.array(["a"])))
    assert "array 'w' is of type <U1" in load_error(saved)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("w.npy", "text")
    rewrite(saved, buffer.getvalue())
    assert "array 'w' is in no format that NumPy writes" in load_error(saved)


def test_weights_that_are_not_finite_are_refused(saved):
    rewrite(saved, npz(w=np.array([1.0, np.nan])))
    assert "array 'w' has 1 NaN or infinite among its 2 numbers" in load_error(saved)


def test_weights_that_32_bits_cannot_hold_are_refused(saved):
    rewrite(saved, npz(w=np.array([1.0, -1e39])))
    assert "array 'w' has numbers that are infinite in 32 bits" in load_error(saved)


def test_a_name_that_is_both_array_and_group_is_refused(saved):
    rewrite(saved, npz(**{"a": np.ones(1), "a/b": np.ones(1)}))
    assert "both an array and a group" in load_error(saved)
    rewrite(saved, npz(**{"a/b": np.ones(1), "a": np.ones(1)}))
    assert "both an array and a group" in load_error(saved)


def test_a_header_that_asks_for_absurd_memory_is_refused(saved):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (2**60,)}
    )
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("w.npy", header.getvalue())
    rewrite(saved, buffer.getvalue())
    assert "is not a usable .npz" in load_error(saved)


@settings(
    max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_no_damage_to_the_weights_gets_past_the_loader_as_another_error(saved, data):
    # The checksum is made to match, so that the parser behind it sees every damaged byte.
    original = saved.with_name("original.npz")
    if not original.exists():
        shutil.copy(saved, original)
    content = bytearray(original.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        position = data.draw(st.integers(0, len(content) - 1))
        content[position] = data.draw(st.integers(0, 255))
    rewrite(saved, bytes(content[: data.draw(st.integers(0, len(content)))]))
    try:
        artefacts.load(saved, "bandit")
    except UserError as error:
        assert "\n" not in str(error)


def test_expect_shapes_accepts_what_fits(saved):
    artefacts.expect_shapes(artefacts.load(saved, "bandit"), SHAPES)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"reward/Dense_0/kernel": (2, 4)},
            r"'reward/Dense_0/kernel' of bandit 'pendulum' has shape \(2, 3\) where \(2, 4\)",
        ),
        ({"scale": (1,)}, r"'scale' of bandit 'pendulum' has shape \(\) where \(1,\)"),
        ({"value": (5,)}, r"has no array 'value', which should have shape \(5,\)"),
    ],
)
def test_expect_shapes_names_the_array_and_both_shapes(saved, changes, message):
    with pytest.raises(UserError, match=message):
        artefacts.expect_shapes(artefacts.load(saved, "bandit"), {**SHAPES, **changes})


def test_expect_shapes_names_an_array_too_many(saved):
    shapes = {name: shape for name, shape in SHAPES.items() if name != "steps"}
    with pytest.raises(UserError, match=r"has an array 'steps' of shape \(2,\) where none"):
        artefacts.expect_shapes(artefacts.load(saved, "bandit"), shapes)
