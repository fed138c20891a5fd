"""Measured antenna patterns: reading MSI Planet (.msi, .pln) and CSV files, gain along a ray."""

import io
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from radiotwin.errors import BadInput
from radiotwin.io.budgets import COLUMNS, DOCUMENT_BYTES
from radiotwin.io.inputs import read_bytes

# Steps between azimuths that differ by less than this share of their mean count as equal: files
# round azimuths.
EVEN_SHARE = 0.01
MAX_GAIN_DBI = 60.0  # [dBi], about that of a dish of 20 m at 5 GHz; more is taken for an error
ROUNDED_DB = 0.1  # [dB], allowed difference of rows of one direction: files hold one decimal
AZIMUTH_DEG = np.arange(0.0, 360.0)  # grid of the patterns that are interpolated from two cuts
ELEVATION_DEG = np.arange(-90.0, 91.0)
_COLUMNS = {"azimuth_deg": (-360, 360), "elevation_deg": (-90, 90),
            "gain_dbi": (-200, MAX_GAIN_DBI)}  # of a CSV file, with the range of allowed values
_TOLERANCE_DB = ROUNDED_DB + 1e-9  # decimals are no exact binary numbers
_GAIN = re.compile(r"([+-]?\d+(?:\.\d*)?)\s*(dbd|dbi)?", re.IGNORECASE)


@dataclass(frozen=True, eq=False)
class Pattern:
    """Gain on a grid of directions in the antenna's own frame.

    Attributes:
        azimuth_deg: (n,) ascending, 0 to less than 360, clockwise from the boresight seen from
            above.
        elevation_deg: (m,) ascending, -90 (below) to 90 (above).
        gain_dbi: (m, n) gain over an isotropic antenna [dBi].
    """

    azimuth_deg: np.ndarray
    elevation_deg: np.ndarray
    gain_dbi: np.ndarray

    @property
    def peak_dbi(self) -> float:
        """Maximum gain of the grid [dBi]."""
        return float(self.gain_dbi.max())

    def at(self, azimuth_deg: ArrayLike, elevation_deg: ArrayLike) -> np.ndarray:
        """Interpolate the gain [dBi], bilinear in dB and periodic in azimuth.

        Azimuths are clockwise from the boresight. Elevations, upwards, are clipped to the grid's.
        """
        # The first column is repeated at the end: 359.5 degrees lies between the last and the first
        azimuths = np.append(self.azimuth_deg, self.azimuth_deg[0] + 360)
        gains = np.column_stack([self.gain_dbi, self.gain_dbi[:, :1]])
        wrapped = (np.asarray(azimuth_deg) - azimuths[0]) % 360 + azimuths[0]
        column, right = _bracket(azimuths, wrapped)
        row, above = _bracket(self.elevation_deg, np.clip(elevation_deg, -90, 90))
        low = (1 - right) * gains[row, column] + right * gains[row, column + 1]
        high = (1 - right) * gains[row + 1, column] + right * gains[row + 1, column + 1]
        return (1 - above) * low + above * high

    def heading_mean(self) -> "Pattern":
        """Average the power over all azimuths, for an antenna on a carrier that turns.

        Evenly spaced azimuths have equal weight. Otherwise the interpolated pattern is averaged.
        """
        gaps_deg = np.diff(self.azimuth_deg, append=self.azimuth_deg[0] + 360)
        power = 10 ** (self.gain_dbi / 10)
        if np.ptp(gaps_deg) > EVEN_SHARE * gaps_deg.mean():
            # Between two azimuths the gain is linear in dB: its mean power is the logarithmic mean
            # of the powers at both ends
            rise = np.diff(self.gain_dbi, append=self.gain_dbi[:, :1]) * np.log(10) / 10
            is_flat = np.abs(rise) < 1e-9
            power = power * np.where(is_flat, 1.0, np.expm1(rise) / np.where(is_flat, 1.0, rise))
        mean_dbi = 10 * np.log10(power @ gaps_deg / 360)
        return Pattern(np.array([0.0]), self.elevation_deg, mean_dbi[:, None])


