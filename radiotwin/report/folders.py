"""Result folders: write tables, figures and page into one, and read one for its page.

A radio map is written in any format, also that of another program, or as a picture.
"""

import math
import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

from radiotwin.closeloop.output.corrected_twin import corrected_twin
from radiotwin.closeloop.output.residuals import residuals
from radiotwin.closeloop.output.result_file import make_report, read_report, write_report
from radiotwin.closeloop.run import Loop
from radiotwin.errors import BadInput
from radiotwin.io.budgets import PAGE_MAPS, PAGE_VALUES
from radiotwin.io.cells import PLANNING, POSITION, RESIDUALS, TRACK, read_table
from radiotwin.io.files import atomic_folder, require_folder
from radiotwin.io.forms import Record, read_record, validated
from radiotwin.io.inputs import is_within, require_within
from radiotwin.links.alignment import in_known_frame
from radiotwin.links.measurements import read_measurements
from radiotwin.maps.export import EXPORTERS, check_format, select, write_map
from radiotwin.maps.export.tables import check_map_place
from radiotwin.maps.file import NETCDF, ZARR, MapStream, check_target, is_zarr, size_of
from radiotwin.maps.radiomap import RadioMap
from radiotwin.maps.survey import segmented_truth
from radiotwin.report.closeloop_figures import write_closeloop_figures
from radiotwin.report.closeloop_page import write_closeloop_page
from radiotwin.report.comparison import read_comparison, write_comparison, write_comparison_figures
from radiotwin.report.map_figures import write_picture
from radiotwin.scene import Scene
from radiotwin.twin import Twin, check_twin_target
from radiotwin.twin.compare import Comparison

FORMATS: dict[str, Callable[[RadioMap, Scene, Path], None]] = EXPORTERS | {".png": write_picture}
TOLD_LINKS = 1_000_000
TRUTH = "truth"
TRUTH_MAPS = (f"truth{NETCDF}", f"truth{ZARR}")  # of a scene's folder
OVERVIEW_LINKS = 20_000_000  # of all maps of a page that are in memory: 9 bytes each
MEASUREMENTS = tuple(f"{folder}measurements{suffix}" for folder in ("", "survey/")
                     for suffix in (".csv", ".csv.gz", ".parquet"))
PAGE = "report.html"  # of a run's folder
CLOSELOOP_FILES = ("closeloop.json", "closeloop.html", "residuals.csv.gz", "twin", PAGE,
                   "groups.png", "waterfall.png", "residual_map.png", "level_map.png",
                   "drivers.png", "effect_*.png")
COMPARISON_FILES = ("compare.json", "scores.csv", "locations.csv", "predictions.csv.gz", PAGE,
                    "scatter.png", "estimates.png", "maps.png")
CONTENT = ("scene.toml, twin.json, closeloop.json, compare.json, config.json of a planning run, or "
           "measurements.csv")


def check_closeloop_folder(folder: Path | str) -> None:
    """Check, before a close-loop starts, that its result can be written to a folder.

    Raises:
        BadInput: it cannot be written, or something that no close-loop wrote would be lost.
    """
    require_folder(folder, CLOSELOOP_FILES, "closeloop.json", keep_others=True)
    check_twin_target(Path(folder) / "twin")


def write_closeloop_folder(loop: Loop, scene: Scene | None, folder: Path | str, *,
                           title: str = "Close-loop report",
                           inputs: dict[str, Any] | None = None) -> dict[str, Any]:
    """Write all that `radiotwin close-loop` writes.

    The folder gets `closeloop.json`, `closeloop.html`, `residuals.csv.gz`, figures, and the
    corrected twin in the folder `twin`.

    Args:
        loop: result to write.
        scene: of the measurements; None: there was no 3D map.
        folder: to write; an older result in it is replaced as a whole, other files are kept.
        title: of the page.
        inputs: names of measurements and scene, for `closeloop.json`.

    Returns:
        Content of `closeloop.json`.

    Raises:
        BadInput: as `check_closeloop_folder`.
    """
    folder = Path(folder)
    check_closeloop_folder(folder)
    origin = None if scene is None else scene.config.origin
    report = make_report(loop) | {"inputs": (inputs or {}) | (
        {"origin": origin.model_dump()} if origin else {})}
    with atomic_folder(folder, CLOSELOOP_FILES) as temporary:
        write_closeloop_figures(loop, scene, report, temporary)
        write_report(report, temporary / "closeloop.json")
        residuals(loop).save(temporary / "residuals.csv.gz")
        corrected_twin(loop, scene).save(temporary / "twin")
        write_closeloop_page(report, temporary, title)
    return report


