"""Conversion of levels to dB or dBm, and the values that stand for a missing level."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.importing.settings import Settings
from radiotwin.importing.source import EMPTY, Source, as_text
from radiotwin.io.cells import as_numbers

LEVEL_COLUMN = {"dBm": "rssi_dbm", "mW": "rssi_dbm", "W": "rssi_dbm", "dB": "gain_db"}
"""Unit in the file -> column of `measurements.csv`."""
NOT_A_NUMBER = "nan"
MILLIWATTS = {"mW": 1.0, "W": 1e3}
POSSIBLE_DB = (-250.0, 0.0)
"""Open interval [dBm or dB]: thermal noise in 1 Hz is -174 dBm, no receiver gets a milliwatt
(0 dBm), and no channel amplifies."""


@dataclass(frozen=True)
class Levels:
    """Levels of one column.

    Attributes:
        db: level [dBm, or dB for gains], (n,); NaN = not detected, or not usable.
        not_measured: (n,) bool, the receiver did not listen.
        impossible: (n,) bool, outside `POSSIBLE_DB`.
    """

    db: np.ndarray
    not_measured: np.ndarray
    impossible: np.ndarray


def read_levels(source: Source, spec: str, settings: Settings,
                offset_db: float | np.ndarray = 0.0) -> Levels:
    """Read the levels of one column.

    Args:
        source: the file.
        spec: the column.
        settings: unit, and the values that mean not detected or not measured.
        offset_db: added to each level, or (n,) to each its own.

    Raises:
        BadInput: the unit is not declared, a cell is not a number, or empty cells have no declared
            meaning.
    """
    cells = source.cells(spec, "level")
    text = as_text(cells)
    is_text = cells.dtype.kind not in "fiu"
    if is_text:  # the word, unlike an empty cell, is what a program wrote
        named = cells.notna() & (cells.astype(str).str.strip().str.lower() == NOT_A_NUMBER)
        text = text.mask(named, NOT_A_NUMBER)
    numbers = as_numbers(text)
    not_measured = _is_one_of(text, numbers, settings.not_measured, is_text)
    not_detected = _is_one_of(text, numbers, settings.not_detected, is_text) & ~not_measured
    declared = not_measured | not_detected
    source.refuse(spec, text, (text == "") & ~declared,
                  "is empty; say what that means: not_detected = [\"empty\"] (it was too weak, "
                  "which is information) or not_measured = [\"empty\"] (nobody listened)")
    source.refuse(spec, text, ~np.isfinite(numbers) & ~declared,
                  "is not a number; if it means that the level was not detected, put it into "
                  "not_detected; if nobody listened, into not_measured")
    _check_unit(source, spec, numbers[~declared], settings.level_unit)
    if settings.not_detected_at_or_below is not None:
        not_detected |= ~declared & (numbers <= settings.not_detected_at_or_below)
    factor = MILLIWATTS.get(str(settings.level_unit))
    with np.errstate(divide="ignore", invalid="ignore"):  # power <= 0 is found to be impossible
        db = numbers if factor is None else 10 * np.log10(numbers * factor)
    db = db + offset_db
    low, high = POSSIBLE_DB
    impossible = ~not_measured & ~not_detected & ~((db > low) & (db < high))
    db = np.where(not_measured | not_detected | impossible, np.nan, db)
    return Levels(db, not_measured, impossible)


def _is_one_of(text: pd.Series, numbers: np.ndarray, values: list[float | str],
               is_text: bool) -> np.ndarray:
    """Return where a cell equals one of the values, (n,) bool; texts in any case.

    Only in a column of texts is the word NaN another value than an empty cell.
    """
    labels = {value.strip().lower() for value in values if isinstance(value, str)}
    labels = {label if label == NOT_A_NUMBER and is_text else
              "" if label in (*EMPTY, "empty") else label for label in labels}
    result = np.isin(numbers, [value for value in values if not isinstance(value, str)])
    if labels:
        result |= text.str.lower().isin(labels).to_numpy(dtype=bool)
    return result


def _check_unit(source: Source, spec: str, numbers: np.ndarray, unit: str | None) -> None:
    if unit is None:
        values = "are all not detected"
        if len(numbers):
            values = (f"run from {numbers.min():g} to {numbers.max():g}, median "
                      f"{np.median(numbers):g}")
        raise BadInput(f"{source.path}: column {spec}: level_unit is not given; allowed are dBm, "
                       "mW and W (received power) and dB (channel gain, negative). The values "
                       f"{values}")
