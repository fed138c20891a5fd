import numpy as np

from radiotwin.twin.localize.on_map import CONSTRICTION, distinct_modes, swarm_search


def test_constriction():
    """Clerc and Kennedy's published value for phi = 4.1."""
    assert np.isclose(CONSTRICTION, 0.7298, atol=1e-4)


def test_swarms_of_two_devices_each_find_their_own_optimum():
    goal = np.array([[30.0, -12.0], [-55.0, 80.0]])

    def log_likelihood(xy_m, device):
        rugged = 2.0 * np.cos(xy_m).sum(axis=1)
        return -0.05 * np.sum((xy_m - goal[device]) ** 2, axis=1) + rugged * (device == 0)

    device = np.array([0, 1, 0])
    best_m, value = swarm_search(
        log_likelihood, np.zeros((3, 2)), device, np.zeros((1, 2)), 40.0, 40, 60, np.random.default_rng(0)
    )
    np.testing.assert_allclose(best_m[1], goal[1], atol=0.1)
    assert np.linalg.norm(best_m[[0, 2]] - goal[0], axis=1).min() < 3.0
    np.testing.assert_allclose(value, log_likelihood(best_m, device))


def test_a_place_where_no_device_may_be_is_never_the_best():
    def log_likelihood(xy_m, device):
        return np.where(xy_m[:, 0] > 1.0, -np.sum(xy_m**2, axis=1), -np.inf)

    best_m, _ = swarm_search(
        log_likelihood, np.array([[5.0, 5.0]]), np.array([0]), np.array([[9.0, 9.0]]), 5.0, 15, 40,
        np.random.default_rng(1),
    )  # fmt: skip
    assert best_m[0, 0] > 1.0 and np.isclose(best_m[0, 0], 1.0, atol=0.2)


def test_distinct_modes():
    xy_m = np.array([[0.0, 0], [1, 0], [10, 0], [20, 0], [30, 0]])
    value = np.array([5.0, 4.9, 3.0, 4.0, -np.inf])
    assert distinct_modes(xy_m, value, 3, 5.0)[:, 0].tolist() == [0, 20, 10]
    assert len(distinct_modes(xy_m, value, 9, 5.0)) == 3
