"""The local frame on the globe: x east, y north [m] in the plane that is azimuthal equidistant about an origin.

On the WGS84 ellipsoid, with heights left as they are: distance and bearing from the origin are exact, and the ground
stays at one z, as a flat city map has it; in a tangent plane (topocentric) the ground 10 km away would lie 8 m below
zero.
"""

import numpy as np
from numpy.typing import ArrayLike

from radiotwin.tables import Origin


def local_crs(origin: Origin) -> str:
    """The local frame in the words of PROJ, for programs that place files by their coordinate reference system."""
    return (f"+proj=aeqd +lat_0={origin.latitude_deg!r} +lon_0={origin.longitude_deg!r} +x_0=0 +y_0=0 +datum=WGS84 "
            "+units=m +no_defs +type=crs")


def to_local(origin: Origin, longitude_deg: np.ndarray, latitude_deg: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """East and north of the origin [m], (n,) each; not finite where there is no such place."""
    return _plane(origin)(np.asarray(longitude_deg, dtype=float), np.asarray(latitude_deg, dtype=float))


def to_geographic(origin: Origin, x_m: ArrayLike, y_m: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Longitude and latitude of points in the local frame [degrees], (n,) each."""
    return _plane(origin)(np.asarray(x_m, dtype=float), np.asarray(y_m, dtype=float), inverse=True)


def _plane(origin: Origin):
    from pyproj import Proj

    return Proj(proj="aeqd", lat_0=origin.latitude_deg, lon_0=origin.longitude_deg, ellps="WGS84")
