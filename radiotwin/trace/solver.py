"""Gains of links by Sionna RT: along the paths that it finds, or averaged over lattice cells.

Sionna RT 2.2.0 returns some paths more than once, for two reasons. Its deterministic search sends
the rays twice, to count candidate paths and to store them. Some rays take another path the second
time (in RBM, single ones of 100,000, from their third interaction on, in 2 of 15 calls): their
candidates are counted but never written. Such a blank candidate appears as a direct path to the
first receiver of the call, without a direction of departure, up to 400 times (26 dB too much). And
if the meshes of two buildings share an edge, both diffract the same ray at the same point.
"""

import logging
import math
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from scipy.constants import speed_of_light

from radiotwin.errors import BadInput, RunFailed
from radiotwin.io.files import scratch_folder
from radiotwin.io.signals import deferred
from radiotwin.runtime import llvm
from radiotwin.runtime.cuda import Device
from radiotwin.runtime.processes import allowed_cores
from radiotwin.scene.antennas import Antenna
from radiotwin.scene.citymap import GROUND_M, SKIN_M
from radiotwin.scene.folder import CityShape, read_city, write_city
from radiotwin.scene.lattice import Lattice
from radiotwin.scene.materials import permittivity, ranges_text
from radiotwin.trace.mended import mended
from radiotwin.trace.settings import DIFFRACTION_PROBABILITY, TABLE_SIZE, SolverSettings

log = logging.getLogger(__name__)
City = Path | str | Sequence[CityShape] | None
"""`city.xml` of a scene folder, or what `read_city` returns; None for free space."""
GROUND_DEPTH_M = 1000.0  # thickness of the ground: as a half space, since its materials are lossy
_VARIANTS = {"cpu": "llvm_ad_mono_polarized", "cuda": "cuda_ad_mono_polarized"}
# Delays are single precision, with a unit roundoff of 6e-8, and sums of up to five segments.
_LENGTH_TOLERANCE = 1e-6  # relative
# Dr.Jit keeps freed memory for the next call. Releasing it after every call takes 40 % of the time
# for allocations; never releasing it may use ever more memory.
_CALLS_BETWEEN_FLUSHES = 10
# A path is no stronger than free space over its own length, but for this rounding
_BOUND_TOLERANCE_DB = 0.1
IMPOSSIBLE_DB = np.inf
"""Gain of a link that exceeds the bound of its paths."""
Antennas = tuple[Antenna | None, Antenna | None]


def library_versions() -> dict[str, str]:
    """Return the versions of the libraries that gains depend on."""
    return {f"{name.replace('-', '_')}_version": version(name)
            for name in ("sionna-rt", "mitsuba", "drjit")}


def import_sionna(device: Device = "cpu") -> Any:
    """Import and return `sionna.rt` for the processor (`cpu`, by libLLVM) or a GPU (`cuda`).

    A process cannot change from one to the other. Mitsuba looks for plugins in the working
    directory first, which may be the folder of a stranger's scene: it is restricted to the folder
    where it is installed. RunFailed without a usable libLLVM or GPU, or on another device already.
    """
    if device == "cpu":
        llvm.prepare()
    with deferred():  # Ctrl-C while compiled modules are loaded would abort the process
        import drjit
        import mitsuba

        _set_variant(mitsuba, device)
        import sionna.rt

    drjit.set_thread_count(allowed_cores())
    resolver = mitsuba.FileResolver()
    resolver.clear()
    resolver.append(os.path.dirname(os.path.realpath(mitsuba.__file__)))
    mitsuba.set_file_resolver(resolver)  # type: ignore[operator]  # as its stub says
    return sionna.rt


