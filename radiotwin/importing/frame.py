"""Conversion of WGS84 or projected positions to the local frame: x east, y north, z up [m].

Conversion of lengths to metres.
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.geo.geodesy import ALLOWED, reference_system, to_local
from radiotwin.io.cells import shown
from radiotwin.io.forms import Origin

AREA_MARGIN_DEG = 1.0  # accepted outside the area for which a projected system is defined
ORIGIN_DECIMALS = 7  # of a computed origin [degrees]: 1 cm
METRES = {"m": 1.0, "ft": 0.3048}  # the international foot, exact since 1959


@dataclass(frozen=True)
class Frame:
    """The local frame about an origin (see `radiotwin.geo.geodesy`); heights are left as they are.

    Attributes:
        origin: None where all positions are local already.
    """

    origin: Origin | None

    def local_m(self, positions: pd.DataFrame) -> np.ndarray:
        """Convert positions to the local frame.

        Args:
            positions: any columns of `POSITION` [degrees, m], n rows.

        Returns:
            x, y, z [m], (n, 3); NaN where unknown.
        """
        local_m = np.full((len(positions), 3), np.nan)
        for axis, name in enumerate("xy"):
            if name in positions:
                local_m[:, axis] = positions[name]
        ground_m = 0.0 if self.origin is None else self.origin.altitude_m
        for name, zero_m in (("altitude", ground_m), ("z", 0.0), ("height", 0.0)):
            if name in positions:  # the last one counts
                height_m = positions[name].to_numpy(dtype=float) - zero_m
                known = ~np.isnan(height_m)
                local_m[known, 2] = height_m[known]
        if self.origin is not None and "latitude" in positions:
            known = positions[["latitude", "longitude"]].notna().all(axis=1).to_numpy()
            local_m[known, 0], local_m[known, 1] = to_local(
                self.origin, positions["longitude"][known], positions["latitude"][known])
        return local_m


def find_frame(declared: Origin | None, receivers: pd.DataFrame, devices: pd.DataFrame) -> Frame:
    """Return the frame about the declared origin, or about the median of the receivers.

    Args:
        declared: origin from the settings.
        receivers: positions with any columns of `POSITION`.
        devices: the same; their median is the origin where no receiver has a latitude.

    Raises:
        BadInput: some positions are local and some geographic, and no origin relates them.
    """
    if declared is not None:
        return Frame(declared)
    geographic, local = (any(name in ends and ends[name].notna().any()
                             for ends in (receivers, devices)) for name in ("latitude", "x"))
    if geographic and local:
        raise BadInput("some positions are latitude and longitude, others are local x and y; give "
                       "the origin of the local frame: --origin LATITUDE,LONGITUDE,ALTITUDE, or "
                       "the crs of x and y")
    if not geographic:
        return Frame(None)
    of_receivers = "latitude" in receivers and receivers["latitude"].notna().any()
    known = receivers if of_receivers else devices
    first = known["longitude"].dropna().iloc[0]
    east = (known["longitude"] - first + 180) % 360 - 180  # so that the date line does no harm
    longitude = (first + east.median() + 180) % 360 - 180
    return Frame(Origin(latitude_deg=round(float(known["latitude"].median()), ORIGIN_DECIMALS),
                        longitude_deg=round(float(longitude), ORIGIN_DECIMALS)))


def to_geographic(positions: pd.DataFrame, crs: str | None) -> pd.DataFrame:
    """Convert projected x, y to latitude and longitude.

    Args:
        positions: any columns of `POSITION`; x, y in the unit of `crs`.
        crs: name of a projected reference system, see `reference_system`; None leaves x, y as
            they are.

    Returns:
        latitude and longitude instead of x and y, and the other columns as they are.

    Raises:
        BadInput: unknown or not projected system, or x, y far outside its area of use.
    """
    if crs is None or "x" not in positions:
        return positions
    from pyproj import Transformer
    from pyproj.exceptions import CRSError, ProjError

    try:
        system = reference_system(crs)
    except CRSError as error:
        raise BadInput(f"crs {shown(crs)} is unknown ({error!s:.200}); give {ALLOWED}, such as "
                       "EPSG:32633 (UTM 33 N)") from None
    if not system.is_projected:
        raise BadInput(f"crs {shown(crs)} is {system.type_name}, not a projected one with x and y; "
                       "degrees go into latitude and longitude")
    known = positions["x"].notna() & positions["y"].notna()
    x, y = positions["x"][known].to_numpy(), positions["y"][known].to_numpy()
    try:
        transformer = Transformer.from_crs(system, "EPSG:4326", always_xy=True)
        longitude, latitude = transformer.transform(x, y)
    except ProjError as error:
        raise BadInput(f"crs {shown(crs)} cannot be converted to latitude and longitude "
                       f"({error!s:.200}); give another one, such as EPSG:32633 (UTM 33 N)"
                       ) from None
    area = system.area_of_use
    if area is not None:
        width = area.east - area.west
        east = (longitude - area.west + AREA_MARGIN_DEG) % 360  # it may cross the date line
        inside = (east <= width % 360 + 2 * AREA_MARGIN_DEG) | (width >= 360)
        inside &= latitude >= area.south - AREA_MARGIN_DEG
        inside &= latitude <= area.north + AREA_MARGIN_DEG
        if not inside.all():
            i = int(np.argmin(inside))
            raise BadInput(f"x, y = {x[i]:g}, {y[i]:g} is latitude {latitude[i]:.3f}, longitude "
                           f"{longitude[i]:.3f}, far outside of the area of {shown(crs)}; is it "
                           "another system, or are x and y swapped?")
    if not (np.isfinite(longitude) & np.isfinite(latitude)).all():
        i = int(np.argmin(np.isfinite(longitude) & np.isfinite(latitude)))
        raise BadInput(f"x, y = {x[i]:g}, {y[i]:g} is no place of {shown(crs)}; is it another "
                       "system, or another unit?")
    degrees = np.full((len(positions), 2), np.nan)
    degrees[known] = np.column_stack([longitude, latitude])
    return positions.drop(columns=["x", "y"]).assign(longitude=degrees[:, 0],
                                                     latitude=degrees[:, 1])


def in_metres(numbers: np.ndarray, unit: str | None, column: str) -> np.ndarray:
    """Convert lengths to metres.

    Args:
        numbers: (n,) in `unit`.
        unit: of `METRES`; None if it is not declared.
        column: file and column, for the message.

    Returns:
        lengths [m], (n,).

    Raises:
        BadInput: the unit is not declared.
    """
    if unit is None:
        known = numbers[np.isfinite(numbers)]
        values = f"run from {known.min():g} to {known.max():g}" if len(known) else "are all empty"
        raise BadInput(f"{column}: length_unit is not given; allowed are {' and '.join(METRES)}. "
                       f"The values {values}")
    return numbers * METRES[unit]
