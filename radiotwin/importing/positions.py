"""Find the positions of receivers and devices in one local frame: x east, y north, z up [m].

They come from columns of the log, else from tables of positions; WGS84 or projected coordinates
are converted. A device of `devices.csv` has one position, so a device that was at several places
over time becomes the devices `NAME@1`, `NAME@2`, ….
"""

from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd

from radiotwin.display import count, some
from radiotwin.errors import BadInput
from radiotwin.geo import ALLOWED, median_origin, reference_system
from radiotwin.importing.read_source import Expected, read_source
from radiotwin.importing.settings import ABOVE_GROUND, HEIGHTS, POSITION, Settings
from radiotwin.importing.source import Source, Tally, are_few
from radiotwin.importing.units import ISO, seconds
from radiotwin.io.cells import cell_text
from radiotwin.io.forms import MAX_POSITION_M, Origin
from radiotwin.links.measurements import DEVICE_OPTIONAL
from radiotwin.links.plausible import FAR_M, READS, distances_m, far_notes, unmatched_notes
from radiotwin.links.site_table import SiteTable, is_site_table, local_positions, read_site_table

AREA_MARGIN_DEG = 1.0  # accepted outside the area for which a projected system is defined
NAMED = ("receiver", "device")
SINCE, UNTIL = "since_s", "until_s"
"""Columns of a table of devices: start and end of the time at a position [s]; NaN = always."""
_MAX_PLACES = 1000  # of one device; with more it is taken to move all the time
SAME_BAND = 1.05  # ratio of carriers of one band, within which 20 lg f changes by 0.4 dB
MIN_SPREAD_DEG = 0.5  # of positions, to search for placeholders 100 km away
MIN_PLACES, MIN_REPEATS = 4, 3  # of a moving receiver; readings at a placeholder position
FAST_M_S, NEAR_M = 340.0, 1000.0  # speed and jump of a glitch; smaller ones are errors of a fix
MIN_READINGS = 10  # of a receiver, to find glitches
MOVING_M = 1.0  # spread of a device's positions above which it moves


def find_origin(declared: Origin | None, receivers: pd.DataFrame,
                devices: pd.DataFrame) -> Origin | None:
    """Return the declared origin, else the median of the receivers, else of the devices.

    It is None if all positions are local.

    Raises:
        BadInput: some positions are local and some geographic, and no origin relates them.
    """
    if declared is not None:
        return declared
    geographic, local = (any(name in ends and ends[name].notna().any()
                             for ends in (receivers, devices)) for name in ("latitude", "x"))
    if geographic and local:
        raise BadInput("some positions are latitude and longitude, others are local x and y; give "
                       "the origin of the local frame: --origin LATITUDE,LONGITUDE,ALTITUDE, or "
                       "the crs of x and y")
    if not geographic:
        return None
    of_receivers = "latitude" in receivers and receivers["latitude"].notna().any()
    known = receivers if of_receivers else devices
    return median_origin(known)


def to_geographic(positions: pd.DataFrame, crs: str | None) -> pd.DataFrame:
    """Convert columns x, y of a projected reference system to latitude and longitude.

    Other columns stay; without a system all columns stay.

    Raises:
        BadInput: unknown or not projected system, or x, y far outside its area of use.
    """
    if crs is None or "x" not in positions:
        return positions
    from pyproj import Transformer
    from pyproj.exceptions import CRSError, ProjError

    try:
        system = reference_system(crs)
    except CRSError as error:
        raise BadInput(f"crs {cell_text(crs)} is unknown ({error!s:.200}); give {ALLOWED}, such as "
                       "EPSG:32633 (UTM 33 N)") from None
    if not system.is_projected:
        raise BadInput(f"crs {cell_text(crs)} is {system.type_name}, not a projected one with x "
                       "and y; degrees go into latitude and longitude")
    known = positions["x"].notna() & positions["y"].notna()
    x, y = positions["x"][known].to_numpy(), positions["y"][known].to_numpy()
    try:
        transformer = Transformer.from_crs(system, "EPSG:4326", always_xy=True)
        longitude, latitude = transformer.transform(x, y)
    except ProjError as error:
        raise BadInput(f"crs {cell_text(crs)} cannot be converted to latitude and longitude "
                       f"({error!s:.200}); give another one, such as EPSG:32633 (UTM 33 N)"
                       ) from None
    area = system.area_of_use
    if area is not None:
        width = area.east - area.west
        east = (longitude - area.west + AREA_MARGIN_DEG) % 360  # it may cross the date line
        inside = (east <= width % 360 + 2 * AREA_MARGIN_DEG) | (width >= 360)
        inside &= latitude >= area.south - AREA_MARGIN_DEG
        inside &= latitude <= area.north + AREA_MARGIN_DEG
        if not inside.all():
            i = int(np.argmin(inside))
            raise BadInput(f"x, y = {x[i]:g}, {y[i]:g} is latitude {latitude[i]:.3f}, longitude "
                           f"{longitude[i]:.3f}, far outside of the area of {cell_text(crs)}; is "
                           "it another system, or are x and y swapped?")
    if not (np.isfinite(longitude) & np.isfinite(latitude)).all():
        i = int(np.argmin(np.isfinite(longitude) & np.isfinite(latitude)))
        raise BadInput(f"x, y = {x[i]:g}, {y[i]:g} is no place of {cell_text(crs)}; is it another "
                       "system, or another unit?")
    degrees = np.full((len(positions), 2), np.nan)
    degrees[known] = np.column_stack([longitude, latitude])
    return positions.drop(columns=["x", "y"]).assign(longitude=degrees[:, 0],
                                                     latitude=degrees[:, 1])


