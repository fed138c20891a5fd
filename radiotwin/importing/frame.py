"""WGS84 or a projected system -> the local frame: x east, y north, z up, in metres."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.importing.settings import POSITION, Origin

DECIMALS = 7  # of a found origin [degrees]: a centimetre


@dataclass(frozen=True)
class Frame:
    """The plane that is azimuthal equidistant about the origin on the WGS84 ellipsoid; heights stay heights.

    Distance and bearing from the origin are exact and the ground stays at one z, as a flat city map has it; in a
    tangent plane (topocentric) the ground 10 km away would lie 8 m below zero.

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
            from pyproj import Proj

            plane = Proj(proj="aeqd", lat_0=self.origin.latitude_deg, lon_0=self.origin.longitude_deg, ellps="WGS84")
            known = positions[["latitude", "longitude"]].notna().all(axis=1).to_numpy()
            x_m, y_m = x_m.copy(), y_m.copy()
            x_m[known], y_m[known] = plane(positions["longitude"][known].to_numpy(dtype=float),
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
    latitude, longitude = (round(float(known[name].median()), DECIMALS) for name in ("latitude", "longitude"))
    return Frame(Origin(latitude_deg=latitude, longitude_deg=longitude))


def to_geographic(positions: pd.DataFrame, crs: str | None) -> pd.DataFrame:
    """`positions` with all of `POSITION`; x and y in the system `crs` [its unit] have become latitude and longitude.

    Raises:
        BadInput: unknown system, or x, y outside of it.
    """
    positions = positions.reindex(columns=list(POSITION)).astype(float)
    if crs is None:
        return positions
    from pyproj import Transformer
    from pyproj.exceptions import CRSError

    try:
        transformer = Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
    except CRSError as error:
        raise BadInput(f"crs {crs!r} is unknown; allowed is what PROJ knows, such as EPSG:32633 (UTM 33 N): {error}"
                       ) from None
    known = positions["x"].notna() & positions["y"].notna()
    longitude, latitude = transformer.transform(positions["x"][known].to_numpy(), positions["y"][known].to_numpy())
    if not (np.isfinite(longitude).all() and np.isfinite(latitude).all()):
        raise BadInput(f"some x, y lie outside of {crs}; is it another system?")
    positions.loc[known, "longitude"], positions.loc[known, "latitude"] = longitude, latitude
    return positions.assign(x=np.nan, y=np.nan)
