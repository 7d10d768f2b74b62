"""The paper's experiments, and studies of this project's own: run from a checkout, not installed.

The program configures JAX before what it runs is imported: evosax computes as it is imported, after which JAX's
devices can no longer be chosen.
"""

from scb.cli import configure_jax

configure_jax()