def _numbered_names(names: pd.Series, since_s: np.ndarray) -> pd.Series:
    """Rename repeated names (n,) to `NAME@1`, … in the order of `since_s` [s]; NaN is first."""
    order = np.lexsort((np.arange(len(names)), np.nan_to_num(since_s, nan=-np.inf)))
    number = names.iloc[order].groupby(names.iloc[order]).cumcount() + 1
    repeated = names.duplicated(keep=False)
    return names.mask(repeated, names + "@" + number.reindex(names.index).astype(str))


def _names_by_time(source: Source, links: pd.DataFrame, table: pd.DataFrame | None) -> pd.DataFrame:
    """Rename devices with several positions over time to `NAME@1`, …, where a row's time holds."""
    if table is None or SINCE not in table:
        return links
    place_of = pd.Series(table.index, index=table.index)
    owner = place_of.str.replace(r"@\d+$", "", regex=True)
    # `_numbered_names` makes several names with a number; a single such name is the device's own.
    is_numbered = owner.duplicated(keep=False) & ~owner.isin(place_of)
    owner = owner.where(is_numbered, place_of).to_numpy()
    names = links["device"].to_numpy(dtype=object, copy=True)
    for device in dict.fromkeys(owner[place_of.to_numpy() != owner]):
        device_links = np.flatnonzero(links["device"].to_numpy() == device)
        if not len(device_links):
            continue
        if "time_s" not in links or links["time_s"].iloc[device_links].isna().any():
            raise BadInput(f"{source.path}: device {device!r} is at several places over time, and "
                           "some of its readings have no time; give the column of the time")
        rows = np.flatnonzero(owner == device)
        since_s = np.nan_to_num(table[SINCE].to_numpy()[rows], nan=-np.inf)
        rows, since_s = rows[np.argsort(since_s)], np.sort(since_s)
        time_s = links["time_s"].to_numpy()[device_links]
        place = np.searchsorted(since_s, time_s, side="right") - 1
        placed = place >= 0
        until_s = table[UNTIL].to_numpy()[rows][place.clip(0)]
        placed &= ~(time_s >= until_s)  # NaN: until the next row
        names[device_links[placed]] = table.index.to_numpy()[rows[place[placed]]]
    return links.assign(device=names)


def _names_by_place(source: Source, links: pd.DataFrame, device_m: np.ndarray,
                place_m: float) -> np.ndarray:
    """Return the device of each link (n,); if it has several places, as `NAME@1`, ….

    Positions (n, 3) [m] within `place_m` of the first one at a place belong to it.
    """
    names = links["device"].to_numpy(dtype=object, copy=True)
    filled_m = np.nan_to_num(device_m)
    for device, rows in links.groupby(np.array(names), sort=False).indices.items():
        rows = rows[np.isfinite(device_m[rows, :2]).all(axis=1)]
        if not len(rows) or (np.ptp(filled_m[rows], axis=0) <= place_m / np.sqrt(3)).all():
            continue
        different_m, first, inverse = np.unique(filled_m[rows], axis=0, return_index=True,
                                                return_inverse=True)
        place = np.full(len(different_m), -1)
        centres_m = np.empty((0, 3))
        for i in np.argsort(first):
            near = np.linalg.norm(centres_m - different_m[i], axis=1) <= place_m
            place[i] = np.argmax(near) if near.any() else len(centres_m)
            if not near.any():
                centres_m = np.vstack([centres_m, different_m[i]])
            if len(centres_m) > _MAX_PLACES:
                raise BadInput(f"{source.path}: device {device!r} is at more than {_MAX_PLACES} "
                               f"places that are {place_m:g} m apart: it moves all the time. Take "
                               "it for the receiver, and the other end for the device: the gain "
                               "is that of both directions")
        if len(centres_m) > 1:
            names[rows] = [f"{device}@{number + 1}" for number in place[inverse.ravel()]]
    return names


