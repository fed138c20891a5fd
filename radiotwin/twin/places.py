"""Read the places at which a twin should predict: numbers, arrays, or a data frame of a user."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.io.cells import listed
from radiotwin.io.forms import Origin
from radiotwin.links.link_table import receivers_of_frame
from radiotwin.scene.citymap import CityMap

WANTED = "latitude, longitude or x_m, y_m, and height_m or above_ground_m"


@dataclass(frozen=True, eq=False)
class Places:
    """Receiver positions and devices of n links to predict.

    Attributes:
        index: (n,) labels of the user's rows.
        receiver_m: (n, 3) positions of the receivers [m].
        device: (n,) row of each link's device.
    """

    index: pd.Index
    receiver_m: np.ndarray
    device: np.ndarray

    @classmethod
    def read(cls, given: Any, columns: Mapping[str, Any], devices: list[str],
             origin: Origin | None, city: CityMap | None) -> Places:
        """Convert a user's places to receiver positions and device rows.

        They are a data frame, an array (n, 3) of x, y, z [m], or None, with numbers, names or
        arrays (n,) of further columns. Without a column `device`, each device is paired with each
        place. BadInput names row and column.
        """
        frame = _frame(given, columns)
        sites = receivers_of_frame(frame)
        receiver_m = sites.local_m(origin, None, "the twin")
        if "above_ground_m" in sites.values:
            above_m = sites.values["above_ground_m"].to_numpy()
            ground_m = 0.0 if city is None else city.ground_height_m(*receiver_m[:, :2].T)
            receiver_m[:, 2] = np.where(np.isnan(above_m), receiver_m[:, 2], ground_m + above_m)
        sites.refuse_rows(np.isnan(receiver_m[:, :2]).any(axis=1), lambda _: (
            "the position is empty; fill it in, or leave the row out"))
        sites.refuse_rows(np.isnan(receiver_m[:, 2]), lambda _: (
            "the height is missing; give height_m (above the scene's datum) or above_ground_m, "
            "such as above_ground_m=1.5 for a phone in the hand"))
        if "device" not in frame:
            row = np.repeat(np.arange(len(frame)), len(devices))
            return cls(frame.index[row], receiver_m[row],
                       np.tile(np.arange(len(devices)), len(frame)))
        device = pd.Index(devices).get_indexer(frame["device"].astype(str))
        if (device < 0).any():
            name = frame["device"].iloc[int(np.argmax(device < 0))]
            raise BadInput(f"device {name!r} is not in the twin; it has {listed(devices)}")
        return cls(frame.index, receiver_m, device)


def _frame(given: Any, columns: Mapping[str, Any]) -> pd.DataFrame:
    """Combine a data frame or array with named columns to one data frame."""
    if isinstance(given, np.ndarray) and given.ndim == 2 and given.shape[1] == 3:
        given = pd.DataFrame(given, columns=["x_m", "y_m", "z_m"])
    if given is not None and not isinstance(given, pd.DataFrame):
        shape = f" of the shape {given.shape}" if isinstance(given, np.ndarray) else ""
        raise BadInput(f"places are a data frame, an array (n, 3) of x, y, z in metres, or named "
                       f"numbers ({WANTED}), not {type(given).__name__}{shape}")
    if given is None and not columns:
        raise BadInput(f"say where: pass a data frame, or {WANTED}, such as "
                       "predict(x_m=10, y_m=20, height_m=1.5, device=...)")
    try:
        if given is not None:
            return given.assign(**columns)
        arrays = np.broadcast_arrays(*(np.asarray(values, dtype=object)
                                       for values in columns.values()))
        frame = pd.DataFrame({name: array.ravel() for name, array in zip(columns, arrays)})
        return frame.infer_objects()
    except ValueError:
        lengths = {name: np.shape(values) for name, values in columns.items() if np.shape(values)}
        rows = "" if given is None else f" of a data frame of {len(given)} rows"
        raise BadInput(f"columns{rows} have different lengths: {lengths}; give one value for all, "
                       "or the same number for each") from None