def _set_variant(mitsuba: Any, device: Device) -> None:
    """Select Mitsuba's variant for the processor or GPU; RunFailed if that is impossible."""
    wanted, used = _VARIANTS[device], mitsuba.variant()
    if used is None:
        try:
            mitsuba.set_variant(wanted)
        except ImportError as error:
            raise RunFailed(f"device {device}: {str(error).strip()}; `radiotwin doctor` says what "
                            "works") from None
    elif used != wanted:
        raise RunFailed(f"device {device}: Mitsuba works in its variant {used} in this process "
                        f"already, and not in {wanted}; begin a new process")


def load_city(city: City, frequency_hz: float, device: Device = "cpu") -> Any:
    """Load a city into Sionna RT, with vertically polarised isotropic antennas at both ends.

    Mitsuba's parser, which can load other files and plugins, gets a copy written from the parsed
    shapes, not the scene's own file. ITU materials outside their frequency range keep the constants
    at its nearest end, with a warning. BadInput if the file cannot be read.
    """
    rt = import_sionna(device)
    scene = rt.load_scene(None) if city is None else _load_copy(rt, city)
    for material in scene.radio_materials.values():
        if isinstance(material, rt.ITURadioMaterial):
            _hold_in_range(material, frequency_hz)
    scene.frequency = frequency_hz
    scene.tx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    scene.rx_array = scene.tx_array
    return scene


def _load_copy(rt: Any, city: Path | str | Sequence[CityShape]) -> Any:
    """Load a copy of a city into Sionna RT, with flat ground so thick that it is a half space."""
    shapes = read_city(city) if isinstance(city, Path | str) else city
    with scratch_folder() as folder:
        write_city(folder, [_as_half_space(shape) if _is_flat_ground(shape) else shape
                            for shape in shapes])
        try:
            return rt.load_scene(str(folder / "city.xml"))
        except (RuntimeError, ValueError, TypeError, LookupError, AttributeError, OSError,
                SyntaxError) as error:
            name = "the city" if shapes is city else city
            raise BadInput(f"{name}: Sionna RT cannot read it "
                           f"({str(error).strip()}); `radiotwin build-scene --check` lists what is "
                           "wrong with it") from None


def _is_flat_ground(shape: CityShape) -> bool:
    """Return whether all vertices of a shape are at z = 0."""
    return bool((np.abs(shape.mesh.vertices[:, 2]) < GROUND_M).all())


def _as_half_space(ground: CityShape) -> CityShape:
    """Make the ground so thick that nothing is reflected from its far side: a half space."""
    material = replace(ground.material, name=f"{ground.material.name}-ground",
                       thickness_m=GROUND_DEPTH_M)
    return replace(ground, material=material)


def _hold_in_range(material: Any, frequency_hz: float) -> None:
    """Use an ITU material's constants at the nearest end of its frequency range, with a warning."""
    epsilon, conductivity, in_range = permittivity(material.itu_type, frequency_hz)
    if in_range:
        return
    log.warning("material %s: ITU-R P.2040 defines %s for %s only; at %g GHz its constants at the "
                "nearest end are used (relative permittivity %.3g, conductivity %.3g S/m)",
                material.name, material.itu_type, ranges_text(material.itu_type),
                frequency_hz / 1e9, epsilon, conductivity)
    material.frequency_update_callback = lambda _: (epsilon, conductivity)


@contextmanager
def candidate_search(table_size: int, diffraction_probability: float) -> Iterator[None]:
    """Set two constants of Sionna RT's path search, for which it has no arguments, in this context.

    They are the entries of the hash table of candidate paths, and the probability that a ray that
    meets an edge is diffracted; see `TABLE_SIZE` and `DIFFRACTION_PROBABILITY` in
    `radiotwin.trace.settings`.
    """
    from sionna.rt.path_solvers.sb_candidate_generator import SBCandidateGenerator as Search

    before = Search.MIN_SPEC_COUNT_SIZE, Search.DIFFRACTION_SAMPLING_PROBABILITY
    Search.MIN_SPEC_COUNT_SIZE = table_size
    Search.DIFFRACTION_SAMPLING_PROBABILITY = diffraction_probability
    try:
        yield
    finally:
        Search.MIN_SPEC_COUNT_SIZE, Search.DIFFRACTION_SAMPLING_PROBABILITY = before