def _read_sites(path: str, key: str, settings: Settings, names: Collection[str]) -> SiteTable:
    """Read a table of positions by name, with projected x and y as latitude and longitude.

    Several rows of one device are its positions over time, with columns `since` and optionally
    `until` in ISO 8601. `key` is `device` or `receiver`, and `names` are those in the log.
    """
    source = read_source(path, expected=Expected(is_wanted=is_site_table))
    uses = [*DEVICE_OPTIONAL, "antenna", "since", "until"] if key == "device" else []
    sites = read_site_table(source.path, source.table, source.where, key, uses,
                            settings.length_unit or "", settings.crs is not None, True, names)
    period: dict[str, np.ndarray] = {}
    unique = sites.names
    if "since" in sites.values:
        period = {SINCE: seconds(source, sites.columns["since"], ISO, settings.time_zone),
                  UNTIL: np.full(len(source), np.nan)}
        if "until" in sites.columns:
            period[UNTIL] = seconds(source, sites.columns["until"], ISO, settings.time_zone)
        sites.refuse("since", period[UNTIL] <= period[SINCE],
                     "is not before the time until which the device was there")
        unique = _numbered_names(unique, period[SINCE])
    sites.refuse(key, unique.duplicated(), f"occurs twice; every {key} has one row")
    notes = [*source.notes, *sites.notes,
             *unmatched_notes(path, sites.names, names, key)]
    values = to_geographic(sites.values.drop(columns=["since", "until"], errors="ignore"),
                           settings.crs).assign(**period)
    return replace(sites, values=values.set_axis(pd.Index(unique, dtype=object)),
                   notes=tuple(notes))


@dataclass(frozen=True)
class PositionedLinks:
    """Links with the positions of their receivers and devices.

    Attributes:
        links: with `receiver_x_m, receiver_y_m, receiver_z_m`, and `receiver_above_ground_m` for
            heights above the ground.
        devices: of the links, in the order of their first link, as in `devices.csv`.
        device_m: (n, 3) position of each link's device [m]; NaN: unknown.
        origin: of the local frame; None: all positions were local already.
        notes: on devices that were split, and on implausible positions.
    """

    links: pd.DataFrame
    devices: pd.DataFrame
    device_m: np.ndarray
    origin: Origin | None
    notes: list[str] = field(default_factory=list)

    def select(self, keep: np.ndarray) -> "PositionedLinks":
        """Select links by a mask (n,), and their devices."""
        links = self.links[keep]
        devices = self.devices[self.devices["device"].isin(links["device"])]
        return replace(self, links=links, devices=devices.reset_index(drop=True),
                       device_m=self.device_m[keep])


