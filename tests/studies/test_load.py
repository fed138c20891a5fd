"""What is measured of a command is its own."""

import pytest

from radiotwin.errors import RunFailed
from studies.load import load_cases, load_table, run_measured
from studies.tables import read_frame


def test_peak_memory_is_that_of_the_command(tmp_path):
    held = bytearray(b"x" * (300 * 2**20))  # of this process, which it must not count
    small = run_measured(["timeit", "-n", "1", "pass"], tmp_path)
    large = run_measured(["timeit", "-n", "1", "bytearray(b'x' * (100 * 2**20))"], tmp_path)
    assert small["peak_mib"] < 60 < 100 < large["peak_mib"] < 260 < len(held) / 2**20
    assert 0 < small["cpu_s"] and 0 < small["wall_s"] < 60
    with pytest.raises(RunFailed, match="exit status 1"):
        run_measured(["timeit", "no_such_name"], tmp_path)


def test_costs_are_shown_beside_those_of_the_smallest_size():
    rows = [{"name": name, "seed": 0, "settings": settings, "cpu_s": 1.0, "results": {"commands": {
        "x": {"wall_s": 2.0 * settings["size"], "cpu_s": 1.0, "peak_mib": 100.0 + settings["size"] / 1e4}}}}
        for name, settings in load_cases(0).items()]
    lines = [line.split(" | ") for line in load_table(read_frame(rows)).splitlines()[2:]]
    assert len(lines) == 12 and [line[1] for line in lines[:3]] == ["1,000", "10,000", "50,000"]
    assert [line[4] for line in lines[:3]] == ["1.0", "10.0", "50.0"] and lines[-1][5:] == ["1,100", "10.00 |"]
