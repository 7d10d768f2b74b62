"""Configures JAX before anything else imports it for good."""

import os
from pathlib import Path

# Two devices, so that sharding is tested on every machine. Set as environment variables, which the
# processes that tests start inherit and which `lpo.cli.configure_jax` leaves alone.
os.environ.setdefault("JAX_NUM_CPU_DEVICES", "2")
# Tests compile more than they compute: without the compiler's optimisations they take two thirds of
# the time where nothing is cached yet.
if "xla_backend_optimization_level" not in os.environ.get("XLA_FLAGS", ""):
    _level = "--xla_backend_optimization_level=0"
    os.environ["XLA_FLAGS"] = " ".join(filter(None, [os.environ.get("XLA_FLAGS"), _level]))
_cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_cache / "lpo" / "jax-tests"))
# The default leaves out what compiles within a second, which here is nearly everything.
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
