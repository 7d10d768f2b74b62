"""The command line `scb`, and what it shares with other programs: how JAX is set up, how mistakes are told.

JAX is configured before anything else imports it for good: one host device a core, which on two
cores trains a population 1.6 times faster, and the persistent compilation cache, since compiling
costs more than a quick run.
"""

import contextlib
import errno
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

INTERRUPTED = 130  # the exit code, as shells have it
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)


def configure_jax() -> None:
    """One CPU device a core and a compilation cache, unless the environment's own settings say otherwise."""
    import jax

    from scb.machine import usable_cores

    if "JAX_NUM_CPU_DEVICES" not in os.environ and "host_platform_device_count" not in (
        os.environ.get("XLA_FLAGS", "")
    ):
        # A caller that has used JAX already keeps its devices: by then their number is settled.
        with contextlib.suppress(RuntimeError):
            jax.config.update("jax_num_cpu_devices", usable_cores())
    if jax.config.values["jax_compilation_cache_dir"] is None:
        # Without a home, as of a user whom a container does not know, there is no cache.
        with contextlib.suppress(RuntimeError):
            base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
            jax.config.update("jax_compilation_cache_dir", str(base / "lpo" / "jax"))


def run_program(
    program: str,
    description: str,
    commands: Callable[[], Mapping[str, Any]],
    arguments: Sequence[str] | None = None,
) -> int:
    """Runs one command of a program and returns its exit code; a user's mistake is one sentence and 2.

    One of several processes ends in it.

    Args:
      program: its name.
      description: one sentence of it, for the help.
      commands: {name: function or LongRun}, asked for after JAX is configured.
      arguments: those of the process where None.
    """
    from scb import processes, termination

    # A caller's process is the caller's.
    if arguments is None:
        termination.watch(program)
    configure_jax()
    from scb.command_line import LongRun, call

    words, known = sys.argv[1:] if arguments is None else arguments, commands()
    given = [_at_home(word) for word in words]
    command = known.get(given[0]) if given else None
    again = ""
    if isinstance(command, type) and issubclass(command, LongRun):
        again = "a run with --out continues with --resume."
    if arguments is None:
        termination.goes_on(again)
    status = exit_code(program, lambda: call(program, description, known, given), again)
    if arguments is None:
        processes.end(status)
    return status


def _at_home(word: str) -> str:
    # Shells expand --out ~/runs, and leave --out=~/runs as it is.
    flag, equals, value = word.partition("=")
    return f"{flag}={os.path.expanduser(value)}" if equals and flag.startswith("--") else word


def exit_code(program: str, act: Callable[[], int | None], again: str = "") -> int:
    """Acts; what it returns, or 0, and where it fails for a reason that a user can see to, a sentence and the code.

    Args:
      program: whose sentence it is.
      again: how what is interrupted goes on, a sentence's end; "" where it does not.
    """
    from jax.errors import JaxRuntimeError

    from scb.errors import UserError, first_line
    from scb.processes import LostProcess

    def tell(*parts: str) -> None:
        print(f"{program}: {'; '.join(filter(None, parts))}", file=sys.stderr, flush=True)

    try:
        status = act()
        sys.stdout.flush()
    except BrokenPipeError:
        # Whoever read the output, such as `head`, has enough; Python would complain at its exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except UserError as error:
        tell(str(error))
        if isinstance(error, LostProcess):
            os._exit(2)  # an orderly end would wait for the lost one
        return 2
    except (MemoryError, JaxRuntimeError) as error:
        if isinstance(error, JaxRuntimeError) and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        reason = f" ({first_line(error)})" if str(error) else ""
        tell(
            f"out of memory{reason}: begin anew with fewer agents, candidates, episodes or environments."
        )
        return 1
    except OSError as error:
        if error.errno not in _NO_ROOM:
            raise
        what = f"cannot write {error.filename or 'what was done'} ({error.strerror})"
        tell(f"{what}: make room{'' if again else '.'}", again)
        return 1
    except KeyboardInterrupt:
        tell(f"interrupted{'' if again else '.'}", again)
        return INTERRUPTED
    return status or 0


def _commands() -> dict[str, Any]:
    from scb import commands, listing
    from scb.analysis.explain import explain_command
    from scb.importer import import_published_command

    return {
        "discover": commands.Discover,
        "train": commands.Train,
        "explain": explain_command,
        "list": listing.list_command,
        "import-published": import_published_command,
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """`scb`: discover bandits and train in them."""
    return run_program(
        "scb",
        "Synthetic contextual bandits: discover one-step environments that train agents for a real one.",
        _commands,
        arguments,
    )


if __name__ == "__main__":
    sys.exit(main())
