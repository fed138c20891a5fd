"""Levels for a coverage map from a twin, a radio map, a published law, or followed paths."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from radiotwin.coverage.areas import with_ground_as_terrain
from radiotwin.coverage.transmitters import Transmitter
from radiotwin.display import some
from radiotwin.errors import BadInput
from radiotwin.io.texts import percent
from radiotwin.links import LinkGeometry, link_geometry
from radiotwin.links.declared import Declared, Radio
from radiotwin.links.links import Columns, Ends, Links, World
from radiotwin.maps.radiomap import RadioMap
from radiotwin.propagation.laws import channel_named
from radiotwin.propagation.laws.image_paths import ImagePaths
from radiotwin.propagation.laws.published import PublishedLaw
from radiotwin.propagation.paths import path_powers
from radiotwin.propagation.terrain import is_far
from radiotwin.scene import Scene
from radiotwin.scene.antennas import Antenna
from radiotwin.scene.citymap import FAR_M, CityMap
from radiotwin.twin import Twin
from radiotwin.twin.model.model import FittedModel

NOTED_TRANSMITTERS = 100  # per frequency: their links are checked against a law's validity range
PATH_RECEIVERS = 5_000  # per batch of followed paths: bounds memory
Levels = tuple[np.ndarray, np.ndarray | None]
"""(n,) mean gain [dB] or received power [dBm], NaN: not detected; (n,) sd [dB], None: unknown."""


@dataclass(frozen=True, eq=False)
class GainSource:
    """A model that predicts levels between transmitters and receivers.

    Attributes:
        description: name of the model, shown to users.
        predict: function of a transmitter's row, receiver positions (n, 3) [m], and flat (y, x)
            indices (n,) of the receivers' cells. Returns gains through the antennas, or received
            powers if `has_power`.
        notes: function of sampled receiver positions (n, 3) [m]. Returns sentences on how far the
            levels can be trusted.
        has_power: whether levels are received powers, which include the transmit power.
    """

    description: str
    predict: Callable[[int, np.ndarray, np.ndarray], Levels]
    notes: Callable[[np.ndarray], list[str]] = lambda receiver_m: []
    has_power: bool = False


def source_over(model: str, scene: Scene, transmitters: Sequence[Transmitter]) -> GainSource:
    """Return the gain source of a model that needs no measurements; receivers are isotropic.

    It is a published law, or `paths`, which follows paths over the map; BadInput for another.
    """
    kind, city = channel_named(model), with_ground_as_terrain(scene.city)
    if kind is ImagePaths:
        source = _source_of_paths(city, transmitters)
    elif issubclass(kind, PublishedLaw):
        source = _source_of_law(kind, city, transmitters)
    else:
        raise BadInput(f"model {model!r} is learnt from measurements, and a scene has none: fit a "
                       "twin with it and give that, or take the model paths, or a published law, "
                       "such as p1411, tr36777_umi, al_hourani_urban or cost231_wi")
    if scene.uav_antenna is None:
        return source
    return replace(source, notes=lambda receiver_m: [
        *source.notes(receiver_m), "receivers are isotropic: the antenna that the scene declares "
        "for its UAVs is not used, as it would be in a traced map"])


def _source_of_law(kind: type[PublishedLaw], city: CityMap,
                   transmitters: Sequence[Transmitter]) -> GainSource:
    """Return a source of gains: a published law, plus the antenna's gain towards the receiver."""
    device_m = np.array([each.position_m for each in transmitters])

    def links(receiver_m: np.ndarray, frequency_hz: float | None, row: int) -> LinkGeometry:
        return link_geometry(device_m, receiver_m, np.full(len(receiver_m), row), city,
                             float(frequency_hz or np.nan))

    laws = {frequency_hz: kind().fit(links(np.empty((0, 3)), frequency_hz, 0), np.empty(0), None)
            for frequency_hz in {each.frequency_hz for each in transmitters}}

    def predict(row: int, receiver_m: np.ndarray, index: np.ndarray) -> Levels:
        each = transmitters[row]
        mean_db, sd_db = laws[each.frequency_hz].predict(links(receiver_m, each.frequency_hz, row))
        if each.antenna is not None:
            mean_db = mean_db + each.antenna.gain_dbi(receiver_m - each.position_m)
        return mean_db, sd_db

    def notes(receiver_m: np.ndarray) -> list[str]:
        """List in which respects links are outside the law's published validity range."""
        found = []
        for frequency_hz, law in laws.items():
            rows = [row for row, each in enumerate(transmitters)
                    if each.frequency_hz == frequency_hz][:NOTED_TRANSMITTERS]
            device = np.repeat(rows, len(receiver_m))
            sample = link_geometry(device_m, np.tile(receiver_m, (len(rows), 1)), device, city,
                                   float(frequency_hz or np.nan))
            found += law.outside(sample) if len(sample) else []
        return list(dict.fromkeys(found))

    return GainSource(f"{kind.name} ({kind.source})", predict, notes)


