import errno
import fcntl
import json
import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scb.checkpoints import Checkpoints
from scb.configurations import config_dict, first_difference
from scb.errors import UserError
from scb.files import write_json, write_text
from scb.locks import held, released
from scb.machine import machine_description
from scb.runs import Run, read_config, run_of
from scb.stopwatch import Stopwatch
from tests.locking import is_locked

CONFIG = {"seed": 0, "evolution": {"sigma": 0.05, "strategy": "SNES"}, "hidden_sizes": (8, 8)}


@pytest.fixture
def run(tmp_path):
    run = Run.open(tmp_path / "run", CONFIG)
    yield run
    run.close()


def lines(run, name="metrics.jsonl"):
    return (run.folder / name).read_text().splitlines()


# -- opening
# ------------------------------------------------------------------------------------------


def test_a_new_run_stores_its_config(run):
    assert not run.resumed
    # As JSON has it: a tuple is a list by now.
    assert read_config(run.folder) == {**CONFIG, "hidden_sizes": [8, 8]}


def test_a_run_may_start_in_an_empty_folder(tmp_path):
    (tmp_path / "empty").mkdir()
    assert Run.open(tmp_path / "empty", CONFIG).folder == tmp_path / "empty"


def test_a_run_may_start_where_another_left_nothing_but_its_settings(tmp_path):
    Run.open(tmp_path / "run", {**CONFIG, "command": "scb discover"}).close()
    found = Run.open(tmp_path / "run", {**CONFIG, "command": "scb discover --seed=2"})
    assert read_config(found.folder)["command"].endswith("--seed=2") and not found.resumed
    found.log(0, {"fitness/mean": 1.0}, 0.1)
    found.close()
    with pytest.raises(UserError, match="already exists and is not empty"):
        Run.open(tmp_path / "run", {**CONFIG, "command": "scb discover"})


def test_a_folder_is_held_until_its_command_has_ended(tmp_path):
    with released():
        run = Run.open(tmp_path / "run", CONFIG)
        run.end_log()
        assert is_locked(run.folder / ".lock")
    assert not is_locked(run.folder / ".lock")


def test_a_file_is_held_by_one_command(tmp_path):
    path = tmp_path / "report.json"
    with held(path):
        lock = tmp_path / ".report.json.lock"
        assert is_locked(lock)
    assert not lock.exists() and not path.exists()


def test_a_lock_that_was_removed_as_it_was_taken_holds_nothing(tmp_path, monkeypatch):
    path, lock = tmp_path / "report.json", tmp_path / ".report.json.lock"
    lockf = fcntl.lockf

    def late(file, flags):
        lock.unlink()  # by whoever held it, before it let go
        lockf(file, flags)

    monkeypatch.setattr(fcntl, "lockf", late)
    with pytest.raises(UserError, match="in use by another command"), held(path):
        pass
    monkeypatch.setattr(fcntl, "lockf", lockf)
    with held(path):
        assert is_locked(lock)


@pytest.mark.parametrize("settings", ['{"theirs": 1}', "no json"])
def test_settings_that_are_no_runs_are_left_alone(tmp_path, settings):
    (tmp_path / "config.json").write_text(settings)
    with pytest.raises(UserError, match="already exists and is not empty"):
        Run.open(tmp_path, CONFIG)
    assert (tmp_path / "config.json").read_text() == settings


def test_a_folder_that_holds_something_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match="already exists and is not empty: choose another --out"):
        Run.open(tmp_path, CONFIG)
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]


def test_a_file_in_the_place_of_the_folder_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="file is a file, and a run needs a folder: choose another"):
        Run.open(tmp_path / "file", CONFIG)


def test_a_folder_that_cannot_be_made_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"cannot write to .*run \(Not a directory\): choose"):
        Run.open(tmp_path / "file" / "run", CONFIG)


def test_resuming_with_the_same_config_keeps_everything(run):
    run.log(0, {"fitness": 1.0}, seconds=0.5)
    resumed = Run.open(run.folder, CONFIG, resume=True)
    assert resumed.resumed
    assert resumed.metrics() == [{"generation": 0, "fitness": 1.0}]
    assert resumed.seconds() == 0.5


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 1}, r"differs at seed \(0 there, 1 now\)"),
        (
            {"evolution": {"sigma": 0.1, "strategy": "SNES"}},
            r"differs at evolution.sigma \(0.05 there, 0.1 now\)",
        ),
        ({"evolution": {"sigma": 0.05}}, r"at evolution.strategy \('SNES' there, None now\)"),
        ({"hidden_sizes": [8]}, r"differs at hidden_sizes \(\[8, 8\] there, \[8\] now\)"),
        ({"new": True}, r"differs at new \(None there, True now\)"),
    ],
)
def test_another_config_cannot_resume_a_run(run, change, message):
    with pytest.raises(UserError, match=message):
        Run.open(run.folder, {**CONFIG, **change}, resume=True)


