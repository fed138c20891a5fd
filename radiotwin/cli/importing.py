"""The command that imports measurements from tables of any layout."""

import math
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from radiotwin.cli.options import parse_origin
from radiotwin.errors import BadInput
from radiotwin.runtime.console import print_rows, say

_BAD_ROWS = 20  # at most so many are printed

if TYPE_CHECKING:
    from radiotwin.importing.settings import Settings


def import_(
    files: Annotated[list[Path], typer.Argument(
        metavar="FILES", help="Logs, folders of logs, or zip files of them: texts with columns "
                               "(.csv, .tsv, .txt, .log, also .gz), JSON lines, .geojson of "
                               "points, .parquet, .xlsx.")],
    out: Annotated[Path, typer.Option(
        "--out", "-o", help="Folder for measurements.csv, devices.csv, import.toml and "
                            "import.json.")],
    format: Annotated[str | None, typer.Option(
        "--format", help="Name of a known format [found by its columns].")] = None,
    columns: Annotated[str | None, typer.Option(
        metavar="FILE.toml|NAME=COLUMN,…",
        help="Column of each quantity: latitude=lat,longitude=lon,level=rsrp,device=cell; or a "
             "file with these and all other settings, which the options overrule.")] = None,
    wide: Annotated[list[str] | None, typer.Option(
        metavar="NAME=COLUMN,…", help="Levels of many receivers or devices in one row: "
                                      "level=*_rss,receiver=*; may be repeated.")] = None,
    only: Annotated[list[str] | None, typer.Option(
        metavar="COLUMN=A|B", help="Keep the rows in which a column is one of these; may be "
                                   "repeated.")] = None,
    delimiter: Annotated[str | None, typer.Option(
        help="Of a text: , ; | tab, space (any number of blanks) or spaces (two and more) "
             "[found].")] = None,
    encoding: Annotated[str | None, typer.Option(
        help="Of a text, such as cp1252 [found].")] = None,
    decimal: Annotated[str | None, typer.Option(help="Decimal mark, . or , [found].")] = None,
    sheet: Annotated[str | None, typer.Option(help="Name of the sheet of a workbook [the first]."
                                              )] = None,
    list_name: Annotated[str | None, typer.Option(
        "--list", metavar="NAME", help="List in JSON whose objects are rows, such as hotspots [the "
                                       "lists of the columns that are used].")] = None,
    header: Annotated[str | None, typer.Option(
        metavar="NAME,…", help="Names of the columns of a text without a header.")] = None,
    lines_before_header: Annotated[int | None, typer.Option(help="Of a text [found].")] = None,
    lines_after_table: Annotated[int | None, typer.Option(help="Of a text [found].")] = None,
    skip_bad_rows: Annotated[int | None, typer.Option(
        metavar="N", help="Leave out rows that cannot be read, and list them, if they are not more "
                          "than N [0].")] = None,
    no_quotes: Annotated[bool, typer.Option(
        "--no-quotes", help="Quotation marks of a text are letters.")] = False,
    level_unit: Annotated[str | None, typer.Option(
        help="dBm, mW, W (received power), or dB (gain).")] = None,
    path_loss: Annotated[bool, typer.Option(
        "--path-loss", help="Levels are path losses, positive numbers in dB.")] = False,
    level_offset_db: Annotated[float | None, typer.Option(
        help="Added to each level, such as a cable's loss.")] = None,
    band_hz: Annotated[str | None, typer.Option(
        metavar="LOW,HIGH", help="Band whose power counts, of a spectrum scan.")] = None,
    length_unit: Annotated[str | None, typer.Option(help="m or ft.")] = None,
    time_format: Annotated[str | None, typer.Option(
        help="epoch s, epoch ms, ISO 8601, or a strftime format.")] = None,
    time_zone: Annotated[str | None, typer.Option(
        help="Zone of times without an offset from UTC: UTC, Europe/Berlin, ….")] = None,
    not_detected: Annotated[str | None, typer.Option(
        metavar="A,B,…", help="Levels that mean it was too weak; empty is an empty cell.")] = None,
    not_measured: Annotated[str | None, typer.Option(
        metavar="A,B,…", help="Levels that mean nobody listened; left out.")] = None,
    not_detected_at_or_below: Annotated[float | None, typer.Option(
        help="Largest level that means it was too weak, in the file's unit.")] = None,
    min_level: Annotated[float | None, typer.Option(
        help="Leave weaker levels out [dBm, or dB for gains].")] = None,
    max_level: Annotated[float | None, typer.Option(
        help="Leave stronger levels out [dBm, or dB for gains].")] = None,
    thin_m: Annotated[float | None, typer.Option(
        help="Of a receiver that stays within this distance, as in a hover, keep one reading: "
             "that of the median level.")] = None,
    place_m: Annotated[float | None, typer.Option(
        help="Positions of a device that are farther apart are different places, each a device "
             "NAME@1, NAME@2, ….")] = None,
    min_distance_m: Annotated[float | None, typer.Option(help="Leave shorter links out.")] = None,
    max_distance_m: Annotated[float | None, typer.Option(help="Leave longer links out.")] = None,
    average_m: Annotated[float | None, typer.Option(
        help="Length of the bins of local means; 20 to 40 wavelengths remove fast fading.")] = None,
    average: Annotated[str | None, typer.Option(help="power or median [power].")] = None,
    origin: Annotated[str | None, typer.Option(
        metavar="LAT,LON[,ALT]", help="Origin of the local frame; ALT is the ground's altitude [m] "
                                      "[median of the receivers, 0].")] = None,
    crs: Annotated[str | None, typer.Option(
        help="Reference system of x and y, such as EPSG:32612 [local metres].")] = None,
    devices: Annotated[str | None, typer.Option(
        help="Table: device, latitude, longitude, height, or x, y, z.")] = None,
    receivers: Annotated[str | None, typer.Option(
        help="Table of fixed receivers, in the same form.")] = None,
    track: Annotated[list[str] | None, typer.Option(
        metavar="[RECEIVER=]FILE", help="Positions over time, where the log has none: .gpx, .kml, "
                                        ".nmea, PX4 .ulg, ArduPilot .bin and .tlog, ROS .bag, "
                                        ".mcap, .db3 or the folder of a ROS 2 bag, or a table, "
                                        "such as those of Airdata, Litchi and DJI; may be "
                                        "repeated.")] = None,
    track_columns: Annotated[str | None, typer.Option(
        metavar="NAME=COLUMN,…", help="Columns of tracks that are tables: time=…,latitude=…,"
                                      "longitude=…,altitude=… [found].")] = None,
    track_time_format: Annotated[str | None, typer.Option(
        help="Of such a track, as --time-format [found].")] = None,
    track_topic: Annotated[str | None, typer.Option(
        metavar="NAME", help="Topic of the tracks that are ROS bags [the only one with "
                             "positions].")] = None,
    track_max_gap_s: Annotated[float | None, typer.Option(
        help="Largest time between two positions of a track that are interpolated [5].")] = None,
    gzip: Annotated[bool, typer.Option("--gzip", help="Write measurements.csv.gz.")] = False,
) -> None:
    """Import measurements from logs and tables of any layout.

    Known formats are recognised; of others the columns are declared. Several files become one
    table with one origin, each of them a flight. The other commands read the result. A report
    counts what was left out.
    """
    options = locals()
    from radiotwin.importing import Settings, import_files, parse_columns, read_settings
    from radiotwin.runtime.console import progress

    given: dict[str, Any] = {name: options[name] for name in Settings.model_fields
                             if name in options and name != "columns"}
    given |= {
        "only": _choices(only), "quotes": False if no_quotes else None,
        "path_loss": path_loss or None, "header": header.split(",") if header else None,
        "delimiter": {"tab": "\t", "\\t": "\t", "space": " ", "spaces": "  "}.get(
            delimiter or "", delimiter),
        "band_hz": _values(band_hz), "not_detected": _values(not_detected),
        "not_measured": _values(not_measured), "origin": parse_origin(origin),
        "track": _tracks(track, {
            "topic": track_topic, "time_format": track_time_format,
            "columns": parse_columns(track_columns) if track_columns else None}),
        "wide": [parse_columns(text) for text in wide] if wide else None}
    mapping = columns
    if columns is not None and "=" in columns and not columns.lower().endswith(".toml"):
        given["columns"] = parse_columns(columns)
        mapping = None
    given = {name: value for name, value in given.items() if value is not None}
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
    """Return the options that name tables of devices, receivers and tracks, to repeat an import.

    import.toml cannot name files outside its folder, so the command line has to. Tracks are left
    out if one has a setting for which there is no option.
    """
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


