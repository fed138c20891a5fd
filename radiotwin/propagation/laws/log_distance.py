"""Log-distance path loss: one line for all links (no map needed), or one for LoS and NLoS each."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any, Self

import numpy as np
from typing_extensions import override

from radiotwin.inference.gaussian import Limit, LogDistanceLine, fit_line, shift_line
from radiotwin.links import LinkGeometry
from radiotwin.propagation.laws.base import (
    MAX_DB,
    MAX_SD_DB,
    MIN_DETECTED,
    ChannelModel,
    drop_uninformative,
    require_array,
    require_names,
)

# Prior of the gap between the lines: in 3GPP TR 38.901 UMi, at 100 m and 2.4 GHz, LoS lies 19 dB
# above NLoS.
NLOS_LOSS_DB, NLOS_LOSS_SD_DB = 20.0, 10.0
MAX_EXPONENT = 100.0  # largest path loss exponent in a file
BORROWED_SD_DB = 8.0  # least sd of a borrowed line: UMi NLoS has 7.8 dB (TR 38.901 table 7.4.1-1)


class LogDistance(ChannelModel):
    """gain = intercept - 10 * exponent * log10(d / 1 m) + N(0, sd^2), the same in LoS and NLoS."""

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
        return {"line": _stored(self.line)}, {}

    @classmethod
    @override
    def from_state(cls, arrays: dict[str, np.ndarray], settings: dict[str, Any]) -> Self:
        require_names("settings", settings, [])
        require_names("arrays", arrays, ["line"])
        return cls(_line(require_array(arrays, "line", (3,), -MAX_DB, MAX_DB)))


class SegmentedLogDistance(ChannelModel):
    """gain = intercept_s - 10 * exponent_s * log10(d / 1 m) + N(0, sd_s^2), s = LoS or NLoS.

    The segmented law of Chen et al., 'Model-aided federated reinforcement learning for multi-UAV
    trajectory planning in IoT networks' (GLOBECOM Workshops 2023). A class with fewer than
    MIN_DETECTED detected links borrows the line of the other class, with a warning. The borrowed
    line is shifted by NLOS_LOSS_DB, a prior that the few links correct, and its standard deviation
    is at least BORROWED_SD_DB.

    Attributes:
        los, nlos: the lines.
        borrowed: class with the borrowed line, "los" or "nlos"; None: both lines were fitted.
    """

    name = "segmented_log_distance"
    uses_map = True

    def __init__(self, los: LogDistanceLine | None = None, nlos: LogDistanceLine | None = None,
                 borrowed: str | None = None) -> None:
        self.los: LogDistanceLine = los  # type: ignore[assignment]  # None only until it is fitted
        self.nlos: LogDistanceLine = nlos  # type: ignore[assignment]
        self.borrowed = borrowed

    @override
    def fit(self, links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
            seed: int = 0) -> Self:
        """Fit a line to LoS links and one to NLoS links; warn if one has to be borrowed."""
        links, level_db, limit_db = drop_uninformative(links, level_db, limit_db)
        data = {
            name: (links.log_distance[rows], level_db[rows], limit_db[rows])
            for name, rows in (("los", links.los), ("nlos", ~links.los))
        }
        detected = {name: int(np.isfinite(level).sum()) for name, (_, level, _) in data.items()}
        few, many = sorted(detected, key=lambda name: detected[name])
        lines = {many: fit_line(*data[many])}
        self.borrowed = few if detected[few] < MIN_DETECTED else None
        if self.borrowed is None:
            lines[few] = fit_line(*data[few])
        else:
            widened = replace(lines[many], sd_db=max(lines[many].sd_db, BORROWED_SD_DB))
            prior_db = NLOS_LOSS_DB if few == "los" else -NLOS_LOSS_DB
            lines[few] = shift_line(widened, *data[few], prior_db, NLOS_LOSS_SD_DB)
            shift_db = lines[few].intercept_db - lines[many].intercept_db
            labels = {"los": "LoS", "nlos": "NLoS"}
            warnings.warn(
                f"only {detected[few]} detected {labels[few]} links (wanted: {MIN_DETECTED}), so "
                f"the {labels[few]} channel is the {labels[many]} one moved by {shift_db:+.1f} "
                f"dB, mostly a guess: measure more {labels[few]} links before relying on it",
                stacklevel=2)
        self.los, self.nlos = lines["los"], lines["nlos"]
        return self

    @override
    def predict(self, links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
        intercept_db, slope, sd_db = self.state()[0]["lines"][links.los.astype(np.intp)].T
        return intercept_db + 10.0 * slope * links.log_distance, sd_db

    @override
    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return `lines` (2, 3) as `_stored` returns them, NLoS first, for `from_state`."""
        lines = np.array([_stored(self.nlos), _stored(self.los)])
        return {"lines": lines}, {"borrowed": self.borrowed}

    @classmethod
    @override
    def from_state(cls, arrays: dict[str, np.ndarray], settings: dict[str, Any]) -> Self:
        """Restore the law from its `state`, after checking it."""
        require_names("settings", settings, ["borrowed"])
        require_names("arrays", arrays, ["lines"])
        nlos, los = map(_line, require_array(arrays, "lines", (2, 3), -MAX_DB, MAX_DB))
        if settings["borrowed"] not in (None, "los", "nlos"):
            raise ValueError("borrowed is none of null, los, nlos")
        return cls(los, nlos, settings["borrowed"])


def _stored(line: LogDistanceLine) -> np.ndarray:
    """Return the line as (3,) intercept [dB], minus the path loss exponent, sd [dB]."""
    return np.array([line.intercept_db, -line.exponent, line.sd_db])


def _line(stored: np.ndarray) -> LogDistanceLine:
    """Return the line of an array of `_stored`; raise ValueError if a number is impossible."""
    if stored.dtype.kind != "f" or not (abs(stored[1]) <= MAX_EXPONENT
                                        and 0 < stored[2] <= MAX_SD_DB):
        raise ValueError("a line's intercept, exponent or standard deviation is impossible")
    intercept_db, slope, sd_db = map(float, stored)
    return LogDistanceLine(intercept_db, -slope, sd_db)