def _source_of_paths(city: CityMap, transmitters: Sequence[Transmitter]) -> GainSource:
    """Return a source of gains: the sum of all paths' powers, each weighted by the antenna."""
    def predict(row: int, receiver_m: np.ndarray, index: np.ndarray) -> Levels:
        each = transmitters[row]
        parts = [np.empty(0)]
        for start in range(0, len(receiver_m), PATH_RECEIVERS):
            ends_m = receiver_m[start:start + PATH_RECEIVERS]
            found = path_powers(city, each.position_m, ends_m,
                                float(each.frequency_hz or np.nan))
            with np.errstate(divide="ignore"):
                gain_db = 10 * np.log10(found.total)
            if each.antenna is not None:
                gain_db += found.directions.antenna_gain_db(len(ends_m), each.antenna)
            parts.append(np.where(np.isfinite(gain_db), gain_db, np.nan))
        return np.concatenate(parts), None

    def notes(receiver_m: np.ndarray) -> list[str]:
        """Report the share of links behind terrain, and of links longer than 5 km."""
        if not len(receiver_m):
            return []
        some_m = np.array([each.position_m for each in transmitters[:NOTED_TRANSMITTERS]])
        share = {
            "are behind terrain: those that no path reaches have": np.mean(
                [city.hidden_by_ground(each_m[None], receiver_m) for each_m in some_m]),
            f"are longer than {FAR_M / 1e3:g} km: they have, in place of paths,": np.mean(
                [is_far(each_m, receiver_m) for each_m in some_m])}
        return [f"{percent(value)} of the links {what} the loss along the profile of ground and "
                "roofs (ITU-R P.526-15, Sec. 4.5)" for what, value in share.items() if value]

    return GainSource("paths over the 3D map, powers added", predict, notes)


def source_of_twin(twin: Twin, scene: Scene, transmitters: Sequence[Transmitter]) -> GainSource:
    """Return the gain source of a twin, for its devices and for new transmitters.

    A transmitter with the name of a device, within a metre of it, is that device. A new one gets
    the twin's general law, plus its antenna's gain along the straight line. Powers and antennas
    that were declared for a device were subtracted before the twin was fitted, so others may be
    declared now. An undeclared antenna is part of the learnt levels, and stays. BadInput if the
    twin is of another map, or predicts received powers and lacks a transmitter.
    """
    twin.require_map(scene)
    twin.warn_of_another_scene(scene, scene.content_hash())
    has_power, device_count = not twin.has_gains, len(twin.devices)
    located = {each.device: (row, each.position_m) for row, each in enumerate(twin.devices)
               if each.located}
    rows = []
    for each in transmitters:
        row, position_m = located.get(each.name, (device_count, (np.nan, np.nan, np.nan)))
        rows.append(row if np.allclose(position_m, each.position_m, atol=1.0) else device_count)
    new = [each.name for each, row in zip(transmitters, rows) if row == device_count]
    if new and has_power:
        raise BadInput(f"{new[0]} is not a device of the twin, whose levels are received "
                       "powers: what another transmitter would send is not known; declare "
                       "tx_power_dbm in devices.csv and fit again, or leave it out with --devices")
    notes = _notes_of_twin(twin, transmitters, rows, has_power)
    measured_hz = [radio.frequency_hz for radio in twin.declared.radios] or [None] * device_count
    if any(each.frequency_hz not in (None, scene.config.radio.frequency_hz,
                                     *measured_hz[row:row + 1])
           for each, row in zip(transmitters, rows)):
        notes.append("transmitters of other frequencies get the twin's law, moved by 20 lg f as in "
                     f"free space: it was learnt at {scene.config.radio.frequency_hz / 1e9:g} GHz")
    frequency_hz = scene.config.radio.frequency_hz if np.isnan(twin.declared.frequency_hz) \
        else twin.declared.frequency_hz

    unmeasured = replace(twin, fitted=FittedModel.of_channel(twin.channel.trend)) \
        if twin.fitted.is_channel_alone else twin

    def predict(row: int, receiver_m: np.ndarray, index: np.ndarray) -> Levels:
        each, device = transmitters[row], np.full(len(receiver_m), rows[row])
        if has_power:
            isotropic = replace(twin.declared, receiver_antenna=None)
            levels = twin.predict(twin.links(receiver_m, device, scene).with_ends(
                declared=isotropic))
            return levels.mean_db, levels.sd_db
        is_measured = rows[row] < device_count
        is_learnt = is_measured and _declared_antenna(twin, rows[row]) is None
        radios = [Radio()] * (device_count + 1)
        radios[rows[row]] = Radio(antenna=None if is_learnt else each.antenna,
                                  frequency_hz=each.frequency_hz)
        if is_measured:
            links = twin.links(receiver_m, device, scene).with_ends(
                declared=Declared(tuple(radios[:device_count]), frequency_hz, False))
            levels = twin.predict(links)
            return levels.mean_db, levels.sd_db
        device_m = np.vstack([np.nan_to_num(twin.device_m), each.position_m])
        links = Links(
            columns=Columns.unmeasured(receiver_m, device, twin.limit_db),
            ends=Ends(device_names=[*(device.device for device in twin.devices), each.name],
                      device_m=device_m, anchors=frozenset(range(len(device_m))),
                      declared=Declared(tuple(radios), frequency_hz, False)),
            world=World(frequency_hz=scene.config.radio.frequency_hz, city=scene.city,
                        is_gain=True))
        levels = unmeasured.predict(links)
        return levels.mean_db, levels.sd_db

    return GainSource(f"twin: {twin.description}", predict, lambda receiver_m: notes, has_power)


