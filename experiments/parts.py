"""Measurements whose parts can be made in any order: one after the other here, or as jobs of `submitit` elsewhere.

    python -m experiments locomotion --seeds 10 --executor slurm --jobs 25 --hours 4 --slurm partition=cpu

What a job finds is kept in a folder beside the report until it is in the report. The same command goes on where it
was: a part that was found is not measured again, and a part that is being measured is waited for.
"""

import fcntl
import hashlib
import json
import os
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from scb import termination
from scb.errors import UserError, at_least, first_line, needed_for, unused
from scb.files import make_folder, write_json

# Only what is measured elsewhere needs it, which the package's own requirements leave out.
if TYPE_CHECKING:
    import submitit
    from submitit.helpers import DelayedSubmission

Keys = tuple[str, ...]
T = TypeVar("T")


@dataclass(frozen=True)
class Part:
    """A part of a measurement.

    Attributes:
      path: where it stands in the report.
      measured: () -> what stands there, as JSON holds it; what is there already is kept.
      names: (below the path) where it has several places; there is nothing to measure where the report has them all.
    """

    path: Keys
    measured: Callable[[], Any]
    names: tuple[Keys, ...] = ((),)

    @classmethod
    def lacking(
        cls,
        report: Mapping[str, Any],
        path: Keys,
        places: Mapping[Keys, T],
        measured: Callable[[list[T]], Any],
    ) -> "Part":
        """Of the places below a path where the report has nothing: what belongs there is measured together."""
        left = {keys: x for keys, x in places.items() if not _has(report, (*path, *keys))}
        return cls(path, partial(measured, list(left.values())), tuple(left))

    @property
    def name(self) -> str:
        """Of the part alone, with what tells it from others at its path."""
        return ", ".join((*self.path, *(" ".join(keys) for keys in self.names if keys)))

    def there(self, report: Mapping[str, Any]) -> bool:
        """Whether the report has it; None holds the place of what is to be measured again."""
        return all(_has(report, (*self.path, *keys)) for keys in self.names)

    def add(self, found: Any, report: dict[str, Any]) -> None:
        """Puts what was measured into the report."""
        *parents, last = self.path
        for key in parents:
            report = report.setdefault(key, {})
        if isinstance(found, dict) and isinstance(report.get(last), dict):
            _merge(report[last], found)
        else:
            report[last] = found


def file_name(*parts: str) -> str:
    """For what has these names, of which an objective's may be a path."""
    return re.sub(r"[^\w.-]", "_", "-".join(parts))


def _has(tree: Any, keys: Keys) -> bool:
    for key in keys:
        if not isinstance(tree, dict) or key not in tree:
            return False
        tree = tree[key]
    return tree is not None


def _merge(tree: dict[str, Any], other: Mapping[str, Any]) -> None:
    for key, value in other.items():
        if isinstance(value, dict) and isinstance(tree.get(key), dict):
            _merge(tree[key], value)
        else:
            tree[key] = value


@dataclass(frozen=True)
class InParts:
    """A measurement of parts, as an `Experiment` takes it.

    Attributes:
      parts: (plan, report) -> its parts, the first to be measured first; it may begin the report.
    """

    parts: Callable[[Any, dict[str, Any]], Iterable[Part]]

    def __call__(self, plan: Any, report: dict[str, Any], save: Callable[[], None]) -> None:
        """Measures what the report lacks, here, and saves after every part."""
        for part in self.parts(plan, report):
            if not part.there(report):
                part.add(part.measured(), report)
                save()


def by_environment(measured: Callable[[str, Any], Any]) -> InParts:
    """A part for each of the plan's environments."""

    def parts(plan: Any, report: dict[str, Any]) -> Iterator[Part]:
        for name in plan["environments"]:
            yield Part(("environments", name), partial(measured, name, plan))

    return InParts(parts)


@dataclass(frozen=True)
class Jobs:
    """Where an experiment's parts are measured."""

    executor: Literal["here", "local", "slurm"] = "here"
    """here: one after the other; local: as processes of this machine; slurm: as its jobs"""
    jobs: int = 2
    """that are submitted at a time"""
    hours: float = 24.0
    """that a job may take; slurm starts it again where it was not enough"""
    cpus: int = 2
    """of a job"""
    gpus: int = 0
    """of a job"""
    slurm: tuple[str, ...] = ()
    """what else sbatch is told, such as partition=long account=mine"""

    def __post_init__(self) -> None:
        at_least(1, self, "jobs", "cpus")
        at_least(0, self, "gpus")
        if not self.hours > 0:
            raise UserError(f"--hours is {self.hours}: it must be more than 0.")
        for word in self.slurm:
            if not all(word.partition("=")):
                raise UserError(f"--slurm {word!r}: give KEY=VALUE, as sbatch's --KEY=VALUE.")
        if self.executor == "here":
            ours = ("jobs", "hours", "cpus", "gpus", "slurm")
            unused(
                self, "the parts are measured here, one after the other", ours, "name --executor"
            )
        if self.executor == "local":
            unused(self, "the jobs are this machine's", ("cpus", "slurm"), "take --executor slurm")

    def executor_in(self, folder: Path) -> "submitit.Executor":
        """That of submitit, whose files are in a folder.

        Raises:
          UserError: submitit is not installed, or SLURM is not here.
        """
        with needed_for(f"--executor {self.executor} needs", "submitit"):
            import submitit
        kinds = {"local": submitit.LocalExecutor, "slurm": submitit.SlurmExecutor}
        try:
            made: submitit.Executor = kinds[self.executor](folder)
        except RuntimeError as error:
            raise UserError(
                f"there is no SLURM here ({error}): choose --executor local."
            ) from error
        minutes = max(1, round(60 * self.hours))
        if self.executor == "local":
            made.update_parameters(timeout_min=minutes, gpus_per_node=self.gpus)
        else:
            further = dict(word.split("=", 1) for word in self.slurm)
            made.update_parameters(
                time=minutes,
                cpus_per_task=self.cpus,
                additional_parameters=further,
                **({"gpus_per_node": self.gpus} if self.gpus else {}),
            )
        return made


