"""Parts are measured once, here or as jobs elsewhere; what jobs found is kept, and failures are told."""

import importlib.util
import json
import os
import signal
import stat
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import pytest

# It closes all handlers of logging as it is imported, pytest's too where that is within a test.
import submitit  # noqa: F401

from experiments.harness import Experiment
from experiments.parts import InParts, Jobs, Measurement, Part, _digest, elsewhere
from scb.errors import UserError


def measured(name, folder):
    """A number, and a line in a file; one whose name says so fails while a file is there."""
    if name == "fails" and (folder / "broken").exists():
        raise UserError("this one cannot be.")
    with (folder / "measured").open("a") as file:
        file.write(f"{name}\n")
    return {"number": len(name), "process": os.getpid()}


def parts_of(folder, *names):
    return [Part(("found", name), partial(measured, name, folder)) for name in names]


def times(folder):
    return sorted((folder / "measured").read_text().split())


def test_a_part_is_put_where_it_belongs_and_keeps_what_is_there():
    report = {"a": {"b": {"old": {"x": 1}}}}
    part = Part(("a", "b"), lambda: None, (("old", "y"), ("new",)))
    assert not part.there(report) and part.name == "a, b, old y, new"
    part.add({"old": {"y": 2}, "new": [3]}, report)
    assert report == {"a": {"b": {"old": {"x": 1, "y": 2}, "new": [3]}}} and part.there(report)
    alone = Part(("c", "d"), lambda: None)
    assert not alone.there(report)
    alone.add(7, report)
    assert alone.there(report) and report["c"] == {"d": 7}


def test_without_jobs_parts_are_measured_one_after_the_other(tmp_path):
    report, saved = {}, []
    measure = InParts(lambda plan, report: iter(parts_of(tmp_path, *plan)))
    measure(["a", "bb"], report, lambda: saved.append(len(report["found"])))
    measure(["a", "bb", "ccc"], report, lambda: saved.append(len(report["found"])))
    assert saved == [1, 2, 3] and times(tmp_path) == ["a", "bb", "ccc"]
    assert report["found"]["ccc"]["number"] == 3


def test_only_jobs_need_submitit(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "submitit", None)
    spec = importlib.util.find_spec("experiments.parts")
    parts = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(parts)
    report = {}
    parts.InParts(lambda *_: parts_of(tmp_path, "a"))(None, report, lambda: None)
    assert report["found"]["a"]["number"] == 1
    with pytest.raises(UserError, match="local needs the package submitit: install it"):
        parts.Jobs("local").executor_in(tmp_path)


def counting(folder, *names):
    return Experiment(
        name="counting_parts",
        title="Counting",
        paper="no figure",
        measure=InParts(lambda options, report: parts_of(folder, *names)),
    )


def test_jobs_measure_what_is_missing_and_say_what_failed(tmp_path, capsys):
    out, broken = tmp_path / "report.json", tmp_path / "broken"
    broken.touch()
    flags = [f"--out={out}", "--executor=local", "--jobs=2", "--hours=0.1"]
    experiment = counting(tmp_path, "a", "fails", "ccc")
    assert experiment.main(flags) == 2
    said, error = capsys.readouterr()
    (sentence,) = error.splitlines()
    assert "1 of 3 parts were not measured, found, fails among them" in sentence
    assert "(this one cannot be):" in sentence and "the same command tries again" in sentence
    assert "found, ccc: measured" in said
    found = json.loads(out.read_text())["found"]
    assert found.keys() == {"a", "ccc"}
    assert os.getpid() not in [x["process"] for x in found.values()]
    broken.unlink()
    assert experiment.main(flags) == 0
    assert json.loads(out.read_text())["found"].keys() == {"a", "fails", "ccc"}
    assert times(tmp_path) == ["a", "ccc", "fails"]
    assert not out.with_suffix(".parts").exists()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--jobs=8"], "jobs is 8, and the parts are measured here, one after the other: leave it"),
        (["--executor=local", "--cpus=4"], "cpus is 4, and the jobs are this machine's"),
        (["--executor=local", "--slurm", "partition=long"], "or take --executor slurm"),
    ],
)
def test_what_no_job_would_heed_is_refused(tmp_path, flags, message, capsys):
    assert counting(tmp_path, "a").main([f"--out={tmp_path / 'report.json'}", *flags]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "measured").exists()


def test_what_an_earlier_start_found_is_taken(tmp_path, monkeypatch):
    (part,) = parts_of(tmp_path, "a")
    monkeypatch.setattr(Jobs, "executor_in", lambda *_: pytest.fail("nothing is missing"))
    monkeypatch.setattr("experiments.parts._digest", lambda part, settings: "kept")
    Measurement(part, tmp_path / "kept.json")()
    report, saved = {}, []
    elsewhere([part], report, lambda: saved.append(1), Jobs("local"), tmp_path, lambda _: None)
    assert report["found"]["a"]["number"] == 1 and saved == [1]
    assert not (tmp_path / "kept.json").exists()


class AtOnce:
    """An executor whose jobs have ended when they are submitted, in this process."""

    job_id = "1"

    def submit(self, job):
        job()
        return self

    def done(self):
        return True


@pytest.fixture
def at_once(monkeypatch):
    monkeypatch.setattr(Jobs, "executor_in", lambda *_: AtOnce())


