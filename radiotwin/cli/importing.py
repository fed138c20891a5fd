"""The command that imports measurements from tables of any layout."""

import inspect
import math
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from radiotwin.cli.options import parse_origin
from radiotwin.errors import BadInput
from radiotwin.runtime.command import with_options
from radiotwin.runtime.console import print_rows, progress, say

_BAD_ROWS = 20  # at most so many are printed

if TYPE_CHECKING:
    from radiotwin.importing.settings import Settings


def _choices(texts: list[str]) -> dict[str, list[str]]:
    """Parse `COLUMN=A|B` of --only into allowed values by column."""
    chosen = {}
    for text in texts:
        column, equals, values = text.partition("=")
        if not (column.strip() and equals):
            raise BadInput(f"--only {text!r} is not COLUMN=A|B; for example Type=LTE")
        chosen[column.strip()] = [value.strip() for value in values.split("|")]
    return chosen


def _values(text: str) -> list[float | str]:
    """Split `A,B,…` at commas; a part that is a finite number becomes one, others stay text."""
    values: list[float | str] = []
    for part in text.split(","):
        try:
            number = float(part)
        except ValueError:
            number = math.nan
        values.append(number if math.isfinite(number) else part.strip())
    return values


_OPTIONS: dict[str, tuple[type, str | None, str]] = {  # name -> type, metavar, help
    "format": (str, None, "Name of a known format [found by its columns]."),
    "columns": (str, "FILE.toml|NAME=COLUMN,…",
                "Column of each quantity: latitude=lat,longitude=lon,level=rsrp,device=cell; or a "
                "file with these and all other settings, which the options overrule."),
    "wide": (list[str], "NAME=COLUMN,…", "Levels of many receivers or devices in one row: "
                                         "level=*_rss,receiver=*; may be repeated."),
    "only": (list[str], "COLUMN=A|B", "Keep the rows in which a column is one of these; may be "
                                      "repeated."),
    "delimiter": (str, None, "Of a text: , ; | tab, space (any number of blanks) or spaces (two "
                             "and more) [found]."),
    "encoding": (str, None, "Of a text, such as cp1252 [found]."),
    "decimal": (str, None, "Decimal mark, . or , [found]."),
    "sheet": (str, None, "Name of the sheet of a workbook [the first]."),
    "list_name": (str, "NAME", "List in JSON whose objects are rows, such as hotspots [the lists "
                               "of the columns that are used]."),
    "header": (str, "NAME,…", "Names of the columns of a text without a header."),
    "lines_before_header": (int, None, "Of a text [found]."),
    "lines_after_table": (int, None, "Of a text [found]."),
    "skip_bad_rows": (int, "N", "Leave out rows that cannot be read, and list them, if they are "
                                "not more than N [0]."),
    "no_quotes": (bool, None, "Quotation marks of a text are letters."),
    "level_unit": (str, None, "dBm, mW, W (received power), or dB (gain)."),
    "path_loss": (bool, None, "Levels are path losses, positive numbers in dB."),
    "level_offset_db": (float, None, "Added to each level, such as a cable's loss."),
    "band_hz": (str, "LOW,HIGH", "Band whose power counts, of a spectrum scan."),
    "length_unit": (str, None, "m or ft."),
    "time_format": (str, None, "epoch s, epoch ms, ISO 8601, or a strftime format."),
    "time_zone": (str, None, "Zone of times without an offset from UTC: UTC, Europe/Berlin, …."),
    "not_detected": (str, "A,B,…", "Levels that mean it was too weak; empty is an empty cell."),
    "not_measured": (str, "A,B,…", "Levels that mean nobody listened; left out."),
    "not_detected_at_or_below": (float, None, "Largest level that means it was too weak, in the "
                                              "file's unit."),
    "min_level": (float, None, "Leave weaker levels out [dBm, or dB for gains]."),
    "max_level": (float, None, "Leave stronger levels out [dBm, or dB for gains]."),
    "thin_m": (float, None, "Of a receiver that stays within this distance, as in a hover, keep "
                            "one reading: that of the median level."),
    "place_m": (float, None, "Positions of a device that are farther apart are different places, "
                             "each a device NAME@1, NAME@2, …."),
    "min_distance_m": (float, None, "Leave shorter links out."),
    "max_distance_m": (float, None, "Leave longer links out."),
    "average_m": (float, None, "Length of the bins of local means; 20 to 40 wavelengths remove "
                               "fast fading."),
    "average": (str, None, "power or median [power]."),
    "origin": (str, "LAT,LON[,ALT]", "Origin of the local frame; ALT is the ground's altitude [m] "
                                     "[median of the receivers, 0]."),
    "crs": (str, None, "Reference system of x and y, such as EPSG:32612 [local metres]."),
    "devices": (str, None, "Table: device, latitude, longitude, height, or x, y, z."),
    "receivers": (str, None, "Table of fixed receivers, in the same form."),
    "track": (list[str], "[RECEIVER=]FILE",
              "Positions over time, where the log has none: .gpx, .kml, .nmea, PX4 .ulg, ArduPilot "
              ".bin and .tlog, ROS .bag, .mcap, .db3 or the folder of a ROS 2 bag, or a table, "
              "such as those of Airdata, Litchi and DJI; may be repeated."),
    "track_columns": (str, "NAME=COLUMN,…", "Columns of tracks that are tables: time=…,latitude=…,"
                                            "longitude=…,altitude=… [found]."),
    "track_time_format": (str, None, "Of such a track, as --time-format [found]."),
    "track_topic": (str, "NAME", "Topic of the tracks that are ROS bags [the only one with "
                                 "positions]."),
    "track_max_gap_s": (float, None, "Largest time between two positions of a track that are "
                                     "interpolated [5]."),
    "gzip": (bool, None, "Write measurements.csv.gz."),
}
_DELIMITERS = {"tab": "\t", "\\t": "\t", "space": " ", "spaces": "  "}
_PARSED: dict[str, Callable[[Any], Any]] = {  # settings that are written otherwise on the line
    "header": lambda text: text.split(","), "only": _choices, "band_hz": _values,
    "not_detected": _values, "not_measured": _values, "origin": parse_origin,
    "delimiter": lambda text: _DELIMITERS.get(text, text)}


