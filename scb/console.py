"""Where commands print their tables."""

import sys

from rich.console import Console

PIPE_WIDTH = 120


def console() -> Console:
    """Standard output, as wide as the terminal; in a file or a pipe wide enough for whole tables."""
    made = Console()
    return made if sys.stdout.isatty() else Console(width=max(PIPE_WIDTH, made.width))
