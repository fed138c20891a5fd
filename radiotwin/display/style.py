"""Colours, colour scales and titles that all plots and figures share."""

import numpy as np

from radiotwin.texts import shown

GAIN_COLOURS = "viridis"
DIFFERENCE_COLOURS = "RdBu_r"  # of model − truth, red: the model predicts more
RESIDUAL_COLOURS = "RdBu"  # of measured − predicted, red: less was measured than predicted
RESIDUAL_RANGE_DB = (2.0, 30.0)  # smallest and largest end of a colour scale


def plain(text: str, max_length: int = 100) -> str:
    """Return a foreign text for a figure: short, on one line, nothing hidden, and no formula."""
    return " ".join(shown(text, max_length).split()).replace("$", r"\$")


def residual_range_db(residual_db: np.ndarray) -> float:
    """Return the end of a symmetric colour scale [dB] that 95 % of the finite values are within."""
    finite = np.abs(residual_db[np.isfinite(residual_db)])
    high_db = float(np.quantile(finite, 0.95)) if len(finite) else 0.0
    return float(np.clip(np.ceil(high_db), *RESIDUAL_RANGE_DB))


def level_range_db(level_db: np.ndarray) -> tuple[float, float]:
    """Return the ends of a colour scale [dB] that nearly all finite values are within."""
    finite = level_db[np.isfinite(level_db)]
    if not len(finite):
        return -1.0, 0.0
    low, high = np.quantile(finite, [0.01, 0.995])
    return float(low), float(high)