def distinct_paths(interactions: np.ndarray, vertices_m: np.ndarray, length_m: np.ndarray,
                   strength: np.ndarray, cos_turn: np.ndarray) -> np.ndarray:
    """Return which paths of each link count, (n, k) bool, each distinct path once.

    Paths are duplicates if they have the same interactions (depth, n, k), 0: none, in the same
    order at the same points (depth, n, k, 3), and the same length: the strongest counts. Paths of
    equal length over different points (two walls at equal distances) both count. There is no path
    where the length (n, k) is not positive. Of a link's direct paths the straightest counts:
    `cos_turn` (n, k), the cosine between the directions of departure and arrival, is -1 unless
    Sionna RT failed to store it.
    """
    exists = length_m > 0
    used = interactions > 0
    direct = exists & ~used.any(axis=0)
    counts = exists & ~direct
    straightest = np.where(direct, cos_turn, np.inf).argmin(axis=1) if direct.any() else 0
    links = np.flatnonzero(direct.any(axis=1))  # the straightest of their direct paths counts
    counts[links, np.broadcast_to(straightest, len(direct))[links]] = True

    link, path = np.nonzero(exists & ~direct)
    types = np.ascontiguousarray(interactions[:, link, path].T)
    kind = np.unique(types, axis=0, return_inverse=True)[1].reshape(-1)
    length = length_m[link, path]
    order = np.lexsort((-strength[link, path], length, kind, link))
    link, path, kind, length = link[order], path[order], kind[order], length[order]
    point_m = np.where(used[..., None], vertices_m, 0.0)
    # Sorted by length: duplicates are neighbours, or a few places apart
    for shift in range(1, len(link)):
        similar = ((link[shift:] == link[:-shift]) & (kind[shift:] == kind[:-shift])
                   & (length[shift:] - length[:-shift] <= _LENGTH_TOLERANCE * length[shift:]))
        if not similar.any():  # nor at a larger shift, as lengths rise within a link and kind
            break
        first = np.flatnonzero(similar)
        second = first + shift
        apart_m = np.abs(point_m[:, link[first], path[first]]
                         - point_m[:, link[second], path[second]])
        same = apart_m.max(axis=(0, 2)) <= SKIN_M  # as close as surfaces that count as one
        first, second = first[same], second[same]
        stronger = strength[link[first], path[first]] >= strength[link[second], path[second]]
        weaker = np.where(stronger, second, first)
        counts[link[weaker], path[weaker]] = False
    return counts