def add_positions(source: Source, links: pd.DataFrame, settings: Settings,
                  tally: Tally) -> PositionedLinks:
    """Find the positions of receivers and devices in one local frame.

    Links without a receiver position, or with an impossible one, are counted in the tally and left
    out.

    Raises:
        BadInput: a table that cannot be used, a position far from the origin, or a moving device.
    """
    sites = {name: _read_sites(path, name, settings, set(links[name]))
             for name, path in (("receiver", settings.receivers), ("device", settings.devices))
             if path is not None}
    tables = {name: sites[name].values if name in sites else None for name in NAMED}
    links = _names_by_time(source, links, tables["device"])
    receivers = _positions(links, "", tables["receiver"], links["receiver"], settings.crs)
    devices = _positions(links, "device_", tables["device"], links["device"], settings.crs)
    no_fix = _placeholder_fixes(receivers, links["receiver"])
    for place, rows in no_fix.items():
        tally.count(f"no fix: a receiver that moves elsewhere stays at {place}", "", len(rows),
                    source.where(links.index[rows[0]]))
    if no_fix:
        fixed = np.ones(len(links), dtype=bool)
        fixed[np.concatenate(list(no_fix.values()))] = False
        links, receivers, devices = links[fixed], receivers[fixed], devices[fixed]
    origin = find_origin(settings.origin, receivers, devices)
    receiver_m, device_m = (local_positions(ends, origin) for ends in (receivers, devices))
    notes = [note for table in sites.values() for note in table.notes]
    notes += _far_notes(source, links, receivers, devices, sites)
    del receivers, devices  # as much memory as the links themselves
    if settings.place_m:
        links = links.assign(device=_names_by_place(source, links, device_m, settings.place_m))
    keep = ~_are_glitches(links, receiver_m)
    links = tally.drop(links, ~keep, f"position {FAR_M / 1000:.0f} km from all others, or one "
                                     f"that takes {FAST_M_S:.0f} m/s to and fro", "", source.where)
    receiver_m, device_m = receiver_m[keep], device_m[keep]
    _check_near(source, links, receiver_m, "receiver")
    _check_near(source, links, device_m, "device")
    links = links.assign(**{f"receiver_{axis}_m": receiver_m[:, i] for i, axis in enumerate("xyz")})
    above_m = _above_ground_m(links, "", tables["receiver"], links["receiver"], receiver_m[:, 2])
    if np.isfinite(above_m).any():
        links = links.assign(receiver_above_ground_m=above_m)
    unknown = np.isnan(receiver_m[:, :2]).any(axis=1)
    names = links["receiver"][unknown]
    for name, rows in names.groupby(names, sort=False):
        tally.count(f"no position of receiver {name!r}", "", len(rows), source.where(rows.index[0]))
    if unknown.any():
        links, device_m = links[~unknown], device_m[~unknown]
    links, declared_as, more = _split_by_band(links)
    table = _device_table(source, links, device_m, tables["device"], declared_as,
                          max(MOVING_M, 2 * (settings.place_m or 0.0)))
    return PositionedLinks(links, table, device_m, origin, [*notes, *more])


def _placeholder_fixes(receivers: pd.DataFrame, names: pd.Series) -> dict[str, np.ndarray]:
    """Find placeholders of missing fixes: position as text -> rows of its readings.

    Such a position repeats to the last digit, far from the middle of a moving receiver's positions.
    """
    if "latitude" not in receivers:
        return {}
    place = receivers[["latitude", "longitude"]].to_numpy(dtype=float)
    spread_deg = np.nan_to_num(np.nanmax(place, axis=0) - np.nanmin(place, axis=0)) \
        if np.isfinite(place).any() else np.zeros(2)
    if spread_deg.max() < MIN_SPREAD_DEG:
        return {}
    found: dict[str, np.ndarray] = {}
    for rows in names.groupby(names.to_numpy(), sort=False).indices.values():
        rows = rows[np.isfinite(place[rows]).all(axis=1)]
        different, number, times = np.unique(place[rows], axis=0, return_inverse=True,
                                             return_counts=True)
        if len(different) < MIN_PLACES:
            continue
        middle = np.median(different, axis=0)  # independent of the number of missing fixes
        apart_m = distances_m(different, middle)
        for i in np.flatnonzero((apart_m > FAR_M) & (times >= MIN_REPEATS)):
            text = f"{different[i, 0]:.10g}, {different[i, 1]:.10g}"
            repeats = rows[number.ravel() == i]
            found[text] = np.concatenate([found[text], repeats]) if text in found else repeats
    return found


def _far_notes(source: Source, links: pd.DataFrame, receivers: pd.DataFrame,
               devices: pd.DataFrame, sites: dict[str, SiteTable]) -> list[str]:
    """Note devices that are far from the middle of the receivers; BadInput: see `far_notes`."""
    for axes in (("latitude", "longitude"), ("x", "y")):
        if all(axis in ends for axis in axes for ends in (receivers, devices)):
            break
    else:
        return []
    first = ~links["device"].duplicated().to_numpy()
    names = links["device"].to_numpy()[first]
    path = sites["device"].path if "device" in sites else source.path
    middle = receivers[list(axes)].median().to_numpy()
    return far_notes(devices.loc[first, list(axes)].to_numpy(dtype=float), middle, axes,
                     lambda row: f"{path}: device {names[row]!r}", "the middle of the receivers")