def _bracket(grid: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the index (…,) of the grid value below each value, and its fraction (…,) of the step.

    Values beyond the grid are clipped to its ends.
    """
    index = np.clip(np.searchsorted(grid, values, side="right") - 1, 0, len(grid) - 2)
    clipped = np.clip(values, grid[0], grid[-1])
    return index, (clipped - grid[index]) / (grid[index + 1] - grid[index])


@dataclass(frozen=True, eq=False)
class Antenna:
    """An antenna pattern with its orientation.

    Attributes:
        pattern: gain in the antenna's own frame.
        azimuth_deg: direction of the boresight, clockwise from north.
        tilt_deg: elevation of the boresight, above zero upwards.
    """

    pattern: Pattern
    azimuth_deg: float = 0.0
    tilt_deg: float = 0.0

    def gain_dbi(self, rays: np.ndarray) -> np.ndarray:
        """Return the gain (...,) [dBi] along rays (..., 3): east, north, up, of any length."""
        azimuth, tilt = np.radians([self.azimuth_deg, self.tilt_deg])
        ahead = np.array([np.sin(azimuth), np.cos(azimuth), 0.0])
        right = np.array([np.cos(azimuth), -np.sin(azimuth), 0.0])
        up = np.array([0.0, 0.0, 1.0])
        ahead, up = (np.cos(tilt) * ahead + np.sin(tilt) * up,
                     np.cos(tilt) * up - np.sin(tilt) * ahead)
        unit = rays / np.maximum(np.linalg.norm(rays, axis=-1, keepdims=True), 1e-30)
        return self.pattern.at(np.degrees(np.arctan2(unit @ right, unit @ ahead)),
                               np.degrees(np.arcsin(np.clip(unit @ up, -1, 1))))


def read_pattern(path: Path | str) -> Pattern:
    """Read an antenna pattern.

    `.msi`, `.pln`: GAIN in dBd unless dBi is written, and the cuts HORIZONTAL and VERTICAL of 360
    attenuations [dB] each. Angles of the vertical cut count downwards from the horizon, as
    manufacturers give downtilts; directions between the cuts are interpolated (see
    `between_cuts`).
    `.csv`: columns azimuth_deg (clockwise from the boresight), elevation_deg (up) and gain_dbi, on
    a full grid.
    If several rows have one direction, such as 0 and 360 degrees, the first is used; they may
    differ by `ROUNDED_DB`.

    Args:
        path: file to read.

    Returns:
        The pattern in the antenna's own frame.

    Raises:
        BadInput: no such file, an unknown format, a missing part, an impossible number, rows that
            contradict each other, or too large; with file and row.
    """
    path = Path(path)
    return parse_pattern(path, read_bytes(path, "pattern of an antenna", DOCUMENT_BYTES))


def parse_pattern(path: Path, text: bytes) -> Pattern:
    """Parse the content of an antenna file, see `read_pattern`.

    Args:
        path: name of the file; its suffix is the format.
        text: content of the file.

    Raises:
        BadInput: as `read_pattern`.
    """
    readers = {".msi": _read_msi, ".pln": _read_msi, ".csv": _read_csv}
    if path.suffix.lower() not in readers:
        raise BadInput(f"{path}: unknown format {path.suffix!r} of an antenna; allowed are "
                       f"{', '.join(readers)}")
    pattern = readers[path.suffix.lower()](path, text)
    if not -MAX_GAIN_DBI <= pattern.peak_dbi <= MAX_GAIN_DBI:
        raise BadInput(f"{path}: a gain of {pattern.peak_dbi:g} dBi is not possible; allowed is up "
                       f"to {MAX_GAIN_DBI:g} dBi")
    return pattern


def between_cuts(horizontal_db: np.ndarray, vertical_db: np.ndarray) -> np.ndarray:
    """Interpolate relative gain over the sphere from two cuts, by horizontal projection [1].

    With f the azimuth's fraction of the way from the front (0) to the back (1):
    G(az, el) = G_H(az) - (1 - f) (G_H(0) - G_V(el)) - f (G_H(180) - G_V(180 - el)).

    [1] Gil, Claro, Ferreira, Pardelinha, Correia, "A 3-D interpolation method for
    base-station-antenna radiation patterns", IEEE Antennas and Propagation Magazine 43(2), 2001.

    Args:
        horizontal_db: (360,) relative gain at azimuths 0 to 359 degrees [dB].
        vertical_db: (360,) relative gain at angles 0 to 359 degrees, downwards from the horizon in
            front [dB].

    Returns:
        (181, 360) relative gain at elevations -90 to 90 degrees [dB].
    """
    down = -ELEVATION_DEG.astype(int)
    front_db, back_db = vertical_db[down % 360, None], vertical_db[(180 - down) % 360, None]
    fraction = np.minimum(AZIMUTH_DEG, 360 - AZIMUTH_DEG) / 180
    return horizontal_db - (1 - fraction) * (horizontal_db[0] - front_db) \
        - fraction * (horizontal_db[180] - back_db)


def _read_msi(path: Path, text: bytes) -> Pattern:
    """Parse an MSI Planet file: GAIN [dBd or dBi], and two cuts of attenuations [dB]."""
    gain_dbi: float | None = None
    cuts: dict[str, dict[float, float]] = {"HORIZONTAL": {}, "VERTICAL": {}}
    cut: dict[float, float] | None = None
    for row, line in enumerate(text.decode("latin-1").splitlines(), start=1):
        fields = line.split()
        if not fields:
            continue
        key = fields[0].upper()
        if key == "GAIN":
            found = _GAIN.fullmatch(" ".join(fields[1:]))
            if not found:
                raise BadInput(f"{path}, row {row}: {line.strip()[:60]!r} is not GAIN, a number, "
                               "and dBd or dBi")
            is_dbi = (found[2] or "dBd").lower() == "dbi"
            gain_dbi = float(found[1]) + (0.0 if is_dbi else 2.15)  # 0 dBd: a half-wave dipole
        elif key in cuts:
            cut = cuts[key]
        elif cut is not None:
            try:
                angle, attenuation = (float(field) for field in fields)
            except ValueError:
                angle = attenuation = np.nan
            if not (0 <= angle <= 360 and 0 <= attenuation < 200):
                raise BadInput(f"{path}, row {row}: {line.strip()[:60]!r} is not an angle (0 to "
                               "360) and an attenuation (0 dB or more)")
            known = cut.setdefault(angle % 360, -attenuation)
            if abs(known + attenuation) > _TOLERANCE_DB:
                raise _contradiction_error(path, row, f"angle {angle:g}", -known, attenuation)
    for key, cut in cuts.items():
        if len(cut) < 2:
            raise BadInput(f"{path}: has no cut {key}; it needs HORIZONTAL and VERTICAL with an "
                           "angle and an attenuation a row")
    if gain_dbi is None:
        raise BadInput(f"{path}: has no GAIN; add a row such as GAIN 15.5 dBi")
    horizontal_db, vertical_db = (_resample(cut) for cut in cuts.values())
    return Pattern(AZIMUTH_DEG, ELEVATION_DEG, gain_dbi + between_cuts(horizontal_db, vertical_db))


def _contradiction_error(path: Path, row: int, direction: str, known_db: float,
                         given_db: float) -> BadInput:
    """Return the error that two rows of one direction have different gains."""
    return BadInput(f"{path}, row {row}: {direction} has {given_db:g} dB, an earlier row of this "
                    f"direction {known_db:g} dB; rows of one direction (0 and 360 degrees are one) "
                    f"may differ by {ROUNDED_DB:g} dB, remove the wrong one")


def _resample(cut: dict[float, float]) -> np.ndarray:
    """Interpolate a cut (angle [degrees] -> gain [dB]) at every whole degree, (360,)."""
    return np.interp(AZIMUTH_DEG, list(cut), list(cut.values()), period=360)


def _read_csv(path: Path, text: bytes) -> Pattern:
    """Parse a CSV file with a gain for every pair of azimuth and elevation of a grid."""
    COLUMNS.check(text.partition(b"\n")[0].count(b",") + 1, path)
    try:
        table = pd.read_csv(io.BytesIO(text), skipinitialspace=True, encoding="utf-8-sig",
                            usecols=lambda name: name in _COLUMNS)
    except (ValueError, OSError) as error:
        raise BadInput(f"{path} cannot be read as CSV: {error}") from None
    columns = list(_COLUMNS)
    if missing := [name for name in columns if name not in table]:
        raise BadInput(f"{path}: column {missing[0]!r} is missing; it needs {columns}, it has "
                       f"{list(table.columns)}")
    numbers = table[columns].apply(pd.to_numeric, errors="coerce")
    for name, (low, high) in _COLUMNS.items():
        bad = ~numbers[name].between(low, high)
        if bad.any():
            row = int(np.flatnonzero(bad)[0])
            given = str(table[name][row])[:60]
            raise BadInput(f"{path}: row {row + 2}, column {name}: {given!r} is not a "
                           f"number from {low} to {high}")
    # A tiny negative angle becomes 360, which is 0
    numbers["azimuth_deg"] = numbers["azimuth_deg"] % 360 % 360
    first_dbi = numbers.groupby(columns[:2])["gain_dbi"].transform("first")
    apart = np.flatnonzero((numbers["gain_dbi"] - first_dbi).abs() > _TOLERANCE_DB)
    if len(apart):
        row = int(apart[0])
        azimuth, elevation, gain_dbi = numbers.iloc[row]
        raise _contradiction_error(path, row + 2, f"azimuth {azimuth:g}, elevation {elevation:g}",
                                   first_dbi[row], gain_dbi)
    numbers = numbers.drop_duplicates(columns[:2])
    across, up = (numbers[name].nunique() for name in columns[:2])
    if across * up != len(numbers) or up < 2:
        raise BadInput(f"{path}: {len(table)} rows are no full grid of {up} elevations and "
                       f"{across} azimuths; give a gain for every pair")
    grid = numbers.pivot(index="elevation_deg", columns="azimuth_deg", values="gain_dbi")
    return Pattern(grid.columns.to_numpy(dtype=float), grid.index.to_numpy(dtype=float),
                   grid.to_numpy(dtype=float))
