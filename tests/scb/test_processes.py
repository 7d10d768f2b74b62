"""Several processes compute what one does: the same bytes, one folder, and an end for all when one is lost."""

import os
import socket
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

import jax
import numpy as np
import pytest

import scb
from scb import processes
from scb.errors import UserError
from scb.evolution import EvolutionConfig

ROOT = Path(scb.__file__).parents[1]
CONFIG = EvolutionConfig(
    population_size=9, num_generations=12, mean_evaluations=5, checkpoint_every=4
)
# What LongRun does, with a problem that takes no time.
CODE = """
import os, sys
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
import numpy as np
from scb.cli import run_program

def commands():
    import jax
    from scb import processes
    from scb.command_line import LongRun, SharedOutput
    from scb.evolution import EvolutionConfig, evolve

    @dataclass(frozen=True, kw_only=True)
    class Search(LongRun):
        program = "many search"
        presets = MappingProxyType({"quick": lambda given: EvolutionConfig(**CONFIG)})
        together = True
        config: EvolutionConfig = field(default_factory=lambda: EvolutionConfig(**CONFIG))
        output: SharedOutput = field(default_factory=lambda: SharedOutput(Path("run")))

        def run(self):
            from tests.scb.probes import Parabola  # which starts JAX

            folder = self.open()
            outcome = evolve(Parabola(0.5), self.config, folder)
            folder.close()
            found = jax.tree.leaves((outcome.mean, outcome.best_mean))
            digest = b"".join(np.asarray(x).tobytes() for x in found).hex()
            print(processes.first(), digest, len(outcome.metrics), flush=True)

    return {"search": Search}

sys.exit(run_program("many", "Searches.", commands))
"""


def free_port():
    with socket.socket() as free:
        free.bind(("localhost", 0))
        return free.getsockname()[1]


def started(number, devices, *flags, config=CONFIG):
    """So many processes, not waited for."""
    code = f"CONFIG = {asdict(config)!r}\n{CODE}"
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "JAX_NUM_CPU_DEVICES": str(devices)}
    port, found = free_port(), []
    for i in range(number):
        others = [f"--coordinator=localhost:{port}", f"--processes={number}", f"--process={i}"]
        found.append(
            subprocess.Popen(
                [sys.executable, "-c", code, "search", *flags, *(others if number > 1 else [])],
                cwd=ROOT,
                env=environment,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
        )
    return found


def ended(running):
    """[(exit status, standard output, standard error)]."""
    said = [process.communicate(timeout=120) for process in running]
    return [(p.returncode, *of_it) for p, of_it in zip(running, said, strict=True)]


@pytest.mark.parametrize("number", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_processes_find_what_one_with_all_their_devices_finds(tmp_path, number):
    one, several = tmp_path / "one", tmp_path / "several"
    ((status, alone, error),) = ended(started(1, 2 * number, f"--out={one}"))
    assert status == 0, error
    together = ended(started(number, 2, f"--out={several}"))
    assert [status for status, *_ in together] == [0] * number, together
    wanted = alone.split()[1:]
    for i, (_, said, error) in enumerate(together):
        assert said.splitlines()[-1].split() == [str(i == 0), *wanted]  # after Gloo's own
        # The first alone says how far they are.
        assert ("generation 12/12" in error) == (i == 0)
        assert (f"process 0 waits for {number - 1} more at localhost" in error) == (i == 0)
    for name in ("metrics.jsonl", "config.json"):
        assert (several / name).read_bytes() == (one / name).read_bytes()


LONG = replace(CONFIG, num_generations=400, checkpoint_every=5)


def reached(process, folder, step):
    """Waits for a checkpoint of this generation or a later one, and returns the newest one's."""
    newest = 0
    while process.poll() is None and newest < step:
        time.sleep(0.01)
        kept = (folder / "checkpoints").glob("*")
        newest = max((int(path.name) for path in kept if path.name.isdigit()), default=0)
    return newest


@pytest.mark.slow
def test_when_one_is_lost_the_others_say_so(tmp_path):
    first, second = started(2, 1, f"--out={tmp_path / 'run'}", config=LONG)
    reached(first, tmp_path / "run", 10)
    second.kill()
    ((status, _, error), _) = ended([first, second])
    assert status == 2 and "Traceback" not in error
    (sentence,) = [line for line in error.splitlines() if line.startswith("many:")]
    assert "one of the 2 processes has ended, and process 0 cannot go on without it" in sentence


@pytest.mark.slow
def test_processes_that_were_lost_and_told_to_end_find_what_one_finds(tmp_path):
    one, folder = tmp_path / "one", tmp_path / "run"
    ((status, alone, _),) = ended(started(1, 4, f"--out={one}", config=LONG))
    running = started(2, 2, f"--out={folder}", config=LONG)
    newest = reached(running[0], folder, 10)
    running[0].kill()  # the one that writes
    (_, (other, *_)) = ended(running)
    assert other not in (None, 0)
    running = started(2, 2, f"--resume={folder}", config=LONG)
    reached(running[0], folder, newest + 10)
    for process in running:
        process.terminate()
    (status, _, error), (other, *_) = ended(running)
    assert status == 143 and "is saved after" in error
    assert other in (143, 2)  # told to end itself, or left alone by the first
    (status, said, error), _ = ended(started(2, 2, f"--resume={folder}", config=LONG))
    assert status == 0, error
    assert said.splitlines()[-1] == alone.splitlines()[-1]
    assert (folder / "metrics.jsonl").read_bytes() == (one / "metrics.jsonl").read_bytes()


@pytest.mark.slow
def test_a_folder_that_the_first_is_refused_is_refused_to_all(tmp_path):
    (tmp_path / "mine.txt").write_text("")
    for status, _, error in ended(started(2, 1, f"--out={tmp_path}")):
        assert status == 2
        assert f"many: {tmp_path} already exists and is not empty" in error


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"process": "1"}, "give all three"),
        ({"coordinator": "here:1", "processes": "two", "process": "0"}, "--processes is 'two'"),
        ({"coordinator": "here:1", "processes": "2", "process": "2"}, "a number from 0 to 1"),
        ({"coordinator": "here", "processes": "2", "process": "1"}, "give HOST:PORT"),
        (
            {"coordinator": "here:x", "processes": "2", "process": "1"},
            "with a port from 1 to 65535",
        ),
        ({"coordinator": "here:", "processes": "2", "process": "1"}, "with a port from 1 to 65535"),
        ({"coordinator": "here:65536", "processes": "2", "process": "0"}, "'here:65536': give H"),
    ],
)
def test_processes_that_do_not_say_who_they_are_are_refused(given, message):
    with pytest.raises(UserError, match=message):
        processes.start(given)


