"""`radiotwin plan`, end to end."""

import json
import shutil

import pandas as pd
import pytest

PLAN = "plan twin --scene scene -o plan --iterations 200 --worlds 20"


@pytest.fixture
def folder(scene_to_map, tmp_path):
    for name in ("scene", "twin"):
        shutil.copytree(scene_to_map / name, tmp_path / name)
    return tmp_path


def test_a_twin_becomes_flights_with_a_promise(run, folder):
    done = run(f"{PLAN} --sizes --wanted 0.5", folder)
    assert done.returncode == 0, done.stderr
    record = json.loads((folder / "plan" / "plan.json").read_text())
    share = record["share"]
    assert record["schema"] == "radiotwin.plan/1" and 0 < share["p10"] <= share["p50"] <= share["p90"] <= 1
    twin = json.loads((folder / "twin" / "twin.json").read_text())
    assert [each["device"] for each in record["devices"]] == [each["device"] for each in twin["devices"]]
    flights = pd.read_csv(folder / "plan" / "flights.csv")
    assert list(flights["uav"].unique()) == [each["uav"] for each in record["flights"]]
    for name in ("plan.png", "sizes.png"):
        assert (folder / "plan" / name).stat().st_size > 5000
    assert "Share collected" in done.stdout and "no [origin]" in done.stdout
    assert {row["uavs"] for row in record["sizes"]} >= {1, 2}
    again = run(f"{PLAN} --sizes --wanted 0.5", folder)
    assert again.returncode == 0 and json.loads((folder / "plan" / "plan.json").read_text()) == record


def test_silent_devices_and_data_lower_and_change_the_promise(run, folder):
    names = [each["device"] for each in json.loads((folder / "twin" / "twin.json").read_text())["devices"]]
    (folder / "data.csv").write_text("device,data_units\n" + "\n".join(f"{name},50000" for name in names))
    shares = []
    for options in ("", "--data data.csv --silent 0.3 --data-spread 0.5"):
        done = run(f"{PLAN} {options}", folder)
        assert done.returncode == 0, done.stderr
        shares.append(json.loads((folder / "plan" / "plan.json").read_text()))
    assert shares[1]["share"]["p50"] < shares[0]["share"]["p50"]
    assert shares[1]["devices"][0]["silent"] == 0.3
