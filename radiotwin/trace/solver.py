"""Gains of links by the paths that Sionna RT finds."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from radiotwin.antennas import Antenna
from radiotwin.trace.settings import DIFFRACTION_PROBABILITY, TABLE_SIZE, SolverSettings
from radiotwin.trace.sionna_scene import candidate_search, import_sionna, load_city

# Dr.Jit keeps freed memory for the next call, which needs the same sizes again but for the paths.
# Freed after every call, 40 % of the time goes into allocating it again; never, it may pile up.
_CALLS_BETWEEN_FLUSHES = 10

Antennas = tuple[Antenna | None, Antenna | None]


class PathGains:
    """Gains from one device to many points, found by shooting rays and the image method.

    Each call of Sionna RT has one device and a fixed number of points. So a gain does not depend on
    the other devices, nor, but for rare collisions in a hash table, on the other points; kernels
    are compiled once; and memory is bounded.

    Args:
        xml_path: `city.xml` of a scene folder; None for free space.
        frequency_hz: Frequency [Hz].
        settings: Settings with solver `paths`.

    Raises:
        BadInput: The file cannot be read.
        RunFailed: No usable libLLVM.
    """

    def __init__(self, xml_path: Path | str | None, frequency_hz: float, settings: SolverSettings
                 ) -> None:
        self.settings = settings
        self._calls = 0
        self._city = load_city(xml_path, frequency_hz)
        rt = import_sionna()
        self._solver = rt.PathSolver(deterministic=True)
        self._transmitter = rt.Transmitter("device", position=[0.0, 0.0, 0.0])
        self._receivers = [rt.Receiver(f"r{i}", position=[0.0, 0.0, 0.0])
                           for i in range(settings.batch_receivers)]
        for radio_device in (self._transmitter, *self._receivers):
            self._city.add(radio_device)

    def batches(self, n: int) -> list[slice]:
        """Return the slices that `n` points are solved in."""
        step = self.settings.batch_receivers
        return [slice(start, min(start + step, n)) for start in range(0, n, step)]

    def solve(self, device_m: np.ndarray, points_m: np.ndarray, antennas: Antennas = (None, None)
              ) -> np.ndarray:
        """Solve one batch.

        Rays are launched all around whatever the antennas. Each path then gets their gains in the
        directions in which it leaves and arrives, and stays vertically polarised, as a pattern of
        levels says nothing else.

        Args:
            device_m: (3,) position [m].
            points_m: (n, 3) positions [m], n at most `settings.batch_receivers`.
            antennas: Antennas of the device and of the receivers; None: isotropic.

        Returns:
            (n,) gain [dB]; NaN where there is no path.
        """
        import drjit

        settings = self.settings
        # A short batch is filled up with its last point: the same shapes run the same kernels
        padded_m = points_m[np.minimum(np.arange(settings.batch_receivers), len(points_m) - 1)]
        self._transmitter.position = [float(value) for value in device_m]
        for receiver, point_m in zip(self._receivers, padded_m):
            receiver.position = [float(value) for value in point_m]
        with candidate_search(TABLE_SIZE, DIFFRACTION_PROBABILITY):
            paths = self._solver(
                self._city, max_depth=settings.max_depth, samples_per_src=settings.samples_per_src,
                max_num_paths_per_src=settings.max_num_paths_per_src,
                refraction=settings.refraction, diffraction=settings.diffraction,
                seed=settings.seed)
        power = self._combine(paths, antennas)[: len(points_m)]
        del paths
        self._calls += 1
        if self._calls % _CALLS_BETWEEN_FLUSHES == 0:
            drjit.flush_malloc_cache()
        return power_to_db(power)

    def gains(self, device_m: np.ndarray, points_m: np.ndarray, antennas: Antennas = (None, None),
              advance: Callable[[int], None] = lambda n: None) -> np.ndarray:
        """Solve any number of points, batch by batch.

        Args:
            device_m: (3,) position [m].
            points_m: (n, 3) positions [m].
            antennas: As in `solve`.
            advance: Called with the number of points after each batch.

        Returns:
            (n,) gain [dB]; NaN where there is no path.
        """
        gain_db = np.full(len(points_m), np.nan)
        for part in self.batches(len(points_m)):
            gain_db[part] = self.solve(device_m, points_m[part], antennas)
            advance(part.stop - part.start)
        return gain_db

    def _combine(self, paths: Any, antennas: Antennas) -> np.ndarray:
        """Return the (batch_receivers,) received over transmitted power."""
        real, imaginary = (np.array(part, dtype=float).reshape(self.settings.batch_receivers, -1)
                           for part in paths.a)
        field = real + 1j * imaginary
        ends = zip(antennas, (paths.theta_t, paths.theta_r), (paths.phi_t, paths.phi_r))
        for antenna, zenith, azimuth in ends:
            if antenna is not None:
                zenith, azimuth = (np.array(angle, dtype=float).reshape(field.shape)
                                   for angle in (zenith, azimuth))
                field *= 10 ** (antenna.gain_dbi(_directions(zenith, azimuth)) / 20)
        if self.settings.combining == "power":
            return _exact_sums(np.abs(field) ** 2)
        # Sionna's coefficients lack the phase of the delay, which is -1 where there is no path
        delay_s = np.array(paths.tau, dtype=float).reshape(field.shape)
        phase = -2 * np.pi * float(self._city.frequency[0]) * delay_s
        field *= np.exp(1j * phase)
        return _exact_sums(field.real) ** 2 + _exact_sums(field.imag) ** 2


def power_to_db(power: np.ndarray) -> np.ndarray:
    """Return a power ratio in dB, NaN where it is zero."""
    with np.errstate(divide="ignore"):
        return np.where(power > 0, 10 * np.log10(power), np.nan)


def _directions(zenith_rad: np.ndarray, azimuth_rad: np.ndarray) -> np.ndarray:
    """Return (..., 3) unit vectors of Sionna's angles; the azimuth counts from x to y."""
    return np.stack([np.sin(zenith_rad) * np.cos(azimuth_rad),
                     np.sin(zenith_rad) * np.sin(azimuth_rad), np.cos(zenith_rad)], axis=-1)


def _exact_sums(values: np.ndarray) -> np.ndarray:
    """Sum each row exactly: the order in which Sionna RT returns paths depends on threads."""
    return np.array([math.fsum(row[row != 0]) for row in values])
