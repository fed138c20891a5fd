"""The numerical noise of a trace: the change of its gains when ten times the rays are sent."""

import numpy as np


def noise_figures(gain_db: np.ndarray, finer_db: np.ndarray) -> dict[str, float | str]:
    """Compare two solutions of the same links.

    Args:
        gain_db: (n,) gain as in the map [dB]; NaN: not detected.
        finer_db: (n,) gain with ten times the rays [dB]; NaN: not detected.

    Returns:
        Attributes: RMS, median and 90th percentile of the difference over links detected in both,
        and the share of links detected in one only. NaN where no link is detected in both.
    """
    both = np.isfinite(gain_db) & np.isfinite(finer_db)
    difference_db = np.abs(gain_db - finer_db)[both] if both.any() else np.array([np.nan])
    return {
        "noise_floor_db": float(np.sqrt(np.mean(difference_db**2))),
        "noise_floor_median_db": float(np.median(difference_db)),
        "noise_floor_p90_db": float(np.quantile(difference_db, 0.9)),
        "noise_floor_detection_share": float(np.mean(np.isfinite(gain_db)
                                                     != np.isfinite(finer_db))),
        "noise_floor_links": int(gain_db.size),
        "noise_floor_method": "a sample of the links solved again with ten times the rays; "
                              "RMS difference over links detected in both",
    }