def check_comparison_folder(folder: Path | str) -> None:
    """Check, before models are compared, that the result can be written to a folder.

    Raises:
        BadInput: it cannot be written, or something that no comparison wrote would be lost.
    """
    require_folder(folder, COMPARISON_FILES, "compare.json", keep_others=True)


def write_comparison_folder(comparison: Comparison, scene: Scene, folder: Path | str,
                            truth: RadioMap | None = None) -> None:
    """Write all that `radiotwin compare` writes: `compare.json`, tables and figures.

    Args:
        comparison: result to write.
        scene: of the measurements.
        folder: to write; an older result in it is replaced as a whole, other files are kept.
        truth: the map that was judged on; None: there was none.
    """
    check_comparison_folder(folder)
    with atomic_folder(folder, COMPARISON_FILES) as temporary:
        write_comparison(comparison, scene, temporary)
        write_comparison_figures(comparison, scene, truth, temporary)


def check_map_target(path: Path | str, scene: Scene) -> None:
    """Check, before a radio map is computed, that it can be written under a file name.

    Raises:
        BadInput: an unknown format, one that needs an origin where the scene has none, or a file
            that cannot be written.
    """
    check_format(Path(path), scene, FORMATS)
    check_target(path)


def export_map(source: RadioMap | Twin, scene: Scene | Path | str, path: Path | str, *,
               devices: Sequence[str] | None = None, altitudes_m: Sequence[float] | None = None,
               name: str = "the radio map",
               tell: Callable[[str], None] | None = None) -> RadioMap | MapStream:
    """Write a radio map as `.nc`, `.zarr`, `.csv`, `.npz`, `.tif`, `.kmz` or `.png`.

    The map of a twin is made block by block where the format allows it.

    Args:
        source: map, or twin whose map is written.
        scene: that the map or twin was made for.
        path: file to write; its suffix chooses the format.
        devices: names, in the order wanted; None: all.
        altitudes_m: altitudes of the lattice [m]; None: all.
        name: what messages call the source.
        tell: called before a Zarr map of over `TOLD_LINKS` is written, with a text on its size.

    Returns:
        What was written.

    Raises:
        BadInput: see `check_map_target`; or a map of another place, no such device or altitude.
    """
    path, scene = Path(path), Scene.of(scene)
    check_map_target(path, scene)
    formats = FORMATS
    if isinstance(source, RadioMap):
        check_map_place(name, source.attributes, scene)
        whole: RadioMap | MapStream = source
    else:
        whole = source.map_stream(scene)
        formats = FORMATS | {".png": partial(write_picture, devices=source.devices)}
    selected = select(whole, None if devices is None else list(devices),
                      None if altitudes_m is None else list(altitudes_m))
    shape = selected.lattice.shape
    if tell is not None and is_zarr(path) and len(selected.devices) * math.prod(shape) > TOLD_LINKS:
        tell(f"{path}: {size_of(shape, len(selected.devices))}")
    write_map(selected, scene, path, formats)
    return selected


class PlanningRecord(Record):
    """Settings of a planning run that its page uses."""

    scene: str | None = None
    truth: str | None = None


@dataclass(eq=False)
class Run:
    """Content of a run's folder; None or empty: the folder does not hold it.

    Attributes:
        folder: folder of the run.
        scene: 3D map and radio.
        maps: name -> radio map; the truth is called `truth`.
        map_step: n where of the maps every n-th position in x and in y was read.
        twin: twin with the estimates of the devices' positions.
        tracks: flight, uav, time_s, x_m, y_m, z_m: one row for each UAV and time.
        residuals: held-out links of a close-loop, see `radiotwin.closeloop.output.residuals`.
        closeloop: content of `closeloop.json`.
        closeloop_folder: folder of the close-loop's figures.
        comparison: tables of a comparison; twins and predictions are empty.
        comparison_folder: folder of the comparison's figures.
        planning: content of `comparison.csv` of a planning run.
        notes: what is not shown and why, a sentence each.
    """

    folder: Path
    scene: Scene | None = None
    maps: dict[str, RadioMap] = field(default_factory=dict)
    map_step: int = 1
    twin: Twin | None = None
    tracks: pd.DataFrame | None = None
    residuals: pd.DataFrame | None = None
    closeloop: dict | None = None
    closeloop_folder: Path | None = None
    comparison: Comparison | None = None
    comparison_folder: Path | None = None
    planning: pd.DataFrame | None = None
    notes: list[str] = field(default_factory=list)


