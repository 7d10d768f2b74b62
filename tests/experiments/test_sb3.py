"""Agents of Stable-Baselines3 are trained once each, a seed of everything at a time, and compared by seed."""

import json
import sys
from importlib.resources import files

import pytest

from experiments import claims, sb3
from scb.seeds import REPORTING

PEER = """import json, sys
if sys.argv[1] == "versions":
    print(json.dumps({{"stable_baselines3": "1", "torch": "2"}}))
    raise SystemExit
job = json.loads(sys.argv[1])
with open({log!r}, "a") as log:
    log.write(json.dumps([job["train_in"], job["algorithm"], job["seed"]]) + "\\n")
if {fails}:
    raise SystemExit("no such thing")
better = 100.0 if job["train_in"].startswith("scb/") else 0.0
returns = [better + n / 1000 + job["seed"] % 10 / 10 for n in job["steps"]]
print("what a library prints")
print(json.dumps({{"returns": returns, "seconds": [1.0] * len(returns)}}))
"""


@pytest.fixture
def peer(tmp_path, monkeypatch):
    """(jobs that were done, a switch to a peer that fails)."""
    log = tmp_path / "log"
    script = tmp_path / "peer.py"

    def write(fails=False):
        script.write_text(PEER.format(log=str(log), fails=fails))

    write()
    monkeypatch.setattr(sb3, "PEER_SCRIPT", script)
    return lambda: [tuple(json.loads(x)) for x in log.read_text().splitlines()], write


def flags(tmp_path, seeds=2, algorithms=("ppo", "td3")):
    found = ["--python", sys.executable, "--seeds", str(seeds)]
    found += ["--environments", "Pendulum-v1", "--algorithms", *algorithms]
    return [*found, "--out", str(tmp_path / "sb3.json")]


def test_a_seed_of_everything_is_trained_before_the_next_and_nothing_twice(tmp_path, peer):
    done, _ = peer
    assert sb3.EXPERIMENT.main(flags(tmp_path, 1)) == 0
    first = [
        (place, algorithm, REPORTING[0])
        for algorithm in ("ppo", "td3")
        for place in ("scb/Synthetic-Pendulum-v1", "Pendulum-v1")
    ]
    assert done() == first
    assert sb3.EXPERIMENT.main(flags(tmp_path, 2)) == 0
    assert done() == first + [(*job[:2], REPORTING[1]) for job in first]
    page = (tmp_path / "sb3.md").read_text()
    assert "| Pendulum-v1, PPO, in the bandit | 110 | 120 |" in page
    assert "| Pendulum-v1, TD3, in itself | 10 |  |" in page
    assert (tmp_path / "figures" / "sb3.png").exists()


def test_what_was_trained_is_kept_when_an_agent_cannot_be(tmp_path, peer, capfd):
    _, write = peer
    assert sb3.EXPERIMENT.main(flags(tmp_path, 1)) == 0
    before = json.loads((tmp_path / "sb3.json").read_text())["agents"]
    write(fails=True)
    assert sb3.EXPERIMENT.main(flags(tmp_path, 2)) == 2
    assert "an agent could not be trained" in capfd.readouterr().err
    assert json.loads((tmp_path / "sb3.json").read_text())["agents"] == before


def test_an_algorithm_is_judged_by_agents_of_the_same_seeds(tmp_path, peer):
    sb3.EXPERIMENT.main(flags(tmp_path, 10))
    report = json.loads((tmp_path / "sb3.json").read_text())
    judged = claims.judge(sb3.claims(report))
    assert [x.outcome for x in judged] == [
        claims.HOLDS
    ] * 3  # PPO after the fewest and the most steps, TD3
    assert all(x.estimate.value == pytest.approx(100.0, abs=0.1) for x in judged)
    page = sb3.EXPERIMENT.page(report)
    assert "itself in 2 of 2 pairs" in page and "and less in 0.**" in page
    del report["agents"]["Pendulum-v1"]["ppo"]["environment"][str(REPORTING[0])]
    page = sb3.EXPERIMENT.page(report)
    assert "itself in 1 of 1 pairs" in page
    assert "Of others there are fewer than 10" in page
    (ppo, *_) = claims.judge(sb3.claims(report))
    assert ppo.estimate.n == 9 and ppo.outcome == claims.UNDECIDED
    report["agents"]["Pendulum-v1"]["ppo"]["environment"] = {}
    assert claims.judge(sb3.claims(report))[0].outcome == claims.UNTESTED


def test_a_bandit_of_ones_own_is_trained_in_alone_and_has_a_report_of_its_own(
    tmp_path, peer, capsys
):
    done, _ = peer
    name, own = "Synthetic-Pendulum-v1", tmp_path / "mine.npz"
    zoo = files("scb") / "zoo"
    for end in (".npz", ".json"):
        own.with_suffix(end).write_bytes((zoo / (name + end)).read_bytes())
    given = [*flags(tmp_path, 1), "--bandit", str(own), "--longest", "20000"]
    assert sb3.EXPERIMENT.main(given) == 0
    assert done() == [(str(own), algorithm, REPORTING[0]) for algorithm in ("ppo", "td3")]
    assert json.loads((tmp_path / "sb3.json").read_text())["steps"]["ppo"] == [10_000, 20_000]
    page = (tmp_path / "sb3.md").read_text()
    assert "the bandit is of another file" in page and "PPO, in itself" not in page
    assert sb3.EXPERIMENT.main(flags(tmp_path, 1)) == 2
    assert "the report holds what was measured with" in capsys.readouterr().err
    given[given.index("Pendulum-v1")] = "CartPole-v1"
    given[given.index(str(tmp_path / "sb3.json"))] = str(tmp_path / "other.json")
    assert sb3.EXPERIMENT.main(given) == 2
    assert "take the bandit of that environment" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--python", "no/python"], "run `make sb3`"),
        (["--algorithms", "trpo"], "algorithm"),
        (["--environments", "Ant-v5"], "environment"),
        (["--environments", "Pendulum-v1", "--algorithms", "dqn"], "none allows what is asked for"),
        (["--longest", "9999"], "longest is 9999: it must be at least 10000"),
        (
            ["--bandit", "b.npz", "--environments", "Pendulum-v1", "CartPole-v1"],
            "there are 2: name",
        ),
        (["--bandit", "b.npz"], "b.npz"),
    ],
)
def test_what_cannot_be_trained_is_refused(tmp_path, peer, capsys, change, message):
    assert sb3.EXPERIMENT.main([*flags(tmp_path), *change]) == 2
    assert message in capsys.readouterr().err
