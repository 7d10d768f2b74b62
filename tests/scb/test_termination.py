"""What a process does that is told to end, that finds no room, or that is not alone in its folder."""

import os
import signal
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import jax
import numpy as np
import pytest

import scb
from scb.configurations import config_dict
from scb.errors import UserError
from scb.evolution import EvolutionConfig, evolve
from scb.runs import Run
from tests.scb.probes import Parabola

ROOT = Path(scb.__file__).parents[1]
CONFIG = EvolutionConfig(
    population_size=8, num_generations=60, mean_evaluations=4, checkpoint_every=50
)
SEARCH = f"""
import pathlib, sys
from scb.evolution import EvolutionConfig, evolve
from scb.configurations import config_dict
from scb.runs import Run
from tests.scb.probes import Parabola

config = EvolutionConfig(**{asdict(CONFIG)!r})
folder = pathlib.Path(sys.argv[1])

def search(resume=False):
    evolve(Parabola(0.5), config, Run.open(folder, config_dict(config), resume), quiet=True)
"""


def started(code, *arguments, **options):
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **options,
    )


def fingerprint(folder, resume=False):
    run = Run.open(folder, config_dict(CONFIG), resume)
    outcome = evolve(Parabola(0.5), CONFIG, run, quiet=True)
    run.close()
    weights = [np.asarray(x).tobytes() for x in jax.tree.leaves((outcome.mean, outcome.best_mean))]
    return weights, outcome.best_mean_generation, (folder / "metrics.jsonl").read_bytes()


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return fingerprint(tmp_path_factory.mktemp("whole") / "run")


@pytest.mark.parametrize(
    ("how", "status", "words"),
    [("SIGTERM", 143, "told to end"), ("SIGINT", 130, "interrupted")],
)
def test_a_search_that_is_told_to_end_loses_no_generation(tmp_path, whole, how, status, words):
    code = f"""{SEARCH}
import os, signal, threading, time
from scb import termination

def end():
    log = folder / "metrics.jsonl"
    while not log.exists() or log.read_bytes().count(b"\\n") < 20:
        time.sleep(0.001)
    os.kill(os.getpid(), signal.{how})

termination.watch("search")
termination.goes_on("the same call goes on.")
threading.Thread(target=end, daemon=True).start()
search()
time.sleep(60)
"""
    folder = tmp_path / "run"
    process = started(code, folder)
    _, said = process.communicate(timeout=120)
    assert process.returncode == status
    (step,) = (int(path.name) for path in (folder / "checkpoints").iterdir())
    logged = (folder / "metrics.jsonl").read_bytes().count(b"\n")
    # The search goes on while it is saved; what it logs then is computed again.
    assert 19 <= step <= logged and step % CONFIG.checkpoint_every
    assert said == (
        f"search: {words}; {folder} is saved after {step} generations; the same call goes on.\n"
    )
    assert fingerprint(folder, resume=True) == whole


def test_a_computation_that_python_waits_for_does_not_delay_the_end():
    code = """
import time
import jax
from scb import termination

termination.watch("long")
spin = jax.jit(lambda x: jax.lax.while_loop(lambda x: x > 0, lambda x: x + 1, x))
spin.lower(1.0).compile()
with termination.saving(lambda: "saved"), termination.saving(lambda: 1 / 0):
    print("ready", flush=True)
    spin(1.0).block_until_ready()
"""
    process = started(code)
    assert process.stdout.readline() == "ready\n"
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=30)
    assert process.returncode == 143
    assert said == (
        "long: told to end; saved; what was done since the last checkpoint is lost (division by zero).\n"
    )


def test_two_commands_do_not_write_into_one_run(tmp_path, whole):
    code = f"{SEARCH}\nRun.open(folder, config_dict(config))\nprint('open', flush=True)\ninput()"
    folder = tmp_path / "run"
    process = started(code, folder, stdin=subprocess.PIPE)
    assert process.stdout.readline() == "open\n"
    stored = (folder / "config.json").read_bytes()
    with pytest.raises(UserError, match=rf"in use by another command \(process {process.pid} on "):
        fingerprint(folder, resume=True)
    assert (folder / "config.json").read_bytes() == stored
    process.kill()
    process.communicate()
    # However it ended: nobody has to remove anything.
    assert fingerprint(folder, resume=True) == whole


@pytest.mark.parametrize(
    "room",
    [
        pytest.param(3000, marks=pytest.mark.slow),
        6000,
        pytest.param(200_000, marks=pytest.mark.slow),
    ],
)
def test_where_there_is_no_room_a_sentence_says_so_and_what_was_saved_stays(tmp_path, whole, room):
    # A limit on the size of files, which the system refuses to exceed as it refuses to fill a full disk.
    code = f"""{SEARCH}
import resource
from scb.cli import run_program

def go():
    resource.setrlimit(resource.RLIMIT_FSIZE, ({room}, {room}))
    search()

sys.exit(run_program("search", "A search.", lambda: {{"go": go}}, ["go"]))
"""
    folder = tmp_path / "run"
    process = started(code, folder)
    _, said = process.communicate(timeout=120)
    if room > 100_000:
        assert process.returncode == 0 and not said
    else:
        assert process.returncode in (1, 2)
        assert said.startswith("search: ") and said.count("\n") == 1 and "make room" in said
    assert fingerprint(folder, resume=True) == whole
