import numpy as np
from scipy.stats import norm

from radiotwin.twin.localize.likelihood import OUTLIER_SHARE, OUTLIER_SPAN_DB, Likelihood
from radiotwin.twin.localize.observations import DirectChannel, LinkTable, merge_repeats, tabulate

BOUNDS = (0.0, 400.0, 0.0, 400.0)


def test_equals_the_formula_written_out(free_space):
    rng = np.random.default_rng(0)
    places = np.column_stack([rng.uniform(0, 400, (5, 2)), [50.0, 60, 60, 70, 70]])
    receiver_m = places[[0, 1, 1, 2, 3, 3, 4]]
    level = np.array([-88.0, -90.0, -94.0, -60.0, np.nan, np.nan, np.nan])
    observations = merge_repeats(receiver_m, np.zeros(7, int), level, np.array([0]), use_missed=True)
    table = tabulate(free_space, observations.receiver_m, 1.5, BOUNDS, np.array([0]), rng)
    likelihood = Likelihood(observations, table, np.array([0]), 1.5, None, limit_db=-95.0)
    likelihood.repeat_share = 0.5
    xy_m = np.array([[130.0, 240.0]])
    mean = -40 - 20 * np.log10(np.linalg.norm(places - [130, 240, 1.5], axis=1))
    floor = OUTLIER_SHARE / OUTLIER_SPAN_DB
    expected = 0.0
    for y, m, n in [(-88, mean[0], 1), (-92, mean[1], 2), (-60, mean[2], 1)]:
        expected += np.log((1 - OUTLIER_SHARE) * norm.pdf(y, m, 2 * np.sqrt(0.5 + 0.5 / n)) + floor)
    for m, weight in [(mean[3], 2 / 1.5), (mean[4], 1)]:
        expected += weight * np.log((1 - OUTLIER_SHARE) * norm.cdf(-95, m, 2) + OUTLIER_SHARE / 2)
    assert np.isclose(likelihood.of_devices([0], xy_m)[0, 0], expected, atol=0.02)


def test_table_is_used_only_where_it_is_exact(free_space, published_law):
    rng = np.random.default_rng(1)
    receiver_m = np.column_stack([rng.uniform(0, 400, (50, 2)), rng.uniform(20, 120, 50)])

    class Placed:
        def predict(self, links):
            return free_space.predict(links)[0] + 0.01 * links.receiver_m[:, 0], np.full(len(links), 2.0)

    class Named(Placed):
        def predict(self, links):
            return free_space.predict(links)[0] - links.device, np.full(len(links), 2.0)

    devices = np.array([2, 5])
    assert isinstance(tabulate(published_law, receiver_m, 1.5, BOUNDS, devices, rng), LinkTable)
    placed = tabulate(Placed(), receiver_m, 1.5, BOUNDS, devices, rng)
    named = tabulate(Named(), receiver_m, 1.5, BOUNDS, devices, rng)
    assert isinstance(placed, DirectChannel) and not placed.by_device
    assert isinstance(named, DirectChannel) and named.by_device


def test_table_and_direct_agree_overhead_and_far(published_law):
    """At the receiver's own foot point, where the elevation turns over, and at the far corner."""
    receiver_m = np.array([[200.0, 200.0, 60.0], [0.0, 0.0, 90.0]])
    table = tabulate(published_law, receiver_m, 1.5, BOUNDS, np.array([0]), np.random.default_rng(2))
    direct = DirectChannel(published_law, receiver_m, 1.5, by_device=False)
    xy_m = np.array([[200.0, 200.0], [200.5, 200.0], [400.0, 400.0], [0.0, 0.0]])
    los = np.array([[True, False], [False, True], [True, True], [False, False]])
    rows = np.array([0, 1])
    for a, b in zip(table.look_up(xy_m, rows, los, 0), direct.look_up(xy_m, rows, los, 0)):
        np.testing.assert_allclose(a, b, atol=0.02)


def test_no_links_have_no_means(free_space, published_law):
    """Such as of a device that was never detected: receivers at very many heights, so that there is no table."""
    rng = np.random.default_rng(3)
    receiver_m = np.column_stack([rng.uniform(0, 400, (600, 2)), np.linspace(20, 120, 600)])
    observations = merge_repeats(receiver_m, np.zeros(600, int), np.full(600, np.nan), np.array([0]), use_missed=True)
    channel = DirectChannel(free_space, observations.receiver_m, 1.5, by_device=False)
    likelihood = Likelihood(observations, channel, np.array([0]), 1.5, None, limit_db=-60.0)
    assert len(likelihood.residuals(0, np.array([200.0, 200.0])).z) == 0
