"""Checks that every traced map must pass."""

import numpy as np
import pytest

from radiotwin.errors import RunFailed
from radiotwin.trace.run import check_gains, free_space_gain_db

FREQUENCY_HZ = 2.4e9


def links():
    """Half of 1000 links with LoS, as in a street: free space and 0 to 2 dB; the others 20 dB and more below."""
    generator = np.random.default_rng(0)
    distance_m = generator.uniform(50, 900, 1000)
    los = np.arange(1000) < 500
    free_db = 20 * np.log10(299_792_458.0 / FREQUENCY_HZ / (4 * np.pi * distance_m))  # ITU-R P.525
    gain_db = free_db + np.where(los, generator.uniform(0, 2, 1000), generator.uniform(-60, -20, 1000))
    gain_db[-100:] = np.nan
    return gain_db, los, distance_m


def check(gain_db, los, distance_m, combining="power"):
    return check_gains(gain_db, los, distance_m, FREQUENCY_HZ, "paths", combining)


def test_a_sound_map_passes_with_its_figures():
    """The tracer and the map may disagree on three links; without LoS there is nothing to compare."""
    gain_db, los, distance_m = links()
    assert free_space_gain_db(1000.0, 2.4e9) == pytest.approx(-(32.4 + 20 * np.log10(2400)), abs=0.06)
    gain_db[:3] = np.nan
    figures = check(gain_db, los, distance_m)
    assert figures["links"] == 1000 and figures["links_with_path"] == 897 and figures["links_los"] == 500
    assert 0.8 < figures["los_excess_median_db"] < 1.2 and figures["los_below_free_space_share"] == 3 / 500
    assert "los_excess_median_db" not in check(gain_db, np.zeros(1000, dtype=bool), distance_m)


@pytest.mark.parametrize("rows, change_db, message", [
    (slice(700, 701), 300.0, "more power"), (slice(None), np.nan, "none of 1000 links has a path"),
    (slice(None), -2.0, "from free space in the median"), (slice(None), 2.5, "from free space in the median"),
    (slice(4), np.nan, "do not see the same city"), (slice(50), -30.0, "do not see the same city")])
def test_what_physics_does_not_allow_fails(rows, change_db, message):
    gain_db, los, distance_m = links()
    gain_db[rows] += change_db
    with pytest.raises(RunFailed, match=message):
        check(gain_db, los, distance_m)
    if rows == slice(50):
        check(gain_db, los, distance_m, combining="coherent")  # fields may cancel
