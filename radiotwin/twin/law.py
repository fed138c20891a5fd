"""The parameters of a fitted law, with their units and how sure they are."""

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
from radiotwin.propagation.laws.log_distance import LogDistance, SegmentedLogDistance
from radiotwin.propagation.laws.segmented_nn import BLOCK_M

LAW = "law"  # in the provenance of a twin
GROUPS = 10  # that are left out in turn
COLUMNS = ["links", "parameter", "value", "low", "high", "unit"]
LEVEL, EXPONENT, SD = "level at 100 m", "path-loss exponent", "sd"


def law_of(channel: ChannelModel) -> LogDistance | SegmentedLogDistance | None:
    """Return the log-distance law that a channel is or builds upon; None where it has none."""
    law = channel if channel.follows_paths else getattr(channel, "law", channel)
    return law if isinstance(law, LogDistance | SegmentedLogDistance) else None


def law_parameters(channel: ChannelModel, links: LinkGeometry, level_db: np.ndarray,
                   limit_db: Limit, seed: int) -> list[dict[str, Any]]:
    """Return the parameters of a channel's law, with 90 % intervals.

    These are by a delete-a-group jackknife (Kott 2001, 'The delete-a-group jackknife', Journal of
    Official Statistics 17) of blocks of a device and `BLOCK_M` of ground, since errors of links
    that are close together are alike.

    Args:
        channel: fitted to n links.
        links: the same.
        level_db: (n,) as of `ChannelModel.fit`.
        limit_db: as of `ChannelModel.fit`.
        seed: of the groups.

    Returns:
        rows of `COLUMNS`; low and high are None where they are not known.
    """
    law = law_of(channel)
    if law is None:
        return []
    values = _values(law)
    spread = np.full(len(values), np.nan)
    cell = np.floor(links.receiver_m[:, :2] / BLOCK_M).astype(np.int64)
    block = np.unique(np.column_stack([links.device, cell]), axis=0, return_inverse=True)[1]
    group = deal_groups(block.ravel(), GROUPS, np.random.default_rng(seed))
    groups = int(group.max()) + 1
    if groups > 2:
        limits_db = np.broadcast_to(np.asarray(-np.inf if limit_db is None else limit_db, float),
                                    len(links))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            left = np.array([_values(type(law)().fit(links.select(rows), level_db[rows],
                                                     limits_db[rows]))
                             for rows in (group != each for each in range(groups))])
        error = np.sqrt((groups - 1) / groups * ((left - left.mean(axis=0)) ** 2).sum(axis=0))
        spread = student_t.ppf(0.95, groups - 1) * error
    return _rows(law, values, spread)


def parameters_of(channel: ChannelModel, refit_db: np.ndarray, sd_db: np.ndarray
                  ) -> list[dict[str, Any]]:
    """Return the parameters of a channel's law after `close-loop`, of which no interval is known.

    Args:
        channel: as it was fitted first.
        refit_db: coefficients of `ChannelModel.level_columns`; none: it was not fitted again.
        sd_db: standard deviations by `ChannelModel.error_group` [dB]; none: those of the law.
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
        values[:, 2] = np.log(sd_db[::-1])  # the class with line of sight is the last
    return _rows(law, values.ravel(), np.full(values.size, np.nan))


def law_frame(rows: list[dict[str, Any]], level: str) -> pd.DataFrame:
    """Return parameters as a data frame; `level` is `gain_db` or `rssi_dbm`."""
    frame = pd.DataFrame(rows, columns=COLUMNS)
    frame[["value", "low", "high"]] = frame[["value", "low", "high"]].astype(float)
    frame.loc[frame["parameter"] == LEVEL, "unit"] = "dB" if level == "gain_db" else "dBm"
    return frame


def _lines(law: LogDistance | SegmentedLogDistance) -> dict[str, LogDistanceLine]:
    return {"all": law.line} if isinstance(law, LogDistance) else {"LoS": law.los, "NLoS": law.nlos}


def _values(law: LogDistance | SegmentedLogDistance) -> np.ndarray:
    """Return level at 100 m [dB], path-loss exponent, and logarithm of the sd [dB] of each line."""
    return np.array([(line.mean_db(np.array(2.0)), line.exponent, np.log(line.sd_db))
                     for line in _lines(law).values()]).ravel()


def _rows(law: LogDistance | SegmentedLogDistance, values: np.ndarray, spread: np.ndarray
          ) -> list[dict[str, Any]]:
    borrowed = getattr(law, "borrowed", None)
    names = [(links, parameter, unit) for links in _lines(law)
             for parameter, unit in ((LEVEL, "dB"), (EXPONENT, ""), (SD, "dB"))]
    rows = []
    for (links, parameter, unit), value, reach in zip(names, values, spread, strict=True):
        ends = np.array([value, value - reach, value + reach])
        if links.casefold() == borrowed:  # a line that is a guess
            ends[1:] = np.nan
        if parameter == SD:
            ends = np.exp(ends)
        value, low, high = (float(each) if np.isfinite(each) else None for each in ends)
        rows.append(dict(zip(COLUMNS, (links, parameter, value, low, high, unit))))
    return rows
