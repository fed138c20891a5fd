"""Tables for GIS programs: rows with a geometry and a reference system, as GeoPandas has them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.geodesy import local_crs
from radiotwin.tables import Origin

if TYPE_CHECKING:
    from geopandas import GeoDataFrame


def geo_data_frame(table: pd.DataFrame, origin: Origin | None, *, position_m: np.ndarray | None
                   = None, geometry: Any = None) -> GeoDataFrame:
    """Return a table with a geometry in metres of the local frame.

    Its reference system is that of the frame, where the origin is known: `.to_crs(4326)` gives
    longitude and latitude.

    Args:
        table: n rows.
        origin: of the local frame; None: the result has no reference system.
        position_m: (n, 2) or (n, 3) points [m]; a row with NaN has no geometry.
        geometry: (n,) shapes in place of points.

    Raises:
        BadInput: GeoPandas is not installed.
    """
    try:
        import geopandas
    except ImportError:
        raise BadInput("a GeoDataFrame needs the package geopandas, which is not installed; "
                       "install it with `pip install 'radiotwin[geo]'`") from None
    if geometry is None:
        import shapely

        assert position_m is not None
        known = np.isfinite(position_m).all(axis=1)
        geometry = np.full(len(table), None, dtype=object)
        geometry[known] = shapely.points(position_m[known])
    crs = None if origin is None else local_crs(origin)
    return geopandas.GeoDataFrame(table, geometry=geometry, crs=crs)
