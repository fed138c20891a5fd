"""What is measured of a command is its own."""

import pytest

from radiotwin.errors import RunFailed
from studies.load import run_measured


def test_peak_memory_is_that_of_the_command(tmp_path):
    held = bytearray(b"x" * (300 * 2**20))  # of this process, which it must not count
    small = run_measured(["timeit", "-n", "1", "pass"], tmp_path)
    large = run_measured(["timeit", "-n", "1", "bytearray(b'x' * (100 * 2**20))"], tmp_path)
    assert small["peak_mib"] < 60 < 100 < large["peak_mib"] < 260 < len(held) / 2**20
    assert 0 < small["cpu_s"] and 0 < small["wall_s"] < 60
    with pytest.raises(RunFailed, match="exit status 1"):
        run_measured(["timeit", "no_such_name"], tmp_path)
