"""A checkpoint of a stranger's: nothing is written where it says, and what it holds fits the mission or is refused."""

import copy

import numpy as np
import pandas as pd
import pytest
import torch

from marl.algorithm1 import Campaign, resume_from, run_algorithm
from marl.checkpoint import Damaged, load_checkpoint, require_log, save_checkpoint
from marl.learner import make_learner
from marl.mission import Known, make_mission
from marl.settings import LearnerSettings, RunSettings
from radiotwin.errors import BadInput
from radiotwin.maps.survey import segmented_truth

RUN = RunSettings(truth="segmented", twin="log-distance", algorithm="qmix", real_episodes=2, episodes=4,
                  planner_iterations=50, flights=2, seed=1)
LEARNER = LearnerSettings(hidden=4, mixing_width=4, batch=2, replay=4, parallel=2, selection_flights=2, federate_every=4)
NAME = "checkpoint.safetensors"


def execute(scene, folder, resume=True):
    return run_algorithm(RUN, LEARNER, scene, segmented_truth(scene), folder, resume, lambda *_: None, lambda *_: None)


@pytest.fixture(scope="module")
def stopped(small_scene, tmp_path_factory):
    """The folder of a run that was killed after its first round."""
    folder = tmp_path_factory.mktemp("run")

    class Killed(Exception):
        pass

    def kill(rows, blocks):
        raise Killed

    with pytest.raises(Killed):
        run_algorithm(RUN, LEARNER, small_scene, segmented_truth(small_scene), folder, False, kill, lambda *_: None)
    return folder


def leaves(value, path=()):
    """Paths of all parts of a state; of a list's only the first."""
    yield path
    if isinstance(value, dict):
        for name, each in value.items():
            yield from leaves(each, (*path, name))
    elif isinstance(value, pd.DataFrame):
        for name in value:
            yield (*path, name)
    elif isinstance(value, list) and value:
        yield from leaves(value[0], (*path, 0))


def at(value, path):
    for name in path:
        value = value[name]
    return value


def changed(state, path, new):
    state = copy.deepcopy(state)
    if not path:
        return new
    at(state, path[:-1])[path[-1]] = new
    return state


def wrong(value):
    """Values of another kind, shape or range than this one."""
    yield from ([], {}, "text", True, -1, 10**30)
    if isinstance(value, np.ndarray | pd.Series):
        array = np.asarray(value)
        yield from (array[:0], np.stack([array, array]))
        if array.dtype != object:
            yield from (np.full_like(array, np.iinfo(array.dtype).min if array.dtype.kind in "iu" else np.nan),
                        np.full_like(array, np.iinfo(array.dtype).max if array.dtype.kind in "iu" else 1e30),
                        array.astype(complex).view(float))
    if isinstance(value, torch.Tensor):
        yield from (torch.full_like(value, torch.nan), value[None], value.double())


def test_every_part_that_is_wrong_is_one_message(small_scene, stopped, tmp_path, monkeypatch):
    """Whatever is accepted must be what this run may have written."""
    state, known = load_checkpoint(stopped / NAME), 0
    truth = segmented_truth(small_scene)
    mission = make_mission(small_scene, truth, Known.anchors(small_scene))
    learner = make_learner(RUN, LEARNER, mission, RUN.real_episodes)
    allowed = {("strategy", "replicas"), ("blocks",), ("tables", 0, "gain_db")}
    for path in leaves(state):
        for new in wrong(at(state, path)) if path else ():
            try:
                content = changed(state, path, new)
            except ValueError:
                continue  # a table of columns of different lengths
            monkeypatch.setattr("marl.algorithm1.load_checkpoint", lambda path, content=content: content)
            number = isinstance(at(state, path), int | float) and isinstance(new, int | float)
            try:
                resume_from(tmp_path / NAME, Campaign(RUN, small_scene, truth), learner)
            except BadInput as error:
                assert "checkpoint" in str(error) and len(str(error)) < 1000
                known += 1
            else:
                assert path in allowed or number, (path, new)
    assert known > 300


def test_no_file_is_written_where_a_checkpoint_says(small_scene, stopped, tmp_path):
    state, outside = load_checkpoint(stopped / NAME), tmp_path / "outside"
    (tmp_path / "run").mkdir()
    for name in (str(outside), "../../outside"):
        state["twin"][name] = np.frombuffer(b"written", np.uint8)
        save_checkpoint(state, tmp_path / "run" / NAME)
        with pytest.raises(BadInput, match="damaged"):
            execute(small_scene, tmp_path / "run")
        del state["twin"][name]
    assert [each.name for each in tmp_path.rglob("*")] == ["run", NAME]


@pytest.mark.parametrize("action", range(1, 6))  # to hover is feasible where a flight ends where it begins
def test_a_plan_that_leaves_the_map_is_refused(small_scene, action):
    """Compiled code would read beyond its arrays."""
    mission = make_mission(small_scene, segmented_truth(small_scene), Known.anchors(small_scene))
    planner = make_learner(RUN.model_copy(update={"algorithm": "planner"}), LEARNER, mission, 1)
    with pytest.raises(Damaged, match="a plan"):
        planner.load_state({"actions": np.full((mission.longest, mission.uavs), action, np.int8)})


def test_what_was_written_is_accepted(small_scene, stopped, tmp_path):
    save_checkpoint(load_checkpoint(stopped / NAME), tmp_path / NAME)
    assert (tmp_path / NAME).read_bytes() == (stopped / NAME).read_bytes()
    assert len(execute(small_scene, tmp_path).rows) == 2
    assert (tmp_path / "twin" / "twin.json").exists()


@pytest.mark.parametrize("name, value, is_one", [
    ("actor/loss", 0.5, True), ("td-error", 1, True), ("converged", True, True), ("loss", float("inf"), True),
    ("", 1.0, False), ("a\nb", 1.0, False), ("x" * 200, 1.0, False), ("loss", "low", False), ("loss", None, False)])
def test_a_learner_of_ones_own_logs_what_it_likes(name, value, is_one):
    block = {"round": 1, "episodes": 4, name: value}
    if is_one:
        assert require_log([block], ("round", "episodes")) == [block]
    else:
        with pytest.raises(Damaged):
            require_log([block], ("round", "episodes"))