SLURM = {"SLURM_JOB_ID": "7", "SLURM_STEP_NODELIST": "node[1-2]", "SLURM_LOCALID": "0"}
SLURM |= {"SLURM_NTASKS": "2", "SLURM_PROCID": "1"}


@pytest.mark.parametrize(
    ("environment", "joined"),
    [
        (SLURM, True),
        ({**SLURM, "SLURM_NTASKS": "1"}, False),
        # A shell or a batch script in a job, without srun.
        ({k: v for k, v in SLURM.items() if k != "SLURM_STEP_NODELIST"}, False),
        (
            {
                "OMPI_MCA_orte_hnp_uri": "x",
                "OMPI_COMM_WORLD_SIZE": "2",
                "OMPI_COMM_WORLD_RANK": "0",
            },
            True,
        ),
        ({}, False),
    ],
)
def test_what_a_launcher_says_is_enough_where_it_says_all(monkeypatch, environment, joined):
    asked = []
    monkeypatch.setattr(jax.distributed, "initialize", lambda **settings: asked.append(settings))
    monkeypatch.setattr(jax.config, "update", lambda *_: None)
    processes.start({}, environment)
    assert bool(asked) == joined


def test_a_launcher_that_hides_where_the_first_is_asks_for_flags():
    said = {"OMPI_COMM_WORLD_SIZE": "4", "OMPI_COMM_WORLD_RANK": "2"}
    with pytest.raises(UserError, match=r"--processes 4 --process \$OMPI_COMM_WORLD_RANK"):
        processes.start({}, said)
    processes.start({}, said | {"OMPI_COMM_WORLD_SIZE": "1"})


def test_a_machine_whose_own_name_has_no_address_is_told_so(monkeypatch):
    def unknown():
        raise RuntimeError("Unable to initialize backend 'cpu': rv == 0. -2 vs 0")

    monkeypatch.setattr(jax.distributed, "initialize", lambda **_: None)
    monkeypatch.setattr(jax.config, "update", lambda *_: None)
    monkeypatch.setattr(jax, "device_count", unknown)
    with pytest.raises(UserError, match=f"-2 vs 0.*{socket.gethostname()}.* has an address"):
        processes.start({}, SLURM)


def test_members_are_dealt_out_in_order_and_all_of_them(monkeypatch):
    monkeypatch.setattr(jax, "process_count", lambda: 3)
    monkeypatch.setattr(jax, "local_devices", lambda: ["a", "b"])
    for size in (1, 2, 5, 6, 7, 12, 64):
        parts = []
        for index in range(3):
            monkeypatch.setattr(jax, "process_index", lambda index=index: index)
            mine, devices = processes.part(size)
            assert len(mine) % len(devices) == 0
            parts.append(mine)
        assert len({len(mine) for mine in parts}) == 1
        together = np.concatenate(parts)
        np.testing.assert_array_equal(together[:size], np.arange(size))


def test_one_process_shares_with_nobody():
    tree = {"a": np.arange(3)}
    assert processes.gathered(tree) is tree and processes.agreed(tree) is tree
    assert processes.told({"x": [1]}) == {"x": [1]} and processes.first() and not processes.many()
