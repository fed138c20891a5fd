"""The real command line, end to end, in a city with a statistical truth (no ray tracing, no LLVM)."""

import json
import sys

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from radiotwin.twin.compare import published_models


@pytest.fixture(scope="module")
def chain(run, tmp_path_factory):
    """Folder in which build-scene, survey, fit, map and compare have run."""
    folder = tmp_path_factory.mktemp("chain")
    for arguments in (
        "build-scene preset:small -o scene",
        "survey scene --truth segmented --flights 4 -o survey/measurements.csv.gz",
        "fit survey/measurements.csv.gz --scene scene -o twin",
        "map twin --scene scene -o twin.nc",
        "compare survey/measurements.csv.gz --scene scene --truth segmented --also twin --also twin.nc -o comparison",
    ):
        result = run(arguments, cwd=folder)
        assert result.returncode == 0, result.stderr
    return folder


def test_the_scene_is_self_contained(chain):
    assert {path.name for path in (chain / "scene").iterdir()} == {"scene.toml", "city.xml", "meshes", "preview.png"}


def test_the_twin_finds_the_devices(chain):
    twin = json.loads((chain / "twin" / "twin.json").read_text())
    true_m = {"d1": (280, 60), "d2": (80, 200), "d3": (160, 120), "d4": (280, 280)}
    found = {d["device"]: (d["x_m"], d["y_m"]) for d in twin["devices"] if d["role"] == "unknown"}
    assert found.keys() == true_m.keys()
    errors_m = [np.hypot(*np.subtract(found[name], true_m[name])) for name in true_m]
    assert np.median(errors_m) < 5 and max(errors_m) < 20


def test_the_map_is_one_that_others_can_read(chain):
    with xr.open_dataset(chain / "twin.nc", engine="h5netcdf") as dataset:
        assert dict(dataset.sizes) == {"device": 7, "z": 2, "y": 16, "x": 16}
        assert np.isfinite(dataset["gain_db"]).all() and (dataset["gain_db"] < 0).all()
        assert dataset.attrs["source"] == "twin:segmented_log_distance"


def test_the_comparison_has_every_model_against_both_judges(chain):
    record = json.loads((chain / "comparison" / "compare.json").read_text())
    scores = pd.DataFrame(record["scores"])
    models = {"log_distance", "segmented_log_distance", "segmented_nn", "kriging",
              *published_models(2.4e9)}
    for against, names in (("held-out flights", models | {"twin"}), ("whole map", models | {"twin", "twin.nc"})):
        part = scores[scores["against"] == against]
        assert set(part["model"]) == names
        assert set(part["links"]) == {"all", "LoS", "NLoS"} and (part["n"] > 0).all()
    rmse = scores.query("links == 'all' and positions == 'estimated'").set_index(["against", "model"])["rmse_db"]
    for against in ("held-out flights", "whole map"):
        assert rmse[against, "segmented_nn"] < 0.5 * rmse[against, "log_distance"]
    assert rmse["whole map", "twin"] == pytest.approx(rmse["whole map", "twin.nc"], abs=1e-4), \
        "a twin's map, written and read again, is the twin"
    for name in ("scores.csv", "locations.csv", "predictions.csv.gz", "scatter.png", "estimates.png", "maps.png"):
        assert (chain / "comparison" / name).stat().st_size > 500


def test_without_torch_the_others_are_compared(chain, run, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.setattr("radiotwin.report.comparison.DEFAULT_MODELS", ("log_distance", "segmented_nn"))
    done = run("compare survey/measurements.csv.gz --scene scene -o without", cwd=chain)
    assert done.returncode == 0 and "segmented_nn is not among the models compared" in done.stderr, done.stderr
    models = {row["model"] for row in json.loads((chain / "without" / "compare.json").read_text())["scores"]}
    assert "log_distance" in models and "segmented_nn" not in models


def test_map_exports_agree(chain, run):
    assert run("map twin --scene scene -o twin.csv", cwd=chain).returncode == 0
    assert run("map twin --scene scene -o twin.png", cwd=chain).returncode == 0
    table = pd.read_csv(chain / "twin.csv")
    with xr.open_dataset(chain / "twin.nc", engine="h5netcdf") as dataset:
        row = table.iloc[1234]
        there = dataset.sel(device=row["device"], x=row["x_m"], y=row["y_m"], z=row["z_m"])
        assert row["gain_db"] == pytest.approx(float(there["gain_db"]), abs=1e-3)
    assert (chain / "twin.png").read_bytes()[:4] == b"\x89PNG"


def test_a_seed_gives_the_same_twin_in_another_process(chain, run_installed):
    assert run_installed("fit survey/measurements.csv.gz --scene scene -o again", cwd=chain).returncode == 0
    for name in ("twin.json", "channel.safetensors"):
        assert (chain / "again" / name).read_bytes() == (chain / "twin" / name).read_bytes()


def test_an_earlier_twin_can_start_the_search(chain, run):
    assert run("fit survey/measurements.csv.gz --scene scene --start twin -o warm", cwd=chain).returncode == 0
    cold, warm = (json.loads((chain / name / "twin.json").read_text())["devices"] for name in ("twin", "warm"))
    for before, after in zip(cold, warm):
        assert np.hypot(before["x_m"] - after["x_m"], before["y_m"] - after["y_m"]) < 5


@pytest.mark.slow
def test_a_twin_by_paths_is_made_and_used_as_any_other(chain, run):
    """Of two devices only: to follow paths takes long."""
    survey = pd.read_csv(chain / "survey" / "measurements.csv.gz")
    devices = pd.read_csv(chain / "survey" / "devices.csv")
    (chain / "few").mkdir()
    devices[devices["device"].isin(["d0", "d2", "d5"])].to_csv(chain / "few" / "devices.csv", index=False)
    survey[survey["device"].isin(["d0", "d2", "d5"])].to_csv(chain / "few" / "measurements.csv", index=False)
    for arguments, says in (
        ("fit few/measurements.csv --scene scene --model paths -o by-paths", "by-paths (paths)"),
        ("map by-paths --scene scene -o by-paths.nc", "3 devices"),
        ("compare few/measurements.csv --scene scene --paths --also by-paths -o few/comparison", "by-paths"),
    ):
        result = run(arguments, cwd=chain)
        assert result.returncode == 0 and says in result.stdout + result.stderr, result.stderr
    with xr.open_dataset(chain / "by-paths.nc", engine="h5netcdf") as dataset:
        assert dataset.attrs["source"] == "twin:paths"
    twin = json.loads((chain / "by-paths" / "twin.json").read_text())
    found = next(device for device in twin["devices"] if device["device"] == "d2")
    assert np.hypot(found["x_m"] - 80, found["y_m"] - 200) < 10
    scores = pd.read_csv(chain / "few" / "comparison" / "scores.csv")
    assert {"segmented_nn", "paths", "by-paths"} <= set(scores["model"])
    located = run("locate few/measurements.csv --twin by-paths --scene scene -o located.csv", cwd=chain)
    assert located.returncode == 0 and "fit --model paths" in located.stdout  # by its law of distance, and says so
