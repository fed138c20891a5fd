"""A run's folder: what is in it, and what is refused."""

import json
import os

import numpy as np
import pandas as pd
import pytest

import marl.session
from marl.learner import make_learner
from marl.mission import Known, make_mission
from marl.seeds import over_seeds, run_seeds
from marl.session import RECORDED, Session, _world
from marl.settings import LearnerSettings, RunSettings
from radiotwin.errors import BadInput
from radiotwin.maps.radiomap import RadioMap
from radiotwin.maps.survey import read_truth, segmented_truth
from radiotwin.scene import Scene
from radiotwin.scene.folder import published_scene
from radiotwin.twin import Twin

WORLD = {"city": "a", "scene.toml": "b", "truth": "c", "truth besides gain_db": "e"}


@pytest.fixture
def session(tmp_path):
    def make(resume):
        return Session(RunSettings(), LearnerSettings(), tmp_path / "run", resume)
    return make


@pytest.fixture
def begun(session):
    session(False)._claim_folder(WORLD)
    return session(True)


def test_a_run_is_resumed_in_its_own_folder_only(begun, session):
    begun._claim_folder(WORLD)
    with pytest.raises(BadInput, match="not an empty folder"):
        session(False)._claim_folder(WORLD)
    with pytest.raises(BadInput, match="truth has changed"):
        begun._claim_folder(WORLD | {"truth": "d"})


@pytest.mark.parametrize("change", [lambda truth: truth.assign(sigma_db=3 * truth["sigma_db"]), lambda truth: truth.assign(los=~truth["los"]),
                                    lambda truth: truth.drop_vars("sigma_db"), lambda truth: truth.assign_coords(x=truth["x"] + 1),
                                    lambda truth: truth.assign_attrs(shadowing_share=0.5)])
def test_a_truth_that_differs_besides_its_gains_is_another(session, small_scene, change):
    truth = segmented_truth(small_scene)
    session(False)._claim_folder(_world(small_scene, truth))
    session(True)._claim_folder(_world(small_scene, segmented_truth(small_scene)))
    with pytest.raises(BadInput, match="the truth besides gain_db has changed since the run in .* was started; put it back"):
        session(True)._claim_folder(_world(small_scene, RadioMap(change(truth.dataset))))


def test_a_truth_is_the_same_from_its_file(small_scene, tmp_path):
    truth = segmented_truth(small_scene)
    truth.save(tmp_path / "truth.nc")
    assert _world(small_scene, truth) == _world(small_scene, RadioMap.load(tmp_path / "truth.nc"))


@pytest.mark.parametrize("name", ["rbm", "rdm"])
def test_recorded_figures_are_of_the_published_truths(name):
    scene = Scene.load(published_scene(name))
    assert _world(scene, read_truth(scene, "traced"))["truth"] in RECORDED


def test_a_folder_that_a_killed_run_only_began_is_empty(session, tmp_path):
    (tmp_path / "run" / ".radiotwin-abcdefgh").mkdir(parents=True)
    (tmp_path / "run" / ".radiotwin-abcdefgh" / "config.json").write_text("")
    session(False)._claim_folder(WORLD)
    assert [each.name for each in (tmp_path / "run").iterdir()] == ["config.json"]


@pytest.mark.parametrize("config", ["[]", "{", "null", '{"run": []}', '{"run": 1, "learner": 2, "world": 3}', "[" * 10**5])
def test_a_configuration_that_is_none_is_nothing_to_resume(config, begun, tmp_path):
    (tmp_path / "run" / "config.json").write_text(config)
    with pytest.raises(BadInput, match="nothing to resume"):
        begun._claim_folder(WORLD)