def import_(
    files: Annotated[list[Path], typer.Argument(
        metavar="FILES", help="Logs, folders of logs, or zip files of them: texts with columns "
                               "(.csv, .tsv, .txt, .log, also .gz), JSON lines, .geojson of "
                               "points, .parquet, .xlsx.")],
    out: Annotated[Path, typer.Option(
        "--out", "-o", help="Folder for measurements.csv, devices.csv, import.toml and "
                            "import.json.")],
    **options: Any,
) -> None:
    """Import measurements from logs and tables of any layout.

    Known formats are recognised; of others the columns are declared. Several files become one
    table with one origin, each of them a flight. The other commands read the result. A report
    counts what was left out.
    """
    from radiotwin.importing import import_files, parse_columns, read_settings

    given = {name: _PARSED.get(name, lambda value: value)(value)
             for name, value in options.items() if value is not None and value is not False}
    gzip = given.pop("gzip", False)
    if given.pop("no_quotes", False):
        given["quotes"] = False
    if "wide" in given:
        given["wide"] = [parse_columns(text) for text in given["wide"]]
    of_tracks = {name.removeprefix("track_"): given.pop(name)
                 for name in ("track_topic", "track_time_format", "track_columns") if name in given}
    if of_tracks.get("columns"):
        of_tracks["columns"] = parse_columns(of_tracks["columns"])
    if "track" in given:
        given["track"] = [_track(text) | of_tracks for text in given["track"]]
    elif of_tracks:
        raise BadInput(f"--track-{next(iter(of_tracks)).replace('_', '-')} is of a track; give "
                       "that with --track, too")
    mapping = given.pop("columns", None)
    if mapping is not None and "=" in mapping and not mapping.lower().endswith(".toml"):
        given["columns"], mapping = parse_columns(mapping), None
    settings = read_settings(mapping, given, files[0].parent)
    with progress("importing", total=None) as advance:
        report = import_files(files, settings, out, gzip, lambda step: advance(1, step))
    _print(report)
    say(f"wrote {out}: {report['written']} links, {report['not_detected']} not detected; "
        f"{report['devices']} devices ({report['anchors']} anchors), {report['receivers']} "
        f"receivers, {report['flights']} flights")
    again = ["radiotwin", "import", *files, "--columns", out / "import.toml", *_tables(settings),
             "-o", out, *["--gzip"] * gzip]
    say(f"again: {shlex.join(map(str, again))}")


