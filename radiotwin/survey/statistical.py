"""The statistical truth of Chen et al. 2023: a distance law per LoS class, and shadowing."""

from dataclasses import dataclass

import numpy as np

from radiotwin.radiomap import RadioMap
from radiotwin.scene import Scene


@dataclass(frozen=True)
class SegmentedLaw:
    """gain = intercept_db + 10 · slope · log10(d / 1 m) + N(0, sigma_db²)."""

    intercept_db: float
    slope: float
    sigma_db: float

    def mean_db(self, log10_distance: np.ndarray) -> np.ndarray:
        """Return the mean gain [dB] at log10(d / 1 m), any shape."""
        return self.intercept_db + 10 * self.slope * log10_distance


# Parameters of Chen et al. 2023
LOS_LAW = SegmentedLaw(-30.0, -2.5, 2**0.5)
NLOS_LAW = SegmentedLaw(-35.0, -3.04, 5**0.5)


def segmented_truth(scene: Scene) -> RadioMap:
    """Return the mean gain and the shadowing of the segmented law over a scene's lattice.

    The mean is given below sensitivity, too: a survey draws the shadowing before it decides what is
    detected.

    Args:
        scene: City, devices and lattice.

    Returns:
        A map with `sigma_db`.
    """
    receiver_m = scene.lattice.positions_m
    gain_db, sigma_db, los = [], [], []
    for device_m in scene.device_m:
        seen = scene.city.line_of_sight(receiver_m, device_m[None])
        distance_m = np.sqrt(((receiver_m - device_m) ** 2).sum(axis=1))
        log_distance = np.log10(np.maximum(distance_m, 1.0))  # the law begins at 1 m
        gain_db.append(np.where(seen, LOS_LAW.mean_db(log_distance),
                                NLOS_LAW.mean_db(log_distance)))
        sigma_db.append(np.where(seen, LOS_LAW.sigma_db, NLOS_LAW.sigma_db))
        los.append(seen)
    return RadioMap.build(
        [device.device for device in scene.config.devices], scene.lattice, np.array(gain_db),
        np.array(los), np.array(sigma_db),
        {"source": "segmented", "frequency_hz": scene.config.radio.frequency_hz,
         "gain_limit_db": scene.config.gain_limit_db, "scene_hash": scene.content_hash()}
    ).placed(scene.config.origin)