@pytest.mark.parametrize("name", ["compare", "tensorboard/x", "metrics.csv"])
@pytest.mark.parametrize("kind", ["link", "pipe"])
def test_links_and_pipes_in_a_run_are_refused(name, kind, begun, tmp_path):
    path = tmp_path / "run" / name
    path.parent.mkdir(exist_ok=True)
    (tmp_path / "outside").mkdir()
    if kind == "link":
        path.symlink_to(tmp_path / "outside")
    else:
        os.mkfifo(path)
    with pytest.raises(BadInput, match="link" if kind == "link" else "pipe"):
        begun._claim_folder(WORLD)


def test_a_value_that_differs_is_named(begun, tmp_path):
    path = tmp_path / "run" / "config.json"
    config = json.loads(path.read_text())
    config["learner"]["batch"] = ["x" * 10_000]
    path.write_text(json.dumps(config))
    with pytest.raises(BadInput, match="--batch 32") as error:
        begun._claim_folder(WORLD)
    assert len(str(error.value)) < 600


def test_planners_beside_a_learner_plan_in_its_twin(small_scene, tmp_path, monkeypatch):
    """And are judged in the truth, which they have not seen."""
    planned_in = []

    def spied(run, learner, mission, rounds, *more):
        made = make_learner(run, learner, mission, rounds, *more)
        prepare = made.prepare
        monkeypatch.setattr(made, "prepare", lambda mission, *rest: planned_in.append((run.algorithm, mission)) or prepare(
            mission, *rest))
        return made

    monkeypatch.setattr(marl.session, "make_learner", spied)
    run = RunSettings(scene=small_scene.folder, truth="segmented", twin="log-distance", algorithm="greedy", real_episodes=1,
                      episodes=4, planner_iterations=50, flights=2)
    Session(run, LearnerSettings(), tmp_path / "run", False).execute()
    twin = Twin.load(tmp_path / "run" / "twin")
    known = Known.of(twin.devices)
    in_twin = make_mission(small_scene, twin.radio_map(small_scene), known, run.assignment).snr_db
    in_truth = make_mission(small_scene, segmented_truth(small_scene), known, run.assignment).snr_db
    assert [name for name, _ in planned_in] == ["planner", "heuristic", "random", "planner"]
    *planned_in, (_, of_the_clairvoyant) = planned_in
    np.testing.assert_array_equal(of_the_clairvoyant.snr_db, in_truth)
    for _, mission in planned_in:
        np.testing.assert_allclose(mission.snr_db, in_twin, atol=1e-3)
        assert np.abs(mission.snr_db - in_truth).max() > 1


def test_seeds_have_folders_of_their_own_and_a_band(small_scene, tmp_path, capsys):
    run = RunSettings(scene=small_scene.folder, truth="segmented", twin="truth", algorithm="greedy", real_episodes=1, flights=2,
                      planner_iterations=50, seed=4)
    run_seeds(run, LearnerSettings(), tmp_path / "run", False, 3)
    assert sorted(path.name for path in (tmp_path / "run").iterdir()) == ["curve.png", "seed-4", "seed-5", "seed-6", "seeds.csv"]
    table = pd.read_csv(tmp_path / "run" / "seeds.csv").set_index("method")
    ratios = [pd.read_csv(tmp_path / "run" / f"seed-{seed}" / "comparison.csv").set_index("method")["truth_ratio"]["greedy"]
              for seed in (4, 5, 6)]
    row = table.loc["greedy"]
    assert row["truth_ratio"] == pytest.approx(np.mean(ratios))  # of three, none is trimmed
    assert min(ratios) - 1e-9 <= row["low"] < row["truth_ratio"] < row["high"] <= max(ratios) + 1e-9
    assert "interquartile mean of 3 seeds" in " ".join(capsys.readouterr().out.split())
    with pytest.raises(BadInput, match="not an empty folder"):
        run_seeds(run, LearnerSettings(), tmp_path / "run", False, 3)
    run_seeds(run, LearnerSettings(), tmp_path / "run", True, 3)
    assert over_seeds(np.array([0.0, 0.5, 0.7, 1.0]))["truth_ratio"] == pytest.approx(0.6)  # the outer quarters do not count
    assert np.isnan(over_seeds(np.array([0.5]))["low"])
