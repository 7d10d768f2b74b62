"""Run folders: what a long computation writes, so that it can be watched, killed and resumed.

runs/NAME/config.json       what was asked for, and the command that asks for it; --resume refuses another
runs/NAME/metrics.jsonl     one line a generation, free of clocks: a resumed run ends with the same bytes
runs/NAME/timing.jsonl      seconds per generation; where a process takes the run up, on which machine
runs/NAME/tensorboard/      the same numbers for TensorBoard
runs/NAME/checkpoints/      of `scb.checkpoints`
runs/NAME/.lock             held by the process that writes here
"""

import contextlib
import json
import secrets
import socket
import time
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from tensorboardX.proto.event_pb2 import Event, SessionLog
from tensorboardX.record_writer import RecordWriter
from tensorboardX.summary import scalar

from scb.configurations import as_if_shorter, config_dict, first_difference, with_defaults
from scb.errors import UserError, needed_for, of_class
from scb.files import as_json, cannot_write, make_folder, plain, write_json, write_text
from scb.locks import lock, release
from scb.machine import arithmetic, machine_description

_LOCK = ".lock"


class Run:
    """A run folder that is open for writing. Make one with `Run.open`."""

    def __init__(self, folder: Path, resumed: bool, wandb_project: str | None = None) -> None:
        self.folder = folder
        self.resumed = resumed
        self._on: dict[str, Any] = {"machine": machine_description()}  # until it has been logged
        self._events: RecordWriter | None = None
        self._wandb = _start_wandb(folder, wandb_project) if wandb_project else None

    @classmethod
    def open(
        cls,
        folder: str | Path,
        config: Mapping[str, Any],
        resume: bool = False,
        wandb_project: str | None = None,
        growing: Collection[str] = (),
        settings: Any = None,
    ) -> "Run":
        """Creates a run folder, or opens one to resume.

        Args:
          folder: where; must not exist or be empty, unless `resume`.
          config: JSON-serialisable; decides the run together with the code's version. An entry
            "command", by which people and resumptions start it, is stored and not compared. An entry
            "inputs", {name: digest} of files and code, may hold more than the folder's, and none of these in another
            state.
          resume: continue the run that is there. Its config must equal `config`, but for `growing`.
          wandb_project: also log to this Weights & Biases project (extra `wandb`).
          growing: entries, such as "config.seeds", that may be more than they were (`grown`); of a search's
            num_generations, also fewer, as long as one is left to do. The folder then stores the new config.
          settings: the dataclass that the config's entry "config" is of. What the folder's lacks of it, as an
            earlier version had no such setting, is at its default.

        Raises:
          UserError: the folder can't be written, holds something already, isn't a run, is another
            process's, or its config differs.
        """
        folder = Path(folder).expanduser()
        if wandb_project:
            _wandb()  # that a missing package leaves no folder behind
        told = arithmetic()
        config = as_json({**config, **({"arithmetic": told} if told else {})})
        if resume:
            stored, asked = ({**c, "command": None} for c in (read_config(folder), config))
            if settings is not None and "config" in stored:
                stored["config"] = with_defaults(stored["config"], settings)
            inputs, now = (x.pop("inputs", None) or {} for x in (stored, asked))
            for name, digest in inputs.items():
                # Under another name it is the same: code that was moved to another module, for one.
                if now.get(name) != digest and (name in now or digest not in now.values()):
                    is_not = "what it was when the run was started" if name in now else "part of it"
                    raise UserError(
                        f"cannot resume {folder}: {name} is not {is_not}; put that back, or start a new folder."
                    )
            stored_as_if = as_if_shorter(folder, stored, asked, growing)
            if difference := first_difference(stored_as_if, asked, growing):
                raise UserError(
                    f"cannot resume {folder}: its config differs at {difference}; resume with the config it was "
                    "started with, or start a new folder."
                )
            make_folder(folder, "--resume")
            lock(folder / _LOCK, folder)
            if stored != asked:
                write_json(folder / "config.json", config)
            return cls(folder, resumed=True, wandb_project=wandb_project)
        if folder.is_file():
            raise UserError(f"{folder} is a file, and a run needs a folder: choose another --out.")
        if folder.exists() and not _has_room(folder):
            raise UserError(
                f"{folder} already exists and is not empty: choose another --out, or continue it with --resume."
            )
        make_folder(folder)
        lock(folder / _LOCK, folder)
        try:
            write_json(folder / "config.json", config)
        except OSError as error:
            raise cannot_write(folder, reason=error.strerror) from error
        return cls(folder, resumed=False, wandb_project=wandb_project)

    def rewind(self, step: int) -> None:
        """Drops log lines of generations after `step`, which a killed run wrote but did not checkpoint."""
        for name in ("metrics.jsonl", "timing.jsonl"):
            path = self.folder / name
            if not path.exists():
                continue
            kept = [line + "\n" for line, told in _logged(path) if told["generation"] < step]
            write_text(path, "".join(kept))

    def log(self, generation: int, metrics: Mapping[str, float], seconds: float) -> None:
        """Appends one generation to every log."""
        line = {"generation": generation, **{k: plain(v) for k, v in metrics.items()}}
        with (self.folder / "metrics.jsonl").open("a") as file:
            file.write(json.dumps(line) + "\n")
        with (self.folder / "timing.jsonl").open("a") as file:
            timing = {"generation": generation, "seconds": round(seconds, 4), **self._on}
            file.write(json.dumps(timing) + "\n")
        self._on = {}
        self._log_to_tensorboard(generation, metrics)
        if self._wandb is not None:
            self._wandb.log(dict(metrics), step=generation)

    def _log_to_tensorboard(self, generation: int, metrics: Mapping[str, float]) -> None:
        # Not by a SummaryWriter, whose thread dies of a full disk, upon which its queue waits for ever.
        now, events = time.time(), []
        if self._events is None:
            folder = self.folder / "tensorboard"
            folder.mkdir(exist_ok=True)
            name = f"events.out.tfevents.{now:.0f}.{socket.gethostname()}"
            self._events = RecordWriter(str(folder / name))
            events.append(Event(wall_time=now, file_version="brain.Event:2"))
            if self.resumed:  # hides what a killed run wrote from here on
                start = SessionLog(status=SessionLog.START)
                events.append(Event(wall_time=now, step=generation, session_log=start))
        events += [
            Event(wall_time=now, step=generation, summary=scalar(name, float(value)))
            for name, value in metrics.items()
        ]
        try:
            for event in events:
                self._events.write(event.SerializeToString())
            self._events.flush()
        except OSError:
            # Left open, Python 3.13 tries once more when it ends, and complains.
            with contextlib.suppress(OSError):
                self._events.close()
            raise

    def metrics(self) -> list[dict[str, Any]]:
        """All logged generations, oldest first."""
        return log_lines(self.folder / "metrics.jsonl")

    def seconds(self) -> float:
        """Wall-clock seconds of all logged generations, over every resumption."""
        lines = log_lines(self.folder / "timing.jsonl", "seconds")
        return float(sum(line["seconds"] for line in lines))

    def end_log(self) -> None:
        """Closes what generations are logged to; the folder stays this process's."""
        if self._events is not None:
            self._events.close()
            self._events = None
        if self._wandb is not None:
            self._wandb.finish()
            self._wandb = None

    def close(self) -> None:
        """Ends the log, and lets go of the folder."""
        self.end_log()
        release(self.folder / _LOCK)