def _split_by_band(links: pd.DataFrame) -> tuple[pd.DataFrame, dict[str, str], list[str]]:
    """Split devices that are read on carriers of several bands, whose levels and antennas differ.

    Channels of one band stay one device; readings without a carrier keep the old name. Returned
    are the links, new -> old name, and a note.
    """
    if "frequency_hz" not in links:
        return links, {}, []
    hz = links["frequency_hz"].to_numpy(dtype=float)
    by_device = links.groupby("device", sort=False)["frequency_hz"]
    wide = by_device.transform("max").to_numpy() > SAME_BAND * by_device.transform("min").to_numpy()
    names = links["device"].astype(object).to_numpy(copy=True)
    before: dict[str, str] = {}
    for device in pd.unique(names[wide]):
        rows = np.flatnonzero((names == device) & np.isfinite(hz))
        known_hz = np.unique(hz[rows])
        band = np.cumsum(np.r_[0, known_hz[1:] > SAME_BAND * known_hz[:-1]])
        usual_hz = np.array([np.median(known_hz[band == each]) for each in range(band[-1] + 1)])
        band_hz = usual_hz[band[np.searchsorted(known_hz, hz[rows])]]
        names[rows] = [f"{device} {each / 1e6:g} MHz" for each in band_hz]
        before |= dict.fromkeys(names[rows], device)
    if not before:
        return links, {}, []
    split = list(dict.fromkeys(before.values()))
    return links.assign(device=names), before, [
        f"{count(len(split), 'device')} read on carriers of several bands ({some(split, 5)}): each "
        "carrier is a device of its own, with its frequency in its name"]


def _are_glitches(links: pd.DataFrame, receiver_m: np.ndarray) -> np.ndarray:
    """Find links (n,) with an impossible receiver position, as a mask.

    Such a position is far from all others of the receiver, or would need supersonic flight to and
    from it. If there are many (see `are_few`), they are real positions, and none is marked.
    """
    known = np.flatnonzero(np.isfinite(receiver_m[:, :2]).all(axis=1))
    glitch = np.zeros(len(links), dtype=bool)
    receiver = pd.factorize(links["receiver"].to_numpy()[known])[0]
    ends = np.flatnonzero(np.diff(np.sort(receiver), append=-1)) + 1
    for rows in np.split(known[np.argsort(receiver, kind="stable")], ends[:-1]):
        place_m = receiver_m[rows, :2]
        if len(rows) < MIN_READINGS or (np.ptp(place_m, axis=0) < FAR_M / 2).all():
            continue
        distance_m = np.linalg.norm(place_m - np.median(place_m, axis=0), axis=1)
        order_m = np.sort(distance_m)
        gaps = np.flatnonzero(np.diff(order_m) > FAR_M)
        if len(gaps) and are_few(len(rows) - 1 - gaps[0], len(rows)):
            glitch[rows[distance_m > order_m[gaps[0]]]] = True
    if "time_s" in links:
        timed = ~glitch[known] & np.isfinite(links["time_s"].to_numpy()[known])
        known, receiver = known[timed], receiver[timed]
        time_s = links["time_s"].to_numpy()[known]
        order = np.lexsort((time_s, receiver))
        known, time_s, receiver = known[order], time_s[order], receiver[order]

        def is_fast(rows: int) -> np.ndarray:
            """Return whether each position is too far from the one `rows` before."""
            step_m = np.linalg.norm(receiver_m[known[rows:], :2] - receiver_m[known[:-rows], :2],
                                    axis=1)
            same = receiver[rows:] == receiver[:-rows]
            return same & (step_m > NEAR_M + FAST_M_S * (time_s[rows:] - time_s[:-rows]))

        spike = is_fast(1)[:-1] & is_fast(1)[1:] & ~is_fast(2)
        if are_few(spike.sum(), len(known)):
            glitch[known[1:-1][spike]] = True
    return glitch


def _check_near(source: Source, links: pd.DataFrame, position_m: np.ndarray, end: str) -> None:
    """Raise BadInput about a position that is too far from the origin."""
    far = (np.abs(position_m) > MAX_POSITION_M).any(axis=1)
    if far.any():
        row = int(np.argmax(far))
        raise BadInput(f"{source.path}: {source.where(links.index[row])}: the {end} lies "
                       f"{np.nanmax(np.abs(position_m[row])) / 1000:.10g} km from the origin "
                       f"({far.sum()} such rows); are position, unit and --origin right?")


