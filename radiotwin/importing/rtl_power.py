"""Power in a band from the sweeps of rtl_power.

A line is `date, time, Hz low, Hz high, Hz step, samples, dB, dB, …`, one for each tuning of a
sweep; all lines of a sweep have one time. rtl_power writes the last bin twice.
"""

import io

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.importing.log_files import Lines, LogFile
from radiotwin.importing.settings import Settings
from radiotwin.io.budgets import CELLS, COLUMNS, ROWS

_FIRST = 6  # fields before the bins
_EDGE = 1e-6  # of a step: an edge of the band on that of a bin


def read_rtl_power(file: LogFile, settings: Settings) -> tuple[pd.DataFrame, np.ndarray]:
    """Sum the bins of each sweep that lie in a band.

    Bins are powers; a bin counts where its centre lies in the band.

    Args:
        file: of rtl_power.
        settings: with the band, or None for all bins.

    Returns:
        texts `date, time, band, power_db, bins`, `power_db` empty where a sweep does not cover the
        band; and the first line of each sweep.

    Raises:
        BadInput: a line that is none of rtl_power, or no bin in the band.
    """
    band_hz = settings.band_hz
    sweeps: list[list[str]] = []
    numbers: list[int] = []
    low_hz = power = 0.0
    high_hz, bins, cells = 0.0, 0, 0
    all_hz = [np.inf, -np.inf]

    def finish() -> None:
        covered = bins and (band_hz is None or (low_hz <= band_hz[0] and high_hz >= band_hz[1]))
        level = f"{10 * np.log10(power):.4f}" if covered and power > 0 else ""
        sweeps[-1][2:] = [level, str(bins)]

    with file.open() as content, io.TextIOWrapper(content, "ascii", "replace", newline="") as text:
        lines = Lines(text, file)
        for line in lines:
            fields = [field.strip() for field in line.split(",")]
            if fields == [""]:
                continue
            COLUMNS.check(len(fields), f"{file}: line {lines.number}")
            cells += len(fields)
            CELLS.check(cells, file)
            centre_hz, db, step_hz = _bins(file, lines.number, fields)
            if not sweeps or sweeps[-1][:2] != fields[:2]:
                if sweeps:
                    finish()
                ROWS.check(len(sweeps) + 1, file)
                sweeps.append(fields[:2])
                numbers.append(lines.number)
                low_hz, high_hz, power, bins = np.inf, -np.inf, 0.0, 0
            margin_hz = step_hz * (0.5 + _EDGE)
            low_hz = min(low_hz, centre_hz[0] - margin_hz)
            high_hz = max(high_hz, centre_hz[-1] + margin_hz)
            all_hz = [min(all_hz[0], low_hz), max(all_hz[1], high_hz)]
            inside = np.ones(len(db), dtype=bool)
            if band_hz is not None:
                inside = (centre_hz >= band_hz[0]) & (centre_hz <= band_hz[1])
            power += float((10 ** (db[inside] / 10)).sum())  # NaN where a bin was not measured
            bins += int(inside.sum())
    if not sweeps:
        raise BadInput(f"{file} is empty")
    finish()
    edges_hz = band_hz or all_hz
    name = f"{edges_hz[0] / 1e6:.6g}-{edges_hz[1] / 1e6:.6g} MHz"
    if all(int(sweep[3]) == 0 for sweep in sweeps):
        raise BadInput(f"{file}: no bin lies in the band {name} (band_hz); the file has "
                       f"{all_hz[0] / 1e6:.6g} to {all_hz[1] / 1e6:.6g} MHz")
    table = pd.DataFrame([[date, time, name, level, count] for date, time, level, count in sweeps],
                         columns=["date", "time", "band", "power_db", "bins"], dtype=str)
    return table, np.array(numbers, dtype=np.int64)


def _bins(file: LogFile, number: int, fields: list[str]) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the centres [Hz] and levels [dB] of the bins of a line, and their width [Hz]."""
    try:
        low_hz, high_hz, step_hz = map(float, fields[2:5])
        db = np.array(fields[_FIRST:], dtype=float)
        count = round((high_hz - low_hz) / step_hz)
    except (ValueError, ZeroDivisionError, OverflowError):
        count = 0
    if not 0 < count <= len(db) <= count + 1:
        raise BadInput(f"{file}: line {number} is none of rtl_power: date, time, Hz low, Hz high, "
                       "Hz step, samples, and a level for each step")
    return low_hz + step_hz * (np.arange(count) + 0.5), db[:count], step_hz