def test_another_arithmetic_cannot_resume_a_run(run, monkeypatch):
    monkeypatch.setattr("scb.runs.arithmetic", lambda: {"jax_enable_x64": "True"})
    with pytest.raises(UserError, match=r"differs at arithmetic \(None there, {'jax_enable_x64'"):
        Run.open(run.folder, CONFIG, resume=True)


GROWING = ["seed", "evolution.sigma", "hidden_sizes"]


@pytest.mark.parametrize("change", [{"seed": 1}, {"hidden_sizes": [8, 8, 4]}])
def test_a_run_that_may_grow_stores_what_it_has_become(run, change):
    Run.open(run.folder, {**CONFIG, **change}, resume=True, growing=GROWING).close()
    assert read_config(run.folder) == {**CONFIG, "hidden_sizes": [8, 8], **change}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": -1}, r"differs at seed \(0 there, -1 now\)"),
        ({"hidden_sizes": [4]}, r"\[4\] now"),
        (
            {"evolution": {"strategy": "SNES", "sigma": 0.1}},
            "0.1 now",
        ),  # of a fraction there is no more
    ],
)
def test_a_run_that_may_grow_may_not_shrink(run, change, message):
    with pytest.raises(UserError, match=message):
        Run.open(run.folder, {**CONFIG, **change}, resume=True, growing=GROWING)
    assert read_config(run.folder) == {**CONFIG, "hidden_sizes": [8, 8]}


@pytest.mark.parametrize("growing", [(), GROWING])
def test_a_bandit_that_was_replaced_cannot_go_on_with_a_run(tmp_path, growing):
    began = {**CONFIG, "inputs": {"mine.npz": "a", "zoo": "b"}}
    Run.open(tmp_path, began).close()
    Run.open(tmp_path, began, resume=True, growing=growing).close()
    replaced = {**began, "inputs": {"mine.npz": "a", "zoo": "c"}}
    with pytest.raises(
        UserError, match="zoo is not what it was when the run was started; put that"
    ):
        Run.open(tmp_path, replaced, resume=True, growing=growing)
    # Nor with another in its place under another name; the same may be called something else.
    other = {**began, "inputs": {"mine.npz": "a", "other": "c"}}
    with pytest.raises(UserError, match="zoo is not part of it; put that back"):
        Run.open(tmp_path, other, resume=True, growing=growing)
    assert read_config(tmp_path)["inputs"] == began["inputs"]
    moved = {**began, "inputs": {"mine.npz": "a", "elsewhere": "b"}}
    Run.open(tmp_path, moved, resume=True, growing=growing).close()


@dataclass(frozen=True)
class Inner:
    sigma: float = 0.05
    averaging: int = 1


@dataclass(frozen=True)
class Outer:
    seed: int
    inner: Inner = field(default_factory=Inner)
    episodes: int = 16
    names: tuple[str, ...] = ("ppo",)
    # A table is one setting, and has no defaults inside.
    drawn: Mapping[str, float] = field(default_factory=lambda: {"scale": 1.0})


def test_what_a_run_of_an_earlier_version_lacks_is_at_its_default(tmp_path):
    settings = {"seed": 3, "inner": {"sigma": 0.1}, "names": ["sac"]}
    began = {"command": "x", "config": settings}
    Run.open(tmp_path, began).close()
    write_text(tmp_path / "metrics.jsonl", "")  # else nothing was found there yet
    same = Outer(3, Inner(0.1), names=("sac",))
    others = {
        r"inner.averaging \(1 there, 2 now": replace(same, inner=Inner(0.1, averaging=2)),
        r"episodes \(16 there, 3 now": replace(same, episodes=3),
        r"names \(\['sac'\] there": replace(same, names=("ppo",)),
        r"drawn.rate \(None there, 0.1 now": replace(same, drawn={"rate": 0.1, "scale": 1.0}),
    }
    for difference, other in others.items():
        with (
            pytest.raises(UserError, match=rf"differs at config\.{difference}"),
            run_of(tmp_path, other, {}, ()),
        ):
            pass
    with run_of(tmp_path, same, {}, ()) as run:
        assert run.resumed
    assert read_config(tmp_path) == began