def _positions(links: pd.DataFrame, prefix: str, table: pd.DataFrame | None, names: pd.Series,
               crs: str | None) -> pd.DataFrame:
    """Return positions and heights of links' ends, from the log, else from `table` by their name.

    NaN: unknown. A position or a height is never mixed from both.
    """
    columns = {name: links[prefix + name] for name in POSITION if prefix + name in links}
    positions = to_geographic(pd.DataFrame(columns, index=links.index), crs)
    if table is None:
        return positions
    no_place = positions.reindex(columns=["latitude", "x"]).isna().all(axis=1)
    heights = positions.reindex(columns=list(HEIGHTS)).assign(
        **{ABOVE_GROUND: links.get(prefix + ABOVE_GROUND)})
    no_height = heights.isna().all(axis=1)
    row = table.index.get_indexer(names)
    for name in POSITION:
        if name not in table:
            continue
        values = (positions[name].to_numpy(dtype=float) if name in positions
                  else np.full(len(links), np.nan))
        declared = np.append(table[name].to_numpy(dtype=float), np.nan)[row]  # -1: not in it
        positions[name] = np.where(no_height if name in HEIGHTS else no_place, declared, values)
    return positions


def _above_ground_m(links: pd.DataFrame, prefix: str, table: pd.DataFrame | None, names: pd.Series,
                    z_m: np.ndarray) -> np.ndarray:
    """Return heights above the ground (n,) [m] of links' ends without a height above the datum."""
    above_m = np.full(len(names), np.nan)
    if table is not None and "above_ground_m" in table:
        above_m = names.map(table["above_ground_m"]).to_numpy(dtype=float)
    if prefix + ABOVE_GROUND in links:
        logged_m = links[prefix + ABOVE_GROUND].to_numpy(dtype=float)
        above_m = np.where(np.isnan(logged_m), above_m, logged_m)
    return np.where(np.isnan(z_m), above_m, np.nan)


def _device_table(source: Source, links: pd.DataFrame, device_m: np.ndarray,
                  table: pd.DataFrame | None, declared_as: dict[str, str],
                  moving_m: float) -> pd.DataFrame:
    """Make the table `devices.csv`; BadInput if a device's positions span more than `moving_m` [m].

    `declared_as` maps names that `_split_by_band` made to those in the table of devices, `table`.
    """
    by_device = pd.DataFrame(device_m, columns=["x_m", "y_m", "z_m"], index=links.index).groupby(
        links["device"].to_numpy(), sort=False)
    range_m = by_device.max() - by_device.min()
    moving = range_m.index[(range_m > moving_m).any(axis=1)]
    if len(moving):
        raise BadInput(f"{source.path}: device {moving[0]!r} has positions "
                       f"{range_m.loc[moving[0]].max():.0f} m apart ({len(moving)} such devices); "
                       "a device has one position: --place-m 5 makes one of each place that is 5 m "
                       "from the others, device = \"by position\" one of each position; or leave "
                       "its position out to have it found")
    devices = by_device.median()
    devices["role"] = np.where(devices[["x_m", "y_m"]].notna().all(axis=1), "anchor", "unknown")
    devices.loc[devices["role"] == "unknown", ["x_m", "y_m"]] = np.nan
    for name in (*DEVICE_OPTIONAL, "antenna"):
        if table is not None and name in table and name != "above_ground_m":
            devices[name] = table[name].reindex(
                [declared_as.get(each, each) for each in devices.index]).to_numpy()
    declared = links["device"].replace(declared_as) if declared_as else links["device"]
    above_m = _above_ground_m(links, "device_", table, declared, device_m[:, 2])
    if np.isfinite(above_m).any():
        devices["above_ground_m"] = pd.Series(above_m).groupby(links["device"].to_numpy(),
                                                               sort=False).median()
    if READS in links:
        devices[READS] = links.groupby("device", sort=False)[READS].max()
    if "frequency_hz" in links:
        logged_hz = links.groupby("device", sort=False)["frequency_hz"].median()
        devices["frequency_hz"] = logged_hz.fillna(devices["frequency_hz"]) \
            if "frequency_hz" in devices else logged_hz
    return devices.rename_axis("device").reset_index()
