"""What the command line keeps of a run, shows and removes, and what it says after Ctrl-C."""

import json

import numpy as np
import pytest

from radiotwin.maps.survey import fly_survey
from radiotwin.runtime.pieces import PieceStore, pieces_folder


@pytest.fixture
def parts():
    """A store of three parts."""
    store = PieceStore(pieces_folder())
    for name in ("channel-1", "channel-2", "position-1"):
        store.put(name, ({"value": np.zeros(1000)}, None), [])
    return store


def test_it_shows_folder_size_and_kinds(parts, run, tmp_path):
    shown = json.loads(run("cache --json", tmp_path).stdout)["cache"]
    assert shown["folder"] == str(parts.folder) and shown["parts"] == {"channel": 2, "position": 1}
    assert 24_000 < shown["bytes"] < shown["limit_bytes"] == 2 * 2**30
    text = run("cache", tmp_path).stdout
    assert str(parts.folder) in text.replace("\n", "") and "position" in text


def test_it_removes_parts_and_nothing_else(parts, run, tmp_path):
    other = parts.folder / "notes.txt"
    other.write_text("mine")
    assert "removed 3 parts" in run("cache --clear", tmp_path).stdout
    assert not parts.files() and other.read_text() == "mine"
    assert "removed 0 parts" in run("cache --clear", tmp_path).stdout


def test_without_a_cache_it_is_empty(run, own_cache, tmp_path):
    assert json.loads(run("cache --json", tmp_path).stdout)["cache"]["bytes"] == 0
    assert not own_cache.exists()


@pytest.fixture
def flown(small_scene, tmp_path):
    fly_survey(small_scene, "segmented", flights=2, seed=0).save(tmp_path / "m.csv")
    return tmp_path / "m.csv"


def test_the_next_run_says_what_it_took_and_writes_the_same(run, small_scene, flown, tmp_path, own_cache):
    command = f"fit {flown} --scene {small_scene.folder} -o"
    whole = run(f"{command} whole", tmp_path)
    kept = sorted(own_cache.glob("pieces/*.npz"))
    assert whole.returncode == 0 and kept
    again = run(f"{command} again", tmp_path)
    assert f"{len(kept)} of " in again.stderr and "parts were kept from an earlier run" in again.stderr
    for name in ("twin.json", "channel.safetensors"):
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    assert again.stdout.replace("again", "whole") == whole.stdout
