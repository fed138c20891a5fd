"""List all paths between a scene's devices and points as one dataset and NetCDF file.

The paths are a contiguous ragged array of the CF conventions, section 9.3.3: the paths of the first
link, then of the second, and so on; `path_count` is their number. Each path has gain, phase, delay,
angles and interactions. Each link has the spreads of delay, angle and Doppler, the K factor and the
impulse response.
"""

from collections.abc import Iterator
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.constants import speed_of_light

from radiotwin.errors import BadInput
from radiotwin.io.budgets import PATHS, RESPONSE_VALUES, ROWS
from radiotwin.io.files import atomic_file, require_suffix, require_writable
from radiotwin.maps.file import CONVENTIONS
from radiotwin.propagation.paths.candidates import candidate_search
from radiotwin.propagation.paths.fields import buffer_amplitudes
from radiotwin.propagation.paths.images import (
    MAX_INTERACTIONS,
    Candidates,
    PathBuffer,
    found_clear,
    unit_vectors,
)
from radiotwin.propagation.paths.interactions import city_slabs
from radiotwin.propagation.terrain import is_far, terrain_paths
from radiotwin.runtime.console import progress
from radiotwin.scene import Scene
from radiotwin.scene.citymap import CityMap
from radiotwin.trace.run import device_indices
from radiotwin.trace.solver import power_to_db

RECEIVER_CHUNK = 500  # receivers at a time
PATH_CHUNK = 20_000  # paths at a time: about 10 MB
NO_INTERACTION, REFLECTION, DIFFRACTION, TERRAIN = 0, 1, 2, 3
SCHEMA = "radiotwin.paths/1"
_UNITS = {"db": "dB", "s": "s", "hz": "Hz", "deg": "degree", "rad": "rad", "m": "m"}
_LONG_NAMES = {
    "gain_db": "sum of the paths' powers, both antennas included (NaN: no path)",
    "coherent_gain_db": "power of the sum of the paths' fields (NaN: no path)",
    "rms_delay_spread_s": "power-weighted standard deviation of the delays",
    "k_factor_db": "direct over all other power (NaN: no direct path, or no other)",
    "path_gain_db": "power gain of the path, both antennas included",
    "phase_rad": "phase of the received field with that of the delay, exp(+j omega t)",
    "first_delay_s": "delay of the first path",
    "doppler_hz": "Doppler shift, positive where the receiver approaches",
    "tap_delay_s": "delay after the link's first path",
    "interaction_m": "points of interaction, from device to receiver (NaN: none)",
}
EDGE_TAPS = 16  # taps before the first and after the last path for the ringing of the low-pass


class Rays(NamedTuple):
    """Paths from one device, sorted by receiver and delay.

    Attributes:
        receiver: (p,) row of the receiver.
        amplitude: (p,) complex gain between vertically polarised isotropic antennas, with the phase
            of the delay, for fields that vary as exp(+j ω t).
        length_m: (p,) length [m].
        kinds: (p, MAX_INTERACTIONS) kind of each interaction, then NO_INTERACTION.
        points_m: (p, MAX_INTERACTIONS, 3) points of interaction [m], then NaN.
        departure: (p, 3) unit vectors from the device along the path.
        arrival: (p, 3) unit vectors from the receiver along the path.
    """

    receiver: np.ndarray
    amplitude: np.ndarray
    length_m: np.ndarray
    kinds: np.ndarray
    points_m: np.ndarray
    departure: np.ndarray
    arrival: np.ndarray


NO_RAYS = Rays(np.zeros(0, dtype=int), np.zeros(0, dtype=complex), np.zeros(0),
               np.zeros((0, MAX_INTERACTIONS), dtype=np.int8),
               np.zeros((0, MAX_INTERACTIONS, 3)), *np.zeros((2, 0, 3)))


