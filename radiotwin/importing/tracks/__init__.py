"""Take the positions of receivers from separate tracks, at the times of a log's readings."""

import re
from datetime import UTC, datetime
from pathlib import Path, PurePath

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.importing.log_files import BINARIES, TEXTS
from radiotwin.importing.settings import HEIGHTS, Settings, TrackFile
from radiotwin.importing.source import Source, Tally
from radiotwin.importing.tracks.autopilots import read_dataflash, read_tlog, read_ulog
from radiotwin.importing.tracks.fixes import COLUMNS, Fixes
from radiotwin.importing.tracks.rosbag import is_rosbag, read_rosbag
from radiotwin.importing.tracks.tables import read_track_table
from radiotwin.importing.tracks.texts import read_geojson, read_gpx, read_kml, read_nmea
from radiotwin.io.cells import listed
from radiotwin.io.inputs import open_input

_READERS = {".gpx": read_gpx, ".kml": read_kml, ".nmea": read_nmea, ".nma": read_nmea,
            ".ulg": read_ulog, ".bin": read_dataflash, ".tlog": read_tlog}


def add_tracks(source: Source, links: pd.DataFrame, settings: Settings,
               tally: Tally) -> tuple[pd.DataFrame, list[str]]:
    """Fill in missing receiver positions of links from tracks; drop and count links without.

    Returns:
        links with `latitude, longitude, altitude` and, if a track has them, angles; and notes.

    Raises:
        BadInput: a track cannot be read, there are no times, or log and track do not overlap.
    """
    if not settings.track:
        return links, []
    if "time_s" not in links:
        raise BadInput(f"{source.path}: a track is joined by time; give the column of the time: "
                       "--columns time=…")
    links = links.reset_index(names="row")  # several links of a row share its number
    time_s = links["time_s"].to_numpy(dtype=float)
    notes: list[str] = []
    columns = {name: links[name].to_numpy(dtype=float, copy=True) for name in COLUMNS
               if name in links}
    # A height of the log or the settings is not replaced by that of the track.
    has_height = links.reindex(columns=[*HEIGHTS]).notna().any(axis=1).to_numpy()
    without = np.ones(len(links), dtype=bool)
    for name in ("latitude", "x"):
        if name in links:
            without &= links[name].isna().to_numpy()
    for track in settings.track:
        fixes = _read(track, settings.time_zone)
        notes += fixes.notes
        needed = without & (links["receiver"].to_numpy() == track.receiver
                            if track.receiver else np.True_)
        if not needed.any():
            raise BadInput(f"{track.file}: no reading needs it: " + (
                f"receiver {track.receiver!r} is none of {listed(links['receiver'].unique())}"
                if track.receiver else "the log has positions of its own"))
        _check_common(source, track, time_s[needed] - track.time_offset_s, fixes)
        found = fixes.at(time_s[needed] - track.time_offset_s, settings.track_max_gap_s)
        for name, values in found.items():
            column = columns.setdefault(name, np.full(len(links), np.nan))
            missing = np.isnan(column[needed]) & ~(has_height[needed] & (name == "altitude"))
            column[needed] = np.where(missing, values, column[needed])
    links = links.assign(**columns).set_index("row")
    lost = without & np.isnan(columns["latitude"])
    return tally.drop(links, lost, f"no position of the track within {settings.track_max_gap_s:g} "
                                   "s", "time", source.where), notes


def _read(track: TrackFile, zone: str | None) -> Fixes:
    """Read a track with the reader for its format, found by the file's name and beginning."""
    path = Path(track.file)
    if is_rosbag(path):
        return read_rosbag(path, track.topic)
    if track.topic is not None:
        raise BadInput(f"{path} is no ROS bag, and has no topic {track.topic!r}; leave the topic "
                       "out, or give a .bag, .mcap or .db3 file")
    if path.suffix.lower() in _READERS:
        return _READERS[path.suffix.lower()](path)
    if path.suffix.lower() in (".geojson", ".json") and (fixes := read_geojson(path)):
        return fixes
    if path.suffix.lower() in (".log", ".txt"):
        with open_input(path, "track") as file:
            begin = file.read(4)
        if begin == b"FMT,":
            return read_dataflash(path)
        if re.match(rb"\$[A-Z]{2,3}", begin):
            return read_nmea(path)
    kind = PurePath(path.name.lower().removesuffix(".gz")).suffix
    if kind not in (*TEXTS, *BINARIES):
        raise BadInput(f"{path}: unknown format of a track; allowed are "
                       f"{', '.join((*_READERS, '.bag', '.mcap', '.db3', *TEXTS, *BINARIES))}")
    return read_track_table(path, track, zone)


def _check_common(source: Source, track: TrackFile, time_s: np.ndarray, fixes: Fixes) -> None:
    """Raise BadInput if track and log do not overlap in time, as with a wrong time zone."""
    first_s, last_s = np.nanmin(time_s), np.nanmax(time_s)
    if last_s < fixes.time_s[0] or first_s > fixes.time_s[-1]:
        off_h = (first_s - fixes.time_s[0]) / 3600
        raise BadInput(f"{track.file} runs from {_stamp(fixes.time_s[0])} to "
                       f"{_stamp(fixes.time_s[-1])} UTC, {source.path} from {_stamp(first_s)} to "
                       f"{_stamp(last_s)} UTC: they have no time in common, the log begins "
                       f"{off_h:+.2f} h later. Is time_zone right? time_offset_s of the track is "
                       "added to its times")


def _stamp(time_s: float) -> str:
    try:
        return datetime.fromtimestamp(time_s, UTC).strftime("%Y-%m-%d %H:%M:%S")
    except (ValueError, OverflowError, OSError):  # no calendar year
        return f"{time_s:g} s"