class PathGains:
    """Gains from a device to points along the paths that Sionna RT finds (shooting and images).

    Each call has one device and a fixed number of points. So a gain does not depend on other
    devices, nor, but for rare collisions in a hash table, on other points; kernels are compiled
    once; and memory is bounded. The settings must have the solver `paths`.

    Raises:
        BadInput: The file cannot be read.
        RunFailed: No usable libLLVM.
    """

    def __init__(self, city: City, frequency_hz: float, settings: SolverSettings) -> None:
        self.settings = settings
        self._calls = 0
        self._city = load_city(city, frequency_hz, settings.compute_device)
        rt = import_sionna(settings.compute_device)
        self._solver = rt.PathSolver(deterministic=True)
        self._transmitter = rt.Transmitter("device", position=[0.0, 0.0, 0.0])
        self._receivers = [rt.Receiver(f"r{i}", position=[0.0, 0.0, 0.0])
                           for i in range(settings.batch_receivers)]
        for radio_device in (self._transmitter, *self._receivers):
            self._city.add(radio_device)

    def batches(self, n: int) -> list[slice]:
        """Return the slices of `n` points that are solved in one call each."""
        step = self.settings.batch_receivers
        return [slice(start, min(start + step, n)) for start in range(0, n, step)]

    def solve(self, device_m: np.ndarray, points_m: np.ndarray, antennas: Antennas = (None, None)
              ) -> np.ndarray:
        """Return the gains (n,) of one batch of points (n, 3) [dB]; NaN where there is no path.

        Rays are launched in all directions, and vertically polarised. Each path is then weighted
        with the antennas' gains (device, receivers) in its directions of departure and arrival.
        Duplicate paths count once. A path carries at most the power of free space over its own
        length between the antennas' peaks: a link whose gain exceeds the sum of these bounds is
        solved again alone, with the next seed, and `IMPOSSIBLE_DB` if it still does.
        """
        seed = self.settings.seed
        gain_db = self._solve(device_m, points_m, antennas, seed)
        for row in np.flatnonzero(gain_db == IMPOSSIBLE_DB):
            point_m, next_seed = points_m[row:row + 1], (seed + 1) % 2**31
            gain_db[row] = self._solve(device_m, point_m, antennas, next_seed)[0]
        return gain_db

    def _solve(self, device_m: np.ndarray, points_m: np.ndarray, antennas: Antennas, seed: int
               ) -> np.ndarray:
        """Return the gains (n,) of one call [dB]; `IMPOSSIBLE_DB` above the upper bound."""
        import drjit

        settings = self.settings
        # A short batch is filled up with its last point: arrays of the same size need no new kernel
        padded_m = points_m[np.minimum(np.arange(settings.batch_receivers), len(points_m) - 1)]
        self._transmitter.position = [float(value) for value in device_m]
        for receiver, point_m in zip(self._receivers, padded_m):
            receiver.position = [float(value) for value in point_m]
        with candidate_search(TABLE_SIZE, DIFFRACTION_PROBABILITY), mended(settings.diffraction):
            paths = self._solver(
                self._city, max_depth=settings.max_depth, samples_per_src=settings.samples_per_src,
                max_num_paths_per_src=settings.max_num_paths_per_src,
                refraction=settings.refraction, diffraction=settings.diffraction != "off",
                seed=seed)
        power, bound = (sums[:len(points_m)] for sums in self._combine(paths, antennas))
        del paths
        self._calls += 1
        if self._calls % _CALLS_BETWEEN_FLUSHES == 0:
            drjit.flush_malloc_cache()
        possible = power <= bound * 10 ** (_BOUND_TOLERANCE_DB / 10)
        return np.where(possible, power_to_db(power), IMPOSSIBLE_DB)

    def gains(self, device_m: np.ndarray, points_m: np.ndarray, antennas: Antennas = (None, None)
              ) -> np.ndarray:
        """Return the gains (n,) of links to any number of points, by batches; see `solve`."""
        gain_db = np.full(len(points_m), np.nan)
        for part in self.batches(len(points_m)):
            gain_db[part] = self.solve(device_m, points_m[part], antennas)
        return gain_db

    def _combine(self, paths: Any, antennas: Antennas) -> tuple[np.ndarray, np.ndarray]:
        """Return received over transmitted power (batch_receivers,), and its upper bound.

        Powers of distinct paths, or fields with their phases, are added as the settings say. The
        bound takes every path as free space over its length, at the antennas' peaks.
        """
        n = self.settings.batch_receivers

        def by_link(values: Any) -> np.ndarray:
            return np.array(values, dtype=float).reshape(n, -1)

        field = by_link(paths.a[0]) + 1j * by_link(paths.a[1])
        leaving, arriving = (_unit_vectors(by_link(zenith), by_link(azimuth)) for zenith, azimuth in
                             ((paths.theta_t, paths.phi_t), (paths.theta_r, paths.phi_r)))
        # Sionna's coefficients lack the phase of the delay, which is -1 where there is no path
        delay_s = by_link(paths.tau)
        interactions = np.array(paths.interactions)
        interactions = interactions.reshape(len(interactions), *field.shape)
        vertices_m = np.array(paths.vertices).reshape(*interactions.shape, 3)
        counted = distinct_paths(interactions, vertices_m, speed_of_light * delay_s, np.abs(field),
                                 np.sum(leaving * arriving, axis=-1))
        field *= counted
        frequency_hz = float(self._city.frequency[0])
        limit = counted / (4 * np.pi * frequency_hz * np.where(counted, delay_s, 1.0))
        for antenna, direction in zip(antennas, (leaving, arriving)):
            if antenna is not None:
                field *= 10 ** (antenna.gain_dbi(direction) / 20)
                limit *= 10 ** (antenna.pattern.peak_dbi / 20)
        if self.settings.combining == "power":
            return _exact_sums(np.abs(field) ** 2), _exact_sums(limit**2)
        field *= np.exp(-2j * np.pi * frequency_hz * delay_s)
        return (_exact_sums(field.real) ** 2 + _exact_sums(field.imag) ** 2,
                _exact_sums(limit) ** 2)


