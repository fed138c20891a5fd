"""The log-distance law with one exponent for all links, the baseline that needs no map."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from typing_extensions import override

from radiotwin.channel.base import ChannelModel, drop_uninformative
from radiotwin.channel.stored import MAX_DB, require_array, require_lines, require_names
from radiotwin.inference.censored_line import LogDistanceLine, fit_line
from radiotwin.inference.gaussian import Limit
from radiotwin.links import LinkGeometry


class LogDistance(ChannelModel):
    """gain = intercept + 10 * exponent * log10(d / 1 m) + N(0, sd^2), with or without LoS."""

    name = "log_distance"
    uses_map = False

    def __init__(self, line: LogDistanceLine | None = None) -> None:
        self.line: LogDistanceLine = line  # type: ignore[assignment]  # None only until it is fitted

    @override
    def fit(self, links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
            seed: int = 0) -> Self:
        links, level_db, limit_db = drop_uninformative(links, level_db, limit_db)
        self.line = fit_line(links.log_distance, level_db, limit_db)
        return self

    @override
    def predict(self, links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
        return self.line.mean_db(links.log_distance), np.full(len(links), self.line.sd_db)

    @override
    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        line = self.line
        return {"line": np.array([line.intercept_db, line.exponent, line.sd_db])}, {}

    @classmethod
    @override
    def from_state(cls, arrays: dict[str, np.ndarray], settings: dict[str, Any]) -> Self:
        require_names("settings", settings, [])
        require_names("arrays", arrays, ["line"])
        line = require_lines(require_array(arrays, "line", (3,), -MAX_DB, MAX_DB))
        return cls(LogDistanceLine(*map(float, line)))