class Measurement:
    """A job: it measures one part and keeps what it found; where SLURM ends it early, it is submitted again."""

    def __init__(self, part: Part, kept: Path) -> None:
        """Kept is the file that what it finds goes to."""
        self.part, self.kept = part, kept

    def __call__(self) -> None:
        """Measures, unless another job has or does."""
        with self.kept.with_suffix(".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # until whoever has it has ended, however it ends
            if self.kept.exists():
                return
            try:
                write_json(self.kept, {"part": self.part.name, "found": self.part.measured()})
            except Exception as error:
                self.kept.with_suffix(".error").write_text(first_line(error))
                raise

    def checkpoint(self) -> "DelayedSubmission":
        """What submitit submits again where SLURM ends the job early."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)


def elsewhere(
    parts: Iterable[Part],
    report: dict[str, Any],
    save: Callable[[], None],
    jobs: Jobs,
    folder: Path,
    tell: Callable[[str], None] = print,
    every: float = 1.0,
    settings: str = "",
) -> None:
    """Measures what the report lacks as jobs, so many at a time, and saves as they end.

    Args:
      folder: for what jobs find and say; that of another start of the same command is continued.
      every: seconds between two looks at the jobs.
      settings: of the measurement: what was found with others is not taken.

    Raises:
      UserError: some of them failed; what the others found is in the report.
    """
    make_folder(folder)
    # Two that stand in one place are one: its job would only wait for the other's.
    named = {part.name: part for part in parts if not part.there(report)}
    kept = {part: folder / f"{_digest(part, settings)}.json" for part in named.values()}

    def taken(part: Part) -> bool:
        if kept[part].exists():
            part.add(json.loads(kept[part].read_text())["found"], report)
            save()
            kept[part].unlink()
            tell(f"{part.name}: measured")
        return part.there(report)

    waiting = [part for part in kept if not taken(part)]
    try:
        executor = jobs.executor_in(folder / "jobs") if waiting else None
    except UserError:
        with suppress(OSError):  # results of an earlier start stay
            folder.rmdir()
        raise
    running: dict[Part, submitit.Job[None]] = {}
    failed: dict[Part, str] = {}

    def cancel() -> str:
        for job in list(running.values()):
            job.cancel(check=False)  # one that has ended by itself is no reason to leave the others
        return "its jobs are cancelled"

    try:
        with termination.saving(cancel):
            while waiting or running:
                while executor and waiting and len(running) < jobs.jobs:
                    part = waiting.pop(0)
                    kept[part].with_suffix(".error").unlink(missing_ok=True)
                    # None is submitted that `cancel` does not know.
                    with termination.writing, _told_apart(folder / "jobs" / "ended.err"):
                        running[part] = executor.submit(Measurement(part, kept[part]))
                    tell(f"{part.name}: job {running[part].job_id}")
                for part in [part for part, job in running.items() if job.done()]:
                    with termination.writing:
                        job = running.pop(part)
                    if not taken(part):
                        said = kept[part].with_suffix(".error")
                        failed[part] = said.read_text() if said.exists() else "its job left nothing"
                        tell(f"{part.name}: failed, job {job.job_id} ({failed[part]})")
                if running:
                    time.sleep(every)
    except BaseException:
        cancel()
        raise
    if failed:
        part, reason = next(iter(failed.items()))
        raise UserError(
            f"{len(failed)} of {len(kept)} parts were not measured, {part.name} among them ({reason}): "
            f"the .err files in {folder / 'jobs'} say more, and the same command tries again."
        )


@contextmanager
def _told_apart(path: Path) -> Iterator[None]:
    """Has processes that start here say in a file, and not on the terminal, how they were interrupted."""
    path.parent.mkdir(exist_ok=True)
    with path.open("ab") as file:
        kept = os.dup(2)
        os.dup2(file.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _digest(part: Part, settings: str) -> str:
    return hashlib.sha256(f"{part.name} {settings}".encode()).hexdigest()[:16]
