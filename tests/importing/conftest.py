"""Imports of small tables in this process."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from radiotwin.importing import import_files, read_settings
from radiotwin.links.measurements import read_measurements

SAMPLES = Path(__file__).parent / "samples"


@pytest.fixture
def bring_in(tmp_path):
    """Import a text; returns the measurements as every other command reads them, and the report."""
    def bring_in(text: str, name: str = "data.csv", **given):
        path = tmp_path / name
        path.write_text(text) if isinstance(text, str) else path.write_bytes(text)
        settings = read_settings(None, {"level_unit": "dBm"} | given)
        report = import_files(path, settings, tmp_path / "out")
        measurements = read_measurements(tmp_path / "out" / "measurements.csv")
        return SimpleNamespace(report=report, table=measurements.table, devices=measurements.devices,
                               measurements=measurements)
    return bring_in


@pytest.fixture
def local():
    """A mapping of local positions in metres."""
    return {"level": "level", "device": "device", "x": "x", "y": "y"}
