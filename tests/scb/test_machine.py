import json
import platform
from pathlib import Path

import jax

from scb.machine import arithmetic, machine_description, package_versions


def test_versions_name_everything_that_decides_the_numbers():
    versions = package_versions()
    assert versions["jax"].count(".") >= 2
    assert set(versions) == {
        *("python", "jax", "jaxlib", "flax", "optax", "evosax", "gymnax", "brax", "numpy", "lpo")
    }


def test_arithmetic_is_told_where_it_is_not_the_default():
    assert arithmetic() == {}
    with jax.enable_x64(True), jax.default_prng_impl("rbg"):
        assert arithmetic() == {"jax_enable_x64": "True", "jax_default_prng_impl": "rbg"}
    with jax.threefry_partitionable(False):
        assert arithmetic() == {"jax_threefry_partitionable": "False"}


def test_the_machine_is_described_without_saying_whose_it_is():
    description = machine_description()
    assert description["cores"] >= 1
    assert description["jax_devices"] >= 1
    assert description["platform"].split()[0] == platform.system()
    text = json.dumps(description)
    assert platform.node() not in text
    assert str(Path.home()) not in text
