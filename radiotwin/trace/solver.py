"""Gains of links by the paths that Sionna RT finds."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from radiotwin.antennas import Antenna
from radiotwin.trace.settings import DIFFRACTION_PROBABILITY, TABLE_SIZE, SolverSettings
from radiotwin.trace.sionna_scene import candidate_search, import_sionna, load_city

# Dr.Jit keeps freed memory for the next call, which takes the same sizes again but for the paths themselves.
# Given back after every call, 40 % of the time goes into asking the system for it anew; never, it may pile up.
CALLS_BETWEEN_FLUSHES = 10

Antennas = tuple[Antenna | None, Antenna | None]


class PathGains:
    """Gains from one device to many points, found by shooting rays and the image method.

    Each call of Sionna RT has one device and a fixed number of points. So a gain does not depend on the other
    devices, nor, but for rare collisions in a hash table, on the other points; kernels are compiled once; and
    memory is bounded.

    Args:
        xml_path: Mitsuba scene file; None for free space.
        frequency_hz: frequency [Hz].
        settings: with solver `paths`.

    Raises:
        BadInput: the file cannot be read.
        RunFailed: no usable libLLVM.
    """

    def __init__(self, xml_path: Path | str | None, frequency_hz: float, settings: SolverSettings):
        self.settings = settings
        self._calls = 0
        self._city = load_city(xml_path, frequency_hz)
        rt = import_sionna()
        self._solver = rt.PathSolver(deterministic=True)
        self._transmitter = rt.Transmitter("device", position=[0.0, 0.0, 0.0])
        self._receivers = [rt.Receiver(f"r{i}", position=[0.0, 0.0, 0.0]) for i in range(settings.batch_receivers)]
        for radio_device in (self._transmitter, *self._receivers):
            self._city.add(radio_device)

    def batches(self, n: int) -> list[slice]:
        """The parts that `n` points are solved in."""
        step = self.settings.batch_receivers
        return [slice(start, min(start + step, n)) for start in range(0, n, step)]

    def solve(self, device_m: np.ndarray, points_m: np.ndarray, antennas: Antennas = (None, None)) -> np.ndarray:
        """Gains of one batch.

        Args:
            device_m: (3,) position [m].
            points_m: (n, 3) positions [m], n at most `settings.batch_receivers`.
            antennas: of the device and of the receivers; None: isotropic. Rays are launched all around whatever the
                antennas; each path then has their gains in the directions in which it leaves and arrives, and stays
                vertically polarised, as a pattern of levels says nothing else.

        Returns:
            (n,) gain [dB]; NaN where there is no path.
        """
        import drjit

        settings = self.settings
        # A batch that is not full is filled with its last point: the same shapes run the same kernels.
        padded_m = points_m[np.minimum(np.arange(settings.batch_receivers), len(points_m) - 1)]
        self._transmitter.position = [float(value) for value in device_m]
        for receiver, point_m in zip(self._receivers, padded_m):
            receiver.position = [float(value) for value in point_m]
        with candidate_search(TABLE_SIZE, DIFFRACTION_PROBABILITY):
            paths = self._solver(
                self._city, max_depth=settings.max_depth, samples_per_src=settings.samples_per_src,
                max_num_paths_per_src=settings.max_num_paths_per_src, refraction=settings.refraction,
                diffraction=settings.diffraction, seed=settings.seed)
        power = self._combine(paths, antennas)[: len(points_m)]
        del paths
        self._calls += 1
        if self._calls % CALLS_BETWEEN_FLUSHES == 0:
            drjit.flush_malloc_cache()
        with np.errstate(divide="ignore"):
            return np.where(power > 0, 10 * np.log10(power), np.nan)

    def gains(self, device_m: np.ndarray, points_m: np.ndarray, antennas: Antennas = (None, None)
              ) -> Iterator[np.ndarray]:
        """Gains [dB] at (n, 3) points, batch by batch."""
        for part in self.batches(len(points_m)):
            yield self.solve(device_m, points_m[part], antennas)

    def _combine(self, paths, antennas: Antennas) -> np.ndarray:
        """(batch_receivers,) received over transmitted power."""
        real, imaginary = (np.array(part, dtype=float).reshape(self.settings.batch_receivers, -1) for part in paths.a)
        field = real + 1j * imaginary
        for antenna, zenith, azimuth in zip(antennas, (paths.theta_t, paths.theta_r), (paths.phi_t, paths.phi_r)):
            if antenna is not None:
                zenith, azimuth = (np.array(angle, dtype=float).reshape(field.shape) for angle in (zenith, azimuth))
                field *= 10 ** (antenna.gain_dbi(_rays(zenith, azimuth)) / 20)
        if self.settings.combining == "power":
            return _exact_sums(np.abs(field) ** 2)
        # Sionna's coefficients leave out the phase of the delay, which is -1 where there is no path.
        delay_s = np.array(paths.tau, dtype=float).reshape(field.shape)
        phase = -2 * np.pi * float(self._city.frequency[0]) * delay_s
        field *= np.exp(1j * phase)
        return _exact_sums(field.real) ** 2 + _exact_sums(field.imag) ** 2


def _rays(zenith: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    """(..., 3) unit vectors east, north, up of Sionna's angles [rad], the azimuth counter-clockwise from east."""
    return np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], axis=-1)


def _exact_sums(values: np.ndarray) -> np.ndarray:
    """Sum of each row, rounded once: Sionna RT gives the same paths in an order that threads decide."""
    return np.array([math.fsum(row[row != 0]) for row in values])
