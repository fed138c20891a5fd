"""The numerical noise of a trace: how far its gains move when ten times the rays are sent."""

import numpy as np

FINER = 10
SHARE = 0.01


def sample_receivers(n: int, seed: int) -> np.ndarray:
    """Indices of the positions that are solved again: 1 % of `n`, at least 8, ascending."""
    count = min(n, max(8, round(SHARE * n)))
    return np.sort(np.random.default_rng(seed).choice(n, size=count, replace=False))


def noise_figures(gain_db: np.ndarray, finer_db: np.ndarray) -> dict[str, float]:
    """Difference between two solutions of the same links.

    Args:
        gain_db: (n,) gain of the map; NaN = not detected.
        finer_db: (n,) gain with ten times the rays; NaN = not detected.

    Returns:
        Attributes: RMS, median and 90th percentile of the difference over links detected in both, and the share
        of links detected in one only. NaN where no link is detected in both.
    """
    both = np.isfinite(gain_db) & np.isfinite(finer_db)
    difference_db = np.abs(gain_db - finer_db)[both]
    if not both.any():
        difference_db = np.array([np.nan])
    return {
        "noise_floor_db": float(np.sqrt(np.mean(difference_db**2))),
        "noise_floor_median_db": float(np.median(difference_db)),
        "noise_floor_p90_db": float(np.quantile(difference_db, 0.9)),
        "noise_floor_detection_share": float(np.mean(np.isfinite(gain_db) != np.isfinite(finer_db))),
        "noise_floor_links": int(gain_db.size),
        "noise_floor_method": f"{100 * SHARE:g} % of the positions solved again with {FINER} times the samples; "
                              "RMS difference over links detected in both",
    }