def _tracks(texts: list[str] | None, given: dict[str, Any]) -> list[dict[str, Any]] | None:
    """Parse values `FILE` or `RECEIVER=FILE` of --track into records, each with settings `given`.

    Settings without a track are BadInput.
    """
    given = {name: value for name, value in given.items() if value is not None}
    if texts is None:
        if given:
            raise BadInput(f"--track-{next(iter(given)).replace('_', '-')} is of a track; give "
                           "that with --track, too")
        return None
    pairs = [(text.rpartition("=")[2], text.rpartition("=")[0]) for text in texts]
    return [{"file": file, **({"receiver": receiver} if receiver else {}),
             **given}
            for file, receiver in pairs]


def _choices(texts: list[str] | None) -> dict[str, list[str]] | None:
    """Parse `COLUMN=A|B` of --only into allowed values by column."""
    if texts is None:
        return None
    chosen = {}
    for text in texts:
        column, equals, values = text.partition("=")
        if not (column.strip() and equals):
            raise BadInput(f"--only {text!r} is not COLUMN=A|B; for example Type=LTE")
        chosen[column.strip()] = [value.strip() for value in values.split("|")]
    return chosen


def _number(value: float | None, name: str) -> str:
    """Format a value of a column; degrees with five decimals (1e-5 degrees is a metre)."""
    if value is None:
        return "–"
    return f"{value:.5f}" if name in ("latitude", "longitude") else f"{value:.2f}"


def _values(text: str | None) -> list[float | str] | None:
    """Split `A,B,…` at commas; a part that is a finite number becomes one, others stay text."""
    if text is None:
        return None
    values: list[float | str] = []
    for part in text.split(","):
        try:
            number = float(part)
        except ValueError:
            number = math.nan
        values.append(number if math.isfinite(number) else part.strip())
    return values
