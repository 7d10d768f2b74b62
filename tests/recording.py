"""Records where every random key of a computation is used, inside compiled programs too."""

import inspect
import sys
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial, wraps
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scb.keys import FIRST_NAME

ROOT = Path(__file__).parents[1]


def _takes_a_key(function: Any) -> bool:
    try:
        return next(iter(inspect.signature(function).parameters), None) == "key"
    except (TypeError, ValueError):
        return False


SAMPLERS = [
    name
    for name, function in vars(jax.random).items()
    if callable(function) and not name.startswith("_") and _takes_a_key(function)
]
# These derive keys, and those ask what a key is.
DERIVING, ASKING = ("split", "fold_in"), {"split", "fold_in", "clone", "key_data", "key_impl"}


@dataclass
class Record:
    """What was seen.

    Attributes:
      used: {(place in the code, "split", "fold_in" or "draw"): keys}, in batches.
      seeds: that keys were made from.
    """

    used: dict[tuple[str, str], list[np.ndarray]] = field(default_factory=lambda: defaultdict(list))
    seeds: set[int] = field(default_factory=set)

    def draws(self) -> int:
        """How many keys were drawn from."""
        return len({k for (_, kind), keys in self._keys().items() if kind == "draw" for k in keys})

    def shared(self) -> list[list[tuple[str, str]]]:
        """The places of every key that is used at more than one, or in more than one way; each set of places once."""
        places = defaultdict(set)
        for use, keys in self._keys().items():
            for key in keys:
                places[key].add(use)
        return sorted({tuple(sorted(found)) for found in places.values() if len(found) > 1})

    def _keys(self) -> dict[tuple[str, str], set[bytes]]:
        return {
            use: {key.tobytes() for key in np.concatenate(batches)}
            for use, batches in self.used.items()
        }

    def _use(self, use: tuple[str, str], keys: Any) -> np.ndarray:
        keys = np.asarray(keys)
        self.used[use].append(np.unique(keys.reshape(-1, keys.shape[-1]), axis=0))
        return keys

    def _seed(self, seeds: Any) -> np.ndarray:
        self.seeds |= set(np.ravel(seeds).tolist())
        return np.asarray(seeds)


def _place() -> str:
    """Line of the innermost caller that is neither JAX, nor this module, nor the one that makes keys."""
    frame = sys._getframe(2)
    own = (__file__, "/scb/keys.py", "/jax/", "/contextlib.py", "/functools.py")
    while any(part in frame.f_code.co_filename for part in own):
        frame = frame.f_back
    name = frame.f_code.co_filename.split("site-packages/")[-1].removeprefix(f"{ROOT}/")
    return f"{name}:{frame.f_lineno}"


def _passed(note: Any, value: jax.Array) -> jax.Array:
    # Its result is what is gone on with: what is not needed is not computed, and not recorded.
    shape = jax.ShapeDtypeStruct(value.shape, value.dtype)
    return jax.pure_callback(note, shape, value, vmap_method="expand_dims")


@contextmanager
def recorded_seeds(record: Record | None = None) -> Iterator[set[int]]:
    """The seeds that keys are made from meanwhile; of programs compiled before, none."""
    record = Record() if record is None else record
    make = jax.random.key

    def made(seed: Any, **named: Any) -> Any:
        if isinstance(seed, jax.core.Tracer):
            return make(_passed(record._seed, seed), **named)
        return make(record._seed(seed), **named)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jax.random, "key", made)
        yield record.seeds


@contextmanager
def recorded() -> Iterator[Record]:
    """Programs compiled before are compiled again, and those compiled meanwhile are dropped."""
    record = Record()

    def used(function: Any, kind: str) -> Any:
        @wraps(function)
        def wrapper(key: Any, *arguments: Any, **named: Any) -> Any:
            if kind == "fold_in" and isinstance(arguments[0], int) and arguments[0] >= FIRST_NAME:
                return function(key, *arguments, **named)  # no position's: see scb.keys
            data = _passed(partial(record._use, (_place(), kind)), jax.random.key_data(key))
            if jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
                data = jax.random.wrap_key_data(data)
            return function(data, *arguments, **named)

        return wrapper

    jax.clear_caches()
    with recorded_seeds(record), pytest.MonkeyPatch.context() as patch:
        for name in SAMPLERS:
            if name not in ASKING or name in DERIVING:
                kind = name if name in DERIVING else "draw"
                patch.setattr(jax.random, name, used(getattr(jax.random, name), kind))
        yield record
    jax.clear_caches()
