"""The radio map that a simulated flight meets: traced, statistical, or any other.

The statistical truth of Chen et al. 2023: a distance law per LoS class, and shadowing.
"""

from dataclasses import dataclass

import numpy as np
from scipy.constants import speed_of_light

from radiotwin.errors import BadInput
from radiotwin.io.inputs import require_within
from radiotwin.maps.radiomap import RadioMap
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


def read_truth(scene: Scene, truth: str = "traced") -> RadioMap:
    """Return the radio map that a command's option `--truth` names.

    Args:
        scene: the world to fly in.
        truth: `traced` (SCENE/truth.nc), `segmented` (statistical), or the path of a radio map.

    Raises:
        BadInput: the scene was not traced, or the file is not a radio map.
    """
    if truth == "segmented":
        return segmented_truth(scene)
    if truth == "traced":
        path = scene.folder / "truth.nc"
        if not path.is_file():
            raise BadInput(f"{path} does not exist; run `radiotwin trace {scene.folder}` first, or "
                           "use --truth segmented")
        return RadioMap.read(require_within(scene.folder, path, str(scene.folder)))
    return RadioMap.read(truth)


# A map says nothing of its links' paths. In a street, two walls and the ground give 16 paths of at
# most four reflections, each weaker than the direct one: 9 off the walls, 7 off the ground, too.
_MAX_PATHS = 16


def require_possible(scene: Scene, truth: RadioMap) -> None:
    """Raise BadInput if a traced link with line of sight is far above free space.

    The bound is free space (ITU-R P.525-4, eq. 4) between the peaks of the antennas, and 12 dB, or
    24 dB where fields were added: 16 paths as strong as the direct one. Maps that are not of gains
    at points (the solver `map`, statistical truths) are not checked.

    Args:
        scene: Scene that the map was made for.
        truth: Map with all its devices.
    """
    attributes = truth.dataset.attrs
    if attributes.get("source") != "raytrace" or attributes.get("solver") != "paths":
        return
    coherent = attributes.get("combining") == "coherent"
    bound_db = (20 if coherent else 10) * np.log10(_MAX_PATHS)
    positions_m, frequency_hz = scene.lattice.positions_m, scene.config.radio.frequency_hz
    for device, at_m, antenna in zip(scene.config.devices, scene.device_m, scene.device_antennas):
        row = truth.devices.index(device.device)
        distance_m = np.maximum(np.linalg.norm(positions_m - at_m, axis=1), 0.01)
        above_db = (truth.gain_db[row].ravel() - sum(
            end.pattern.peak_dbi for end in (antenna, scene.uav_antenna) if end is not None)
            - 20 * np.log10(speed_of_light / (4 * np.pi * frequency_hz * distance_m)))
        wrong = truth.los[row].ravel() & (above_db > bound_db)
        if wrong.any():
            worst = int(np.where(wrong, above_db, -np.inf).argmax())
            position = ", ".join(f"{value:g}" for value in positions_m[worst])
            raise BadInput(
                f"{wrong.sum()} links with line of sight of {device.device} lie more than "
                f"{bound_db:.0f} dB above free space (at {position} m {above_db[worst]:+.1f} dB), "
                "which no reflections bring; versions that counted a direct path several times "
                "made such maps: run `radiotwin trace` again")