class CellGains:
    """Gains from a device averaged over cells around lattice positions, one altitude at a time.

    A cell is a horizontal square of side `lattice.step_m`, centred on its position. Its gain is an
    average over the cell (400 m² with a step of 20 m): shadow borders are blurred, and links there
    have no sharp LoS.

    Raises:
        BadInput: The file cannot be read.
        RunFailed: No usable libLLVM.
    """

    def __init__(self, city: City, frequency_hz: float, settings: SolverSettings,
                 lattice: Lattice) -> None:
        self.settings = settings
        self.lattice = lattice
        self._city = load_city(city, frequency_hz, settings.compute_device)
        rt = import_sionna(settings.compute_device)
        self._solver = rt.RadioMapSolver()
        self._transmitter = rt.Transmitter("device", position=[0.0, 0.0, 0.0])
        self._city.add(self._transmitter)

    def solve(self, device_m: np.ndarray, z_m: float) -> np.ndarray:
        """Return the gains (ny * nx,) of cells at an altitude [dB]; NaN if no ray crosses one."""
        import drjit

        settings, lattice = self.settings, self.lattice
        step_m = lattice.step_m
        self._transmitter.position = [float(value) for value in device_m]
        with mended(settings.diffraction):
            radio_map = self._solver(
                self._city,
                center=[float(np.mean(lattice.x_m)), float(np.mean(lattice.y_m)), float(z_m)],
                orientation=[0.0, 0.0, 0.0], cell_size=[step_m, step_m],
                size=[len(lattice.x_m) * step_m, len(lattice.y_m) * step_m],
                samples_per_tx=settings.samples_per_src, max_depth=settings.max_depth,
                refraction=settings.refraction, diffraction=settings.diffraction != "off",
                seed=settings.seed)
        power = np.array(radio_map.path_gain, dtype=float).reshape(-1)
        del radio_map
        drjit.flush_malloc_cache()
        return power_to_db(power)


def power_to_db(power: np.ndarray) -> np.ndarray:
    """Return power ratios (any shape) in dB, NaN where they are zero."""
    with np.errstate(divide="ignore"):
        return np.where(power > 0, 10 * np.log10(power), np.nan)


def _unit_vectors(zenith_rad: np.ndarray, azimuth_rad: np.ndarray) -> np.ndarray:
    """Return the unit vectors (..., 3) of zenith and azimuth; the azimuth counts from x to y."""
    return np.stack([np.sin(zenith_rad) * np.cos(azimuth_rad),
                     np.sin(zenith_rad) * np.sin(azimuth_rad), np.cos(zenith_rad)], axis=-1)


def _exact_sums(values: np.ndarray) -> np.ndarray:
    """Sum each row exactly, as the order of Sionna RT's paths depends on threads."""
    return np.array([math.fsum(row[row != 0]) for row in values])
