"""Where commands print their tables, and searches how far they are."""

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from rich import progress
from rich.console import Console

from scb import processes

PIPE_WIDTH = 200
# Also because what a search starts from is judged, by agents that may train for minutes.
_FIRST = "compiling, the first takes longest"


def console() -> Console:
    """Standard output, as wide as the terminal; in a file or a pipe wide enough for whole tables.

    Of several processes the first alone says something.
    """
    # No markup: "[no interval]" and a path with brackets are what they say.
    made = Console(quiet=not processes.first(), markup=False)
    if not made.quiet and not sys.stdout.isatty():
        made.width = max(PIPE_WIDTH, made.width)
    return made


def progress_console(quiet: bool) -> Console:
    """Standard error, where nothing is said if `quiet`, and of several processes by the first alone."""
    return Console(file=sys.stderr, quiet=quiet or not processes.first(), markup=False)


class Progress:
    """A bar with fitness and time left on a terminal; a line now and then elsewhere (a log file, CI)."""

    def __init__(self, console: Console, total: int, first: int) -> None:
        self._console, self._total, self._done = console, total, first
        self._seconds: list[float] = []
        self._bar = progress.Progress(
            progress.TextColumn("generation {task.completed}/{task.total}"),
            progress.BarColumn(),
            progress.TextColumn("{task.fields[fitness]}"),
            progress.TimeElapsedColumn(),
            progress.TimeRemainingColumn(),
            console=console,
            disable=console.quiet or not console.is_terminal,
        )

    def __enter__(self) -> Callable[[dict[str, Any], float], None]:
        self._bar.start()
        self._task = self._bar.add_task("", total=self._total, completed=self._done, fitness=_FIRST)
        # A minute without a line looks like one that hangs.
        if not self._console.is_terminal and self._done < self._total:
            self._console.print(f"generation {self._done + 1}/{self._total}: {_FIRST}")
        return self._advance

    def _advance(self, metrics: dict[str, Any], seconds: float) -> None:
        self._done += 1
        self._seconds = [*self._seconds, seconds][-20:]
        judged = [v for k, v in metrics.items() if k.endswith("mean/fitness")]
        parts = [f"fitness {metrics['fitness/mean']:.4g}"] if "fitness/mean" in metrics else []
        parts += [f"mean {value:.4g}" for value in judged[-1:]]
        parts += [f"{metrics['failed']} failed"] if metrics["failed"] else []
        text = ", ".join(parts)
        self._bar.update(self._task, advance=1, fitness=text)
        milestone = judged or self._done in (1, self._total)
        if not self._console.is_terminal and milestone:
            # The first of a process is compiled, and says nothing of the others.
            left = ""
            if len(self._seconds) > 1:
                minutes = float(np.median(self._seconds[1:])) * (self._total - self._done) / 60
                left = f", {minutes:.1f} min left"
            self._console.print(f"generation {self._done}/{self._total}: {text}{left}")

    def __exit__(self, *_: object) -> None:
        self._bar.stop()