def test_what_was_found_with_other_settings_is_not_taken(tmp_path, at_once):
    (part,) = parts_of(tmp_path, "a")
    Measurement(part, tmp_path / f"{_digest(part, 'few')}.json")()
    for settings, number in (("many", 2), ("few", 2)):
        report, jobs = {}, Jobs("local")
        elsewhere([part], report, lambda: None, jobs, tmp_path, lambda _: None, 0.1, settings)
        assert part.there(report) and len(times(tmp_path)) == number


def test_what_is_named_twice_is_one_job(tmp_path, at_once):
    report, told = {}, []
    parts = [*parts_of(tmp_path, "a"), *parts_of(tmp_path, "a")]
    elsewhere(parts, report, lambda: None, Jobs("local"), tmp_path, told.append, every=0.1)
    assert report["found"]["a"]["number"] == 1
    assert sum(": job " in line for line in told) == 1


def test_a_part_that_another_job_measures_is_waited_for(tmp_path):
    began, may_end = threading.Event(), threading.Event()

    def slow():
        began.set()
        may_end.wait(10)
        return measured("a", tmp_path)

    jobs = [
        Measurement(Part(("found", "a"), work), tmp_path / "kept.json")
        for work in (slow, partial(measured, "a", tmp_path))
    ]
    threads = [threading.Thread(target=job) for job in jobs]
    threads[0].start()
    began.wait(10)
    threads[1].start()
    time.sleep(0.2)
    assert not (tmp_path / "measured").exists()
    may_end.set()
    for thread in threads:
        thread.join(10)
    assert times(tmp_path) == ["a"]


# What a cluster has: the script is run here, by srun without its flags.
SLURM = {
    "sbatch": """
grep '^#SBATCH' "$1" >> {folder}/asked
id=$(($(cat {folder}/last 2>/dev/null || echo 40) + 1)); echo $id > {folder}/last
export SLURM_JOB_ID=$id SLURM_NTASKS=1 SLURM_JOB_NUM_NODES=1 SLURM_NODEID=0 SLURM_PROCID=0 SLURM_LOCALID=0
bash "$1" > {folder}/slurm.log 2>&1 &
echo "Submitted batch job $id"
""",
    "srun": """
while [ "${{1#-}}" != "$1" ]; do case "$1" in --unbuffered) shift;; *) shift 2;; esac; done
exec "$@"
""",
    "sacct": "echo 'JobID|State|NodeList'",
    "scontrol": "echo here",
    "scancel": "true",
}


def test_slurms_jobs_are_asked_for_what_is_given(tmp_path, monkeypatch):
    commands = tmp_path / "bin"
    commands.mkdir()
    for name, code in SLURM.items():
        path = commands / name
        path.write_text(f"#!/bin/bash\n{code.format(folder=tmp_path)}")
        path.chmod(path.stat().st_mode | stat.S_IEXEC)
    monkeypatch.setenv("PATH", f"{commands}:{os.environ['PATH']}")
    out = tmp_path / "report.json"
    flags = [f"--out={out}", "--executor=slurm", "--hours=1.5", "--cpus=3"]
    assert counting(tmp_path, "a").main([*flags, "--slurm", "partition=long", "account=x"]) == 0
    assert json.loads(out.read_text())["found"]["a"]["number"] == 1
    asked = (tmp_path / "asked").read_text()
    for line in ("--time=90", "--cpus-per-task=3", "--partition=long", "--account=x"):
        assert f"#SBATCH {line}" in asked


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        (["--executor=slurm"], "there is no SLURM here"),
        (["--jobs=0"], "jobs is 0"),
        (["--hours=0"], "--hours is 0.0: it must be more than 0"),
        (["--slurm", "partition"], "give KEY=VALUE"),
    ],
)
def test_jobs_that_cannot_be_are_refused(tmp_path, capsys, flags, sentence):
    out = tmp_path / "report.json"
    assert counting(tmp_path, "a").main([f"--out={out}", *flags]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert sentence in line and not Path(out).exists()


def test_who_stops_the_command_stops_its_jobs(tmp_path, monkeypatch):
    cancelled = []

    class Job:
        job_id = "1"

        def done(self):
            raise KeyboardInterrupt

        def cancel(self, check):
            assert not check
            cancelled.append(self)

    class Executor:
        def submit(self, _):
            return Job()

    monkeypatch.setattr(Jobs, "executor_in", lambda *_: Executor())
    with pytest.raises(KeyboardInterrupt):
        elsewhere(parts_of(tmp_path, "a", "b", "c"), {}, lambda: None, Jobs("local"), tmp_path)
    assert len(cancelled) == 2


def test_a_command_that_is_told_to_end_cancels_every_job_and_says_how_it_goes_on(tmp_path):
    code = f"""
import pathlib, time
from experiments.parts import Jobs, Part, elsewhere
from scb import termination

class Job:
    job_id = "1"
    def done(self):
        return False
    def cancel(self, check):
        time.sleep(0.1)
        print("cancelled", flush=True)

class Executor:
    def submit(self, _):
        return Job()

termination.watch("long")
termination.goes_on("it goes on.")
Jobs.executor_in = lambda *_: Executor()
parts = [Part((name,), dict) for name in "abc"]
elsewhere(parts, {{}}, lambda: None, Jobs("local", jobs=3), pathlib.Path({str(tmp_path)!r}), every=0.01)
"""
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    while "job 1" not in process.stdout.readline():
        pass
    process.send_signal(signal.SIGTERM)
    said, error = process.communicate(timeout=60)
    assert process.returncode == 143
    assert said.count("cancelled") >= 1 + said.count("job 1")
    assert error == "long: told to end; its jobs are cancelled; it goes on.\n"
