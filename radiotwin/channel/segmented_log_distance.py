"""The log-distance law with one line for links with line of sight and one for those without."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any, Self

import numpy as np

from radiotwin.channel.base import MIN_DETECTED, ChannelModel, drop_uninformative
from radiotwin.inference.censored_line import LogDistanceLine, fit_line, shift_line
from radiotwin.links.geometry import LinkGeometry

NLOS_LOSS_DB, NLOS_LOSS_SPREAD_DB = 20.0, 10.0
"""Prior of the gap between the lines: in 3GPP TR 38.901 UMi, at 100 m and 2.4 GHz, LoS lies 19 dB above NLoS."""
BORROWED_SIGMA_DB = 8.0
"""Least standard deviation of a borrowed line: NLoS shadowing in TR 38.901 UMi has 7.8 dB (table 7.4.1-1)."""


class SegmentedLogDistance(ChannelModel):
    """gain = intercept_s + 10 * exponent_s * log10(d / 1 m) + N(0, sigma_s^2), s = LoS or NLoS.

    The segmented law of Chen et al., 'Model-aided federated reinforcement learning for multi-UAV trajectory
    planning in IoT networks' (GLOBECOM Workshops 2023). A class with fewer than MIN_DETECTED detected links borrows
    the other's line, moved by NLOS_LOSS_DB give or take what its few links say, with at least BORROWED_SIGMA_DB;
    `borrowed` ("los" or "nlos") then names the class, and a warning says so.
    """

    name = "segmented_log_distance"
    uses_map = True

    def __init__(
        self,
        los: LogDistanceLine | None = None,
        nlos: LogDistanceLine | None = None,
        borrowed: str | None = None,
    ) -> None:
        self.los: LogDistanceLine = los  # type: ignore[assignment]  # None only until it is fitted
        self.nlos: LogDistanceLine = nlos  # type: ignore[assignment]
        self.borrowed = borrowed

    def fit(self, links: LinkGeometry, level_db: np.ndarray, limit_db: float | None, seed: int = 0) -> Self:
        """Maximum likelihood with censoring, each class by itself; see ChannelModel.fit. The seed changes nothing."""
        links, level_db = drop_uninformative(links, level_db, limit_db)
        data = {
            "los": (links.log_distance[links.los], level_db[links.los]),
            "nlos": (links.log_distance[~links.los], level_db[~links.los]),
        }
        detected = {name: int(np.isfinite(level).sum()) for name, (_, level) in data.items()}
        poor, rich = sorted(detected, key=lambda name: detected[name])
        lines = {rich: fit_line(*data[rich], limit_db)}
        self.borrowed = poor if detected[poor] < MIN_DETECTED else None
        if self.borrowed is None:
            lines[poor] = fit_line(*data[poor], limit_db)
        else:
            wide = replace(lines[rich], sigma_db=max(lines[rich].sigma_db, BORROWED_SIGMA_DB))
            prior_db = NLOS_LOSS_DB if poor == "los" else -NLOS_LOSS_DB
            lines[poor] = shift_line(wide, *data[poor], limit_db, prior_db, NLOS_LOSS_SPREAD_DB)
            shift_db = lines[poor].intercept_db - lines[rich].intercept_db
            words = {"los": "LoS", "nlos": "NLoS"}
            warnings.warn(
                f"only {detected[poor]} detected {words[poor]} links (wanted: {MIN_DETECTED}), so the {words[poor]} "
                f"channel is the {words[rich]} one moved by {shift_db:+.1f} dB, mostly a guess: measure more "
                f"{words[poor]} links before relying on it",
                stacklevel=2,
            )
        self.los, self.nlos = lines["los"], lines["nlos"]
        return self

    def predict(self, links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
        """Mean and standard deviation [dB], (n,) each."""
        intercept_db, exponent, sigma_db = self.state()[0]["lines"][links.los.astype(np.intp)].T
        return intercept_db + 10.0 * exponent * links.log_distance, sigma_db

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """See ChannelModel.state; lines: (2, 3) intercept [dB], exponent, sigma [dB] of NLoS, then of LoS."""
        lines = [[line.intercept_db, line.exponent, line.sigma_db] for line in (self.nlos, self.los)]
        return {"lines": np.array(lines)}, {"borrowed": self.borrowed}

    @classmethod
    def from_state(cls, arrays: dict[str, np.ndarray], settings: dict[str, Any]) -> Self:
        """See ChannelModel.from_state."""
        nlos, los = (LogDistanceLine(*map(float, row)) for row in arrays["lines"])
        return cls(los, nlos, settings["borrowed"])
