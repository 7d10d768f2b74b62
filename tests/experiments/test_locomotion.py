"""Locomotion is measured a few agents at a time, goes on where it was, and decides nothing by few agents."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments import claims, locomotion_claims, locomotion_rates
from experiments import locomotion as module
from lpo import figures, full_size
from lpo.comparison import Comparison
from lpo.objectives import CLIPS
from scb.agents.ppo import DIAGNOSIS
from scb.errors import UserError
from scb.seeds import REPORTING, VALIDATING
from scb.statistics import iqm, paired_difference
from tests.experiments.hoppers import STEPS, curves, report


@pytest.fixture
def compared(monkeypatch):
    """Trainings that were asked for; each earns what its objective's name says, and they stop after `limit`."""
    asked = []

    def compare(environment, objectives, seeds, spec, diagnose, rows, tell):
        if len(asked) == compared_limit[0]:
            raise ConnectionError
        (objective,) = objectives
        asked.append((environment, objective.name, tuple(seeds)))
        return Comparison(
            [curves(objective.name, seeds, 500.0 if objective.name == "dpo" else 9.0)]
        )

    compared_limit = [100]
    monkeypatch.setattr(module, "compare", compare)
    return asked, compared_limit


@pytest.fixture
def trained_at(compared, monkeypatch):
    """The learning rates of those trainings."""
    rates, stub = [], module.compare

    def compare(environment, objectives, seeds, spec, *others, **named):
        rates.append(spec.hyperparameters.learning_rate)
        return stub(environment, objectives, seeds, spec, *others, **named)

    monkeypatch.setattr(module, "compare", compare)
    return rates


FLAGS = ["--objectives", "ppo", "dpo", "--seeds", "4"]


def test_an_interrupted_measurement_goes_on_where_it_was(tmp_path, compared):
    asked, limit = compared
    out = tmp_path / "report.json"
    limit[0] = 3
    with pytest.raises(ConnectionError):
        module.EXPERIMENT.main([*FLAGS, "--out", str(out)])
    limit[0] = 100
    assert module.EXPERIMENT.main([*FLAGS, "--out", str(out)]) == 0
    first, second = (tuple(REPORTING[i : i + 2]) for i in (0, 2))
    assert asked == [("hopper", x, seeds) for seeds in (first, second) for x in ("ppo", "dpo")]
    agents = json.loads(out.read_text())["environments"]["hopper"]["agents"]
    agent = agents["dpo"][str(first[0])]
    assert agent["returns"] == "0 50 500" and (agent["length"], agent["speed"]) == (1000, 5)
    assert agent["kl"] == "0 5 50" and agent["outside"] == "0 2.5 25"
    page = (tmp_path / "locomotion.md").read_text()
    assert (
        "| dpo | 4 | 502 [500, 503] | 502 [500, 503] |" in page
        and "fewer than 10 agents decide nothing" in page
    )


def test_a_clip_is_chosen_on_seeds_that_report_nothing_and_compared(
    tmp_path, compared, monkeypatch
):
    asked, limit = compared
    made = module.compare

    def best_at_half(environment, objectives, seeds, *rest, **further):
        (of,) = made(environment, objectives, seeds, *rest, **further).curves
        return Comparison(
            [replace(of, returns=of.returns + 50 * (objectives[0].name == "ppo-0.5"))]
        )

    monkeypatch.setattr(module, "compare", best_at_half)
    flags = ["--objectives", "ppo", "--seeds", "2", "--tuning-agents", "3"]
    out = tmp_path / "report.json"
    limit[0] = 9
    with pytest.raises(ConnectionError):
        module.EXPERIMENT.main([*flags, "--out", str(out)])
    assert locomotion_rates.swept(json.loads(out.read_text())["environments"]["hopper"]) == {}
    limit[0] = 100
    assert module.EXPERIMENT.main([*flags, "--out", str(out)]) == 0
    judged = tuple(REPORTING[:2])
    sweeps, rest = asked[:10], asked[10:]
    assert {clip for _, clip, _ in sweeps} == set(module.CLIPS)
    assert {seeds for *_, seeds in sweeps} == {tuple(VALIDATING[:2]), tuple(VALIDATING[2:3])}
    assert rest == [("hopper", clip, judged) for clip in ("ppo", "ppo-0.5")]
    page = (tmp_path / "locomotion.md").read_text()
    assert "| ppo-0.5 | 2 |" in page and "ppo-0.5 earned most. So few" in page


