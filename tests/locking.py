"""Who holds a file."""

import subprocess
import sys


def is_locked(path):
    """Whether another process could not lock it; one's own never stands in one's way."""
    code = f"import fcntl; fcntl.lockf(open({str(path)!r}, 'a+'), fcntl.LOCK_EX | fcntl.LOCK_NB)"
    return subprocess.run([sys.executable, "-c", code], capture_output=True).returncode != 0
