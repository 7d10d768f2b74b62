import pytest

from experiments import ablations
from experiments.ablations import LATENTS, NONE, SHAPES, name_of
from experiments.claims import judge
from experiments.searches import ENOUGH

# TI and T, I and TI, two continuous latents and two categorical ones; of MountainCar also T's goal and the curricula.
OF_EACH = 2 + 4
TINY = {
    "algorithms": ["ppo"],
    "evaluation_episodes": 2,
    "mean_evaluations": 2,
    "evaluate_mean_every": 1,
    "more_seeds": {},
    "environments": {
        "MountainCar-v0": {
            "generations": 1,
            "population_size": 2,
            "agents_per_candidate": 1,
            "seeds": 1,
        }
    },
}


def report(seeds=5, **finals):
    """A report in which every search ends as said here, by search, and else at -150."""
    environments = {}
    for environment in ablations.ENVIRONMENTS:
        environments[environment] = {
            search: {
                str(seed): {
                    "generation": [0, 1],
                    "fitness": [-200.0, finals.get(search, -150.0 + seed)],
                    "mean": [-200.0, finals.get(search, -150.0 + seed)],
                    "failed": [0.0, 4.0],
                    "seconds": 60.0,
                }
                for seed in range(seeds)
            }
            for search in ablations.searches_of(environment)
        }
    preset = "quick" if seeds < ENOUGH else "paper"
    return {
        "environments": environments,
        "plan": ablations.EXPERIMENT.presets[preset],
        "machine": {"cores": 2, "accelerator": "none"},
    }


def test_every_search_of_the_papers_rows_is_there_once():
    searches = ablations.searches_of("MountainCar-v0")
    # T, TI, I, IC; three other latents; four other shapes.
    assert len(searches) == len(set(searches)) == 4 + (len(LATENTS) - 1) + (len(SHAPES) - 1)
    assert len(ablations.searches_of("Pendulum-v1")) == 3 + len(LATENTS) - 1


def test_a_search_is_the_papers_recipe_with_one_thing_changed():
    plan = ablations.EXPERIMENT.presets["paper"]
    config = ablations.config_of("MountainCar-v0", name_of("I", "uniform", "step"), 3, plan)
    assert config.bandit.latent == "uniform" and config.curriculum.shape == "step"
    assert (config.curriculum.initial, config.curriculum.final) == (1000, 200)
    assert (config.curriculum.begin, config.curriculum.transition) == (200, 600)
    assert config.init == "random" and config.evolution.seed == 3
    assert (config.evolution.population_size, config.evolution.num_generations) == (128, 1000)
    assert (
        ablations.config_of("Pendulum-v1", name_of("T", "normal", NONE), 0, plan).curriculum is None
    )


def test_of_some_there_may_be_more_searches_than_of_the_rest(monkeypatch):
    monkeypatch.setattr(ablations, "ENVIRONMENTS", ("MountainCar-v0",))
    more = [name_of("TI", "normal", NONE), name_of("I", "normal", "step")]
    plan = {**TINY, "runs": "runs", "more_seeds": {"MountainCar-v0": dict.fromkeys(more, 3)}}
    _, _, names, seeds = zip(*(part.path for part in ablations.parts(plan, {})), strict=True)
    every = ablations.searches_of("MountainCar-v0")
    assert list(zip(seeds, names, strict=True)) == [
        *(("0", x) for x in every),
        *((seed, x) for seed in "12" for x in more),
    ]
    fewer = {**TINY, "runs": "runs"}
    assert [part.path[-1] for part in ablations.parts(fewer, {})] == ["0"] * len(every)


def test_searches_beyond_the_plan_are_not_looked_at():
    search, made = name_of("I", "normal", NONE), report(5)
    of_it = made["environments"]["Acrobot-v1"][search]

    def end():
        return ablations.facts(made)["rows"]["Acrobot-v1"]["what is learned"]["I"]["final"]

    before, claimed = end(), str(judge(ablations.claims(made)))
    of_it["5"] = {**of_it["0"], "fitness": [-200.0, -500.0]}
    assert end() == before and str(judge(ablations.claims(made))) == claimed
    made["plan"] = {**made["plan"], "more_seeds": {"Acrobot-v1": {search: 6}}}
    assert end() != before and str(judge(ablations.claims(made))) != claimed


@pytest.mark.slow
def test_transitions_alone_do_not_reach_the_goal_of_mountain_car(
    tmp_path, monkeypatch, small_agents
):
    monkeypatch.setattr(ablations, "ENVIRONMENTS", ("MountainCar-v0",))
    wanted = [name_of("T", "normal", NONE)]
    monkeypatch.setattr(ablations, "searches_of", lambda environment: wanted)
    found, saved = {}, []
    plan = {**TINY, "runs": str(tmp_path)}
    ablations.measure(plan, found, lambda: saved.append(1))
    curves = found["environments"]["MountainCar-v0"]
    assert list(curves) == wanted and len(saved) == 1
    assert curves[wanted[0]]["0"]["fitness"] == [-200.0, -200.0]
    ablations.measure(plan, found, lambda: saved.append(1))
    assert len(saved) == 1  # what is there is not searched again


