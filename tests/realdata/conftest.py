"""Real measurements, where they are: the folder RADIOTWIN_DATA, or shared/data beside the checkout."""

import os
from pathlib import Path

import pytest

from radiotwin.links.measurements import Measurements, read_measurements

DATA = Path(os.environ.get("RADIOTWIN_DATA", Path(__file__).parents[3] / "shared" / "data"))


def pytest_collection_modifyitems(items):
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.realdata)


@pytest.fixture(scope="session")
def folder():
    """Return the folder of a set; skip where it is missing."""
    def of(name: str) -> Path:
        if not (DATA / name).is_dir():
            pytest.skip(f"{DATA / name} is not there: docs/real-data.md says where to get it; name its folder in "
                        "RADIOTWIN_DATA")
        return DATA / name
    return of


@pytest.fixture(scope="session")
def duke(folder) -> Measurements:
    """The campus network."""
    return read_measurements(folder("duke_cbrs") / "measurements.csv.gz")


@pytest.fixture(scope="session")
def powder(folder) -> Measurements:
    """400 of the 5,006 positions of hand-held transmitters."""
    whole = read_measurements(folder("powder_frs") / "measurements.csv.gz")
    devices = whole.devices.sample(400, random_state=0)
    kept = whole.table["device"].isin(devices["device"])
    return Measurements(whole.table[kept].reset_index(drop=True), devices.reset_index(drop=True))
