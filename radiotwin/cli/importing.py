"""The command that brings in measurements of others."""

import math
import shlex
from pathlib import Path
from typing import Annotated, Any

import typer

from radiotwin.console import print_rows, say, show_warnings_plainly
from radiotwin.errors import BadInput


def add_commands(app: typer.Typer) -> None:
    app.command("import")(import_)


def import_(
    file: Annotated[Path, typer.Argument(metavar="FILE", help=".csv, .csv.gz, .parquet, or .geojson of points.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for measurements.csv, devices.csv, import.toml and "
                                                          "import.json.")],
    columns: Annotated[str | None, typer.Option(
        metavar="FILE.toml|NAME=COLUMN,…", help="What stands where: latitude=lat,longitude=lon,level=rsrp,device=cell; "
        "or a file with these and all other settings, which the options overrule.")] = None,
    wide: Annotated[list[str] | None, typer.Option(
        metavar="NAME=COLUMN,…", help="Levels of many receivers or devices in one row: level=*_rss,receiver=*; may be "
                                      "repeated.")] = None,
    level_unit: Annotated[str | None, typer.Option(help="dBm, mW, W (received power), or dB (gain).")] = None,
    length_unit: Annotated[str | None, typer.Option(help="m or ft.")] = None,
    time_format: Annotated[str | None, typer.Option(help="epoch s, epoch ms, ISO 8601, or as of strftime.")] = None,
    time_zone: Annotated[str | None, typer.Option(help="Of times without an offset: UTC, Europe/Berlin, ….")] = None,
    not_detected: Annotated[str | None, typer.Option(
        metavar="A,B,…", help="Levels that mean it was too weak; empty is an empty cell.")] = None,
    not_measured: Annotated[str | None, typer.Option(
        metavar="A,B,…", help="Levels that mean nobody listened; left out.")] = None,
    not_detected_at_or_below: Annotated[float | None, typer.Option(help="In the file's unit.")] = None,
    min_level: Annotated[float | None, typer.Option(help="Leave weaker ones out [dBm, or dB for gains].")] = None,
    max_level: Annotated[float | None, typer.Option(help="Leave stronger ones out.")] = None,
    min_distance_m: Annotated[float | None, typer.Option(help="Leave links out that are shorter.")] = None,
    max_distance_m: Annotated[float | None, typer.Option(help="Leave links out that are longer.")] = None,
    average_m: Annotated[float | None, typer.Option(help="Local means over this length; 20 to 40 wavelengths.")] = None,
    average: Annotated[str | None, typer.Option(help="power or median [power].")] = None,
    origin: Annotated[str | None, typer.Option(
        metavar="LAT,LON[,ALT]", help="Of the local frame; ALT is the ground's altitude [m] [median of the receivers, "
                                      "0].")] = None,
    crs: Annotated[str | None, typer.Option(help="Of x and y, such as EPSG:32612 [local metres].")] = None,
    devices: Annotated[str | None, typer.Option(help="Table: device, latitude, longitude, height, or x, y, z.")] = None,
    receivers: Annotated[str | None, typer.Option(help="Table of fixed receivers, in the same form.")] = None,
    gzip: Annotated[bool, typer.Option("--gzip", help="Write measurements.csv.gz.")] = False,
) -> None:
    """Bring measurements of any table into the form that the other commands read, and say what was left out and why."""
    from radiotwin.importing import import_file, parse_columns, read_settings
    from radiotwin.progress import progress

    show_warnings_plainly()
    given: dict[str, Any] = {
             "level_unit": level_unit, "length_unit": length_unit, "time_format": time_format, "time_zone": time_zone,
             "not_detected": _values(not_detected), "not_measured": _values(not_measured),
             "not_detected_at_or_below": not_detected_at_or_below, "min_level": min_level, "max_level": max_level,
             "min_distance_m": min_distance_m, "max_distance_m": max_distance_m, "average_m": average_m,
             "average": average, "origin": _origin(origin), "crs": crs, "devices": devices, "receivers": receivers,
             "wide": [parse_columns(text) for text in wide] if wide else None}
    pairs = columns is not None and "=" in columns and not columns.endswith(".toml")
    if columns is not None and pairs:
        given["columns"] = parse_columns(columns)
    settings = read_settings(None if pairs else columns, {k: v for k, v in given.items() if v is not None})
    with progress("importing", total=None) as advance:
        report = import_file(file, settings, out, gzip, lambda text: advance(1, text))
    _print(report)
    say(f"wrote {out}: {report['written']} links, {report['not_detected']} not detected; {report['devices']} devices "
        f"({report['anchors']} anchors), {report['receivers']} receivers, {report['flights']} flights")
    again = ["radiotwin", "import", file, "--columns", out / "import.toml", "-o", out, *(["--gzip"] if gzip else [])]
    say(f"again: {shlex.join(map(str, again))}")


def _print(report: dict) -> None:
    rows = [["read", "", report["readings"], f"{report['rows']} rows"]]
    rows += [[item["reason"], item["column"], -item["readings"], item["first"]] for item in report["left_out"]]
    rows += [["kept", "", report["kept"], ""]]
    if report["written"] != report["kept"]:
        rows += [["local means", "", report["written"], ""]]
    print_rows(f"Readings of {report['file']}", {"": "left", "column": "left", "readings": "right", "first": "left"},
               rows)
    print_rows("Ranges", {"column": "left", "min": "right", "median": "right", "max": "right", "unit": "left",
                          "empty": "right"},
               [[name, *(_number(r[k], name) for k in ("min", "median", "max")), r["unit"], r["empty"]]
                for name, r in report["ranges"].items()])
    if report["time"]:
        say(f"from {report['time']['first']} to {report['time']['last']} (UTC)")
    if report["origin"]:
        say("origin: latitude {latitude_deg}, longitude {longitude_deg}, ground at {altitude_m} m".format(
            **report["origin"]))
    for text in report["warnings"]:
        say(f"note: {text}")


def _number(value: float | None, name: str) -> str:
    """Degrees of a position need more decimals than anything else: 1e-5 is a metre."""
    if value is None:
        return "–"
    return f"{value:.5f}" if name in ("latitude", "longitude") else f"{value:.2f}"


def _values(text: str | None) -> list[float | str] | None:
    if text is None:
        return None
    values = []
    for part in text.split(","):
        try:
            number = float(part)
        except ValueError:
            number = math.nan
        values.append(number if math.isfinite(number) else part.strip())
    return values


def _origin(text: str | None) -> dict[str, float] | None:
    if text is None:
        return None
    names = ("latitude_deg", "longitude_deg", "altitude_m")
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in (2, 3):
        raise BadInput(f"--origin {text!r} is not two or three numbers; give LATITUDE,LONGITUDE or "
                       "LATITUDE,LONGITUDE,ALTITUDE in degrees and metres")
    return dict(zip(names, values))
