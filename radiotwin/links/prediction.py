"""Predicted levels of links."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Prediction:
    """Expected levels of n links.

    Attributes:
        mean_db: (n,) mean gain [dB] or power [dBm], also below what can be detected.
        sd_db: (n,) standard deviation [dB].
        detection_probability: (n,) that the link is detected.
    """

    mean_db: np.ndarray
    sd_db: np.ndarray
    detection_probability: np.ndarray

    @classmethod
    def concatenate(cls, parts: list["Prediction"]) -> "Prediction":
        """Return the predictions of several sets of links, one after the other."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts])
                     for name in ("mean_db", "sd_db", "detection_probability")))