def _declared_antenna(twin: Twin, row: int) -> Antenna | None:
    """Return the antenna that was declared for a device when the twin was fitted; else None."""
    return twin.declared.radios[row].antenna if twin.declared.radios else None


def _notes_of_twin(twin: Twin, transmitters: Sequence[Transmitter], rows: list[int],
                   has_power: bool) -> list[str]:
    """Return sentences on transmitters without measurements, and on antennas and powers not used.

    `rows` are the transmitters' rows in `twin.devices`; a new one has `len(twin.devices)`.
    """
    device_count, notes = len(twin.devices), []
    new = [each for each, row in zip(transmitters, rows) if row == device_count]
    directed = [each.name for each in new if each.antenna is not None]
    undeclared = [each.device for row, each in enumerate(twin.devices)
                  if _declared_antenna(twin, row) is None]
    if new:
        notes.append(f"{len(new)} of {len(transmitters)} transmitters were not measured: "
                     "the twin's law for any device is used")
    if directed and len(undeclared) == device_count:
        notes.append("the law of the twin's devices contains whatever antennas they have, and the "
                     f"antenna of {some(directed)} is added to it: unless they are isotropic it "
                     "counts twice; declare their antennas in devices.csv (antenna, azimuth_deg, "
                     "tilt_deg) and fit again")
    unused = [each.name for each, row in zip(transmitters, rows)
              if row < device_count and each.antenna is not None
              and _declared_antenna(twin, row) is None]
    if unused:
        notes.append(f"the antenna of {some(unused)} is not used: it is in the measured levels; "
                     "declared in devices.csv when the twin is fitted, it can be another")
    if has_power and any(each.tx_power_dbm is not None for each in transmitters):
        powers = [each.name for each in transmitters if each.tx_power_dbm is not None]
        notes.append(f"tx_power_dbm of {some(powers)} is not used: the twin's levels are received "
                     "powers of devices whose powers nobody declared; declare them in devices.csv "
                     "and fit again")
    return notes


def source_of_map(radio_map: RadioMap, level: int,
                  transmitters: Sequence[Transmitter]) -> GainSource:
    """Return the gain source of a radio map at one altitude; its gains include its antennas."""
    row_of = {name: row for row, name in enumerate(radio_map.devices)}
    dataset = radio_map.dataset

    def read(name: str, row: int, index: np.ndarray) -> np.ndarray:
        """Read a variable at the cells with flat indices (n,), from the rows that span them."""
        if not len(index):
            return np.empty(0)
        columns = dataset.sizes["x"]
        first, last = int(index.min()) // columns, int(index.max()) // columns
        part = dataset[name].variable[row_of[transmitters[row].name], level, first:last + 1]
        return part.values.ravel()[index - first * columns].astype(float)

    def predict(row: int, receiver_m: np.ndarray, index: np.ndarray) -> Levels:
        sd_db = read("sigma_db", row, index) if "sigma_db" in dataset else None
        return read("gain_db", row, index), sd_db

    return GainSource(f"radio map: {radio_map.attributes.get('source', 'unknown source')}", predict)


def twin_transmitters(twin: Twin, declared: Sequence[Transmitter]) -> list[Transmitter]:
    """Return a twin's located devices as transmitters, with settings from `declared` by name."""
    by_name = {each.name: each for each in declared}
    return [replace(by_name.get(each.device, Transmitter(each.device, np.empty(0))),
                    position_m=np.array(each.position_m, dtype=float))
            for each in twin.devices if each.located]


def filled_in_from_twin(twin: Twin, transmitters: Sequence[Transmitter]) -> list[Transmitter]:
    """Return transmitters, with missing radio settings from the twin's device of the same name."""
    radio_of = dict(zip((each.device for each in twin.devices), twin.declared.radios))
    return [replace(each, **{name: getattr(radio_of[each.name], name) for name in (
        "tx_power_dbm", "cable_loss_db", "antenna", "frequency_hz") if getattr(each, name) is None})
        if each.name in radio_of else each for each in transmitters]


def altitude_row(radio_map: RadioMap, height_m: float | None) -> int:
    """Return a radio map's index of altitude `height_m` [m], BadInput if it lacks it; None: 0."""
    altitudes_m = radio_map.lattice.z_m
    if height_m is None:
        return 0
    if not (altitudes_m == height_m).any():
        known = ", ".join(f"{each:g}" for each in altitudes_m[:20])
        raise BadInput(f"the radio map has no altitude of {height_m:g} m; it has {known} m")
    return int(np.flatnonzero(altitudes_m == height_m)[0])
