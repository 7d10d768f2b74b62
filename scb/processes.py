"""Several processes, on one machine or many, that compute one search together: who they are, and what they share.

All of them run the same program on the same numbers; each evaluates its part of every population, and what the
parts are worth is gathered. The first process alone writes.
"""

import contextlib
import json
import os
import socket
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import jax
import numpy as np
from jax._src.distributed import global_state
from jax.experimental import multihost_utils

from scb import termination
from scb.errors import UserError, first_line

T = TypeVar("T")

# What a launcher tells the processes that it starts; with all of a line, JAX finds the others by itself.
_LAUNCHERS = {
    "SLURM": (
        "SLURM_JOB_ID",
        "SLURM_STEP_NODELIST",
        "SLURM_NTASKS",
        "SLURM_PROCID",
        "SLURM_LOCALID",
    ),
    "Open MPI": ("OMPI_MCA_orte_hnp_uri", "OMPI_COMM_WORLD_SIZE", "OMPI_COMM_WORLD_RANK"),
}
_NUMBERS = {"SLURM": "SLURM_NTASKS", "Open MPI": "OMPI_COMM_WORLD_SIZE"}
_HEARTBEAT = 30  # seconds without a sign of life, after which a process counts as lost
_GOODBYE = 10  # seconds in which the others end, once one has


class LostProcess(UserError):
    """Another process has ended; this one can't go on, nor say goodbye to it."""


def start(given: Mapping[str, str], environment: Mapping[str, str] = os.environ) -> None:
    """Joins the processes of one search, before JAX computes anything; alone where there are no others.

    Args:
      given: of the flags coordinator, processes and process those that were given.
      environment: variables, from which a launcher's processes are known.

    Raises:
      UserError: flags that don't say who is who, or processes that don't come.
    """
    settings: dict[str, Any] = {}
    if given:
        if given.keys() != {"coordinator", "processes", "process"}:
            raise UserError(
                "each of several processes needs --coordinator HOST:PORT, --processes NUMBER and --process ITS_NUMBER: "
                "give all three."
            )
        settings = {
            "coordinator_address": given["coordinator"],
            "num_processes": _number(given, "processes", 1, 2**20),
        }
        settings["process_id"] = _number(given, "process", 0, settings["num_processes"] - 1)
        host, _, port = given["coordinator"].rpartition(":")
        if not (host and port.isdecimal() and 1 <= int(port) < 2**16):
            raise UserError(
                f"--coordinator is {given['coordinator']!r}: give HOST:PORT, with a port from 1 to 65535."
            )
    elif not any(_launched(name, environment) for name in _LAUNCHERS):
        _expect_alone(environment)
        return
    if given and settings["process_id"] == 0 and settings["num_processes"] > 1:
        others = settings["num_processes"] - 1
        print(f"process 0 waits for {others} more at {given['coordinator']} ...", file=sys.stderr)
    # Else the others are killed with a stack trace, before they can say a sentence.
    jax.config.update("jax_enable_recoverability", True)
    try:
        jax.distributed.initialize(**settings, heartbeat_timeout_seconds=_HEARTBEAT)
    # Whatever it is, it is about who is there.
    except Exception as error:
        raise UserError(
            f"the processes did not find each other ({first_line(error)}): start as many "
            "as there are to be, with one coordinator, which process 0 listens at."
        ) from error
    termination.arm()  # JAX has its own use for the signal
    try:
        devices, own = jax.device_count(), jax.local_device_count()
    # Such as a machine that does not know the address of its own name, at which the others were to reach it.
    except RuntimeError as error:
        raise UserError(
            f"this process has no devices to share with the others ({first_line(error)}): see that "
            f"{socket.gethostname()}, the name of its machine, has an address, such as in /etc/hosts."
        ) from error
    if devices != jax.process_count() * own:
        raise UserError(
            f"process {jax.process_index()} has {own} devices of {devices} in {jax.process_count()} processes: give "
            "each as many, such as by JAX_NUM_CPU_DEVICES."
        )


