"""The held-out residuals of all links of a close-loop, before and after."""

import numpy as np
import pandas as pd

from radiotwin.closeloop.residuals import Residuals
from radiotwin.closeloop.run import Loop


def residual_table(loop: Loop) -> pd.DataFrame:
    """Return held-out residuals, measured − predicted, one row for each link.

    Args:
        loop: result of the close-loop.

    Returns:
        columns `time_s, flight, receiver, receiver_x_m, receiver_y_m, receiver_z_m, device,
        device_x_m, device_y_m, device_z_m` (device positions of the model; NaN where it has none),
        `los` (1, 0),
        `measured_db` (dBm for power), `before_db` and `after_db`, NaN where the link was not
        detected or never held out
    """
    links = loop.after.links
    device_m = np.where(loop.after.whole.usable[:, None], links.device_m[links.device], np.nan)
    before_db, after_db = (links.level_db - model.held_out_mean_db
                           for model in (loop.before, loop.after))
    return pd.DataFrame({
        "time_s": links.time_s, "flight": np.array(links.flight_names)[links.flight],
        "receiver": np.array(links.receiver_names)[links.receiver],
        **{f"receiver_{axis}_m": links.receiver_m[:, i] for i, axis in enumerate("xyz")},
        "device": np.array(links.device_names)[links.device],
        **{f"device_{axis}_m": device_m[:, i] for i, axis in enumerate("xyz")},
        "los": links.los.astype(int), "measured_db": links.level_db, "before_db": before_db,
        "after_db": after_db})


def residuals(loop: Loop) -> Residuals:
    """Return the held-out residuals of a close-loop, see `residual_table`."""
    return Residuals(residual_table(loop), loop.origin)
