"""Commands that learn from measurements and judge what was learned: fit, map, compare."""

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from radiotwin.console import print_rows, result, say, show_warnings_plainly
from radiotwin.errors import BadInput

if TYPE_CHECKING:
    from radiotwin.scene import Scene

SAME_PLACE = 1e-6  # degrees, or metres of altitude, of two origins
MeasurementFile = Annotated[Path, typer.Argument(
    metavar="MEASUREMENTS", help="measurements.csv, .csv.gz or .parquet; devices.csv lies beside it.")]
SceneOption = Annotated[Path, typer.Option(help="Scene folder: the 3D map and where UAVs may fly.")]


def add_commands(app: typer.Typer) -> None:
    app.command("fit")(fit)
    app.command("map")(map_)
    app.command("compare")(compare)


def fit(
    measurements: MeasurementFile,
    scene: SceneOption,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the twin.")] = Path("twin"),
    model: Annotated[str, typer.Option(
        help="segmented_nn, segmented_log_distance, log_distance, regression_kriging, or raytrace: paths over the 3D "
             "map, also to find devices in narrow streets; takes minutes.")] = "segmented_nn",
    devices: Annotated[Path | None, typer.Option(help="Table of devices [devices.csv beside the file].")] = None,
    start: Annotated[Path | None, typer.Option(help="An earlier twin, to start the search from.")] = None,
    allow_indoor: Annotated[bool, typer.Option("--allow-indoor", help="Unknown devices may be inside buildings.")
                            ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of the fits and the search.")] = 0,
) -> None:
    """Learn the channel from the anchors, then find the unknown devices: the twin."""
    from radiotwin.measurements import read_measurements
    from radiotwin.scene import Scene
    from radiotwin.twin import Twin, check_twin_target, fit_twin

    show_warnings_plainly()
    check_twin_target(out)
    data, world = read_measurements(measurements, devices), Scene.load(scene)
    earlier = Twin.load(start) if start else None
    twin = fit_twin(data, world, model=model, seed=seed, start=earlier, allow_indoor=allow_indoor)
    twin.save(out)
    print_rows(f"Twin {out} ({model})",
               {"device": "left", "role": "left", "x [m]": "right", "y [m]": "right", "90 % radius [m]": "right",
                "note": "left"},
               [[d.device, d.role, d.x_m, d.y_m, d.credible_radius_m, _note(d)] for d in twin.devices])


def _note(device) -> str:
    if not device.located:
        return "not located: the data do not say where it is"
    if device.second_mode:
        x_m, y_m, weight = device.second_mode
        return f"perhaps at ({x_m:.0f}, {y_m:.0f}), {weight:.0%}"
    return ""


def map_(
    twin: Annotated[Path, typer.Argument(metavar="TWIN", help="Folder of a twin, as `fit` makes it, or a radio map "
                                                              "(.nc), as `trace` makes it.")],
    scene: SceneOption,
    out: Annotated[Path | None, typer.Option(
        "--out", "-o", help="Radio map: .nc (all), .csv (a row a link), .npz (NumPy), .tif (GeoTIFF), .kmz (Google "
                            "Earth) or .png (a picture of the lowest altitude) [TWIN.nc].")] = None,
    devices: Annotated[str | None, typer.Option(metavar="A,B,…", help="Only these devices.")] = None,
    altitudes: Annotated[str | None, typer.Option(
        metavar="Z,…", help="Only these of the lattice's altitudes [m].")] = None,
) -> None:
    """Predict the gain of every device over the scene's lattice, or write a radio map in another form."""
    from radiotwin.export import EXPORTERS, check_format, select
    from radiotwin.radiomap import RadioMap
    from radiotwin.scene import Scene
    from radiotwin.twin import Twin

    show_warnings_plainly()
    is_map = twin.suffix == ".nc"
    if out is None and is_map:
        raise BadInput(f"{twin} is a radio map already; say with --out in which form it is to be written")
    out = out or twin.resolve().with_name(f"{twin.resolve().name}.nc")
    world = Scene.load(scene)
    check_format(out, world)
    radio_map = RadioMap.read(twin) if is_map else Twin.load(twin).radio_map(world)
    if is_map:
        _check_place(twin, radio_map.dataset.attrs, world)
    radio_map = select(radio_map, devices.split(",") if devices else None, _altitudes(altitudes))
    EXPORTERS[out.suffix](radio_map, world, out)
    say(f"wrote {out}: {len(radio_map.devices)} devices on {radio_map.lattice.shape} positions (z, y, x)")


def _check_place(path: Path, attributes: dict, scene: "Scene") -> None:
    """A map of another city would be written with this one's outlines and place on the globe."""
    origin = scene.config.origin
    for name, value in ({} if origin is None else origin.model_dump()).items():
        there = attributes.get(f"origin_{name}", value)
        if abs(there - value) > SAME_PLACE:
            raise BadInput(f"{path} is a map of another place: its origin's {name} is {there:g}, that of "
                           f"{scene.folder} is {value:g}; give the scene that it was made for, or trace again")
    if attributes.get("scene_hash") not in (None, scene.content_hash()):
        warnings.warn(f"{path} was made for another scene than {scene.folder}, or that has changed since: outlines, "
                      "devices and the place on the globe are those of the scene", stacklevel=2)


def _altitudes(text: str | None) -> list[float] | None:
    if text is None:
        return None
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise BadInput(f"--altitudes {text!r} are not numbers; give metres, as 50,60") from None


def compare(
    measurements: MeasurementFile,
    scene: SceneOption,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the tables and figures.")] = Path("comparison"),
    truth: Annotated[str | None, typer.Option(
        help="Judge on a whole map, too: traced (SCENE/truth.nc), segmented, or a radio map.")] = None,
    held_out: Annotated[int, typer.Option(help="Flights, the last ones, that no model is fitted to.")] = 1,
    devices: Annotated[Path | None, typer.Option(help="Table of devices [devices.csv beside the file].")] = None,
    raytrace: Annotated[bool, typer.Option(
        "--raytrace", help="Judge the model raytrace, too: paths over the 3D map. Takes minutes.")] = False,
    also: Annotated[list[Path] | None, typer.Option(
        help="A twin's folder, or (with --truth) a radio map, to be judged beside the models; may be repeated.")
        ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the fits and the search.")] = 0,
) -> None:
    """Hold all channel models against flights they have not seen, and against the truth map where there is one."""
    from radiotwin.channel import MODELS
    from radiotwin.compare import compare_models, split_flights
    from radiotwin.comparison_output import judge_also, write_comparison
    from radiotwin.files import require_writable
    from radiotwin.measurements import read_measurements
    from radiotwin.scene import Scene
    from radiotwin.survey import read_truth
    from radiotwin.twin import RAYTRACE

    show_warnings_plainly()
    require_writable(out / "compare.json")
    world = Scene.load(scene)
    train, test = split_flights(read_measurements(measurements, devices), held_out)
    truth_map = read_truth(world, truth) if truth else None
    twins, maps = judge_also(also or [], truth_map, test.flights)
    models = (*MODELS, *[RAYTRACE] * raytrace)
    comparison = compare_models(train, test, world, truth_map, seed=seed, models=models, twins=twins, maps=maps)
    write_comparison(comparison, world, truth_map, out)
    print_comparison(comparison)
    say(f"wrote {out}")


def print_comparison(comparison) -> None:
    """The tables of a comparison on the terminal."""
    result("scores", comparison.scores.to_dict("records"))
    result("locations", comparison.locations.to_dict("records"))
    for title, columns, rows in comparison.tables():
        print_rows(title, columns, rows)
