"""Sources of gains: a twin, a radio map, or a published law or paths over a scene's 3D map."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
from typing_extensions import override

from radiotwin.coverage.transmitters import Transmitter
from radiotwin.errors import BadInput
from radiotwin.links import LinkGeometry, link_geometry
from radiotwin.links.links import Columns, Ends, Links, World
from radiotwin.maps.radiomap import RadioMap
from radiotwin.propagation.laws import channel_named
from radiotwin.propagation.laws.image_paths import ImagePaths
from radiotwin.propagation.laws.published import PublishedLaw
from radiotwin.scene import Scene
from radiotwin.scene.antennas import Antenna
from radiotwin.scene.lattice import Lattice
from radiotwin.twin import Twin

NOTED_TRANSMITTERS = 100  # of a frequency, whose links are compared with a law's validity
PATH_RECEIVERS = 5_000  # whose paths are followed at a time: bounds the memory


class GainSource(ABC):
    """Levels between transmitters and receivers.

    Attributes:
        description: of the model, for people.
        has_power: whether its levels are received powers, with the transmit power in them.
    """

    description: str
    has_power: bool = False

    @abstractmethod
    def predict(self, row: int, receiver_m: np.ndarray, index: np.ndarray,
                ) -> tuple[np.ndarray, np.ndarray | None]:
        """Return gains with antennas, or received powers where `has_power`.

        Args:
            row: of the transmitter.
            receiver_m: (n, 3) positions of the receivers [m].
            index: (n,) flat (y, x) index of their cells.

        Returns:
            (n,) mean [dB], NaN where it is not detected; and (n,) standard deviation [dB], None
            where it is not known.
        """

    def notes(self, receiver_m: np.ndarray) -> list[str]:
        """Return how far the levels can be trusted, a sentence each.

        Args:
            receiver_m: (n, 3) some of the receivers [m].
        """
        return []


class LawSource(GainSource):
    """A published law, and the pattern of each antenna along the straight line.

    Args:
        model: name of the law.
        scene: whose 3D map decides line of sight.
        transmitters: each with a frequency.
    """

    def __init__(self, model: str, scene: Scene, transmitters: Sequence[Transmitter]) -> None:
        kind = channel_named(model)
        if not issubclass(kind, PublishedLaw):
            raise BadInput(f"model {model!r} is learnt from measurements, and a scene has none: "
                           "fit a twin with it and give that, or take raytrace, or a published "
                           "law, such as p1411, tr36777_umi, al_hourani_urban or cost231_wi")
        self._scene, self._transmitters = scene, transmitters
        self._device_m = np.array([each.position_m for each in transmitters])
        self._laws = {frequency_hz: kind().fit(self._links(np.empty((0, 3)), frequency_hz, 0),
                                               np.empty(0), None)
                      for frequency_hz in {each.frequency_hz for each in transmitters}}
        self.description = f"{kind.name} ({kind.source})"

    @override
    def predict(self, row: int, receiver_m: np.ndarray, index: np.ndarray,
                ) -> tuple[np.ndarray, np.ndarray | None]:
        each = self._transmitters[row]
        law = self._laws[each.frequency_hz]
        links = self._links(receiver_m, each.frequency_hz, row)
        mean_db, sd_db = law.predict(links)
        return mean_db + antenna_gain_db(each, receiver_m), sd_db

    @override
    def notes(self, receiver_m: np.ndarray) -> list[str]:
        """Return where links lie outside what the law was published for."""
        found = []
        for frequency_hz, law in self._laws.items():
            rows = [row for row, each in enumerate(self._transmitters)
                    if each.frequency_hz == frequency_hz][:NOTED_TRANSMITTERS]
            device = np.repeat(rows, len(receiver_m))
            links = link_geometry(self._device_m, np.tile(receiver_m, (len(rows), 1)), device, None)
            found += law.outside(links) if len(links) else []
        return list(dict.fromkeys(found))

    def _links(self, receiver_m: np.ndarray, frequency_hz: float | None, row: int) -> LinkGeometry:
        return link_geometry(self._device_m, receiver_m, np.full(len(receiver_m), row),
                             self._scene.city, float(frequency_hz or np.nan))


class PathSource(GainSource):
    """The sum of the powers of all paths over the 3D map, through the antennas; nothing is fitted.

    Args:
        scene: 3D map.
        transmitters: each with a frequency.
    """

    def __init__(self, scene: Scene, transmitters: Sequence[Transmitter]) -> None:
        self._city, self._transmitters = scene.city, transmitters
        self.description = "raytrace: paths over the 3D map, powers added"

    @override
    def predict(self, row: int, receiver_m: np.ndarray, index: np.ndarray,
                ) -> tuple[np.ndarray, np.ndarray | None]:
        from radiotwin.propagation.paths.powers import path_powers  # numba is large

        each = self._transmitters[row]
        parts = [np.empty(0)]
        for start in range(0, len(receiver_m), PATH_RECEIVERS):
            ends_m = receiver_m[start:start + PATH_RECEIVERS]
            found = path_powers(self._city, each.position_m[None], ends_m,
                                np.zeros(len(ends_m), int), float(each.frequency_hz or np.nan),
                                "vertical")
            parts.append(found.total if each.antenna is None else
                         _through_antenna(found.departures, found.total, each.antenna))
        with np.errstate(divide="ignore"):
            gain_db = 10 * np.log10(np.concatenate(parts))
        return np.where(np.isfinite(gain_db), gain_db, np.nan), None


def _through_antenna(departures: np.ndarray, power: np.ndarray, antenna: Antenna) -> np.ndarray:
    """Return the power (n,) of paths through an antenna, by their mean direction in each sector.

    Args:
        departures: (n, sectors, 3) power times direction, see `PathPowers`.
        power: (n,) of all paths, from an isotropic antenna.
        antenna: of the transmitter.
    """
    in_sector = np.linalg.norm(departures, axis=2)
    weighted = in_sector * 10 ** (antenna.gain_dbi(departures) / 10)
    return power * weighted.sum(axis=1) / np.maximum(in_sector.sum(axis=1), 1e-300)


class TwinSource(GainSource):
    """A twin: of its own devices, or its law for transmitters elsewhere.

    Measured levels hold the antennas of the twin's devices. Transmitters that were not measured
    get the law of all devices, and the pattern of their antenna along the straight line.

    Args:
        twin: learnt in the scene.
        scene: its 3D map.
        transmitters: each is a device of the twin where it has the name and the place of one.
    """

    def __init__(self, twin: Twin, scene: Scene, transmitters: Sequence[Transmitter]) -> None:
        twin.require_map(scene)
        twin.warn_of_another_scene(scene, scene.content_hash())
        self._twin, self._scene, self._transmitters = twin, scene, transmitters
        self.has_power = twin.level == "rssi_dbm"
        self.description = f"twin: {twin.description}"
        own = {each.device: row for row, each in enumerate(twin.devices) if each.located}
        self._row = [own.get(each.name) if is_device(twin, each) else None
                     for each in transmitters]
        new = [each.name for each, row in zip(transmitters, self._row) if row is None]
        if new and self.has_power:
            raise BadInput(f"{new[0]} is not a device of the twin, whose levels are received "
                           "powers: what another transmitter would send is not known; import the "
                           "measurements as gains, or leave it out with --devices")
        self._notes = []
        if new:
            self._notes.append(f"{len(new)} of {len(transmitters)} transmitters were not measured: "
                              "the twin's law for any device is used")
        if any(each.frequency_hz not in (None, scene.config.radio.frequency_hz)
               for each in transmitters):
            self._notes.append("transmitters of other frequencies get the twin's law, which was "
                               f"learnt at {scene.config.radio.frequency_hz / 1e9:g} GHz")

    @override
    def notes(self, receiver_m: np.ndarray) -> list[str]:
        """Return which transmitters get the law of other devices, or of another frequency."""
        return self._notes

    @override
    def predict(self, row: int, receiver_m: np.ndarray, index: np.ndarray,
                ) -> tuple[np.ndarray, np.ndarray | None]:
        known, each = self._row[row], self._transmitters[row]
        if known is not None:
            links = self._twin.links(receiver_m, np.full(len(receiver_m), known), self._scene)
            found = self._twin.predict(links)
            return found.mean_db, found.sd_db
        twin = self._twin
        device_m = np.vstack([np.nan_to_num(twin.device_m), each.position_m])
        device = np.full(len(receiver_m), len(twin.devices))
        links = Links(
            columns=Columns.unmeasured(receiver_m, device, twin.limit_db),
            ends=Ends(device_names=[*(device.device for device in twin.devices), each.name],
                      device_m=device_m, anchors=frozenset(range(len(device_m)))),
            world=World(frequency_hz=self._scene.config.radio.frequency_hz,
                        city=self._scene.city, is_gain=True))
        if twin.fitted is None:
            mean_db, sd_db = twin.channel.trend.predict(links.geometry)
        else:
            found = twin.predict(links)
            mean_db, sd_db = found.mean_db, found.sd_db
        return mean_db + antenna_gain_db(each, receiver_m), sd_db


class MapSource(GainSource):
    """A radio map at one of its altitudes, with the antennas that it was made with.

    Args:
        radio_map: of the scene.
        altitude_m: of the map to use [m].
        transmitters: which must be in the map.
    """

    def __init__(self, radio_map: RadioMap, altitude_m: float,
                 transmitters: Sequence[Transmitter]) -> None:
        self._level = int(np.flatnonzero(radio_map.lattice.z_m == altitude_m)[0])
        row_of = {name: row for row, name in enumerate(radio_map.devices)}
        self._rows = [row_of[each.name] for each in transmitters]
        self._dataset = radio_map.dataset
        self.description = f"radio map: {radio_map.attributes.get('source', 'unknown source')}"

    @override
    def predict(self, row: int, receiver_m: np.ndarray, index: np.ndarray,
                ) -> tuple[np.ndarray, np.ndarray | None]:
        sd_db = self._at("sigma_db", row, index) if "sigma_db" in self._dataset else None
        return self._at("gain_db", row, index), sd_db

    def _at(self, name: str, row: int, index: np.ndarray) -> np.ndarray:
        """Return a variable at cells (n,); only the rows with them are read."""
        if not len(index):
            return np.empty(0)
        columns = self._dataset.sizes["x"]
        first, last = int(index.min()) // columns, int(index.max()) // columns
        part = self._dataset[name].variable[self._rows[row], self._level, first:last + 1]
        return part.values.ravel()[index - first * columns].astype(float)


def over_scene(model: str, scene: Scene, transmitters: Sequence[Transmitter]) -> GainSource:
    """Return the source for a scene without measurements.

    Args:
        model: name of a published law, or `raytrace` for paths over the map.
        scene: 3D map.
        transmitters: each with a frequency.

    Raises:
        BadInput: no such model, or one that is learnt.
    """
    if channel_named(model) is ImagePaths:
        return PathSource(scene, transmitters)
    return LawSource(model, scene, transmitters)


def is_device(twin: Twin, transmitter: Transmitter) -> bool:
    """Return whether a transmitter has the name and, to a metre, the place of a twin's device."""
    return any(each.device == transmitter.name and each.located and np.allclose(
        (each.x_m, each.y_m, each.z_m), transmitter.position_m, atol=1.0)
        for each in twin.devices)


