"""Levels of any unit -> dB or dBm, and which of them are none."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.importing.read import EMPTY, Source, as_text
from radiotwin.importing.settings import Settings

COLUMN = {"dBm": "rssi_dbm", "mW": "rssi_dbm", "W": "rssi_dbm", "dB": "gain_db"}
"""Unit in the file -> column of `measurements.csv`."""
MILLIWATTS = {"mW": 1.0, "W": 1e3}
POSSIBLE_DB = (-250.0, 0.0)
"""Open interval. Thermal noise in 1 Hz is -174 dBm; nobody receives a milliwatt (0 dBm), and no channel amplifies."""


@dataclass(frozen=True)
class Levels:
    """Attributes:
        db: (n,) level [dBm, or dB for gains]; NaN = not detected, or of no use.
        not_measured: (n,) bool: nobody listened.
        impossible: (n,) bool: a number that no receiver can have meant.
    """

    db: np.ndarray
    not_measured: np.ndarray
    impossible: np.ndarray


def read_levels(source: Source, spec: str, settings: Settings) -> Levels:
    """Levels of one column.

    Raises:
        BadInput: the unit is not declared, a cell is no number, or empty cells have no declared meaning.
    """
    cells = source.cells(spec, "level")
    text = as_text(cells)
    numbers = pd.to_numeric(text, errors="coerce").to_numpy(dtype=float)
    not_measured = _is_one_of(text, numbers, settings.not_measured)
    not_detected = _is_one_of(text, numbers, settings.not_detected) & ~not_measured
    said = not_measured | not_detected
    source.refuse(spec, text, (text == "") & ~said, "is empty; say what that means: not_detected = [\"empty\"] (it was "
                  "too weak, which is information) or not_measured = [\"empty\"] (nobody listened)")
    source.refuse(spec, text, ~np.isfinite(numbers) & ~said, "is not a number; if it stands for a level that was not "
                  "detected, put it into not_detected")
    _check_unit(source, spec, numbers[~said], settings.level_unit)
    if settings.not_detected_at_or_below is not None:
        not_detected |= ~said & (numbers <= settings.not_detected_at_or_below)
    with np.errstate(divide="ignore", invalid="ignore"):  # what is not positive is impossible, and found below
        factor = MILLIWATTS.get(str(settings.level_unit))
        db = numbers if factor is None else 10 * np.log10(numbers * factor)
    low, high = POSSIBLE_DB
    impossible = ~not_measured & ~not_detected & ~((db > low) & (db < high))
    return Levels(np.where(not_measured | not_detected | impossible, np.nan, db), not_measured, impossible)


def _is_one_of(text: pd.Series, numbers: np.ndarray, values: list[float | str]) -> np.ndarray:
    result = np.zeros(len(text), dtype=bool)
    for value in values:
        if isinstance(value, str):
            word = value.strip().lower()
            result |= (text.str.lower() == ("" if word in (*EMPTY, "empty") else word)).to_numpy(dtype=bool)
        else:
            result |= numbers == value
    return result


def _check_unit(source: Source, spec: str, numbers: np.ndarray, unit: str | None) -> None:
    if unit is None:
        looks = f"run from {numbers.min():g} to {numbers.max():g}, median {np.median(numbers):g}" if len(numbers) \
            else "are all not detected"
        raise BadInput(f"{source.path}: column {spec}: level_unit is not given; allowed are dBm, mW and W (received "
                       f"power) and dB (channel gain, negative). The values {looks}")