def follow_rays(city: CityMap, device_m: np.ndarray, receiver_m: np.ndarray, frequency_hz: float,
                depth: int = 4) -> Iterator[tuple[Rays, int]]:
    """Find paths of up to `depth` interactions from a device (3,) to receivers (n, 3) [m].

    As `radiotwin.propagation.paths.powers.PathPowers`, but without diffraction at two edges.

    Yields:
        The paths to the next chunk of receivers, with rows of all receivers, and the chunk's size.
    """
    search = candidate_search(city, depth)
    candidates = search.candidates(device_m)
    kinds = _kinds(candidates)
    wave_number = 2 * np.pi * frequency_hz / speed_of_light
    slabs = city_slabs(city, frequency_hz)
    buffer = PathBuffer.allocate(PATH_CHUNK)
    for first in range(0, len(receiver_m), RECEIVER_CHUNK):
        ends_m = np.ascontiguousarray(receiver_m[first:first + RECEIVER_CHUNK], dtype=float)
        far = is_far(device_m, ends_m)
        near = np.flatnonzero(~far)
        parts = [_direct(city, device_m, ends_m[near], wave_number)]
        for rows in found_clear(city, search.surfaces, candidates, device_m, ends_m[near], buffer):
            found = buffer_amplitudes(search.surfaces, candidates, wave_number, slabs, buffer, rows)
            parts.append(_rays(buffer, rows, kinds[buffer.candidate[rows]], *found))
        joined = _joined(parts)
        joined = joined._replace(receiver=near[joined.receiver])
        dark = np.setdiff1d(near, joined.receiver)
        rows = np.append(np.flatnonzero(far), dark[city.hidden_by_ground(device_m, ends_m[dark])])
        joined = _joined([joined, _along_terrain(city, device_m, ends_m, rows, wave_number)])
        order = np.lexsort((joined.length_m, joined.receiver))
        rays = Rays(*(array[order] for array in joined))
        yield rays._replace(receiver=rays.receiver + first), len(ends_m)


def _direct(city: CityMap, device_m: np.ndarray, ends_m: np.ndarray, wave_number: float) -> Rays:
    """Return the direct paths (ITU-R P.525-4, eq. 4) to the receivers that see the device."""
    lit = np.flatnonzero(city.line_of_sight(device_m, ends_m))
    length_m = np.linalg.norm(ends_m[lit] - device_m, axis=1)
    forth = unit_vectors(ends_m[lit] - device_m)
    amplitude = np.exp(-1j * wave_number * length_m) / np.maximum(2 * wave_number * length_m, 1e-9)
    return Rays(lit, amplitude, length_m, np.zeros((len(lit), MAX_INTERACTIONS), dtype=np.int8),
                np.full((len(lit), MAX_INTERACTIONS, 3), np.nan), forth, -forth)


def _along_terrain(city: CityMap, device_m: np.ndarray, ends_m: np.ndarray, rows: np.ndarray,
                   wave_number: float) -> Rays:
    """Return one path over the terrain profile to each of the receivers `rows`."""
    ends_m = ends_m[rows]
    along = terrain_paths(city, device_m, ends_m, wave_number * speed_of_light / (2 * np.pi))
    legs = along.edge_m - device_m, along.edge_m - ends_m
    lengths_m = [np.maximum(np.linalg.norm(leg, axis=1), 1e-9) for leg in legs]
    bent = ~city.line_of_sight(device_m, ends_m)
    kinds = np.zeros((len(rows), MAX_INTERACTIONS), dtype=np.int8)
    points_m = np.full((len(rows), MAX_INTERACTIONS, 3), np.nan)
    kinds[bent, 0], points_m[bent, 0] = TERRAIN, along.edge_m[bent]
    return Rays(rows, np.sqrt(along.gain) * np.exp(-1j * wave_number * sum(lengths_m)),
                sum(lengths_m), kinds, points_m, *map(unit_vectors, legs))


def _rays(buffer: PathBuffer, rows: np.ndarray, kinds: np.ndarray, amplitude: np.ndarray,
          length_m: np.ndarray) -> Rays:
    """Return the paths in rows (p,) of a buffer with their directions and points."""
    between_m = np.where(kinds[:, :, None] == NO_INTERACTION, np.nan,
                         buffer.points_m[rows, 1:-1])
    return Rays(buffer.receiver[rows], amplitude, length_m, kinds, between_m,
                *map(unit_vectors, buffer.end_legs_m(rows)))


def _kinds(candidates: Candidates) -> np.ndarray:
    """Return the (c, MAX_INTERACTIONS) kinds of interactions of each candidate."""
    before, after = (candidates.before >= 0).sum(axis=1), (candidates.after >= 0).sum(axis=1)
    over_edge = candidates.edge >= 0
    place = np.arange(MAX_INTERACTIONS)
    used = place < (before + over_edge + after)[:, None]
    at_edge = over_edge[:, None] & (place == before[:, None])
    return np.where(used, np.where(at_edge, DIFFRACTION, REFLECTION),
                    NO_INTERACTION).astype(np.int8)


