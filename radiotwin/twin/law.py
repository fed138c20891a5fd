"""Report the parameters of a twin's log-distance law with units and 90 % intervals."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import t as student_t

from radiotwin.inference.gaussian import Limit, LogDistanceLine
from radiotwin.inference.held_out import deal_groups
from radiotwin.links import LinkGeometry
from radiotwin.propagation.laws import ChannelModel
from radiotwin.propagation.laws.base import ground_blocks
from radiotwin.propagation.laws.log_distance import LogDistance, SegmentedLogDistance

LAW = "law"  # key in the provenance of a twin
GROUPS = 10  # groups of links that the jackknife leaves out in turn
COLUMNS = ["links", "parameter", "value", "low", "high", "unit"]
LEVEL, EXPONENT, SD = "level at 100 m", "path-loss exponent", "sd"


def law_of(channel: ChannelModel) -> LogDistance | SegmentedLogDistance | None:
    """Return the log-distance law of a channel, itself or its trend; None if it has none."""
    law = channel if channel.follows_paths else getattr(channel, "law", channel)
    return law if isinstance(law, LogDistance | SegmentedLogDistance) else None


def law_parameters(channel: ChannelModel, links: LinkGeometry, level_db: np.ndarray,
                   limit_db: Limit, seed: int) -> list[dict[str, Any]]:
    """Return a channel's log-distance law with 90 % intervals, as rows of `COLUMNS`; None: unknown.

    The intervals are by a delete-a-group jackknife (Kott 2001, 'The delete-a-group jackknife',
    Journal of Official Statistics 17). All links of a block (`ground_blocks`) are in one group. The
    n links are those of the fit, see `ChannelModel.fit`.
    """
    law = law_of(channel)
    if law is None:
        return []
    values = _values(law)
    half_width = np.full(len(values), np.nan)
    group = deal_groups(ground_blocks(links), GROUPS, np.random.default_rng(seed))
    groups = int(group.max()) + 1
    if groups > 2:
        limits_db = np.broadcast_to(np.asarray(-np.inf if limit_db is None else limit_db, float),
                                    len(links))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            fits = np.array([_values(type(law)().fit(links.select(rows), level_db[rows],
                                                     limits_db[rows]))
                             for rows in (group != number for number in range(groups))])
        error = np.sqrt((groups - 1) / groups * ((fits - fits.mean(axis=0)) ** 2).sum(axis=0))
        half_width = student_t.ppf(0.95, groups - 1) * error
    return _rows(law, values, half_width)


def parameters_of(channel: ChannelModel, refit_db: np.ndarray, sd_db: np.ndarray
                  ) -> list[dict[str, Any]]:
    """Return a channel's log-distance law as `close-loop` refitted it, as rows of `COLUMNS`.

    `refit_db` are coefficients of `ChannelModel.level_columns`, `sd_db` by
    `ChannelModel.error_group`; empty: those of the law.
    """
    law = law_of(channel)
    if law is None:
        return []
    values = _values(law).reshape(-1, 3)
    if len(refit_db) == 2 * len(values):
        level_db, slope_db = np.reshape(refit_db, (-1, 2)).T
        values[:, 0] += level_db
        values[:, 1] -= slope_db / 10.0
    if len(sd_db) == len(values):
        values[:, 2] = np.log(sd_db[::-1])  # error groups end with LoS, lines begin with it
    return _rows(law, values.ravel(), np.full(values.size, np.nan))


def law_frame(rows: list[dict[str, Any]], level: str) -> pd.DataFrame:
    """Return rows of `COLUMNS` as a data frame; `level`, gain_db or rssi_dbm, sets the unit."""
    frame = pd.DataFrame(rows, columns=COLUMNS)
    frame[["value", "low", "high"]] = frame[["value", "low", "high"]].astype(float)
    frame.loc[frame["parameter"] == LEVEL, "unit"] = "dB" if level == "gain_db" else "dBm"
    return frame


def _lines(law: LogDistance | SegmentedLogDistance) -> dict[str, LogDistanceLine]:
    """Return the lines of a law by class of links: all, or LoS and NLoS."""
    return {"all": law.line} if isinstance(law, LogDistance) else {"LoS": law.los, "NLoS": law.nlos}


def _values(law: LogDistance | SegmentedLogDistance) -> np.ndarray:
    """Return for each line level at 100 m [dB], path loss exponent, and log of the sd [dB]."""
    return np.array([(line.mean_db(np.array(2.0)), line.exponent, np.log(line.sd_db))
                     for line in _lines(law).values()]).ravel()


def _rows(law: LogDistance | SegmentedLogDistance, values: np.ndarray, half_width: np.ndarray
          ) -> list[dict[str, Any]]:
    """Return rows of `COLUMNS` from `_values` and the half widths, as many, of their intervals.

    Where a half width is NaN, or a line is borrowed, the interval is None.
    """
    borrowed = getattr(law, "borrowed", None)
    names = [(links, parameter, unit) for links in _lines(law)
             for parameter, unit in ((LEVEL, "dB"), (EXPONENT, ""), (SD, "dB"))]
    rows = []
    for (links, parameter, unit), value, half in zip(names, values, half_width, strict=True):
        ends = np.array([value, value - half, value + half])
        if links.casefold() == borrowed:  # a borrowed line is a guess
            ends[1:] = np.nan
        if parameter == SD:
            ends = np.exp(ends)
        value, low, high = (float(end) if np.isfinite(end) else None for end in ends)
        rows.append(dict(zip(COLUMNS, (links, parameter, value, low, high, unit))))
    return rows
