"""The figures of the numerical noise."""

import numpy as np
import pytest

from radiotwin.trace.run import noise_figures


def test_figures_of_a_known_difference():
    generator = np.random.default_rng(0)
    gain_db = generator.uniform(-110, -80, 20_000)
    finer_db = gain_db + generator.normal(0, 2, 20_000)
    gain_db[:1000] = np.nan
    finer_db[500:1200] = np.nan
    figures = noise_figures(gain_db, finer_db)
    assert figures["noise_floor_db"] == pytest.approx(2.0, rel=0.03)
    assert figures["noise_floor_median_db"] == pytest.approx(2 * 0.6745, rel=0.03)
    assert figures["noise_floor_p90_db"] == pytest.approx(2 * 1.6449, rel=0.03)
    assert figures["noise_floor_detection_share"] == pytest.approx((500 + 200) / 20_000)


def test_nothing_detected_in_both_has_no_figure():
    figures = noise_figures(np.array([np.nan, -90.0]), np.array([-90.0, np.nan]))
    assert np.isnan(figures["noise_floor_db"])
    assert figures["noise_floor_detection_share"] == 1