def test_further_objectives_are_trained_on_seeds_that_report_nothing(tmp_path, compared):
    asked, _ = compared
    flags = ["--objectives", "ppo", "--seeds", "1", "--tuning-agents", "1", "--out"]
    further = ["--validated", "none", "dpo-4-1.2"]
    out = tmp_path / "report.json"
    assert module.EXPERIMENT.main([*flags, str(out), *further]) == 0
    validating = [(name, seeds) for _, name, seeds in asked if seeds == (VALIDATING[0],)]
    assert {name for name, _ in validating} == {*module.CLIPS, "none", "dpo-4-1.2"}
    entry = json.loads(out.read_text())["environments"]["hopper"]
    assert set(locomotion_rates.swept(entry)) == set(module.CLIPS)
    assert "dpo-4-1.2" not in (tmp_path / "locomotion.md").read_text()
    with pytest.raises(UserError, match=r"validated is .*give tuning_agents"):
        module.Options(validated=("none",))


def test_what_was_kept_is_read_as_it_was(tmp_path):
    made = curves("ppo", range(3))
    entry = {"backend": "generalized", "steps": STEPS, "episodes": 20}
    (read,) = full_size.as_comparison(
        "hopper", {**entry, "agents": {"ppo": module.kept(made)}}
    ).curves
    np.testing.assert_array_equal(read.returns, made.returns)
    np.testing.assert_array_equal(read.speeds[:, -1], made.speeds[:, -1])
    np.testing.assert_array_equal(read.lengths[:, -1], made.lengths[:, -1])
    assert read.seeds == made.seeds and read.backend == made.backend
    for name in DIAGNOSIS:
        np.testing.assert_allclose(read.diagnosis[name], made.diagnosis[name], rtol=1e-3)


def test_agents_that_were_not_diagnosed_have_no_numbers_for_it():
    kept = module.kept(replace(curves("ppo", range(3)), diagnosis=None))
    entry = {"backend": "generalized", "steps": STEPS, "episodes": 20, "agents": {"ppo": kept}}
    (read,) = full_size.as_comparison("hopper", entry).curves
    assert all(np.isnan(read.diagnosis[name]).all() for name in DIAGNOSIS)


def test_ten_agents_decide_and_fewer_do_not():
    judged = claims.judge(locomotion_claims.claims(report(10)))
    assert [x.outcome for x in judged] == [
        *(claims.HOLDS, claims.HOLDS, claims.UNDECIDED, claims.HOLDS),
        *(claims.FAILS, claims.FAILS, claims.UNDECIDED, claims.FAILS),
    ]
    assert "lpo-pendulum ends no lower than PPO" in judged[4].claim.text
    assert {x.outcome for x in claims.judge(locomotion_claims.claims(report(9)))} == {
        claims.UNDECIDED
    }


def test_the_page_has_a_row_of_differences_an_objective():
    page = module.EXPERIMENT.page(report(10))
    whole = "+100 [100, 100]"
    assert (
        f"| hopper: dpo | 10 | **{whole}** | **{whole}** | +0 [0, 0] | **+50 [50, 50]** |" in page
    )
    not_so = "−50 [−50, −50] not so"
    assert (
        f"| hopper: lpo-pendulum | 10 | {not_so} | {not_so} | +0 [0, 0] | −25 [−25, −25] not so |"
        in page
    )
    assert "(hopper: −5 and −5). The others are undecided, or not so where that is said." in page


def test_the_reference_is_ppo_wherever_it_stands():
    made, other = report(10), report(10)
    agents = other["environments"]["hopper"]["agents"]
    other["environments"]["hopper"]["agents"] = dict(reversed(agents.items()))
    texts = [
        {x.claim.text: x.outcome for x in claims.judge(locomotion_claims.claims(r))}
        for r in (made, other)
    ]
    assert texts[0] == texts[1] and not any(": ppo " in text for text in texts[0])


