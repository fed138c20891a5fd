"""What a change of the mean is worth, in nats."""

import numpy as np
import pytest
from scipy.stats import t

SCALE_DB, LIMIT_DB = 4.0, -100.0


def test_a_blank_may_rise_up_to_the_limit_of_detection(make_links, view):
    links = make_links(np.array([[0.0, 0.0, 2.0]]), np.random.default_rng(0).uniform(20, 90, (3, 3)),
                       level_db=np.full(3, np.nan), limit_db=LIMIT_DB)
    seen = view(links, np.array([-125.0, -125.0, -95.0]), SCALE_DB)
    rows = np.arange(3)
    assert seen.gain_nats(rows, np.array([20.0, 25.0, 0.0])) == pytest.approx(np.zeros(3))
    risen, _, lowered = seen.gain_nats(rows, np.array([30.0, 0.0, -6.0]))
    five_db = (t.logpdf(0.0, 4) - t.logpdf(5.0 / SCALE_DB, 4)) / seen.design_effect
    assert (risen, lowered) == pytest.approx((-five_db, five_db))


def test_a_reading_gains_what_a_heavy_tail_says(make_links, view):
    links = make_links(np.array([[0.0, 0.0, 2.0]]), np.random.default_rng(0).uniform(20, 90, (2, 3)), level_db=np.full(2, -90.0))
    seen = view(links, np.array([-94.0, -82.0]), SCALE_DB)
    gained = seen.gain_nats(np.arange(2), np.array([4.0, 0.0])) * seen.design_effect
    expected = t.logpdf(0.0, 4) - t.logpdf(1.0, 4)
    assert gained == pytest.approx([expected, 0.0])