@pytest.mark.parametrize("preset", ["quick", "paper"])
def test_presets_cover_all_environments(preset):
    assert set(ablations.EXPERIMENT.presets[preset]["environments"]) == set(ablations.ENVIRONMENTS)


def outcomes(found):
    return [x.outcome for x in ablations.EXPERIMENT.judged(found)]


def test_claims_follow_the_figures():
    of_pendulum = ["holds", "holds"] + ["undecided"] * 4
    # TI beats T everywhere, I is as good as TI, latents are alike; T never reaches the goal; no curriculum helps.
    of_mountain_car = [*of_pendulum, "holds"] + ["undecided"] * len(SHAPES)
    expected = [*of_pendulum, *of_mountain_car, *of_pendulum]
    assert outcomes(report(**{name_of("T", "normal", NONE): -200.0})) == expected
    # Every T failed, which is no less than every search; I is far below TI, and every curriculum above none.
    worse = {name_of("T", "normal", NONE): None, name_of("I", "normal", NONE): -500.0}
    found = outcomes(report(**worse))
    assert found[:2] == ["undecided", "does not hold"]
    assert found[OF_EACH + 7 : -OF_EACH] == ["holds"] * len(SHAPES)
    assert "| T | all failed |" in ablations.EXPERIMENT.block("body", report(**worse))
    categorical = {
        name_of("I", latent, curriculum): -190.0
        for latent in ("categorical", "softmax_categorical")
        for curriculum in (NONE, "linear")
    }
    assert outcomes(report(**categorical))[2:6] == ["holds"] * 4
    # Two searches tell nothing apart.
    assert outcomes(report(seeds=2, **worse)).count("undecided") == 3 * OF_EACH + len(SHAPES)
    said = ablations.EXPERIMENT.block("verdict", report(seeds=2, **worse))
    assert "On Pendulum-v1 there are too few searches to tell anything apart." in said


def test_a_line_says_how_many_of_its_searches_failed():
    search = name_of("TI", "normal", NONE)
    found = report(**{search: -100.0})
    for environment in found["environments"].values():
        environment[search]["3"]["fitness"][-1] = None
    # The four others are better than all of T's, and yet a failure is worse than any return.
    assert outcomes(found)[0] == "undecided"
    said = ablations.EXPERIMENT.block("body", found)
    assert "| TI | −100.0 [−100.0, −100.0] (1 of 5 failed) |" in said
    # And where T's others are better than all of TI's, so is one that failed.
    found = report(**{name_of("T", "normal", NONE): -100.0})
    assert outcomes(found)[0] == "does not hold"
    for environment in found["environments"].values():
        environment[name_of("T", "normal", NONE)]["3"]["fitness"][-1] = None
    assert outcomes(found)[0] == "undecided"


@pytest.mark.parametrize(
    ("environment", "where", "short_of_a_tenth", "a_tenth"),
    [
        # A tenth of the way from -200 to -117.7, and from -497.9 to -76.7.
        ("MountainCar-v0", slice(OF_EACH, -OF_EACH), -191.9, -191.7),
        ("Acrobot-v1", slice(-OF_EACH, None), -456.0, -455.5),
    ],
)
def test_searches_that_all_end_near_random_actions_test_no_claim(
    environment, where, short_of_a_tenth, a_tenth
):
    found = report()
    curves = found["environments"][environment]
    for curve in (c for search in curves.values() for c in search.values()):
        curve["fitness"][-1] = short_of_a_tenth
    said = f"On {environment} no search of so few generations ends a tenth of the way"
    assert said in ablations.EXPERIMENT.block("verdict", found)
    assert set(outcomes(found)[where]) == {"not tested at this size"}
    assert outcomes(found)[:2] == outcomes(report())[:2]
    # One search that does is enough to tell it from the others.
    curves[name_of("TI", "normal", NONE)]["0"]["fitness"][-1] = a_tenth
    assert said not in ablations.EXPERIMENT.block("verdict", found)
    assert "not tested at this size" not in outcomes(found)


def test_the_page_and_the_figure_show_every_search():
    found = report()
    rows = sum(len(x) for e in ablations.ENVIRONMENTS for x in ablations.rows(e).values())
    gpu = {"cores": 16, "accelerator": "NVIDIA H100 80GB HBM3"}
    for curve in found["environments"]["Pendulum-v1"][name_of("T", "normal", NONE)].values():
        curve["machines"] = [gpu]
    body = ablations.EXPERIMENT.block("body", found)
    table = body[: body.index("## How it was measured")]
    assert sum(line.startswith("| ") for line in table.splitlines()) == rows + 2
    assert "| 3% | 60 on 2 cores |" in body  # 4 of 128 candidates failed
    assert body.count("| 60 on H100 |") == 1
    axes = ablations.draw(found).axes
    assert sum(len(a.lines) for a in axes) == rows
