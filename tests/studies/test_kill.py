"""The table of killed runs counts what went wrong."""

from studies.kill import kill_cases, kill_table
from studies.tables import read_frame


def test_what_differed_or_was_left_over_is_counted():
    kill = {"moment_s": 1.0, "killed": True, "orphans": 0, "different": [], "left_over": []}
    kills = [kill, kill | {"different": ["a.csv"]}, kill | {"killed": False, "left_over": ["x", "y"]}, kill | {"orphans": 2}]
    rows = [{"name": name, "seed": seed, "settings": settings, "cpu_s": 1.0,
             "results": {"duration_s": 4.0, "files": 3, "kills": kills}}
            for seed in (0, 1) for name, settings in kill_cases(seed).items()]
    lines = kill_table(read_frame(rows)).splitlines()[2:]
    assert len(lines) == len(kill_cases(0)) and lines[-1] == "| trace | 4 | 3 | 6 of 8 | 2 | 2 | 2 |"