def read_run(folder: Path | str, scene: Path | None = None, truth: str | None = None,
             measurements: Path | None = None) -> Run:
    """Read the folder of a run, and predict the map of its twin.

    Args:
        folder: folder that a command of radiotwin or `marl.fedqmix` wrote.
        scene: scene folder; None: the one that the run holds or names.
        truth: `segmented`, or a file of a radio map; None: `truth.nc` of the scene, if it exists.
        measurements: file with the flights to show; None: the flights of the run.

    Raises:
        BadInput: no such folder, nothing in it that can be shown, or damaged content.
    """
    folder = Path(folder)
    if not os.path.isdir(folder):
        raise BadInput(f"{folder} is not a folder; give the folder of a run: it holds {CONTENT}")
    run = Run(folder)
    found = _first(folder, "closeloop.json", "closeloop/closeloop.json")
    if found is not None:
        run.closeloop, run.closeloop_folder = read_report(found), found.parent
        table = _first(found.parent, "residuals.csv.gz")
        if table is not None:
            run.residuals = read_table(table, RESIDUALS, dict.fromkeys(
                ("time_s", "measured_db"), "number or nothing"))
    found = _first(folder, "compare.json", "comparison/compare.json")
    if found is not None:
        run.comparison, run.comparison_folder = read_comparison(found), found.parent
    settings = _planning_settings(folder)
    inputs = (run.closeloop or {}).get("inputs", {})
    run.scene = _scene(run, scene, inputs.get("scene") or settings.get("scene"))
    found = _first(folder, "twin.json", "twin/twin.json")
    run.twin = Twin.load(found.parent) if found is not None else None
    found = _first(folder, "comparison.csv")
    if settings and found is not None:
        run.planning = read_table(found, PLANNING)
    _read_maps(run, truth or ("segmented" if settings.get("truth") == "segmented" else None))
    run.tracks = _tracks(run, measurements)
    if all(part is None for part in (run.scene, run.twin, run.closeloop, run.comparison,
                                     run.planning, run.tracks)):
        raise BadInput(f"{folder} holds nothing to show; a run's folder holds {CONTENT}")
    return run


def _first(folder: Path, *names: str) -> Path | None:
    """Return the first of the named files (or .zarr folders) that a folder holds; else None.

    BadInput if it is a link that leads out of the folder.
    """
    found = next((folder / name for name in names if os.path.isfile(folder / name)
                  or (name.endswith(ZARR) and os.path.isdir(folder / name))), None)
    return None if found is None else require_within(folder, found, str(folder))


def _scene(run: Run, given: Path | None, named: str | None) -> Scene | None:
    """Load a run's scene: the one given, the one in its folder, or the one it names; else None.

    Without a scene, `run.notes` gets the reason.
    """
    if given is not None:
        return Scene.load(given)
    found = _first(run.folder, "scene.toml", "scene/scene.toml")
    if found is not None:
        return Scene.load(found.parent)
    reason = "the run names no scene; give one with --scene"
    if named and os.path.isfile(Path(named) / "scene.toml"):
        if is_within(Path(named), run.folder, Path.cwd()):
            return Scene.load(named)
        # A stranger's run must not choose what is read here and goes into a page.
        reason = (f"the run names the scene {named}, which is neither in its folder nor in the "
                  f"current one; give it with --scene")
    elif named:
        reason = f"the scene {named} does not exist; give one with --scene"
    run.notes.append(f"No 3D map: {reason}.")
    return None


