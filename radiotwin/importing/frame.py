"""WGS84 or a projected system -> the local frame: x east, y north, z up, in metres."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.geodesy import to_local
from radiotwin.importing.settings import POSITION
from radiotwin.tables import Origin

MARGIN_DEG = 1.0  # around the area for which a projected system is made
DECIMALS = 7  # of a found origin [degrees]: a centimetre


@dataclass(frozen=True)
class Frame:
    """The local frame about an origin (see `radiotwin.geodesy`); heights stay heights.

    Attributes:
        origin: None where all positions are local already.
    """

    origin: Origin | None

    def local_m(self, positions: pd.DataFrame) -> np.ndarray:
        """(n, 3) x, y, z of positions with columns of `POSITION`; NaN where unknown."""
        x_m, y_m = positions["x"].to_numpy(dtype=float), positions["y"].to_numpy(dtype=float)
        ground_m = 0.0 if self.origin is None else self.origin.altitude_m
        above_m = positions["height"].fillna(positions["z"]).fillna(positions["altitude"] - ground_m)
        if self.origin is not None:
            known = positions[["latitude", "longitude"]].notna().all(axis=1).to_numpy()
            x_m, y_m = x_m.copy(), y_m.copy()
            x_m[known], y_m[known] = to_local(self.origin, positions["longitude"][known].to_numpy(dtype=float),
                                              positions["latitude"][known].to_numpy(dtype=float))
        return np.column_stack([x_m, y_m, above_m.to_numpy(dtype=float)])


def find_frame(declared: Origin | None, receivers: pd.DataFrame, devices: pd.DataFrame) -> Frame:
    """The frame about the declared origin, or about the median of the receivers, on altitude zero.

    Raises:
        BadInput: some positions are local and some geographic, and nothing says how they lie to each other.
    """
    if declared is not None:
        return Frame(declared)
    both = pd.concat([receivers, devices])
    geographic, local = both["latitude"].notna().any(), both["x"].notna().any()
    if geographic and local:
        raise BadInput("some positions are latitude and longitude, others are local x and y; give the origin of the "
                       "local frame: --origin LATITUDE,LONGITUDE,ALTITUDE, or the crs of x and y")
    if not geographic:
        return Frame(None)
    known = receivers if receivers["latitude"].notna().any() else devices
    first = known["longitude"].dropna().iloc[0]
    east = (known["longitude"] - first + 180) % 360 - 180  # a median across the date line, too
    longitude = (first + east.median() + 180) % 360 - 180
    return Frame(Origin(latitude_deg=round(float(known["latitude"].median()), DECIMALS),
                        longitude_deg=round(float(longitude), DECIMALS)))


def to_geographic(positions: pd.DataFrame, crs: str | None) -> pd.DataFrame:
    """`positions` with all of `POSITION`; x and y in the system `crs` [its unit] have become latitude and longitude.

    Raises:
        BadInput: unknown system, or x, y outside of it.
    """
    positions = positions.reindex(columns=list(POSITION)).astype(float)
    if crs is None:
        return positions
    from pyproj import CRS, Transformer
    from pyproj.exceptions import CRSError

    try:
        system = CRS(crs)
    except CRSError as error:
        raise BadInput(f"crs {crs!r} is unknown; allowed is what PROJ knows, such as EPSG:32633 (UTM 33 N): {error}"
                       ) from None
    if not system.is_projected:
        raise BadInput(f"crs {crs} is {system.type_name}, not a projected one with x and y; degrees go into latitude "
                       "and longitude")
    transformer = Transformer.from_crs(system, "EPSG:4326", always_xy=True)
    known = positions["x"].notna() & positions["y"].notna()
    longitude, latitude = transformer.transform(positions["x"][known].to_numpy(), positions["y"][known].to_numpy())
    area = system.area_of_use
    if area is not None:
        east = (longitude - area.west + MARGIN_DEG) % 360  # the area may lie across the date line
        inside = (east <= (area.east - area.west) % 360 + 2 * MARGIN_DEG) | (area.east - area.west >= 360)
        inside &= (latitude >= area.south - MARGIN_DEG) & (latitude <= area.north + MARGIN_DEG)
        if not inside.all():
            i = int(np.argmin(inside))
            raise BadInput(f"x, y = {positions['x'][known].iloc[i]:g}, {positions['y'][known].iloc[i]:g} is latitude "
                           f"{latitude[i]:.3f}, longitude {longitude[i]:.3f}, far outside of the area of {crs}; is it "
                           "another system, or are x and y swapped?")
    positions.loc[known, "longitude"], positions.loc[known, "latitude"] = longitude, latitude
    return positions.assign(x=np.nan, y=np.nan)
