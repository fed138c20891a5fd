"""Arguments and options that several commands share."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import radiotwin as rt
from radiotwin.errors import BadInput
from radiotwin.io.inputs import is_within

if TYPE_CHECKING:
    from radiotwin.io.forms import Origin

MeasurementFile = Annotated[Path, typer.Argument(
    metavar="MEASUREMENTS", help="measurements.csv, .csv.gz or .parquet, with devices.csv in the "
                                 "same folder.")]
DeviceTable = Annotated[Path | None, typer.Option(
    help="Table of the devices [devices.csv in the folder of the measurements].")]
SceneFolder = Annotated[Path, typer.Argument(
    metavar="SCENE", help="Scene folder, as `build-scene` makes it.")]
SceneOption = Annotated[Path, typer.Option(
    help="Scene folder: the 3D map and the lattice of the UAVs.")]
OptionalScene = Annotated[Path | None, typer.Option(
    help="Scene folder; without one every link has line of sight.")]
PointsFile = Annotated[Path, typer.Option(
    help="CSV file with x_m, y_m, z_m; or latitude_deg, longitude_deg, z_m, where the scene has an "
         "origin.")]
Shift = Annotated[str | None, typer.Option(
    metavar="DX,DY", help="Metres to add to x and y of measurements and devices for the scene's "
                          "frame; 0,0 says that it is theirs.")]
Force = Annotated[bool, typer.Option(
    "--force", help="Replace a file that radiotwin did not write.")]
OnlyDevices = Annotated[str | None, typer.Option(metavar="A,B,…", help="Only these devices.")]
Quality = Annotated[str | None, typer.Option(help="fast, default or high [default].")]
TargetDb = Annotated[float | None, typer.Option(
    help="Take the quality with the fewest rays whose RMS error, against ten times the rays on a "
         "few links, is within this [dB].")]
Combining = Annotated[str, typer.Option(
    help="power (sum of the paths' powers) or coherent (sum of their fields).")]
Diffraction = Annotated[str | None, typer.Option(
    help="reciprocal (the same in both directions), sionna (as released) or off [reciprocal].")]
Radius = Annotated[float | None, typer.Option(
    help="Leave out what lies farther from the lines of a batch's links [m; 400 in cities of more "
         "than 5,000 shapes, inf (the whole city) in others].")]
MAX_SEED = 2**32 - 1  # of scikit-learn
RaySeed = Annotated[int, typer.Option(min=0, max=MAX_SEED, help="Seed of the rays.")]
FitSeed = Annotated[int, typer.Option(min=0, max=MAX_SEED, help="Seed of the fits and the search.")]

Workers = Annotated[str, typer.Option(
    metavar="auto|N", help="Processes that share the work; 1 is this one. auto: as many as there "
                           "are cores and memory, where it takes long enough. The result is the "
                           "same to the bit.")]
ComputeDevice = Annotated[str, typer.Option(
    "--device", metavar="auto|cpu|cuda",
    help="Where rays are traced: auto takes a GPU where tracing works on one. Gains of a GPU "
         "differ from the processor's by rounding.")]
Cluster = Annotated[str | None, typer.Option(
    metavar="auto|ADDRESS", help="Run on Ray: auto starts a cluster on this machine and ends it "
                                 "again, ADDRESS (HOST:PORT) joins one. Needs radiotwin[ray].")]


@contextmanager
def open_model(path: Path) -> "Iterator[rt.RadioMap | rt.Twin]":
    """Open a radio map (.nc, .zarr) without reading its values, or load a twin from its folder."""
    from radiotwin.maps.file import is_map

    if not is_map(path):
        yield rt.Twin.load(path)
        return
    with rt.RadioMap.open(path) as radio_map:
        yield radio_map


def split_names(text: str | None) -> list[str] | None:
    """Split `A,B,…` into names; None for no text, which stands for all."""
    return text.split(",") if text else None


def parse_origin(text: str | None) -> "Origin | None":
    """Parse `LATITUDE,LONGITUDE[,ALTITUDE]`, a place on the earth; None for None."""
    from radiotwin.io.forms import as_origin

    if text is None:
        return None
    values = parse_numbers("--origin", text, None, "LATITUDE,LONGITUDE[,ALTITUDE]")
    try:
        return as_origin(values)
    except BadInput as error:
        raise BadInput(f"--{error}") from None


def in_frame_of(scene: "rt.Scene | None", measurements: "rt.Measurements",
                shift: str | None) -> "rt.Measurements":
    """Convert measurements to a scene's local frame, plus a shift of `DX,DY` [m] if one is given.

    Without a scene they keep their frame, and a shift raises BadInput.
    """
    shift_m = None
    if shift is not None:
        dx_m, dy_m = parse_numbers("--shift", shift, 2, "DX,DY in metres, such as 12,-40")
        shift_m = dx_m, dy_m
    if scene is not None:
        return rt.in_scene_frame(measurements, scene, shift_m)
    if shift_m is not None:
        raise BadInput("--shift moves measurements into the frame of a scene, and none is given; "
                       "add --scene, or leave it out")
    return measurements.on_ground(None)


def keep_scene_apart(out: Path, scene: "rt.Scene | None") -> None:
    """Raise BadInput if results would be written to the scene's own folder."""
    if scene is not None and is_within(scene.folder, out) and is_within(out, scene.folder):
        raise BadInput(f"cannot write {out}: it is the scene's folder; choose another output "
                       "folder")


def parse_numbers(option: str, text: str, count: int | None = None,
                  form: str = "A,B,…") -> list[float]:
    """Parse an option's value as `count` (None: one or more) finite numbers with commas between.

    The message of a BadInput names the option, and says to give the `form`.
    """
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if not values or len(values) != (count or len(values)) or not all(map(math.isfinite, values)):
        wanted = f"{count} numbers" if count else "numbers"
        raise BadInput(f"{option} {text!r} is not {wanted} with commas between them; give {form}")
    return values


def parse_extent(text: str | None) -> tuple[float, float, float, float] | None:
    """Parse `XMIN,YMIN,XMAX,YMAX` into x_min, x_max, y_min, y_max [m]; None for None."""
    if text is None:
        return None
    form = "XMIN,YMIN,XMAX,YMAX in metres, the minimum below the maximum"
    x_min, y_min, x_max, y_max = parse_numbers("--extent", text, 4, form)
    if not (x_min < x_max and y_min < y_max):
        raise BadInput(f"--extent {text!r} is not an area; give {form}")
    return x_min, x_max, y_min, y_max