with_options(
    import_, inspect.Signature(list(inspect.signature(import_).parameters.values())[:2]), {
        name: (Annotated[kind if kind is bool else kind | None, typer.Option(
            "--list" if name == "list_name" else f"--{name.replace('_', '-')}", metavar=metavar,
            help=text)], False if kind is bool else None)
        for name, (kind, metavar, text) in _OPTIONS.items()})


def _track(text: str) -> dict[str, Any]:
    """Parse `FILE` or `RECEIVER=FILE` of --track."""
    receiver, _, file = text.rpartition("=")
    return {"file": file, **({"receiver": receiver} if receiver else {})}


def _print(report: dict[str, Any]) -> None:
    """Print an import's report: readings read, left out and kept, files, ranges, origin, faults."""
    rows = [["read", "", report["readings"], f"{report['rows']} rows"]]
    rows += [[item["reason"], item["column"], -item["readings"], item["first"]]
             for item in report["left_out"]]
    rows += [["kept", "", report["kept"], ""]]
    if report["written"] != report["kept"]:
        rows += [["local means", "", report["written"], ""]]
    files = report["files"]
    if len(files) > 1:
        print_rows("Files", {"file": "left", "rows": "right", "readings": "right",
                             "format": "left"},
                   [[each["file"], each["rows"], each["readings"], each["format"] or "declared"]
                    for each in files])
    print_rows(f"Readings of {files[0]['file'] if len(files) == 1 else f'{len(files)} files'}",
               {"": "left", "column": "left", "readings": "right", "first": "left"}, rows)
    print_rows("Ranges", {"column": "left", "min": "right", "median": "right", "max": "right",
                          "unit": "left", "empty": "right"},
               [[name, *(_number(values[key], name) for key in ("min", "median", "max")),
                 values["unit"], values["empty"]] for name, values in report["ranges"].items()])
    if report["time"]:
        say(f"from {report['time']['first']} to {report['time']['last']} (UTC)")
    if report["origin"]:
        say("origin: latitude {latitude_deg}, longitude {longitude_deg}, ground at {altitude_m} m"
            .format(**report["origin"]))
    bad = report["bad_rows"]
    for row in bad[:_BAD_ROWS]:
        say(f"bad row left out: {row['row']}, {row['column'] or 'all'}: {row['cell']} "
            f"{row['reason']}")
    if len(bad) > _BAD_ROWS:
        say(f"and {len(bad) - _BAD_ROWS} more bad rows: all are in import.json")
    for text in report["warnings"]:
        say(f"note: {text}")


def _tables(settings: "Settings") -> list[str]:
    """Return the options that name tables and tracks: import.toml names none outside its folder."""
    options = [text for name in ("devices", "receivers") if (table := getattr(settings, name))
               for text in (f"--{name}", table)]
    tracks, topics = settings.track, {track.topic for track in settings.track}
    if len(topics) != 1 or any(track.time_offset_s or track.columns or track.time_format
                               or track.time_zone or track.length_unit or "=" in track.file
                               for track in tracks):
        return options  # no tracks, or settings of them that have no option
    for track in tracks:
        options += ["--track", f"{track.receiver}={track.file}" if track.receiver else track.file]
    topic = topics.pop()
    return [*options, "--track-topic", topic] if topic else options


def _number(value: float | None, name: str) -> str:
    """Format a value of a column; degrees with five decimals (1e-5 degrees is a metre)."""
    if value is None:
        return "–"
    return f"{value:.5f}" if name in ("latitude", "longitude") else f"{value:.2f}"
