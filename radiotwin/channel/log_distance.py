"""The log-distance law with one exponent for all links, the baseline that needs no map."""

from __future__ import annotations

from typing import Any, Self

import numpy as np

from radiotwin.channel.base import ChannelModel, drop_uninformative
from radiotwin.inference.censored_line import LogDistanceLine, fit_line
from radiotwin.links.geometry import LinkGeometry


class LogDistance(ChannelModel):
    """gain = intercept + 10 * exponent * log10(d / 1 m) + N(0, sigma^2), whether or not there is line of sight."""

    name = "log_distance"
    uses_map = False

    def __init__(self, line: LogDistanceLine | None = None) -> None:
        self.line: LogDistanceLine = line  # type: ignore[assignment]  # None only until it is fitted

    def fit(self, links: LinkGeometry, level_db: np.ndarray, limit_db: float | None, seed: int = 0) -> Self:
        """Maximum likelihood with censoring; see ChannelModel.fit. The seed changes nothing."""
        links, level_db = drop_uninformative(links, level_db, limit_db)
        self.line = fit_line(links.log_distance, level_db, limit_db)
        return self

    def predict(self, links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
        """Mean and standard deviation [dB], (n,) each."""
        return self.line.mean_db(links.log_distance), np.full(len(links), self.line.sigma_db)

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """See ChannelModel.state."""
        line = self.line
        return {"line": np.array([line.intercept_db, line.exponent, line.sigma_db])}, {}

    @classmethod
    def from_state(cls, arrays: dict[str, np.ndarray], settings: dict[str, Any]) -> Self:
        """See ChannelModel.from_state."""
        return cls(LogDistanceLine(*map(float, arrays["line"])))
