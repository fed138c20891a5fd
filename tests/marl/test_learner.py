"""The registry of learners, and the example of the documentation: a learner of somebody else's."""

import csv
import json
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

from marl.algorithm1 import run_algorithm
from marl.flights import evaluate
from marl.heuristics import HeuristicPolicy
from marl.learner import Learner, make_learner
from marl.qmix import IQL, QNetworks
from marl.session import Session
from marl.settings import (
    LEARNERS,
    LearnerSettings,
    RunSettings,
    learner_class,
    learners,
    settings_of,
)
from radiotwin.maps.survey import segmented_truth
from radiotwin.runtime.plugins import entry_points

DOCS = Path(__file__).parents[2] / "docs" / "marl.md"


@pytest.fixture
def best_of_many():
    """Run the example, and forget the learner afterwards."""
    section = DOCS.read_text(encoding="utf-8").split("### Add a learner")[1]
    code = section.split("```python\n")[1].split("```")[0]
    exec(compile(code, str(DOCS), "exec"), {"__name__": "example"})
    yield
    LEARNERS.pop("best-of-many")


def test_every_registered_learner_is_one():
    for name in LEARNERS:
        assert issubclass(learner_class(name), Learner)
    assert [name for name in LEARNERS if learner_class(name).learns] == ["fedqmix", "qmix", "iql"]
    assert [name for name in LEARNERS if not learner_class(name).uses_map] == ["greedy", "heuristic", "random"]


def test_an_installed_package_adds_a_learner(monkeypatch):
    point = EntryPoint("theirs", "marl.qmix:IQL", "radiotwin.learners")
    monkeypatch.setattr("radiotwin.runtime.plugins.metadata.entry_points", lambda group: [point] * (group == "radiotwin.learners"))
    entry_points.cache_clear()
    try:
        assert settings_of({"algorithm": "theirs"})[0].algorithm == "theirs" and learner_class("theirs") is IQL
        assert list(learners())[-1] == "theirs"
    finally:
        entry_points.cache_clear()


def test_a_learner_may_shape_its_reward(city_mission):
    class Half(QNetworks):
        def reward(self, flights):
            return super().reward(flights) / 2

    flights = evaluate(city_mission, HeuristicPolicy("random", np.random.default_rng(0)), 3, np.random.default_rng(1))
    settings = LearnerSettings(hidden=4, mixing_width=4)
    usual, half = (made(settings, city_mission, 0)._batch(flights, city_mission).reward for made in (QNetworks, Half))
    assert usual.sum() * settings.reward_scale == pytest.approx(flights.collected.sum(), rel=1e-4)
    np.testing.assert_allclose(half, usual / 2)


def test_a_new_learner_runs_like_the_others(small_scene, tmp_path, best_of_many, capsys):
    given = {"scene": str(small_scene.folder), "truth": "segmented", "twin": "log-distance",
             "algorithm": "best-of-many", "real_episodes": "2", "episodes": "30", "flights": "4",
             "planner_iterations": "50", "compare": "truth"}
    run, settings = settings_of(given)
    Session(run, settings, tmp_path / "out", resume=False).execute()
    with (tmp_path / "out" / "comparison.csv").open() as file:
        rows = list(csv.DictReader(file))
    # It learns, so that it is compared over maps; in the truth each of its episodes is a real one.
    assert [(row["method"], row["trained_in"], row["real_episodes"]) for row in rows[:3]] == [
        ("best-of-many", "log-distance twin", "2"), ("best-of-many", "NN twin", "2"),
        ("best-of-many", "the truth", "60")]
    [random, clairvoyant] = rows[-2:]
    assert random["method"] == "random" and float(rows[2]["truth_ratio"]) > float(random["truth_ratio"])
    # Of two flights that measured, and of 60 that did not say what they collected.
    missed = 2 * (float(clairvoyant["truth_ratio"]) - float(rows[0]["real_ratio"]))
    assert float(rows[0]["regret"]) == pytest.approx(missed, abs=1e-4) and missed > 0 and rows[2]["regret"] == ""
    assert json.loads((tmp_path / "out" / "config.json").read_text())["run"]["algorithm"] == "best-of-many"
    assert "best-of-many" in capsys.readouterr().out


def test_a_new_learner_resumes(small_scene, tmp_path, best_of_many):
    run = RunSettings(algorithm="best-of-many", twin="log-distance", truth="segmented", real_episodes=2, episodes=20,
                      flights=4)

    def execute(folder, resume, on_round):
        return run_algorithm(run, LearnerSettings(), small_scene, segmented_truth(small_scene), folder, resume,
                             on_round, lambda *_: None)

    def stop(rows, blocks):
        raise KeyboardInterrupt

    unbroken = execute(None, False, lambda *_: None)
    with pytest.raises(KeyboardInterrupt):
        execute(tmp_path, False, stop)
    resumed = execute(tmp_path, True, lambda *_: None)
    np.testing.assert_array_equal(resumed.flights.action, unbroken.flights.action)


def test_a_learner_sees_no_map_before_it_is_prepared(city_mission):
    learner = make_learner(RunSettings(algorithm="random"), LearnerSettings(), city_mission, 1)
    assert np.isneginf(learner.setup.mission.snr_db).all() and np.isfinite(city_mission.snr_db).all()
