import numpy as np

from radiotwin.twin.localize.posterior import refine, second_mode


def grid(width):
    centres = np.arange(width / 2, 200, width)
    return np.stack(np.meshgrid(centres, centres), axis=-1).reshape(-1, 2)


def everywhere(xy_m):
    return np.ones(len(xy_m), bool)


def posterior_of(log_likelihood, peaks=((100.0, 100.0),), likelihood_power=1.0):
    xy_m = grid(5.0)
    return refine(log_likelihood, xy_m, xy_m, log_likelihood(xy_m), 5.0, np.array(peaks), likelihood_power)


def gaussian(at, sigma):
    return lambda xy_m: -0.5 * np.sum((xy_m - at) ** 2, axis=1) / sigma**2


def test_radius_of_a_gaussian():
    """90 % of a round Gaussian are within sigma sqrt(2 ln 10); tempering by 1/4 doubles it."""
    for sigma in (0.4, 2.0, 8.0):
        posterior = posterior_of(gaussian((92.3, 104.1), sigma), [(92.3, 104.1)])
        (at, weight), *_ = posterior.modes(everywhere)
        np.testing.assert_allclose(at, (92.3, 104.1), atol=0.05 * sigma)
        assert weight > 0.995
        assert np.isclose(posterior.radius(at), sigma * np.sqrt(2 * np.log(10)), rtol=0.06)
        tempered = posterior_of(gaussian((92.3, 104.1), sigma), [(92.3, 104.1)], 0.25)
        assert np.isclose(tempered.radius(at), 2 * sigma * np.sqrt(2 * np.log(10)), rtol=0.06)


def test_weights_of_two_modes():
    def two(xy_m):
        far = np.exp(gaussian((50.0, 60.0), 2.0)(xy_m)) + 0.25 * np.exp(gaussian((150.0, 60.0), 2.0)(xy_m))
        return np.log(far + 1e-300)

    posterior = posterior_of(two)
    modes = posterior.modes(everywhere)
    x_m, y_m, weight = second_mode(modes)
    np.testing.assert_allclose(modes[0][0], (50, 60), atol=0.1)
    np.testing.assert_allclose((x_m, y_m), (150, 60), atol=0.1)
    assert np.isclose(weight, 0.2, atol=0.01)
    assert posterior.radius(modes[0][0]) > 90


def test_a_peak_narrower_than_a_cell_counts_once_a_swarm_has_found_it():
    def needle(xy_m):
        return np.where(
            np.abs(xy_m - (33.3, 71.7)).max(axis=1) < 0.4, 30.0, gaussian((120.0, 120.0), 5.0)(xy_m)
        )

    assert np.linalg.norm(posterior_of(needle).modes(everywhere)[0][0] - (120, 120)) < 1
    found = posterior_of(needle, [(33.3, 71.7)])
    assert np.linalg.norm(found.modes(everywhere)[0][0] - (33.3, 71.7)) < 0.2


def test_the_region_of_a_flat_posterior_is_nine_tenths():
    assert np.isclose(posterior_of(lambda xy_m: np.zeros(len(xy_m))).region_share(), 0.9, atol=0.01)


def test_mean_of_a_crescent_is_on_it():
    def ring(xy_m):
        return -0.5 * ((np.linalg.norm(xy_m - (100, 100), axis=1) - 60) / 3) ** 2

    at = posterior_of(ring).modes(everywhere)[0][0]
    assert abs(np.linalg.norm(at - (100, 100)) - 60) < 5


def test_a_power_widens_a_posterior_and_does_not_move_its_estimate():
    """Of two peaks that touch, the higher and narrower one has most of the mean; a flatter power would have it between."""
    def two(xy_m):
        return np.log(np.exp(gaussian((80.0, 100.0), 4.0)(xy_m)) + 0.05 * np.exp(gaussian((95.0, 100.0), 8.0)(xy_m)))

    sharp, wide = posterior_of(two, [(80.0, 100.0)]), posterior_of(two, [(80.0, 100.0)], 0.1)
    (at, _), (same, _) = sharp.modes(everywhere)[0], wide.modes(everywhere)[0]
    np.testing.assert_allclose(same, at, atol=0.5)
    assert wide.radius(same) > 2 * sharp.radius(at)
    mean = wide.mass @ wide.xy_m / wide.mass.sum()
    assert np.hypot(*(mean - at)) > 3, "what the estimate does not do"
