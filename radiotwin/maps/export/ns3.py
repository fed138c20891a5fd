"""Losses between nodes for ns-3's MatrixPropagationLossModel, as two tables.

The model holds one loss for each pair of nodes and none that changes with time [1].

[1] ns-3 manual, "Propagation": MatrixPropagationLossModel::SetLoss, SetDefaultLoss.
"""

from pathlib import Path

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.io.budgets import ROWS
from radiotwin.io.cells import write_csv
from radiotwin.io.files import atomic_path

NODES, LOSSES = "nodes.csv", "losses.csv"
_POSITION = ["x_m", "y_m", "z_m"]


def write_ns3(devices: pd.DataFrame, points_m: np.ndarray, gain_db: np.ndarray,
              folder: Path | str) -> int:
    """Write `nodes.csv` and `losses.csv`.

    `nodes.csv` has a row for each node: `node` (its number, devices first), `x_m, y_m, z_m`, and
    `name` (`point0`, … of points). `losses.csv` has a row for each pair with a gain: `device_node`,
    `point_node`, `loss_db`, positive.

    Args:
        devices: k rows `device, x_m, y_m, z_m`.
        points_m: (n, 3) positions of the other ends [m].
        gain_db: (k, n) channel gain [dB]; NaN: no link.
        folder: to write to; other files in it are kept.

    Returns:
        number of pairs.

    Raises:
        BadInput: no gain at all, or a device without a position, or one that is called as a point.
    """
    names = [f"point{number}" for number in range(len(points_m))]
    unplaced = ~np.isfinite(devices[_POSITION].to_numpy(dtype=float)).all(axis=1)
    if unplaced.any():
        raise BadInput(f"device {devices['device'].iloc[int(np.argmax(unplaced))]!r} has no "
                       "position, which a node needs; leave it out with --devices")
    same = set(devices["device"]) & set(names)
    if same:
        raise BadInput(f"device {sorted(same)[0]!r} has the name of a point; rename it")
    seen = np.isfinite(gain_db)
    if not seen.any():
        raise BadInput("no pair of a device and a point has a gain; are the points outdoors and in "
                       "reach?")
    ROWS.check(gain_db.size, "points times devices")
    device, point = np.nonzero(seen)
    nodes = pd.DataFrame(np.vstack([devices[_POSITION].to_numpy(dtype=float), points_m]),
                         columns=_POSITION)
    nodes.insert(0, "node", np.arange(len(nodes)))
    nodes["name"] = [*devices["device"], *names]  # last: a name may have a comma
    losses = pd.DataFrame({"device_node": device, "point_node": len(devices) + point,
                           "loss_db": -gain_db[seen]})
    folder = Path(folder)
    with atomic_path(folder / NODES) as first, atomic_path(folder / LOSSES) as second:
        write_csv(nodes, first, "%.3f")
        write_csv(losses, second, "%.3f")
    return len(losses)
