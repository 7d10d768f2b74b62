"""Random keys come from scb.keys, and no two draws of a run use the same one."""

import re

import jax
import numpy as np
import pytest

from scb.keys import key_at, named_key, root_key, split_key
from tests.scb.test_imports import MODULES, ROOT

# rejax's side of the benchmark runs where this project is not installed.
ELSEWHERE = {"scb/keys.py", "experiments/rejax_peer.py"}


def data(key):
    return tuple(np.asarray(jax.random.key_data(key)).tolist())


@pytest.mark.parametrize("package", MODULES)
def test_keys_are_made_in_one_module(package):
    made = re.compile(
        r"random\.(key|PRNGKey|split|fold_in|wrap_key_data|clone)\b|from jax\.random|from jax import random"
    )
    for path in MODULES[package]:
        name = str(path.relative_to(ROOT))
        assert name in ELSEWHERE or not made.search(path.read_text()), name


def test_a_position_is_a_part_of_a_split_which_is_why_no_key_has_both():
    key = root_key(3)
    assert [data(k) for k in split_key(key, 4)] == [data(key_at(key, i)) for i in range(4)]


def test_a_longer_split_begins_with_a_shorter_one():
    key = root_key(3)
    assert [data(k) for k in split_key(key, 5)][:4] == [data(k) for k in split_key(key, 4)]


def test_named_keys_differ_from_each_other_and_from_every_position():
    key = root_key(0)
    named = {data(named_key(key, role)) for role in ("ppo", "sac", "expert", "")}
    positions = {data(k) for k in split_key(key, 10_000)} | {data(key_at(key, 2**31 - 1))}
    assert len(named) == 4 and not named & positions and data(key) not in named


def test_a_name_means_the_same_key_in_every_process():
    # sha256("expert") begins with c7d25387, whose first bit is set already.
    assert data(named_key(root_key(0), "expert")) == data(key_at(root_key(0), 0xC7D25387))