def twin_transmitters(twin: Twin, declared: Sequence[Transmitter]) -> list[Transmitter]:
    """Return the located devices of a twin, with power and load of those declared by that name."""
    by_name = {each.name: each for each in declared}
    found = []
    for each in twin.devices:
        if each.located:
            other = by_name.get(each.device)
            found.append(Transmitter(
                each.device, np.array([each.x_m, each.y_m, each.z_m], dtype=float),
                *((other.tx_power_dbm, other.antenna, other.load, other.frequency_hz)
                  if other else ())))
    return found


def antenna_gain_db(transmitter: Transmitter, receiver_m: np.ndarray) -> np.ndarray | float:
    """Return what an antenna adds along the straight line (n,) [dB]; 0 for an isotropic one."""
    if transmitter.antenna is None:
        return 0.0
    return transmitter.antenna.gain_dbi(receiver_m - transmitter.position_m)


def altitude_of(radio_map: RadioMap, height_m: float | None) -> float:
    """Return the altitude of a map that a height names; its lowest for None.

    Raises:
        BadInput: the map has no such altitude.
    """
    altitudes_m = radio_map.lattice.z_m
    if height_m is None:
        return float(altitudes_m[0])
    if not (altitudes_m == height_m).any():
        known = ", ".join(f"{each:g}" for each in altitudes_m[:20])
        raise BadInput(f"the radio map has no altitude of {height_m:g} m; it has {known} m")
    return height_m


def map_grid(radio_map: RadioMap, altitude_m: float) -> Lattice:
    """Return the positions of a map at one altitude.

    Raises:
        BadInput: they are not equally far apart, so that they have no cells.
    """
    lattice = radio_map.lattice
    step_m = lattice.step_m
    if not step_m or any(not np.allclose(np.diff(axis), step_m, rtol=0, atol=1e-6 * step_m)
                         for axis in (lattice.x_m, lattice.y_m)):
        raise BadInput("the radio map's positions are not equally far apart, so that shares of "
                       "an area cannot be told; make a map with one step")
    return Lattice(lattice.x_m, lattice.y_m, np.array([altitude_m]), lattice.ground_m)
