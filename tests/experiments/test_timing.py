"""What is timed is what was asked for: programs that are compiled, not found."""

import jax
import pytest
from jax.experimental.compilation_cache.compilation_cache import reset_cache

from experiments.timing import OWN, in_turn, without_compilation_cache

SETTINGS = (
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)


@pytest.fixture
def cache(tmp_path):
    before = {name: jax.config.values[name] for name in SETTINGS}
    for name, value in zip(SETTINGS, (str(tmp_path), 0, -1), strict=True):
        jax.config.update(name, value)
    reset_cache()
    yield tmp_path
    for name, value in before.items():
        jax.config.update(name, value)
    reset_cache()


def test_a_program_is_compiled_whether_it_was_before_or_not(cache):
    x = jax.numpy.arange(3.0)  # made before: what makes it is a program too
    numbers = [len(list(cache.iterdir()))]

    def compiled(by: float) -> None:
        jax.block_until_ready(jax.jit(lambda x: x * by)(x))
        numbers.append(len(list(cache.iterdir())))

    compiled(2.0)
    with without_compilation_cache():
        compiled(3.0)
    compiled(4.0)
    assert numbers[0] < numbers[1] == numbers[2] < numbers[3]


def test_both_ways_are_timed_in_turn_and_compared_repeat_by_repeat():
    asked = []

    def rate(who, rates):
        left = iter(rates)

        def once():
            asked.append(who)
            return next(left)

        return once

    # The other's comes first, and is no less the other.
    found = in_turn({"gym": rate("gym", [10.0, 30.0, 20.4]), OWN: rate(OWN, [40.0, 60.0, 10.2])}, 3)
    assert asked == ["gym", OWN] * 3
    assert found == {"gym": 20, OWN: 40, "ratios": [4.0, 2.0, 0.5]}
