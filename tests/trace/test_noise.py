"""The figures of the numerical noise."""

import numpy as np
import pytest

from radiotwin.trace import SolverSettings
from radiotwin.trace.run import exchange_figures, noise_figures, trace_map


def test_figures_of_a_known_difference():
    generator = np.random.default_rng(0)
    gain_db = generator.uniform(-110, -80, 20_000)
    finer_db = gain_db + generator.normal(0, 2, 20_000)
    gain_db[:1000] = np.nan
    finer_db[500:1200] = np.nan
    figures = noise_figures(gain_db, finer_db)
    found = [figures[f"noise_floor_{name}"] for name in ("db", "median_db", "p90_db", "detection_share")]
    assert found == pytest.approx([2.0, 2 * 0.6745, 2 * 1.6449, (500 + 200) / 20_000], rel=0.03)
    apart = noise_figures(np.array([np.nan, -90.0]), np.array([-90.0, np.nan]))
    assert np.isnan(apart["noise_floor_db"]) and apart["noise_floor_detection_share"] == 1


def test_exchanged_ends_are_compared_by_class():
    los = np.array([True] * 3 + [False] * 5)
    forward_db = np.full(8, -90.0)
    backward_db = forward_db + [3, -4, np.nan, 0, 2, -7, 1, np.nan]
    figures = exchange_figures(forward_db, backward_db, los)
    expected = {"links": 6, "los_db": np.sqrt((9 + 16) / 2), "nlos_db": np.sqrt((0 + 4 + 49 + 1) / 4),
                "nlos_bias_db": (0 + 2 - 7 + 1) / 4, "nlos_doubtful_share": 1 / 4}
    assert figures == pytest.approx({f"exchanged_{name}": value for name, value in expected.items()})
    assert np.isnan(exchange_figures(forward_db, backward_db, np.ones(8, dtype=bool))["exchanged_nlos_db"])


def test_a_map_has_the_change_by_exchanged_ends(own_scene, law, tmp_path):
    """The law is reciprocal, but for 0.1 dB less from a high transmitter."""
    solve = law.solve
    law.solve = lambda self, device_m, points_m, antennas: solve(self, device_m, points_m, antennas) - 0.1 * (device_m[2] > 10)
    attributes = trace_map(own_scene, SolverSettings(), tmp_path / "map.nc", ["d4", "d1"]).dataset.attrs
    assert attributes["exchanged_links"] > 5
    assert attributes["exchanged_los_db"] == pytest.approx(0.1) and attributes["exchanged_nlos_db"] == pytest.approx(0.1)
