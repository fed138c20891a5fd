"""A run's folder: what is in it, and what is refused."""

import json
import os

import pytest

from marl.session import Session
from marl.settings import LearnerSettings, RunSettings
from radiotwin.errors import BadInput

WORLD = {"city": "a", "scene.toml": "b", "truth": "c"}


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
