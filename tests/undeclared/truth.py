"""Gains of the true world: Sionna RT with antennas, rough walls and settings that the product does not use.

Two searches are added by power. The first follows mirror-like reflections and first-order diffraction, five
interactions deep; the second follows what rough walls scatter, two deep, with few rays, as scattered paths are many
and weak.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from radiotwin.trace.solver import candidate_search, import_sionna, load_city

SPECULAR = {"max_depth": 5, "samples_per_src": 60_000, "max_num_paths_per_src": 1_000_000, "diffraction": True,
            "refraction": False, "seed": 20_011}
SCATTERED = {"max_depth": 2, "samples_per_src": 1_500, "max_num_paths_per_src": 600_000, "diffraction": False,
             "refraction": False, "los": False, "specular_reflection": False, "diffuse_reflection": True, "seed": 77}
TABLE_SIZE = 3_000_017  # a prime; the entries that candidate paths are told apart by
DIFFRACTION_SHARE = 0.4  # of the rays that meet an edge
RECEIVERS = 108  # positions a call: it divides the 1080 of a case
CALLS_BETWEEN_FLUSHES = 10


@dataclass(frozen=True)
class Antenna:
    """An antenna and how it is turned.

    Attributes:
        pattern: a name of Sionna RT, vertically polarised in its own frame.
        turn_rad: (3,) or (n, 3) angles about z, then y, then x, for one device or n receivers.
    """

    pattern: str = "iso"
    turn_rad: np.ndarray | tuple = (0.0, 0.0, 0.0)


class TrueCity:
    """A true city that can be solved for one device at a time."""

    def __init__(self, xml_path: Path, frequency_hz: float):
        self._city = load_city(xml_path, frequency_hz)
        self._rt = import_sionna()
        self._solver = self._rt.PathSolver(deterministic=True)
        self._transmitter = self._rt.Transmitter("device", position=[0.0, 0.0, 0.0])
        self._receivers = [self._rt.Receiver(f"r{i}", position=[0.0, 0.0, 0.0]) for i in range(RECEIVERS)]
        for end in (self._transmitter, *self._receivers):
            self._city.add(end)
        self._calls = 0

    def gains(self, device_m: np.ndarray, points_m: np.ndarray, at_device: Antenna = Antenna(),
              at_receiver: Antenna = Antenna()) -> np.ndarray:
        """(n,) gains of the links from a device to points (n, 3) [dB], NaN where there is no path."""
        self._city.tx_array = self._array(at_device.pattern)
        self._city.rx_array = self._array(at_receiver.pattern)
        self._transmitter.position = [float(value) for value in device_m]
        self._transmitter.orientation = [float(value) for value in at_device.turn_rad]
        turns = np.broadcast_to(at_receiver.turn_rad, (len(points_m), 3))
        power = np.concatenate([self._power(points_m[start:start + RECEIVERS], turns[start:start + RECEIVERS])
                                for start in range(0, len(points_m), RECEIVERS)])
        with np.errstate(divide="ignore"):
            return np.where(power > 0, 10 * np.log10(power), np.nan)

    def _array(self, pattern: str):
        return self._rt.PlanarArray(num_rows=1, num_cols=1, pattern=pattern, polarization="V")

    def _power(self, points_m: np.ndarray, turns_rad: np.ndarray) -> np.ndarray:
        import drjit

        last = len(points_m) - 1
        for number, receiver in enumerate(self._receivers):  # a call that is not full repeats its last point
            row = min(number, last)
            receiver.position = [float(value) for value in points_m[row]]
            receiver.orientation = [float(value) for value in turns_rad[row]]
        total = np.zeros(RECEIVERS)
        for settings in (SPECULAR, SCATTERED):
            with candidate_search(TABLE_SIZE, DIFFRACTION_SHARE):
                paths = self._solver(self._city, **settings)
            real, imaginary = (np.array(part, dtype=float).reshape(RECEIVERS, -1) for part in paths.a)
            # An exact sum does not depend on the order that threads leave the paths in.
            total += [math.fsum(row[row > 0]) for row in real**2 + imaginary**2]
            del paths
        self._calls += 1
        if self._calls % CALLS_BETWEEN_FLUSHES == 0:
            drjit.flush_malloc_cache()
        return total[:len(points_m)]
