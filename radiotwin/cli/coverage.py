"""The command that predicts the coverage of a network: coverage."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

import radiotwin as rt
from radiotwin.cli.options import (
    OnlyDevices,
    OptionalScene,
    open_model,
    parse_extent,
    parse_numbers,
    split_names,
)
from radiotwin.errors import BadInput
from radiotwin.io.files import atomic_folder, require_folder
from radiotwin.io.inputs import keep_inputs
from radiotwin.runtime.console import print_rows, result, say


def coverage(
    source: Annotated[Path, typer.Argument(
        metavar="SOURCE", help="Where gains are from: a twin's folder, a radio map (.nc, "
                               ".zarr), or a scene's folder for a published law, or paths, over "
                               "its map.")],
    scene: OptionalScene = None,
    out: Annotated[Path, typer.Option(
        "--out", "-o", help="Folder for tables, rasters, vectors and pictures.")
        ] = Path("coverage"),
    model: Annotated[str | None, typer.Option(
        help="Where SOURCE is a scene: a published law (p1411, tr36777_uma, tr36777_umi, "
             "al_hourani_urban (…), cost231_wi (…)), or paths: follows paths over the map, which "
             "takes far longer [p1411].")] = None,
    transmitters: Annotated[Path | None, typer.Option(
        metavar="TABLE", help="Transmitters in place of the twin's or the scene's devices: device, "
                              "x_m, y_m (or latitude_deg, longitude_deg), z_m, tx_power_dbm, "
                              "eirp_dbm, cable_loss_db, frequency_hz, load, antenna, azimuth_deg, "
                              "tilt_deg.")] = None,
    devices: OnlyDevices = None,
    tx_power_dbm: Annotated[float | None, typer.Option(
        help="Power of transmitters that declare none [tx_power_dbm of the scene].")] = None,
    load: Annotated[float, typer.Option(
        help="Share of the time that transmitters which declare none are active, 0 to 1.")] = 1.0,
    height: Annotated[float | None, typer.Option(
        help="Height of the receivers above the ground [1.5]; of a radio map, one of its altitudes "
             "[the lowest].")] = None,
    step: Annotated[float | None, typer.Option(help="Side of a cell [5 m; a map's own].")] = None,
    extent: Annotated[str | None, typer.Option(
        metavar="A,B,C,D", help="XMIN,YMIN,XMAX,YMAX [m] [that of the scene].")] = None,
    bandwidth_hz: Annotated[float | None, typer.Option(help="[that of the scene]")] = None,
    noise_figure_db: Annotated[float | None, typer.Option(
        help="Of the receivers [that which the scene's noise_dbm implies].")] = None,
    threshold_dbm: Annotated[float, typer.Option(
        help="Received power that the service needs.")] = -105.0,
    classes: Annotated[str, typer.Option(
        metavar="A,B,…", help="Lower ends of the legend's classes [dBm], descending.")
        ] = "-75,-85,-95,-105,-115",
    reliability: Annotated[float, typer.Option(
        help="Share of the locations in a cell that must reach the threshold.")] = 0.9,
    polygon: Annotated[Path | None, typer.Option(
        metavar="FILE.geojson", help="Areas whose covered shares are wanted, too.")] = None,
    indoor_loss_db: Annotated[float | None, typer.Option(
        help="Predict inside buildings, too, with this loss; they are left out otherwise.")] = None,
    aclr_db: Annotated[float, typer.Option(
        help="Adjacent-channel leakage ratio of the transmitters: what a channel gets of one in "
             "either of the next two.")] = 45.0,
    rate: Annotated[str, typer.Option(
        metavar="SHARE,SINR,CAP", help="Rate by SINR: share of Shannon's bound, least SINR [dB], "
                                       "greatest rate [bit/s/Hz] (3GPP TR 36.942).")
        ] = "0.6,-10,4.4",
    formats: Annotated[str | None, typer.Option(
        metavar="A,B,…", help="Of nc, tif, gpkg, kmz, png [all that can be written].")] = None,
) -> None:
    """Predict the coverage of a network.

    Received power, best server, SNR, SINR, rate and covered shares on a street-level grid.
    """
    from radiotwin.coverage import RateModel, read_transmitters
    from radiotwin.coverage.areas import read_areas
    from radiotwin.coverage.output import FILES, available_formats, write_formats, write_tables
    from radiotwin.report import write_coverage_pictures

    settings = rt.CoverageSettings(
        height_m=height, step_m=step, extent_m=parse_extent(extent), tx_power_dbm=tx_power_dbm,
        bandwidth_hz=bandwidth_hz, noise_figure_db=noise_figure_db, load=load,
        threshold_dbm=threshold_dbm, reliability=reliability, indoor_loss_db=indoor_loss_db,
        aclr_db=aclr_db,
        classes_dbm=tuple(parse_numbers("--classes", classes)),
        rate=RateModel(*parse_numbers("--rate", rate, 3)))
    settings.check()
    world = _world(source, scene, model)
    usable, notes = available_formats(world, split_names(formats))
    require_folder(out, FILES, mark="coverage.json")
    keep_inputs(out, transmitters, polygon, world.folder, source)
    areas = read_areas(polygon, world) if polygon else []
    table = read_transmitters(transmitters, world) if transmitters else None
    with _gains(source, world, model) as gains:
        found = rt.predict_coverage(gains, world, table, settings, areas, split_names(devices))
    with atomic_folder(out) as folder:
        write_tables(found, folder)
        write_formats(found, world, folder, usable)
        if "png" in usable:
            write_coverage_pictures(found, world, folder)
    _print(found.summary)
    for note in (*found.summary["notes"], *notes):
        say(f"note: {note}")
    say(f"wrote {out}: {', '.join(sorted(path.name for path in out.iterdir()))}")


def _world(source: Path, scene: Path | None, model: str | None) -> "rt.Scene":
    """Load the scene of a coverage source: the source itself, or --scene for a twin or map."""
    from radiotwin.maps.file import is_map

    if (source / "scene.toml").exists():
        if scene is not None:
            raise BadInput(f"{source} is a scene already; leave --scene out")
        return rt.Scene.load(source)
    if model is not None:
        raise BadInput(f"--model is for a scene without measurements, and {source} is none; leave "
                       "it out, or give the scene's folder in place of it")
    if not is_map(source) and not source.is_dir():
        raise BadInput(f"{source} is neither a folder nor a radio map (.nc, .zarr); give a twin's "
                       "folder, a radio map, or a scene's folder")
    if scene is None:
        raise BadInput(f"{source} needs the scene's 3D map; give its folder with --scene")
    return rt.Scene.load(scene)


@contextmanager
def _gains(source: Path, world: "rt.Scene",
           model: str | None) -> "Iterator[rt.Twin | rt.RadioMap | str]":
    """Yield the source of gains: an opened twin or radio map, or for a scene the name of a law."""
    from radiotwin.maps.export.tables import check_map_place

    if (source / "scene.toml").exists():
        yield model or "p1411"
        return
    with open_model(source) as opened:
        if isinstance(opened, rt.RadioMap):
            check_map_place(str(source), opened.attributes, world)
        yield opened


def _print(facts: dict[str, Any]) -> None:
    """Print a prediction's assumptions, covered shares of areas, and share of each server."""
    result("coverage", facts)
    above = "above the ground" if facts["above_ground"] else "above the datum"
    say(f"{facts['model']}; {facts['cells']:,} cells of {facts['step_m']:g} m, receivers "
        f"{facts['height_m']:g} m {above}; noise {facts['noise_dbm']:.1f} dBm "
        f"({facts['bandwidth_hz'] / 1e6:g} MHz, noise figure {facts['noise_figure_db']:.1f} dB)")
    if facts["cells_left_out_indoors"]:
        say(f"{facts['cells_left_out_indoors']:,} cells inside buildings are left out; shares are "
            "of the others")
    columns = dict.fromkeys(("area", "quantity"), "left") | dict.fromkeys(
        ("at least", "share [%]", f"with {facts['reliability']:.0%} reliability [%]",
         "expected [%]", "km²"), "right")
    rows: list[list] = []
    for area in facts["areas"]:
        for title, key, unit, factor in (("received power", "received_power_dbm", "dBm", 1.0),
                                         ("SINR", "sinr_db", "dB", 1.0),
                                         ("rate", "rate_bps", "Mbit/s", 1e-6)):
            rows += [[area["area"], title, f"{each['threshold'] * factor:.4g} {unit}",
                      100 * each["share"],
                      *(100 * each.get(name, float("nan")) for name in
                        ("share_reliable", "mean_probability")),
                      each["share"] * area["area_m2"] / 1e6] for each in area[key]]
    print_rows("Share of the area", columns, rows)
    shares = facts["areas"][0]["best_server"]
    print_rows("Transmitters", {"device": "left"} | dict.fromkeys(
        ("x [m]", "y [m]", "z [m]", "power [dBm]", "load", "best server [%]"), "right"),
        [[each["device"], *(float("nan") if each[axis] is None else each[axis]
                            for axis in ("x_m", "y_m", "z_m")),
          "measured" if each["tx_power_dbm"] is None else each["tx_power_dbm"], each["load"],
          100 * shares[each["device"]]] for each in facts["transmitters"]])