@dataclass(frozen=True)
class Other(Inner):
    power: float = 4.0


@dataclass(frozen=True)
class Either:
    inner: Inner | Other = field(default_factory=Inner)


def test_of_one_of_several_classes_nothing_is_filled_in(tmp_path):
    # Else a run of one would go on as a run of the other.
    Run.open(tmp_path, {"command": "x", "config": config_dict(Either())}).close()
    write_text(tmp_path / "metrics.jsonl", "")
    with (
        pytest.raises(UserError, match=r"inner.power \(None there, 4.0 now"),
        run_of(tmp_path, Either(Other()), {}, ()),
    ):
        pass


@pytest.mark.parametrize(
    "config",
    [
        *(None, [], "x", {"evolution": None}, {"evolution": []}),
        *({"evolution": {"num_generations": x}} for x in (None, "9", [], 9.5, math.inf)),
    ],
)
def test_a_damaged_number_of_generations_is_refused(tmp_path, config):
    Run.open(tmp_path, {"config": config}).close()
    asked = {"config": {"evolution": {"num_generations": 1}}}
    with pytest.raises(UserError, match=r"differs at config"):
        Run.open(tmp_path, asked, resume=True, growing=["config.evolution.num_generations"])


def test_only_a_folder_with_a_checkpoint_in_it_counts_as_one(tmp_path):
    began, asked = ({"num_generations": n} for n in (9, 4))
    Run.open(tmp_path, began).close()
    for name in ("999", "²", "5.tmp"):
        (tmp_path / "checkpoints" / name).mkdir(parents=True)
    write_text(tmp_path / "checkpoints" / "²" / "state", "")
    Run.open(tmp_path, asked, resume=True, growing=["num_generations"]).close()
    (tmp_path / "checkpoints" / "3" / "state").mkdir(parents=True)
    with pytest.raises(
        UserError, match=r"after 3 generations: of 4 it has done 3; take at least 4"
    ):
        Run.open(tmp_path, {"num_generations": 3}, resume=True, growing=["num_generations"])


def test_a_run_that_does_not_say_what_it_began_with_goes_on(run):
    Run.open(run.folder, {**CONFIG, "inputs": {"mine.npz": "a"}}, resume=True).close()
    assert "inputs" not in read_config(run.folder)


@pytest.mark.parametrize("content", [None, "", "{", '{"seed": ', "[1]", "3", "null"])
def test_what_is_no_run_cannot_be_resumed(tmp_path, content):
    if content is not None:
        (tmp_path / "config.json").write_text(content)
    with pytest.raises(UserError, match=r"is not a run \(no readable config.json\)"):
        Run.open(tmp_path, CONFIG, resume=True)


