"""The command line `scb`, called in the tests' process."""

import contextlib
import io
from types import SimpleNamespace

from scb.cli import main


def call(*arguments):
    """Exit code, stdout and stderr of one command."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as stop:  # tyro's own refusals and its help
            code = stop.code
    return SimpleNamespace(code=code, out=out.getvalue(), err=err.getvalue())
