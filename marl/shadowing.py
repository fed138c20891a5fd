"""How long a twin's doubt lasts: what its map is wrong about is wrong in every slot of a flight, and nearby, too.

A map's `sigma_db` says how far off it may be, not for how long. Drawn anew in every slot it would pay to hover anywhere
and wait for luck, which only a world with such shadowing rewards. So the share of the variance that stays, and the
distance over which it does, are learnt from what the measurements leave over.
"""

from typing import NamedTuple

import numpy as np
from scipy.fft import fft2, next_fast_len

from radiotwin.inference.gaussian import standardised
from radiotwin.channel.residual_field import ResidualField
from radiotwin.measurements import Measurements
from radiotwin.radiomap import RadioMap
from radiotwin.twin import Twin

MOST_LINKS = 300  # of a device, to learn from
LEAST = 0.05  # share that is worth drawing
FAR = 3.0  # correlation lengths until fields of opposite sides of the map are taken to know nothing of each other


class Shadowing(NamedTuple):
    """Correlation of the shadowing of a link.

    Attributes:
        share: of its variance that stays as it is for a flight; the rest is drawn anew in every slot.
        length_m: distance over which the correlation of what stays falls to 1/e (Gudmundson 1991, Electronics
            Letters 27).
    """

    share: float = 0.0
    length_m: float = 50.0


def twin_shadowing(twin: Twin, radio_map: RadioMap, measurements: Measurements, limit_db: float,
                   seed: int) -> Shadowing:
    """That of a twin's errors: what its field says, where it interpolates and so leaves next to nothing over of what it
    has learnt from; otherwise what `fit_shadowing` finds."""
    if twin.residual_field is not None:
        found = Shadowing(twin.residual_field.share, twin.residual_field.length_m)
    else:
        found = fit_shadowing(radio_map, measurements, limit_db, seed)
    # What is over within a cell cannot be told from what is over within a slot, and next to nothing takes as long to
    # draw as much does.
    return found if found.length_m >= radio_map.lattice.step_m and found.share >= LEAST else Shadowing()


def fit_shadowing(radio_map: RadioMap, measurements: Measurements, limit_db: float, seed: int) -> Shadowing:
    """Learn it from what a map leaves over of measurements, in its sigmas, by maximum likelihood (`ResidualField`).

    Args:
        radio_map: of a twin, with `sigma_db`.
        measurements: what the twin was learnt from; receivers belong to the nearest cell.
        limit_db: gain below which nothing is detected; a link without level enters with its mean below.
        seed: picks links where there are too many.
    """
    lattice, rng = radio_map.lattice, np.random.default_rng(seed)
    axes = zip((lattice.z_m, lattice.y_m, lattice.x_m), measurements.receiver_m.T[::-1])
    cell = [np.abs(axis_m[:, None] - there_m).argmin(axis=0) for axis_m, there_m in axes]
    rows = []
    for number, device in enumerate(measurements.devices["device"]):
        if device in radio_map.devices:
            mine = np.flatnonzero(measurements.device_index == number)
            rows.append(rng.choice(mine, min(MOST_LINKS, len(mine)), replace=False))
    some = np.sort(np.concatenate(rows))
    names = measurements.devices["device"].to_numpy()[measurements.device_index[some]]
    at = np.array([radio_map.devices.index(name) for name in names]), *(axis[some] for axis in cell)
    mean_db, sigma_db = radio_map.gain_db[at].astype(float), radio_map.dataset["sigma_db"].values[at].astype(float)
    residual = standardised(measurements.level_db[some], mean_db, sigma_db, limit_db)
    field = ResidualField().fit(measurements.device_index[some], measurements.receiver_m[some], residual, seed)
    return Shadowing(field.share, field.length_m)


class CorrelatedField:
    """Gaussian fields of unit variance and correlation exp(-distance / length) over a grid, by circulant embedding
    (Dietrich and Newsam 1997, SIAM J. Sci. Comput. 18).

    Args:
        shape: (rows, columns).
        step_m: of the grid.
        length_m: of the correlation.
    """

    def __init__(self, shape: tuple[int, int], step_m: float, length_m: float):
        self._shape = shape
        # A torus on which the far side of the map is far enough away.
        around = [next_fast_len(side + min(side, int(np.ceil(FAR * length_m / step_m)))) for side in shape]
        rows, columns = (np.minimum(np.arange(n), n - np.arange(n)) * step_m for n in around)
        spectrum = fft2(np.exp(-np.hypot(rows[:, None], columns) / length_m)).real.clip(0)
        self._amplitude = np.sqrt(spectrum / spectrum.mean() / spectrum.size).astype(np.float32)

    def draw(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """(count, rows, columns) float32 independent fields."""
        pairs = -(-count // 2)
        noise = rng.standard_normal((pairs, *self._amplitude.shape, 2), dtype=np.float32).view(np.complex64)[..., 0]
        fields = fft2(noise * self._amplitude)[:, :self._shape[0], :self._shape[1]]
        return np.concatenate([fields.real, fields.imag])[:count]  # both parts are fields of their own
