"""Imports gymnax without starting JAX, which whoever imports this package may want to configure first.

gymnax computes a constant as it is imported, and evosax does. By then JAX has chosen its devices: a program can no
longer ask for one a core, and several hosts can no longer be joined. The package imports this module before all others.
"""

from collections.abc import Iterator
from contextlib import contextmanager

from jax._src.xla_bridge import backends_are_initialized
from jax.extend.backend import clear_backends


@contextmanager
def unstarted() -> Iterator[None]:
    """Leaves JAX as unstarted as it was, whatever is imported meanwhile."""
    started = backends_are_initialized()
    yield
    if not started:
        clear_backends()


with unstarted():
    import gymnax  # noqa: F401
