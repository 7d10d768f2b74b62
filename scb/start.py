"""Imports gymnax without starting JAX, which whoever imports this package may want to configure first.

gymnax computes a constant as it is imported, and evosax does. By then JAX has chosen its devices: a program can no
longer ask for one a core, and several hosts can no longer be joined. The package imports this module before all others.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager

from jax._src.xla_bridge import backends_are_initialized
from jax.extend.backend import clear_backends

from scb.errors import UserError


@contextmanager
def unstarted() -> Iterator[None]:
    """Leaves JAX as unstarted as it was, whatever is imported meanwhile."""
    started = backends_are_initialized()
    yield
    if not started:
        clear_backends()


with unstarted():
    try:
        import gymnax  # noqa: F401
    # JAX starts here first: without a word where a plugin is not installed.
    except (AssertionError, RuntimeError) as error:
        if not (platforms := os.environ.get("JAX_PLATFORMS")):
            raise
        raise UserError(
            f"JAX_PLATFORMS is {platforms}, and JAX finds no such device here, or lacks the plugin for it: leave the "
            "variable out, or make it cpu."
        ) from error
