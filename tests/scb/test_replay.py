import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from scb.agents.replay import ReplayBuffer, add, empty_buffer, sample


def numbered(*numbers):
    """Transitions that say which they are: a number, and a pair of it and its square."""
    number = jnp.array(numbers, jnp.float32)
    return {"number": number, "pair": jnp.stack([number, number**2], axis=-1)}


def filled(capacity, *batches):
    buffer = empty_buffer({"number": jnp.zeros(()), "pair": jnp.zeros(2)}, capacity)
    for batch in batches:
        buffer = add(buffer, numbered(*batch))
    return buffer


def test_an_empty_buffer_has_the_shapes_and_dtypes_of_its_example():
    example = {"action": jnp.int32(0), "observation": jax.ShapeDtypeStruct((3,), jnp.bfloat16)}
    buffer = empty_buffer(example, 7)
    assert (buffer.capacity, int(buffer.written)) == (7, 0)
    chex.assert_shape(buffer.transitions["action"], (7,))
    chex.assert_shape(buffer.transitions["observation"], (7, 3))
    assert buffer.transitions["action"].dtype == jnp.int32
    assert buffer.transitions["observation"].dtype == jnp.bfloat16


def test_the_oldest_transitions_make_room():
    # Six places, written in pairs: the fourth pair takes the places of the first.
    buffer = filled(6, (1, 2), (3, 4), (5, 6), (7, 8))
    np.testing.assert_array_equal(buffer.transitions["number"], [7, 8, 3, 4, 5, 6])
    np.testing.assert_array_equal(
        buffer.transitions["pair"], [[7, 49], [8, 64], [3, 9], [4, 16], [5, 25], [6, 36]]
    )
    assert int(buffer.written) == 8


def test_a_batch_that_does_not_fit_at_the_end_goes_on_at_the_start():
    # Five places: 1 2 3 - -, then 6 5 of (4 5 6) wrap: 6 2 3 4 5. Of (7 8 9) two follow 6: 6 7 8 9 5.
    buffer = filled(5, (1, 2, 3), (4, 5, 6))
    np.testing.assert_array_equal(buffer.transitions["number"], [6, 2, 3, 4, 5])
    buffer = add(buffer, numbered(7, 8, 9))
    np.testing.assert_array_equal(buffer.transitions["number"], [6, 7, 8, 9, 5])


def test_a_batch_as_large_as_the_buffer_replaces_everything():
    buffer = filled(3, (1, 2, 3), (4, 5, 6))
    np.testing.assert_array_equal(buffer.transitions["number"], [4, 5, 6])


# (capacity, first batch, later batches); the agents prefill by one size and go on in another.
@pytest.mark.parametrize(
    ("capacity", "first", "later"), [(12, 4, 4), (12, 6, 3), (10, 4, 2), (10, 4, 4), (7, 2, 2)]
)
def test_the_newest_transitions_are_kept(capacity, first, later):
    # Where `later` doesn't divide the capacity, a slice would not wrap around the ring's end.
    numbers = iter(range(1, 100))
    batches = [[next(numbers) for _ in range(size)] for size in (first, *[later] * 7)]
    # In whatever order.
    total = first + 7 * later
    stored = filled(capacity, *batches).transitions["number"]
    assert set(np.asarray(stored)) == set(range(total - capacity + 1, total + 1))


def test_only_what_was_stored_is_sampled():
    # Three of a hundred places are filled; the rest hold zeros that nobody stored.
    batch = sample(filled(100, (1, 2, 3)), jax.random.key(0), 200)
    assert set(np.asarray(batch["number"])) == {1.0, 2.0, 3.0}
    np.testing.assert_array_equal(batch["pair"][:, 1], batch["number"] ** 2)


def test_samples_are_uniform_over_the_newest_transitions():
    # 8000 draws of the 4 that are left of 6: each is expected 2000 times.
    batch = sample(filled(4, (1, 2, 3), (4, 5, 6)), jax.random.key(1), 8000)
    values, counts = np.unique(batch["number"], return_counts=True)
    np.testing.assert_array_equal(values, [3, 4, 5, 6])
    assert stats.chisquare(counts).pvalue > 1e-4


def test_a_scan_over_writes_is_the_python_loop():
    batches = jnp.arange(24.0).reshape(6, 4)
    loop = empty_buffer(jnp.zeros(()), 10)
    scanned, _ = jax.lax.scan(lambda ring, batch: (add(ring, batch), None), loop, batches)
    for batch in batches:
        loop = add(loop, batch)
    chex.assert_trees_all_equal(scanned, loop)


def test_members_of_a_population_have_their_own_contents_and_one_write_position():
    # `out_axes=None` is refused by vmap for whatever depends on the member.
    def fill(offset):
        buffer = empty_buffer(jnp.zeros(()), 4)
        for start in (0, 2, 4):
            buffer = add(buffer, offset + jnp.arange(start, start + 2.0))
        return buffer

    axes = ReplayBuffer(transitions=0, written=None)
    buffers = jax.vmap(fill, out_axes=axes)(jnp.array([0.0, 100.0]))
    # Of 0 1 | 2 3 | 4 5 the last pair took the place of the first.
    np.testing.assert_array_equal(buffers.transitions, [[4, 5, 2, 3], [104, 105, 102, 103]])
    assert buffers.written.shape == () and int(buffers.written) == 6

    keys = jax.random.split(jax.random.key(0), 2)
    batches = jax.vmap(lambda b, k: sample(b, k, 50), in_axes=(axes, 0))(buffers, keys)
    assert [set(np.asarray(b)) for b in batches] == [{2, 3, 4, 5}, {102, 103, 104, 105}]
    assert not np.array_equal(batches[0], batches[1] - 100)  # each draws by its own key
