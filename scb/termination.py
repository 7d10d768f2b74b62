"""A process that is told to end saves what it has first.

By SIGTERM, as schedulers do before they kill, it ends with 143, and by SIGINT, as Ctrl-C sends it, with 130.
"""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator

SAID = {signal.SIGTERM: "told to end", signal.SIGINT: "interrupted"}

# Held while a checkpoint is written, so that no other thread ends the process or writes the same one meanwhile.
writing = threading.RLock()
_savers: list[Callable[[], str]] = []
_pipe: int | None = None
_again = ""


@contextlib.contextmanager
def saving(save: Callable[[], str]) -> Iterator[None]:
    """Within it a process that `watch` watches calls `save` before it ends, and says what it returns, if anything.

    It is called from another thread, for the main one may be inside a computation of minutes.
    """
    with writing:
        _savers.append(save)
    try:
        yield
    finally:
        with writing:
            _savers.remove(save)


def goes_on(how: str) -> None:
    """From now on a process that is ended says this of how its work goes on; "" for nothing."""
    global _again
    _again = how


def watch(program: str) -> None:
    """From now on these signals end this process so. Of a main thread; once is enough."""
    global _pipe
    read, _pipe = os.pipe()
    os.set_blocking(_pipe, False)
    arm()
    threading.Thread(target=_wait, args=(program, read), daemon=True).start()


def arm() -> None:
    """Takes the signals back from what has taken them since `watch`; nothing where nobody watches."""
    if _pipe is None:
        return
    # Python would call a handler when the computation at hand is over. What is written for the signal's number
    # to the file descriptor is there at once.
    signal.set_wakeup_fd(_pipe, warn_on_full_buffer=False)
    for number in SAID:
        signal.signal(number, lambda *_: None)


def _wait(program: str, read: int) -> None:
    while (number := os.read(read, 1)[0]) not in SAID:
        pass
    with writing:
        said = []
        for save in _savers:
            try:
                said.append(save())
            # Whatever it is, what was saved before is there, and the time that is left is short.
            except Exception as error:
                said.append(f"what was done since the last checkpoint is lost ({error})")
        told = "; ".join(filter(None, (SAID[signal.Signals(number)], *said, _again)))
        print(f"{program}: {told.rstrip('.')}.", file=sys.stderr, flush=True)
        os._exit(128 + number)
