"""The difference of two radio maps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from radiotwin.display.axes import DIFFERENCE_COLOURS, plain, residual_range_db
from radiotwin.display.summary import Summary, count, some
from radiotwin.errors import BadInput
from radiotwin.geo.frames import is_same_frame, place
from radiotwin.maps.form import GROUND
from radiotwin.maps.view import OverDevices, map_table, origin_of, pick, plot_values
from radiotwin.scene import Scene

if TYPE_CHECKING:
    from geopandas import GeoDataFrame
    from matplotlib.axes import Axes

NAME = "difference_db"
SAME_M = 1e-3  # positions nearer than this are one [m]


@dataclass(frozen=True, eq=False, repr=False)
class MapDifference(OverDevices):
    """Gain of one map minus that of another.

    Of a map of distributions (`sigma_db`) the mean counts, also where a link would not be detected;
    `score_map` compares with a truth as it is detected.

    Attributes:
        dataset: variable `difference_db` (float32, NaN where either map has no gain) with dims
            (device, z, y, x); attributes `minuend` and `subtrahend` are the sources of the maps.
    """

    dataset: xr.Dataset

    @classmethod
    def of(cls, first: xr.Dataset, second: xr.Dataset) -> MapDifference:
        """Subtract the gains of a map from those of another.

        Args:
            first: dataset of a radio map.
            second: dataset of another one with the same devices over the same lattice.

        Raises:
            BadInput: other devices, other positions, other ground, or another frame.
        """
        names = [[str(name) for name in each["device"].values] for each in (first, second)]
        if set(names[0]) != set(names[1]):
            raise BadInput(f"the maps have different devices, {some(names[0])} and "
                           f"{some(names[1])}; take those of both with `selected` first")
        for axis in "xyz":
            ours_m, theirs_m = first[axis].values, second[axis].values
            if ours_m.shape != theirs_m.shape or not np.allclose(ours_m, theirs_m, rtol=0,
                                                                 atol=SAME_M):
                raise BadInput(f"the maps are over different positions: {axis} goes from "
                               f"{ours_m[0]:g} to {ours_m[-1]:g} m in {len(ours_m)} steps, and "
                               f"from {theirs_m[0]:g} to {theirs_m[-1]:g} m in {len(theirs_m)}; "
                               "make both for the same scene")
        ground_m, other_m = (each[GROUND].values if GROUND in each else 0.0
                             for each in (first, second))
        if not np.allclose(ground_m, other_m, rtol=0, atol=SAME_M):
            raise BadInput("the maps are over different ground, or one is of heights above the "
                           "ground and the other of heights above the datum; make both for the "
                           "same scene")
        origin, other = (origin_of({str(name): value for name, value in each.attrs.items()})
                         for each in (first, second))
        if origin is not None and other is not None and not is_same_frame(origin, other):
            raise BadInput(f"the maps are in different frames, about {place(origin)} and about "
                           f"{place(other)}; make both for the same scene")
        order = [names[1].index(name) for name in names[0]]
        difference = first["gain_db"].values - second["gain_db"].values[order]
        known = origin or other
        attributes = {f"origin_{name}": value
                      for name, value in (known.model_dump() if known else {}).items()}
        attributes |= {"minuend": str(first.attrs.get("source", "")),
                       "subtrahend": str(second.attrs.get("source", ""))}
        variable = (first["gain_db"].dims, difference.astype(np.float32),
                    {"units": "dB", "long_name": "difference of the gains"})
        return cls(xr.Dataset({NAME: variable}, first.coords, attributes))

    @property
    def difference_db(self) -> np.ndarray:
        """(device, z, y, x) difference [dB]; NaN where either map has no gain."""
        return self.dataset[NAME].values

    @property
    def rmse_db(self) -> float:
        """Root of the mean square over all links that both maps have [dB]; NaN without one."""
        known = self.difference_db[np.isfinite(self.difference_db)].astype(float)
        return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")

    @property
    def mean_db(self) -> float:
        """Mean over all links that both maps have [dB]; NaN without one."""
        known = self.difference_db[np.isfinite(self.difference_db)].astype(float)
        return float(known.mean()) if len(known) else float("nan")

    def plot(self, device: str | None = None, altitude_m: float | None = None,
             ax: Axes | None = None, *, scene: Scene | None = None,
             geographic: bool | None = None) -> Axes:
        """Draw the difference for one device at one altitude, red where the first map has more.

        Args:
            device: name; None: the first one.
            altitude_m: one of the maps' [m]; None: the lowest.
            ax: axes of matplotlib to draw into; None: a new figure.
            scene: whose buildings are outlined; None: none are.
            geographic: whether axes are longitude and latitude; None: where the origin is known.

        Returns:
            The axes.

        Raises:
            BadInput: no such device or altitude, or longitude and latitude without an origin.
        """
        device, altitude_m, part = pick(self.dataset, device, altitude_m)
        high_db = residual_range_db(part[NAME].values)
        ax = plot_values(part[NAME], self.origin, ax, geographic, scene, device,
                         "difference of the gains [dB]", "both", cmap=DIFFERENCE_COLOURS,
                         vmin=-high_db, vmax=high_db)
        names = " − ".join(plain(self.dataset.attrs[each], 40) or "map"
                           for each in ("minuend", "subtrahend"))
        ax.set_title(f"{names}\ndevice {plain(device)} at {altitude_m:g} m")
        return ax

    def to_geodataframe(self) -> GeoDataFrame:
        """Return a row with a point for each device and position, in metres of the local frame.

        Raises:
            BadInput: GeoPandas is not installed.
        """
        return map_table(self.dataset, [NAME], self.origin)

    @property
    def _summary(self) -> Summary:
        known = int(np.isfinite(self.difference_db).sum())
        names = " − ".join(self.dataset.attrs[each] or "map" for each in ("minuend", "subtrahend"))
        return Summary(
            "MapDifference", f"{names}, {count(len(self), 'device')}, RMS {self.rmse_db:.2f} dB, "
            f"mean {self.mean_db:+.2f} dB", (
                ("maps", names), ("devices", some(self.devices)),
                ("links in both", f"{known:,} of {self.difference_db.size:,}"),
                ("RMS", f"{self.rmse_db:.2f} dB"), ("mean", f"{self.mean_db:+.2f} dB")))
