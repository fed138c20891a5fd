"""Likelihood of levels with Student-t errors, of which some were not detected (left-censored).

A blank level counts as "below the limit" (Tobin 1958) or, where links drop out whatever their
level, as one of the two (Deaton and Irish 1984, 'Statistical models for zero expenditures in
household budgets', Journal of Public Economics 23).
"""

import numpy as np
from scipy.special import gammaln, stdtr

MIN_CURVATURE = 1e-6  # of a blank that says nothing, so that every Newton step is defined
MIN_PROBABILITY = 1e-300  # of which a logarithm is taken


def log_density(z: np.ndarray, dof: float) -> np.ndarray:
    """Return the logarithm of Student's t density at z, any shape."""
    constant = gammaln(0.5 * (dof + 1)) - gammaln(0.5 * dof) - 0.5 * np.log(dof * np.pi)
    return constant - 0.5 * (dof + 1) * np.log1p(z * z / dof)


def censored_nll(level_db: np.ndarray, limit_db: np.ndarray, mean_db: np.ndarray,
                 scale_db: np.ndarray, dof: float,
                 dropout_probability: np.ndarray | float = 0.0) -> np.ndarray:
    """Return the negative log-likelihood of each level [nats].

    Args:
        level_db: (n,) measured; NaN = not detected.
        limit_db: (n,) below which nothing is detected; -inf where a blank says nothing.
        mean_db: (n,) of the prediction [dB].
        scale_db: (n,) of its error [dB].
        dof: degrees of freedom of the errors.
        dropout_probability: (n,), or one for all, of a blank whatever the level.

    Returns:
        (n,)
    """
    blank = np.isnan(level_db)
    dropout = np.broadcast_to(dropout_probability, mean_db.shape)
    z = np.where(blank, 0.0, (level_db - mean_db) / scale_db)
    value = 0.5 * (dof + 1) * np.log1p(z * z / dof) + np.log(scale_db) + 0.5 * np.log(dof * np.pi) \
        + gammaln(0.5 * dof) - gammaln(0.5 * (dof + 1)) - np.log1p(-dropout)
    if blank.any():
        known = np.isfinite(limit_db[blank])
        limit = np.where(known, limit_db[blank], 0.0)
        z = np.where(known, (limit - mean_db[blank]) / scale_db[blank], np.inf)
        missed = dropout[blank] + (1 - dropout[blank]) * stdtr(dof, np.where(known, z, 0.0))
        value[blank] = np.where(known, -np.log(np.maximum(missed, MIN_PROBABILITY)), 0.0)
    return value


def derivatives(level_db: np.ndarray, limit_db: np.ndarray, mean_db: np.ndarray,
                scale_db: np.ndarray, dof: float, dropout_probability: np.ndarray | float,
                ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return derivatives of the log-likelihood.

    Args:
        level_db: (n,) measured; NaN = not detected.
        limit_db: (n,) below which nothing is detected; -inf where a blank says nothing.
        mean_db: (n,) of the prediction [dB].
        scale_db: (n,) of its error [dB].
        dof: degrees of freedom of the errors.
        dropout_probability: (n,), or one for all, of a blank whatever the level.

    Returns:
        (n,) slope in the mean, (n,) curvature in it, (n,) slope in the logarithm of the scale.
    """
    blank = np.isnan(level_db)
    z = np.where(blank, 0.0, (level_db - mean_db) / scale_db)
    weight = (dof + 1) / (dof + z * z)
    slope, curvature = weight * z / scale_db, weight / scale_db**2
    scale_slope = weight * z * z - 1.0
    if blank.any():
        known, mean, scale = np.isfinite(limit_db[blank]), mean_db[blank], scale_db[blank]
        z = (np.where(known, limit_db[blank], mean) - mean) / scale
        dropout = np.broadcast_to(dropout_probability, mean_db.shape)[blank]
        missed = np.maximum(dropout + (1 - dropout) * stdtr(dof, z), MIN_PROBABILITY)
        ratio = (1 - dropout) * np.exp(log_density(z, dof)) / missed
        bending = ratio * (ratio + z * (dof + 1) / (dof + z * z))
        slope[blank] = np.where(known, -ratio / scale, 0.0)
        curvature[blank] = np.where(known, np.maximum(bending, MIN_CURVATURE) / scale**2,
                                    MIN_CURVATURE)
        scale_slope[blank] = np.where(known, -ratio * z, 0.0)
    return slope, curvature, scale_slope


def mean_if_detected(mean_db: np.ndarray, scale_db: np.ndarray, limit_db: np.ndarray,
                     dof: float) -> np.ndarray:
    """Return the mean level of those links of a kind that are detected [dB].

    Near the limit only the strong ones are. The mean of Student's t above
    a = (limit - mean) / scale is f(a) / F(-a) * (dof + a²) / (dof - 1).

    Args:
        mean_db: (n,) of all links of the kind [dB].
        scale_db: (n,) of their errors [dB].
        limit_db: (n,) -inf where no limit is known.
        dof: degrees of freedom, above 1.
    """
    known = np.isfinite(limit_db)
    a = np.where(known, np.where(known, limit_db, 0.0) - mean_db, 0.0) / scale_db
    density = np.exp(log_density(a, dof))
    above_db = scale_db * density / np.maximum(stdtr(dof, -a), MIN_PROBABILITY) \
        * (dof + a * a) / (dof - 1)
    return mean_db + np.where(known, above_db, 0.0)


def detection_probability(mean_db: np.ndarray, scale_db: np.ndarray, limit_db: np.ndarray,
                          dof: float, dropout_probability: np.ndarray | float = 0.0) -> np.ndarray:
    """Return the probability that a link is detected (n,); arguments as of `censored_nll`."""
    known = np.isfinite(limit_db)
    below = np.where(known, stdtr(dof, (np.where(known, limit_db, 0.0) - mean_db) / scale_db), 0.0)
    return (1 - dropout_probability) * (1 - below)