def end(status: int) -> None:
    """Ends this process with an exit code where others are, and waits for them where it is the first.

    JAX would let them end in any order, and abort one that says goodbye when the first, which listens, has ended.
    """
    if global_state.client is None:
        return
    # Not asked of JAX, which may have been unable to start its devices.
    if global_state.process_id == 0:
        for i in range(1, global_state.num_processes):
            # One that doesn't end has lost its way, and says so itself.
            with contextlib.suppress(jax.errors.JaxRuntimeError):
                global_state.client.blocking_key_value_get(f"ended/{i}", _GOODBYE * 1000)
        return
    sys.stdout.flush()
    sys.stderr.flush()
    global_state.client.key_value_set(f"ended/{global_state.process_id}", "")
    os._exit(status)


def _number(given: Mapping[str, str], name: str, low: int, high: int) -> int:
    if not given[name].isdecimal() or not low <= int(given[name]) <= high:
        raise UserError(f"--{name} is {given[name]!r}: it must be a number from {low} to {high}.")
    return int(given[name])


def _launched(name: str, environment: Mapping[str, str]) -> bool:
    """Whether a launcher started several processes; parts of its variables, as a shell in a job has, say nothing."""
    said = all(variable in environment for variable in _LAUNCHERS[name])
    return said and environment[_NUMBERS[name]] not in ("", "0", "1")


def _expect_alone(environment: Mapping[str, str]) -> None:
    """A UserError where a launcher says that there are several, and not where: each would search for itself."""
    _, size, rank = _LAUNCHERS["Open MPI"]
    # Since Open MPI 5.
    if rank in environment and environment.get(size, "1") not in ("", "0", "1"):
        raise UserError(
            f"Open MPI started {environment[size]} processes, and this release of it does not tell them where the "
            f"first is: give each --coordinator HOST:PORT --processes {environment[size]} --process ${rank}, as by "
            "mpirun ... sh -c '...'."
        )


def many() -> bool:
    """Whether there are several."""
    return jax.process_count() > 1


def first() -> bool:
    """Whether this is the one that writes."""
    return jax.process_index() == 0


def part(size: int) -> tuple[np.ndarray, Sequence[Any]]:
    """Which of so many members this process computes, and its devices for them.

    The members are dealt out in order and evenly, some of them twice where the devices don't divide them.
    """
    number = jax.process_count()
    devices = jax.local_devices()[: -(-size // number)]
    each = -(-size // (number * len(devices))) * len(devices)
    first_member = jax.process_index() * each
    return np.arange(first_member, first_member + each) % size, devices


def gathered(tree: Any) -> Any:
    """The parts of all processes, [B, ...] arrays, one after the other.

    Raises:
      LostProcess: one of them has ended.
    """
    return _all(tree, tiled=True) if many() else tree


def agreed(tree: Any) -> Any:
    """What the first process has, numbers and arrays of the same shapes everywhere."""
    if not many():
        return tree
    return jax.tree.map(lambda x: x[0], _all(jax.tree.map(np.asarray, tree), tiled=False))


def told(said: Any) -> Any:
    """What the first process says: anything that JSON holds."""
    if not many():
        return said
    text = np.frombuffer(json.dumps(said).encode(), np.uint8)
    padded = np.zeros(int(agreed(np.int32(len(text)))), np.uint8)
    if first():
        padded[:] = text
    return json.loads(np.asarray(agreed(padded)).tobytes())


def by_first(act: Callable[[], T]) -> T | None:
    """What the first process does, such as with a folder that it alone has: its value there, None elsewhere.

    Raises:
      UserError: it was refused; what it is refused, all are.
    """
    found, refused = None, ""
    if first():
        try:
            found = act()
        except UserError as error:
            refused = str(error)
    if refused := told(refused):
        raise UserError(refused)
    return found


def _all(tree: Any, tiled: bool) -> Any:
    try:
        return jax.tree.map(np.asarray, multihost_utils.process_allgather(tree, tiled=tiled))
    # The second where it is noticed as the gathering is begun.
    except (jax.errors.JaxRuntimeError, ValueError) as error:
        reason = first_line(error).rsplit("] ", 1)[-1]
        raise LostProcess(
            f"one of the {jax.process_count()} processes has ended, and process {jax.process_index()} cannot go on "
            f"without it ({reason}): see what it says, and start all of them again with --resume."
        ) from error