def test_logging_to_wandb_needs_its_package(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(UserError, match="needs the package wandb: install the extra"):
        Run.open(tmp_path / "run", CONFIG, wandb_project="bandits")
    assert not (tmp_path / "run").exists()  # which would be in the way of the next try


def test_a_resumed_run_goes_on_in_its_own_run_of_wandb(tmp_path, monkeypatch):
    started = []
    wandb = SimpleNamespace(init=lambda **named: started.append(named) or SimpleNamespace())
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    for resume in (False, True):
        Run.open(tmp_path / "run", CONFIG, resume, wandb_project="bandits")
    Run.open(tmp_path / "other", CONFIG, wandb_project="bandits")
    first, again, other = (x["id"] for x in started)
    assert first == again != other and {x["resume"] for x in started} == {"allow"}


# -- logs
# ---------------------------------------------------------------------------------------------


def test_a_logged_generation_is_one_line_of_json_without_clocks(run):
    run.log(0, {"fitness": np.float32(0.5), "failed": 2, "steps": np.int64(7)}, seconds=1.25)
    assert lines(run) == ['{"generation": 0, "fitness": 0.5, "failed": 2, "steps": 7}']
    run.log(1, {"fitness": 0.5}, seconds=1.5)
    first, second = lines(run, "timing.jsonl")
    machine = machine_description()
    assert json.loads(first) == {"generation": 0, "seconds": 1.25, "machine": machine}
    assert second == '{"generation": 1, "seconds": 1.5}'


def test_a_number_that_json_does_not_know_is_null(run):
    run.log(0, {"a": float("nan"), "b": np.float32("inf"), "c": 1.0}, seconds=0.0)
    assert json.loads(lines(run)[0]) == {"generation": 0, "a": None, "b": None, "c": 1.0}


def test_seconds_add_up_over_generations(run):
    assert (run.metrics(), run.seconds()) == ([], 0.0)
    for generation, seconds in enumerate([0.5, 1.5, 0.25]):
        run.log(generation, {}, seconds)
    assert run.seconds() == 2.25


def test_tensorboard_gets_the_same_numbers(run):
    run.log(0, {"fitness": 0.5}, seconds=0.0)
    run.close()
    (events,) = (run.folder / "tensorboard").iterdir()
    assert b"fitness" in events.read_bytes()


def test_rewinding_drops_what_came_after_the_checkpoint(run):
    for generation in range(5):
        run.log(generation, {"fitness": float(generation)}, seconds=1.0)
    run.rewind(3)
    assert [line["generation"] for line in run.metrics()] == [0, 1, 2]
    assert run.seconds() == 3.0
    # And the next generation is appended behind them.
    run.log(3, {"fitness": 30.0}, seconds=1.0)
    assert run.metrics()[-1] == {"generation": 3, "fitness": 30.0}


def test_rewinding_drops_the_half_line_that_a_kill_left(run):
    for generation in range(3):
        run.log(generation, {"fitness": 1.0}, seconds=1.0)
    whole = lines(run)
    for cut in (whole[2][:5], whole[2][:-1]):
        (run.folder / "metrics.jsonl").write_text("\n".join([*whole[:2], cut]))
        run.rewind(3)
        assert lines(run) == whole[:2]


@pytest.mark.parametrize("damage", ["{", "5", '{"fitness": 1.0}'])
def test_a_line_that_is_damaged_before_the_last_is_told_and_nothing_dropped(run, damage):
    for generation in range(3):
        run.log(generation, {"fitness": 1.0}, seconds=1.0)
    written = "\n".join([lines(run)[0], damage, lines(run)[2]])
    (run.folder / "metrics.jsonl").write_text(written)
    with pytest.raises(UserError, match=r"line 2 of .*metrics\.jsonl is damaged"):
        run.rewind(3)
    assert (run.folder / "metrics.jsonl").read_text() == written


def test_a_log_that_is_damaged_is_told_wherever_it_is_read(run):
    for generation in range(3):
        run.log(generation, {"fitness/mean": 1.0}, 2.0)
    paths = [run.folder / name for name in ("metrics.jsonl", "timing.jsonl")]
    for path in paths:
        path.write_bytes(path.read_bytes()[:-9])  # as a kill leaves it
    assert [told["generation"] for told in run.metrics()] == [0, 1]
    assert run.seconds() == 4.0
    for path in paths:
        path.write_bytes(b"\xff\xfe" + path.read_bytes())
    for read in (run.metrics, run.seconds, lambda: run.rewind(3)):
        with pytest.raises(UserError, match=r"line 1 of .*\.jsonl is damaged"):
            read()


def test_rewinding_a_run_without_logs_is_nothing(run):
    run.rewind(0)
    assert not (run.folder / "metrics.jsonl").exists()


# -- checkpoints
# --------------------------------------------------------------------------------------


def state(value):
    return {
        "mean": jnp.full(3, value),
        "inner": (jnp.int32(value), {"x": jnp.ones((2, 2)) * value}),
    }


def assert_is(restored, value):
    step, tree, damaged = restored
    assert (step, damaged) == (value, [])
    np.testing.assert_array_equal(tree["mean"], np.full(3, value))
    assert tree["inner"][0] == value and tree["inner"][0].dtype == jnp.int32
    np.testing.assert_array_equal(tree["inner"][1]["x"], np.full((2, 2), value))


def test_the_newest_checkpoint_is_restored_and_only_three_are_kept(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    for step in (1, 2, 3, 4):
        checkpoints.save(step, state(step))
    checkpoints.close()
    again = Checkpoints(tmp_path)
    assert_is(again.restore(state(0)), 4)
    again.close()
    assert {p.name for p in (tmp_path / "checkpoints").iterdir()} == {"2", "3", "4"}


def test_without_checkpoints_there_is_nothing_to_restore(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    assert_is(checkpoints.restore(state(0)), 0)
    checkpoints.close()


def cut_in_half(folder):
    """Cuts every file of a checkpoint, as a full disk or a killed copy does."""
    for path in [p for p in folder.rglob("*") if p.is_file()]:
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def test_a_damaged_checkpoint_is_passed_over_and_makes_room_for_its_repetition(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    for step in (1, 2, 3):
        checkpoints.save(step, state(step))
    checkpoints.close()
    for step in (2, 3):
        cut_in_half(tmp_path / "checkpoints" / str(step))
    again = Checkpoints(tmp_path)
    step, tree, damaged = again.restore(state(0))
    assert (step, sorted(damaged)) == (1, [2, 3])
    np.testing.assert_array_equal(tree["mean"], np.full(3, 1.0))
    again.save(2, state(2))
    assert_is(again.restore(state(0)), 2)
    again.close()


def test_a_checkpoint_whose_numbers_were_altered_is_passed_over(tmp_path):
    # It reads well, but the digest beside it is another state's.
    checkpoints = Checkpoints(tmp_path)
    for step in (1, 2):
        checkpoints.save(step, state(step))
    checkpoints.close()
    old, new = (next((tmp_path / "checkpoints" / s / "digest").rglob("metadata")) for s in "12")
    new.write_bytes(old.read_bytes())
    again = Checkpoints(tmp_path)
    step, _, damaged = again.restore(state(0))
    again.close()
    assert (step, damaged) == (1, [2])


def test_where_no_checkpoint_can_be_read_it_is_told_and_they_stay(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    for step in (1, 2):
        checkpoints.save(step, state(step))
    checkpoints.close()
    again = Checkpoints(tmp_path)
    # As another version's state is.
    with pytest.raises(UserError, match=r"no checkpoint in .* can be read \(.*\): resume with"):
        again.restore({**state(0), "momentum": np.zeros(3)})
    assert_is(again.restore(state(0)), 2)
    cut_in_half(tmp_path / "checkpoints" / "1")
    cut_in_half(tmp_path / "checkpoints" / "2")
    with pytest.raises(UserError, match="or remove that folder to start again"):
        again.restore(state(0))
    again.close()


def test_a_full_disk_is_found_before_a_checkpoint_is_begun(tmp_path, monkeypatch):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, state(1))

    def full(path, content):
        assert len(content) > 2 * sum(np.asarray(x).nbytes for x in jax.tree.leaves(state(1)))
        path.touch()
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(Path, "write_bytes", full)
        said = (
            r"checkpoint 2 could not be written to .* \(.*No space left on device\): the one before"
        )
        with pytest.raises(UserError, match=said):
            checkpoints.save(2, state(2))
    assert {p.name for p in (tmp_path / "checkpoints").iterdir()} == {"1"}
    checkpoints.save(2, state(2))
    assert_is(checkpoints.restore(state(0)), 2)
    checkpoints.close()


# -- small things
# -------------------------------------------------------------------------------------


def test_json_is_replaced_whole(tmp_path):
    path = tmp_path / "report.json"
    for content in ({"a": 1}, {"a": 2}):
        write_json(path, content)
        assert json.loads(path.read_text()) == content
    assert [p.name for p in tmp_path.iterdir()] == ["report.json"]


def test_a_stopwatch_counts_from_its_last_reading(monkeypatch):
    readings = iter([10.0, 12.5, 13.0])
    monkeypatch.setattr("scb.stopwatch.time.perf_counter", lambda: next(readings))
    watch = Stopwatch()
    assert (watch.lap(), watch.lap()) == (2.5, 0.5)


def test_a_setting_that_an_earlier_version_had_not_is_as_good_as_an_empty_one():
    assert first_difference({"a": {"b": 1}}, {"a": {"b": 1, "c": {}}, "d": []}) == ""
    assert first_difference({"a": {}, "b": None}, {}) == ""
    assert first_difference({}, {"a": 0}) == "a (None there, 0 now)"
    assert first_difference({"a": {"b": 1}}, {}) == "a ({'b': 1} there, None now)"


def test_where_nothing_can_be_written_is_told(tmp_path):
    with pytest.raises(UserError, match=r"cannot write to .*gone .*choose another place"):
        write_text(tmp_path / "gone" / "x.json", "")
    with pytest.raises(UserError, match=r"cannot write to .*gone"), held(tmp_path / "gone" / "x"):
        pass