def _joined(parts: list[Rays]) -> Rays:
    """Concatenate paths."""
    return Rays(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def list_paths(scene: Scene | Path | str, points_m: np.ndarray, out_path: Path | str | None = None,
               devices: list[str] | None = None, velocity_m_s: ArrayLike | None = None,
               bandwidth_hz: float | None = None) -> xr.Dataset:
    """Find the paths from a scene's devices to points, with gain, delay, angles and spreads.

    Paths have up to 4 interactions, at most one of them a diffraction. If terrain blocks a link
    without paths, and beyond 5 km, there is one path along the terrain profile. Both ends are
    vertically polarised and have the scene's antennas. Azimuths are clockwise from north,
    elevations above the horizon; an angle of arrival is the direction from which the path arrives.

    Args:
        scene: 3D map, devices and radio.
        points_m: (n, 3) positions of the receiver [m].
        out_path: NetCDF-4 file to write; None writes nothing.
        devices: names; None: all devices of the scene.
        velocity_m_s: (3,) of the receiver east, north and up [m/s], for Doppler shifts.
        bandwidth_hz: of the impulse responses [Hz]; None: without them.

    Returns:
        Dims `link` (all points of the first device, then of the next), `path`, `interaction` and,
        with a bandwidth, `tap`. Links inside buildings, below the ground, or within a wavelength
        have no paths; `reason` says so.

    Raises:
        BadInput: unknown device, wrong shape of points, impossible bandwidth or velocity, more
            paths than the budget, or an output that cannot be written.
    """
    scene, points_m = Scene.of(scene), np.asarray(points_m, dtype=float)
    velocity = None if velocity_m_s is None else np.asarray(velocity_m_s, dtype=float)
    _check(points_m, velocity, bandwidth_hz, out_path)
    index = device_indices(scene, devices)
    ROWS.check(len(index) * len(points_m), "points times devices")
    reason = np.concatenate([_reasons(scene, row, points_m) for row in index])
    usable = reason.reshape(len(index), -1) == ""
    rays = _joined([NO_RAYS, *_follow(scene, index, points_m, usable)])
    dataset = _links(scene, index, points_m)
    dataset["reason"] = "link", reason
    _describe(dataset, rays, scene.config.radio.frequency_hz, velocity, bandwidth_hz)
    missing = (dataset["path_count"].to_numpy() == 0) & (reason == "")
    dataset["reason"] = "link", np.where(missing, "no path", reason).astype(object)
    dataset.attrs |= {
        "schema": SCHEMA, "frequency_hz": scene.config.radio.frequency_hz,
        "scene": scene.config.name, "scene_hash": scene.content_hash(),
        "radiotwin_version": version("radiotwin"),
        **({} if velocity is None else {"velocity_m_s": velocity}),
        **({} if bandwidth_hz is None else {"bandwidth_hz": bandwidth_hz})}
    for name, variable in dataset.variables.items():
        unit = _UNITS.get(str(name).rpartition("_")[2])
        variable.attrs |= ({"units": unit} if unit else {}) \
            | ({"long_name": _LONG_NAMES[name]} if name in _LONG_NAMES else {})
    if out_path is not None:
        _write(dataset, out_path)
    return dataset


def _check(points_m: np.ndarray, velocity: np.ndarray | None, bandwidth_hz: float | None,
           out_path: Path | str | None) -> None:
    """Raise BadInput if an argument of `list_paths` is impossible."""
    if points_m.ndim != 2 or points_m.shape[1] != 3 or not len(points_m) \
            or not np.isfinite(points_m).all():
        raise BadInput("points_m must hold finite positions [m] of shape (n, 3), n at least 1; it "
                       f"has the shape {points_m.shape}")
    if velocity is not None and (velocity.shape != (3,) or not np.isfinite(velocity).all()
                                 or np.linalg.norm(velocity) > 0.01 * speed_of_light):
        raise BadInput(f"the velocity is {velocity.tolist()}; give three numbers [m/s], east, "
                       "north and up, of at most 1 % of the speed of light")
    if bandwidth_hz is not None and not 0 < bandwidth_hz < np.inf:
        raise BadInput(f"the bandwidth is {bandwidth_hz:g} Hz; it must be positive")
    if out_path is not None:
        require_suffix(out_path, ".nc")
        require_writable(out_path)


def _reasons(scene: Scene, device: int, points_m: np.ndarray) -> np.ndarray:
    """Return the reason (n,) why a device has no link to a point; empty if it may have one."""
    inside, below_ground = scene.city.inside(points_m), scene.city.below_ground(points_m)
    wavelength_m = speed_of_light / scene.config.radio.frequency_hz
    within_wavelength = np.linalg.norm(points_m - scene.device_m[device], axis=1) < wavelength_m
    return np.select([inside & below_ground, inside, within_wavelength],
                     ["below the ground", "inside a building", "within a wavelength"], default="")


def _follow(scene: Scene, index: list[int], points_m: np.ndarray, usable: np.ndarray
            ) -> Iterator[Rays]:
    """Yield paths of `usable` links with antenna gains; receivers count over all links."""
    count = 0
    with progress("following paths", total=int(usable.sum())) as advance:
        for row, device in enumerate(index):
            points = np.flatnonzero(usable[row])
            for rays, receivers in follow_rays(scene.city, scene.device_m[device],
                                               points_m[points],
                                               scene.config.radio.frequency_hz):
                gain_dbi = np.zeros(len(rays.length_m))
                for antenna, direction in ((scene.device_antennas[device], rays.departure),
                                           (scene.uav_antenna, rays.arrival)):
                    if antenna is not None:
                        gain_dbi += antenna.gain_dbi(direction)
                count += len(gain_dbi)
                PATHS.check(count, f"paths of {len(index)} devices to {len(points_m)} points")
                yield rays._replace(receiver=row * len(points_m) + points[rays.receiver],
                                    amplitude=rays.amplitude * 10 ** (gain_dbi / 20))
                advance(receivers)


def _links(scene: Scene, index: list[int], points_m: np.ndarray) -> xr.Dataset:
    """Return a dataset of links with device name, device position and receiver position [m]."""
    names = np.array([scene.config.devices[device].device for device in index], dtype=object)
    columns = {"device": np.repeat(names, len(points_m))}
    for axis, name in enumerate("xyz"):
        columns[f"device_{name}_m"] = np.repeat(scene.device_m[index, axis], len(points_m))
        columns[f"receiver_{name}_m"] = np.tile(points_m[:, axis], len(index))
    return xr.Dataset({name: ("link", values) for name, values in columns.items()})


def _describe(dataset: xr.Dataset, rays: Rays, frequency_hz: float, velocity: np.ndarray | None,
              bandwidth_hz: float | None) -> None:
    """Add the paths, and each link's gain, spreads and K factor, to a dataset of links."""
    links, link = dataset.sizes["link"], rays.receiver
    amplitude, delay_s, kinds = rays.amplitude, rays.length_m / speed_of_light, rays.kinds
    power = np.abs(amplitude) ** 2
    first_s = np.full(links, np.inf)
    np.minimum.at(first_s, link, delay_s)
    with np.errstate(divide="ignore"):
        path_gain_db = 10 * np.log10(np.maximum(power, 1e-300))
    count = np.bincount(link, minlength=links)
    values: dict[str, Any] = {
        "path_count": (count, {"sample_dimension": "path", "long_name": "number of paths"}),
        "gain_db": power_to_db(sums(power, link, links)),
        "coherent_gain_db": power_to_db(np.abs(sums(amplitude, link, links)) ** 2),
        "first_delay_s": np.where(count > 0, first_s, np.nan),
        "rms_delay_spread_s": rms_spread(delay_s, power, link, links),
        "k_factor_db": k_factor_db(power, kinds[:, 0] == NO_INTERACTION, link, links)}
    of_paths: dict[str, np.ndarray] = {
        "link_of_path": link.astype(np.int32), "path_gain_db": path_gain_db,
        "phase_rad": np.angle(amplitude), "delay_s": delay_s}
    for end in ("departure", "arrival"):
        ray = getattr(rays, end)
        azimuth = np.arctan2(ray[:, 0], ray[:, 1])
        elevation = np.arcsin(np.clip(ray[:, 2], -1, 1))
        of_paths[f"{end}_azimuth_deg"] = np.degrees(azimuth) % 360
        of_paths[f"{end}_elevation_deg"] = np.degrees(elevation)
        values[f"{end}_azimuth_spread_deg"] = angular_spread_deg(azimuth, power, link, links)
        values[f"{end}_zenith_spread_deg"] = angular_spread_deg(elevation, power, link, links)
        if end == "arrival" and velocity is not None:
            shift_hz = ray @ velocity / (speed_of_light / frequency_hz)  # approaching is positive
            of_paths["doppler_hz"] = shift_hz
            values["doppler_spread_hz"] = rms_spread(shift_hz, power, link, links)
    for name, value in values.items():
        dataset[name] = ("link", *value) if isinstance(value, tuple) else ("link", value)
    for name, value in of_paths.items():
        dataset[name] = "path", value
    used = max(int((kinds != NO_INTERACTION).sum(axis=1).max(initial=1)), 1)
    dataset["interactions"] = ("path", "interaction"), kinds[:, :used], {
        "flag_values": np.arange(TERRAIN + 1, dtype=np.int8),
        "flag_meanings": "none reflection diffraction terrain"}
    dataset["interaction_m"] = (
        ("path", "interaction", "axis"), rays.points_m[:, :used].astype(np.float32))
    dataset["axis"] = "axis", np.array(list("xyz"), dtype=object)
    if bandwidth_hz is not None:
        excess_s = delay_s - first_s[link]
        taps = 2 * EDGE_TAPS + 1 + int(np.ceil(float(excess_s.max(initial=0.0)) * bandwidth_hz))
        RESPONSE_VALUES.check(links * taps, f"impulse responses of {links} links, {taps} taps each")
        response = impulse_response(amplitude, excess_s, link, links, bandwidth_hz, taps)
        dataset["tap_delay_s"] = "tap", (np.arange(taps) - EDGE_TAPS) / bandwidth_hz
        for name, part in (("real", response.real), ("imaginary", response.imag)):
            dataset[f"response_{name}"] = ("link", "tap"), part, {
                "long_name": f"{name} part of the band-limited impulse response"}


def _write(dataset: xr.Dataset, path: Path | str) -> None:
    """Write the dataset as compressed NetCDF-4."""
    packed = {"zlib": True, "complevel": 4}
    encoding = {str(name): packed for name, array in dataset.data_vars.items()
                if array.dtype.kind in "fi" and array.size}
    content = BytesIO()
    dataset.assign_attrs(Conventions=CONVENTIONS).to_netcdf(content, engine="h5netcdf",
                                                            encoding=encoding)
    with atomic_file(path) as file:
        file.write(content.getbuffer())


def sums(values: np.ndarray, link: np.ndarray, links: int) -> np.ndarray:
    """Sum real or complex values (p,) over the paths of each link; return (links,)."""
    if np.iscomplexobj(values):
        return sums(values.real, link, links) + 1j * sums(values.imag, link, links)
    return np.bincount(link, weights=values, minlength=links)


def rms_spread(values: np.ndarray, power: np.ndarray, link: np.ndarray, links: int) -> np.ndarray:
    """Return the power-weighted standard deviation (links,) of a quantity (p,) over a link's paths.

    For delays it is the RMS delay spread (Rappaport, "Wireless Communications", 2nd ed., 2002, eq.
    5.35), for Doppler shifts the RMS Doppler spread. `power` (p,) is linear, `link` (p,) the row of
    each path's link. NaN without a path.
    """
    total = sums(power, link, links)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = sums(power * values, link, links) / total
        return np.sqrt(sums(power * (values - mean[link]) ** 2, link, links) / total)


def angular_spread_deg(angle_rad: np.ndarray, power: np.ndarray, link: np.ndarray, links: int
                       ) -> np.ndarray:
    """Return the circular spread [deg] of path angles (p,) [rad], by link (TR 38.901, A.1).

    The other arguments are those of `rms_spread`. Result (links,); NaN without a path.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        resultant = np.abs(sums(power * np.exp(1j * angle_rad), link, links)) \
            / sums(power, link, links)
        return np.degrees(np.sqrt(-2 * np.log(np.clip(resultant, 1e-300, 1))))


def k_factor_db(power: np.ndarray, direct: np.ndarray, link: np.ndarray, links: int) -> np.ndarray:
    """Return the Rician K factor (links,): power of the direct path over all others [dB].

    `direct` (p,): the path has no interaction. NaN without a direct path, or without another path.
    """
    direct_power, others = sums(power * direct, link, links), sums(power * ~direct, link, links)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where((direct_power > 0) & (others > 0), 10 * np.log10(direct_power / others),
                        np.nan)


def impulse_response(amplitude: np.ndarray, excess_s: np.ndarray, link: np.ndarray, links: int,
                     bandwidth_hz: float, taps: int) -> np.ndarray:
    """Return the band-limited impulse response (links, taps), complex, sampled at the bandwidth.

    Tap l of an ideal low-pass is the sum of a sinc(l - B τ) over the paths (Tse and Viswanath,
    "Fundamentals of Wireless Communication", 2005, eq. 2.34). Tap `EDGE_TAPS` is at excess delay 0.
    Amplitudes (p,) have the phase of the carrier over the total delay; `excess_s` (p,) is the delay
    after the link's first path, `link` (p,) ascends.
    """
    response = np.zeros((links, taps), dtype=complex)
    tap = np.arange(taps) - EDGE_TAPS
    bounds = np.searchsorted(link, np.arange(links + 1))
    for row, (first, end) in enumerate(zip(bounds[:-1], bounds[1:])):
        pulse = np.sinc(tap - bandwidth_hz * excess_s[first:end, None])
        response[row] = amplitude[first:end] @ pulse
    return response
