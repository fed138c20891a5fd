"""`radiotwin close-loop` as a user runs it, on a file and nothing else."""

import json
import re

import numpy as np
import pandas as pd
import pytest


def write(folder, offset_db=0.0, seed=0):
    """A survey over open ground of which one receiver reads `offset_db` too much."""
    rng = np.random.default_rng(seed)
    device_m = rng.uniform(0, 400, (4, 2))
    rows = []
    for flight in range(4):
        for receiver in range(2):
            place_m = np.cumsum(rng.normal(0, 12, (40, 2)), axis=0) + 200
            for slot, (x, y) in enumerate(place_m):
                for device, (east, north) in enumerate(device_m):
                    distance_m = np.sqrt((x - east) ** 2 + (y - north) ** 2 + 50**2)
                    gain_db = -38 - 22 * np.log10(distance_m) + rng.normal(0, 2) + offset_db * receiver
                    rows.append((flight * 100 + slot, f"f{flight}", f"r{receiver}", x, y, 51.5, f"d{device}", gain_db))
    names = ["time_s", "flight", "receiver", "receiver_x_m", "receiver_y_m", "receiver_z_m", "device", "gain_db"]
    pd.DataFrame(rows, columns=names).to_csv(folder / "measurements.csv", index=False)
    pd.DataFrame({"device": [f"d{i}" for i in range(4)], "x_m": device_m[:, 0], "y_m": device_m[:, 1], "z_m": 1.5,
                  "role": "anchor"}).to_csv(folder / "devices.csv", index=False)


@pytest.mark.usefixtures("quick_report")
def test_a_file_and_a_table_of_devices_are_enough(run, tmp_path):
    write(tmp_path, offset_db=6.0)
    done = run("close-loop measurements.csv --out result", tmp_path)
    assert done.returncode == 0, done.stderr
    assert "receiver_gain_offset" in done.stdout and "closeloop.html" in done.stdout
    report = json.loads((tmp_path / "result" / "closeloop.json").read_text())
    assert report["schema"] == "radiotwin.closeloop/3" and report["verdict"] == "effect"
    assert report["effects"][0]["name"] == "receiver_gain_offset"
    assert report["error"]["after"]["rmse_db"] < 0.8 * report["error"]["before"]["rmse_db"]
    links = pd.read_csv(tmp_path / "result" / "residuals.csv.gz")
    assert len(links) == report["error"]["before"]["n"] == 1280
    for when in ("before", "after"):
        rmse_db = np.sqrt((links[f"{when}_db"] ** 2).mean())
        assert rmse_db == pytest.approx(report["error"][when]["rmse_db"], abs=1e-3)
    shown = run("report result", tmp_path)
    assert shown.returncode == 0 and "no scene" in shown.stdout, shown.stderr
    whole = (tmp_path / "result" / "report.html").read_text()
    assert "Receiver gain offset" in whole and not re.search(r'<[^>]*(?:src|href)="(?!data:)', whole)
    reasons = {candidate["name"]: candidate["reason"] for candidate in report["candidates"]}
    assert "heading" in reasons["body_shadowing"] and "frequency" in reasons["missing_obstacle"]
    page = (tmp_path / "result" / "closeloop.html").read_text()
    assert page.count("data:image/png;base64,") == 5 and "Receiver gain offset" in page
    assert not re.search(r'(?:src|href)="(?!data:)', page)  # nothing from a network


@pytest.mark.parametrize("arguments, parts", [
    ("--base oracle", ["oracle", "twin, raytrace, log-distance"]),
    ("--base raytrace", ["raytrace", "--scene"]),
    ("--scene nowhere", ["nowhere"])])
def test_bad_input_is_one_message(run, tmp_path, arguments, parts):
    write(tmp_path)
    done = run(f"close-loop measurements.csv --out result {arguments}", tmp_path)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert all(part in done.stderr for part in parts), done.stderr
    assert not (tmp_path / "result").exists()


def test_report_of_nothing_is_bad_input(run, tmp_path):
    for arguments, part in (("report nowhere", "is not a folder"), ("report .", "holds nothing to show")):
        done = run(arguments, tmp_path)
        assert done.returncode == 2 and part in done.stderr and not list(tmp_path.iterdir())