def test_all_are_compared_with_ppo_though_it_is_not_named(tmp_path, compared):
    flags = ["--objectives", "dpo", "lpo-multi", "--seeds", "1", "--out", str(tmp_path / "r.json")]
    module.EXPERIMENT.main(flags)
    assert [name for _, name, _ in compared[0]] == ["ppo", "dpo", "lpo-multi"]


def test_only_agents_of_the_same_seeds_are_compared():
    made = report(10)
    agents = made["environments"]["hopper"]["agents"]
    agents["dpo"] = module.kept(curves("dpo", range(100, 104)))
    judged = claims.judge(locomotion_claims.claims(made))
    assert [x.outcome for x in judged[:3]] == [claims.UNTESTED] * 3


def test_leads_along_the_training_are_corrected_for_all_points(tmp_path):
    seeds = REPORTING[:12]
    ppo, far, near = (curves(x, seeds) for x in ("ppo", "far", "near"))
    jitter = np.random.default_rng(0).normal(0.0, 5.0, (2, 12))
    far.returns[:, 1] += 40.0 + jitter[0]
    far.returns[:, 2] -= 40.0 + jitter[1]
    near.returns[:, 1] += jitter[0]
    number, sides = locomotion_claims.leading([ppo, far, near])
    assert number == 2 * 2  # the untrained agents are the same
    assert sides == {"ahead": {"far": [50]}, "behind": {"far": [100]}}
    figure = figures.leads([ppo, far, near])
    assert [axes.get_title(loc="left") for axes in figure.axes] == [
        "far\n12 pairs",
        "near\n12 pairs",
    ]
    drawn = figure.axes[0].lines[0].get_ydata()
    ours, theirs = far.paired(ppo, "returns")
    np.testing.assert_allclose(drawn, iqm(ours, axis=0) - iqm(theirs, axis=0))
    with pytest.raises(UserError, match="nothing shares a seed with ppo"):
        figures.leads([ppo, curves("other", REPORTING[12:14])])


def test_the_width_of_a_policy_is_read_off_its_entropy():
    # At the end (50 + seed) / 50 nats more than three joints of deviation 1 have.
    last = module.width(curves("ppo", range(10), 50.0))
    assert last == pytest.approx(np.exp(np.mean(50 + np.arange(10)) / 50 / 3), rel=1e-3)


def test_objectives_are_trained_at_other_rates_by_agents_that_report_nothing(
    tmp_path, compared, trained_at
):
    asked, _ = compared
    out = tmp_path / "report.json"
    flags = [*FLAGS, "--tuning-agents=2", "--rates", "0.001", f"--out={out}"]
    assert module.EXPERIMENT.main(flags) == 0
    seeds = tuple(VALIDATING[:2])
    clips = [(name, seeds) for name in CLIPS]
    assert [x[1:] for x in asked[: len(clips) + 2]] == [*clips, ("ppo", seeds), ("dpo", seeds)]
    assert trained_at[len(clips) : len(clips) + 3] == [0.001, 0.001, 0.00025]
    entry = json.loads(out.read_text())["environments"]["hopper"]
    assert entry["rates"]["0.001"].keys() == {"ppo", "dpo"} and "ppo" in entry["sweep"]
    assert {*entry["agents"]["ppo"]}.isdisjoint(map(str, seeds))
    rates = locomotion_rates.at_rates("hopper", entry)
    assert [*rates] == ["0.00025", "0.001"] and [*rates["0.001"]] == ["ppo", "dpo"]
    area, late, agents = rates["0.001"]["dpo"]
    assert (area, late, agents) == (275.25, 500.5, 2)
    page = module.EXPERIMENT.page(json.loads(out.read_text()))
    assert "| 0.001 | 30, 10 | 275, 500 |" in page and "| 0.00025 | 30, 10 |  |" in page
    assert "2 or more of each, which do not decide it" in page
    before = len(asked)
    assert module.EXPERIMENT.main(flags) == 0 and len(asked) == before
    assert module.EXPERIMENT.main([*flags, "--rates", "0.002", "-1"]) == 2 and len(asked) == before