def log_lines(path: Path, *needed: str) -> list[dict[str, Any]]:
    """What a run's metrics.jsonl or timing.jsonl says of each generation, oldest first; nothing where it is not there.

    The half line that a kill left at its end is left out.

    Args:
      needed: what each line has beside its generation.

    Raises:
      UserError: another line is damaged.
    """
    return [told for _, told in _logged(path, *needed)] if path.exists() else []


def _logged(path: Path, *needed: str) -> list[tuple[str, dict[str, Any]]]:
    """The same, of a log that is there: its lines as they stand there, and as they are read."""
    found, lines = [], path.read_text(errors="replace").splitlines()
    for number, line in enumerate(lines, 1):
        reason = ""
        try:
            told = json.loads(line)
        except ValueError as error:
            if number == len(lines):
                break
            reason = str(error)
        else:
            if not isinstance(told, dict) or type(told.get("generation")) is not int:
                reason = "it is of no generation"
            elif lacking := [name for name in needed if name not in told]:
                reason = f"it lacks {', '.join(lacking)}"
        if reason:
            raise UserError(
                f"line {number} of {path} is damaged ({reason}): mend it, or remove the file, of which "
                "nothing but the log is lost."
            )
        found.append((line, told))
    return found


def _has_room(folder: Path) -> bool:
    """Whether a run may start there: nothing is in it, or a run that ended before it had found anything.

    Such as one whose expert was none: its configuration is all that it left.
    """
    if not folder.is_dir():
        return False
    held = {path.name for path in folder.iterdir()} - {_LOCK}
    try:
        return not held or (held == {"config.json"} and "command" in read_config(folder))
    except UserError:
        return False


def read_config(folder: str | Path) -> dict[str, Any]:
    """The config that a run was started with; a UserError if the folder isn't a run."""
    path = Path(folder).expanduser() / "config.json"
    try:
        return dict(json.loads(path.read_text()))
    except (OSError, TypeError, ValueError) as error:
        raise UserError(
            f"{folder} is not a run (no readable config.json): give the folder of a run that was started with --out."
        ) from error


@contextlib.contextmanager
def run_of(
    folder: "Run | str | Path | None",
    config: Any,
    inputs: Mapping[str, str],
    growing: Collection[str],
) -> Iterator["Run | None"]:
    """Within it the run of a folder, begun there, or gone on with where it was begun; a run, or None, is itself.

    Args:
      config: a dataclass, which decides the run.
      inputs: {name: digest} of files that the run begins with.
      growing: fields, such as "evolution.num_generations", that may have grown (`Run.open`).

    Raises:
      UserError: as `Run.open`, also where the folder holds another run.
    """
    of_class(Run | str | Path | None, run=folder)
    if folder is None or isinstance(folder, Run):
        yield folder
        return
    path = Path(folder).expanduser()
    begun = path.exists() and not _has_room(path)
    command = read_config(path).get("command") if begun else None  # of whoever began it
    stored = {
        "command": command or "python",
        "config": config_dict(config),
        "inputs": dict(inputs),
    }
    run = Run.open(
        path, stored, begun, growing=[f"config.{name}" for name in growing], settings=config
    )
    try:
        yield run
    finally:
        run.close()


def _wandb() -> Any:
    with needed_for("logging to Weights & Biases needs", "wandb", "wandb"):
        import wandb
    return wandb


def _start_wandb(folder: Path, project: str) -> Any:
    """The folder's run there, which is the same one after a resumption."""
    kept = folder / "wandb-id.txt"
    if not kept.exists():
        write_text(kept, secrets.token_hex(4))
    return _wandb().init(
        project=project,
        name=folder.name,
        dir=str(folder),
        id=kept.read_text().strip(),
        resume="allow",
    )
