"""Weights of a convex combination."""

import numpy as np

from radiotwin.inference.held_out import combine, convex_weights


def test_weights_are_not_negative_and_sum_to_one():
    rng = np.random.default_rng(0)
    for _ in range(20):
        error = rng.normal(0, rng.uniform(1, 9, 5), (80, 5)) + rng.normal(0, 3, (80, 1))
        weights = convex_weights(error, rng.random(80), 0.01)
        assert weights.shape == (2, 5) and (weights >= 0).all()
        np.testing.assert_allclose(weights.sum(axis=1), 1.0)


def test_independent_errors_are_weighted_by_their_precision():
    error = np.random.default_rng(1).normal(0, [1.0, 2.0], (200_000, 2))
    weights = convex_weights(error, np.full(len(error), 0.5), 0.0)
    np.testing.assert_allclose(weights.mean(axis=0), [0.8, 0.2], atol=0.01)  # 1/1 : 1/4


def test_each_end_of_the_share_gets_the_prediction_that_is_best_there():
    rng = np.random.default_rng(2)
    share = rng.random(5000)
    error = rng.normal(0, 1, (5000, 2)) * np.column_stack([0.2 + 5 * share, 5.2 - 5 * share])
    near, far = convex_weights(error, share, 0.001)
    assert near[0] > 0.9 and far[1] > 0.9


def test_of_predictions_that_are_alike_the_best_is_kept():
    rng = np.random.default_rng(3)
    common = rng.normal(0, 4, 3000)
    error = common[:, None] * [1.01, 1.0, 1.005]
    np.testing.assert_allclose(convex_weights(error, rng.random(3000), 0.01)[:, 1], 1.0, atol=0.3)


def test_a_combination_lies_between_its_members():
    weights = np.array([[1.0, 0.0], [0.25, 0.75]])
    predictions = np.array([[-80.0, -100.0]] * 3)
    np.testing.assert_allclose(combine(predictions, np.array([0.0, 0.5, 1.0]), weights),
                               [-80.0, -87.5, -95.0])