def test_enough_pairs_at_another_rate_are_told_with_their_intervals():
    made = report(10)
    entry = made["environments"]["hopper"]
    entry["sweep"] = {name: entry["agents"][name] for name in CLIPS if name in entry["agents"]}
    few = {name: dict(list(of_it.items())[:9]) for name, of_it in entry["agents"].items()}
    entry["rates"] = {"0.001": entry["agents"], "0.002": few}
    ((rate, name, pairs, area, late), (_, other, *_)) = locomotion_rates.leads_at_rates(
        "hopper", entry
    )
    assert (rate, name, pairs, other) == ("0.001", "dpo", 10, "lpo-pendulum")
    ours, theirs = (full_size.as_comparison("hopper", entry).by_name[x] for x in ("dpo", "ppo"))
    assert area == paired_difference(ours.area, theirs.area)
    assert late == paired_difference(ours.late, theirs.late)
    page = module.EXPERIMENT.page(made)
    assert "| dpo at 0.001 | 10 | " in page and "dpo at 0.002" not in page
    # Beside PPO whose rate falls stand the others with a rate that does not, and PPO itself.
    falling = {"ppo": {s: x | {"returns": "0 50 160"} for s, x in entry["agents"]["ppo"].items()}}
    entry["rates"] = {"0.001": entry["agents"], "0.001, annealed": falling}
    leads = {
        (rate, name): area.value
        for rate, name, _, area, _ in locomotion_rates.leads_at_rates("hopper", entry)
    }
    beside = "0.001 beside PPO at 0.001, annealed"
    assert leads == pytest.approx(
        {
            ("0.001", "dpo"): 50.0,
            ("0.001", "lpo-pendulum"): -25.0,
            (beside, "ppo"): (104.5 - 160) / 2,
            (beside, "dpo"): (204.5 - 160) / 2,
            (beside, "lpo-pendulum"): (54.5 - 160) / 2,
        }
    )
    assert f"| dpo at {beside} | 10 | " in module.EXPERIMENT.page(made)
    assert (
        "locomotion_elsewhere.md" not in page
        and "locomotion_elsewhere" not in module.EXPERIMENT.pages(made)
    )


def test_agents_that_report_at_another_rate_stand_apart(tmp_path, trained_at):
    out = tmp_path / "report.json"
    assert module.EXPERIMENT.main([*FLAGS, f"--out={out}"]) == 0
    assert module.EXPERIMENT.main([*FLAGS, "--learning-rate", "0.0005", f"--out={out}"]) == 0
    assert trained_at == [0.00025] * 4 + [0.0005] * 4
    # The environment's own rate is no other.
    assert module.EXPERIMENT.main([*FLAGS, "--learning-rate", "0.00025", f"--out={out}"]) == 0
    assert len(trained_at) == 8
    made = json.loads(out.read_text())
    entries = made["environments"]
    assert [*entries] == ["hopper", "hopper at 0.0005"]
    assert entries["hopper at 0.0005"]["hyperparameters"] == {"learning_rate": 0.0005}
    whole, other = module.facts(made)["comparisons"].values()
    assert {c.environment for c in (*whole.curves, *other.curves)} == {"hopper"}
    assert other.curves[0].hyperparameters == {"learning_rate": 0.0005}
    assert {"locomotion_hopper", "locomotion_hopper_at_0.0005"} <= module.draw(made).keys()
    page = module.EXPERIMENT.page(made)
    assert "*Hopper at 0.0005* is hopper with a learning rate of 0.0005." in page
    assert "[On hopper at 0.0005](locomotion_elsewhere.md); [what an iteration does" in page
    assert "(figures/locomotion_hopper_at_0.0005.png)" not in page
    pages = module.EXPERIMENT.pages(made)
    assert pages.keys() == {"locomotion", "locomotion_elsewhere", "locomotion_updates"}
    assert pages["locomotion_updates"].count("_updates.png)") == 2
    assert "**On hopper at 0.0005 nothing is shown.**" in pages["locomotion_elsewhere"]
    assert "(figures/locomotion_hopper_at_0.0005.png)" in pages["locomotion_elsewhere"]
    assert "--environments hopper`" in page and "`--learning-rate` for those" in page


