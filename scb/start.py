"""Imports gymnax without starting JAX, which whoever imports this package may want to configure first.

gymnax computes a constant as it is imported. By then JAX has chosen its devices: a program can no longer ask for one a
core, and several hosts can no longer be joined. The package imports this module before all others.
"""

from jax._src.xla_bridge import backends_are_initialized
from jax.extend.backend import clear_backends

_started = backends_are_initialized()
import gymnax  # noqa: E402, F401

if not _started:
    clear_backends()
