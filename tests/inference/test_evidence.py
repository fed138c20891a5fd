"""P-values of held-out gains, where there is nothing to gain and where there is."""

import numpy as np

from radiotwin.inference.held_out import cross_fit_p_value, sign_flip_p_value


def test_the_cross_fit_p_value_bounds_the_probability_of_a_gain_that_is_chance():
    """Likelihood ratios of a mean that was fitted elsewhere, when the true mean is zero."""
    rng = np.random.default_rng(0)
    p_values = []
    for _ in range(4000):
        data, elsewhere = rng.normal(size=(2, 5, 20))
        guess = elsewhere.mean(axis=1, keepdims=True)
        p_values.append(cross_fit_p_value((0.5 * data**2 - 0.5 * (data - guess) ** 2).sum(axis=1)))
    for level in (0.5, 0.1, 0.02):
        assert np.mean(np.array(p_values) <= level) <= level


def test_gains_of_one_sign_are_no_chance_and_gains_of_both_are():
    rng = np.random.default_rng(1)
    assert sign_flip_p_value(np.abs(rng.normal(size=30)), 0) < 1e-3
    assert sign_flip_p_value(np.r_[np.abs(rng.normal(size=15)), -np.abs(rng.normal(size=15))], 0) > 0.01