def test_agents_at_another_rate_stand_beside_the_clip_at_the_papers():
    made = report(10)
    usual = made["environments"]["hopper"]
    # Of the same seeds as PPO's there, and of too few others.
    agents = {"ppo": usual["agents"]["dpo"], "dpo": module.kept(curves("dpo", range(100, 104)))}
    other = {"environment": "hopper", "hyperparameters": {"learning_rate": 0.001}}
    made["environments"]["hopper at 0.001"] = {**usual, **other, "agents": agents}
    ((name, objective, apart),) = module.facts(made)["beside_papers"]
    assert (name, objective, apart["final"].n) == ("hopper at 0.001", "ppo", 10)
    assert {of: round(x.value) for of, x in apart.items()} == {
        "final": 100,
        "late": 100,
        "area": 50,
    }
    row = "| hopper at 0.001: ppo | 10 | +100 [100, 100] | +100 [100, 100] | +50 [50, 50] |"
    assert row in module.EXPERIMENT.page(made)
    assert "at the paper's learning rate" not in module.EXPERIMENT.page(report(10))


def test_agents_whose_learning_rate_falls_to_zero_stand_apart(tmp_path, compared, monkeypatch):
    settings, stub = [], module.compare

    def compare(environment, objectives, seeds, spec, *others, **named):
        settings.append(
            (spec.hyperparameters.learning_rate, spec.config.anneal_learning_rate, seeds[0])
        )
        return stub(environment, objectives, seeds, spec, *others, **named)

    monkeypatch.setattr(module, "compare", compare)
    out = tmp_path / "report.json"
    flags = ["--objectives", "ppo", "dpo", "--seeds", "2", f"--out={out}"]
    assert module.EXPERIMENT.main(flags) == 0
    at_rate = [*flags, "--learning-rate", "0.001", "--annealed"]
    assert module.EXPERIMENT.main(at_rate) == 0
    first = REPORTING[0]
    assert settings == [(0.00025, False, first)] * 2 + [(0.001, True, first)] * 2
    # Of those that report nothing the rates fall, and of those that report there is no other.
    settings.clear()
    swept = [*flags, "--tuning-agents", "1", "--rates", "0.001", "0.0005", "--annealed"]
    assert module.EXPERIMENT.main(swept) == 0
    assert [x for x in settings if x[1]] == [
        (rate, True, VALIDATING[0]) for rate in (0.001, 0.001, 0.0005, 0.0005)
    ]
    assert all(seed == VALIDATING[0] for rate, _, seed in settings)
    entries = json.loads(out.read_text())["environments"]
    assert [*entries] == ["hopper", "hopper at 0.001, annealed"]
    assert entries["hopper at 0.001, annealed"]["hyperparameters"] == {
        "learning_rate": 0.001,
        "anneal_learning_rate": True,
    }
    assert [*locomotion_rates.at_rates("hopper", entries["hopper"])] == [
        "0.00025",
        "0.0005, annealed",
        "0.001, annealed",
    ]
    page = module.EXPERIMENT.page(json.loads(out.read_text()))
    assert (
        "*Hopper at 0.001, annealed* is hopper with a learning rate that falls linearly from 0.001 to zero."
        in page
    )
    assert "| 0.001, annealed |" in page
    with pytest.raises(UserError, match=r"annealed is .*give learning_rate or rates"):
        module.Options(annealed=True)


def test_the_shipped_curves_are_of_the_full_size_and_stand_beside_shorter_trainings():
    whole = full_size.full_size("hopper")
    # The paper's 5.24 million.
    assert whole.curves[0].objective == "ppo" and whole.curves[0].steps[-1] == 5 * 2**20
    short = Comparison([curves("ppo", range(2))])
    assert full_size.longer(short) is not None
    assert full_size.longer(Comparison([curves("ppo", range(2), steps=[0, 1, 2**30])])) is None
    assert full_size.full_size("Pendulum-v1") is None


def test_an_environment_of_which_only_clips_were_compared_so_far_is_left_out():
    begun = {"environments": {"walker2d": {"backend": "generalized", "sweep": {}}}}
    assert full_size.looked_at(begun) == {}


def test_the_file_is_where_the_library_looks_for_it():
    assert Path(full_size.PATH).samefile(module.EXPERIMENT.out)
