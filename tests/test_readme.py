"""The README's Python is run, with less training than it says."""

import re
from pathlib import Path

import pytest

README = Path(__file__).parents[1] / "README.md"
BLOCKS = re.findall(r"```python\n(.*?)```", README.read_text(), re.S)
# (what the README says, what is run)
SHORTER = (
    ("scb.PPOConfig(activation", "scb.PPOConfig(total_steps=1000, activation"),
    ("scb.SACConfig()", "scb.SACConfig(total_steps=1500)"),
    ("total_steps=150_000", "total_steps=10_000"),
    (
        "population_size=32, num_generations=30,",
        "population_size=2, num_generations=1, mean_evaluations=2,",
    ),
    (
        "population_size=32, num_generations=150",
        "population_size=2, num_generations=1, mean_evaluations=2",
    ),
)


def shortened(block):
    """A block with less training."""
    for long, short in SHORTER:
        block = block.replace(long, short)
    return block


def test_every_replacement_finds_its_text():
    for long, short in SHORTER:
        assert sum(long in block for block in BLOCKS) == 1, long
        assert long != short


# Compiling SAC and a search takes from half a minute to a minute each.
SLOW = ("discover", "SAC", "meta_train")


@pytest.mark.parametrize(
    "block",
    [
        pytest.param(
            block,
            marks=[pytest.mark.slow] if any(word in block for word in SLOW) else [],
            id=f"block-{number}",
        )
        for number, block in enumerate(BLOCKS)
    ],
)
def test_a_block_of_the_readme_runs(block, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # some of them save what they make
    exec(compile(shortened(block), "README.md", "exec"), {})


@pytest.mark.parametrize("call", ["meta_train(config)", "discover(config)"])
def test_what_the_slow_blocks_configure_exists(call):
    block = next(block for block in BLOCKS if call in block)
    lines = block.splitlines()
    number = next(i for i, line in enumerate(lines) if call in line)
    names: dict = {}
    exec("\n".join(lines[:number]), names)
    assert names["config"].evolution.population_size == 32