def _read_maps(run: Run, truth: str | None) -> None:
    """Read into `run.maps` the truth, the twin's map and those in the run's folder.

    Of large maps only every n-th position in x and y is read, so that all fit into memory;
    `run.map_step` becomes n.
    """
    with ExitStack() as stack:
        maps = _open_maps(run, truth, stack)
        links = sum(len(each.devices) * math.prod(each.lattice.shape) for each in maps.values())
        run.map_step = max(math.ceil(math.sqrt(links / OVERVIEW_LINKS)), 1)
        thinned = {name: each.thinned(run.map_step) for name, each in maps.items()}
        PAGE_VALUES.check(sum(len(each.devices) * math.prod(each.lattice.shape)
                              for each in thinned.values()), f"the radio maps of {run.folder}")
        run.maps = {name: RadioMap.collect(each) for name, each in thinned.items()}


def _open_maps(run: Run, truth: str | None, stack: ExitStack) -> dict[str, RadioMap | MapStream]:
    """Open the maps of a run by name: truth, twin's map, and those in its folder; read later.

    A map of another lattice, or a truth of another version of the scene, is left out with a line in
    `run.notes`; BadInput if it was given as `truth`.
    """
    maps: dict[str, RadioMap | MapStream] = {}
    if truth is not None and truth != "segmented":
        given = stack.enter_context(RadioMap.open(truth))
        if run.scene is not None and not given.is_over_lattice_of(run.scene):
            raise BadInput(f"{truth} is not over the lattice of {run.scene.folder}, so it cannot "
                           "be compared with the run; give a map of that scene")
        maps[TRUTH] = given
    elif truth == "segmented" and run.scene is not None:
        maps[TRUTH] = segmented_truth(run.scene)
    elif run.scene is not None and (path := _first(run.scene.folder, *TRUTH_MAPS)):
        found = stack.enter_context(RadioMap.open(path))
        try:
            found.require_made_for(run.scene)
            maps[TRUTH] = found
        except BadInput as error:
            run.notes.append(f"{path} is not shown: {error}.")
    if run.twin is not None and run.scene is not None:
        name = "twin, corrected" if run.twin.is_corrected else "twin"
        maps[name] = run.twin.map_stream(run.scene)
    truths = [] if run.scene is None else [os.path.realpath(run.scene.folder / name)
                                           for name in TRUTH_MAPS]
    paths = sorted([*run.folder.glob(f"*{NETCDF}"), *run.folder.glob(f"*{ZARR}")])
    PAGE_MAPS.check(len(paths), run.folder)
    for path in paths:
        if path.stem in maps or os.path.realpath(path) in truths:
            continue
        found = stack.enter_context(
            RadioMap.open(require_within(path.parent, path, str(path.parent))))
        if run.scene is not None and not found.is_over_lattice_of(run.scene):
            run.notes.append(
                f"{path} is not shown: it is not over the lattice of {run.scene.folder}.")
        else:
            maps[path.stem] = found
    return maps


def _tracks(run: Run, measurements: Path | None) -> pd.DataFrame | None:
    """Read the UAVs' positions over time from `flights.csv`, measurements, or held-out links.

    None if there are none of these, or if any reading lacks a time.
    """
    path = _first(run.folder, "flights.csv")
    if measurements is None and path is not None:
        return read_table(path, TRACK)
    found = measurements or _first(run.folder, *MEASUREMENTS)
    if found is not None:
        if measurements is None:
            _first(found.parent, "devices.csv")
        measured = read_measurements(found)
        if run.scene is not None:
            measured = in_known_frame(measured, run.scene.config.origin, "the scene")
        links = measured.table
    elif run.residuals is not None and "time_s" in run.residuals:
        links = run.residuals
    else:
        return None
    tracks = links.rename(
        columns={"receiver": "uav"} | {f"receiver_{name}": name for name in POSITION})
    if "time_s" not in tracks or tracks["time_s"].isna().any():
        return None  # positions without an order are no flight
    return tracks[list(TRACK)].drop_duplicates().reset_index(drop=True)


def _planning_settings(folder: Path) -> dict[str, Any]:
    """Return the scene and truth that a planning run (`marl.fedqmix`) names; else empty."""
    path = _first(folder, "config.json")
    if path is None:
        return {}
    settings = read_record(path, "settings of a planning run").get("run", {})
    if not isinstance(settings, dict):
        return {}
    return validated(PlanningRecord, settings, path, "make the run again")
