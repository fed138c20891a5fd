"""Arguments and options that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

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
OnlyDevices = Annotated[str | None, typer.Option(metavar="A,B,…", help="Only these devices.")]
Quality = Annotated[str | None, typer.Option(help="fast, default or high [default].")]
TargetDb = Annotated[float | None, typer.Option(
    help="Take the quality with the fewest rays whose RMS error, against ten times the rays on a "
         "few links, is within this [dB].")]
Combining = Annotated[str, typer.Option(
    help="power (sum of the paths' powers) or coherent (sum of their fields).")]
RaySeed = Annotated[int, typer.Option(min=0, help="Seed of the rays.")]
FitSeed = Annotated[int, typer.Option(min=0, help="Seed of the fits and the search.")]


def split_names(text: str | None) -> list[str] | None:
    """Split a list of names.

    Args:
        text: `A,B`; None or empty for all.
    """
    return text.split(",") if text else None
