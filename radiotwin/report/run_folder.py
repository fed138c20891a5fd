"""Read the folder of a run: of a demo, a twin, a close-loop, a planning run, or a scene."""

import math
import os
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from radiotwin.closeloop.output.result_file import read_report
from radiotwin.errors import BadInput
from radiotwin.io.budgets import PAGE_MAPS, PAGE_VALUES
from radiotwin.io.cells import PLANNING, POSITION, RESIDUALS, TRACK, read_table
from radiotwin.io.forms import Record, read_record, validated
from radiotwin.io.inputs import is_within, require_within
from radiotwin.links.alignment import in_known_frame
from radiotwin.links.measurements import read_measurements
from radiotwin.maps.form import NETCDF, ZARR, MapStream
from radiotwin.maps.radiomap import RadioMap
from radiotwin.maps.survey import segmented_truth
from radiotwin.report.comparison import read_comparison
from radiotwin.scene import Scene
from radiotwin.twin import Twin
from radiotwin.twin.compare import Comparison

TRUTH = "truth"
TRUTH_MAPS = (f"truth{NETCDF}", f"truth{ZARR}")  # of a scene's folder
OVERVIEW_LINKS = 20_000_000  # of all maps of a page that are in memory: 9 bytes each
MEASUREMENTS = tuple(f"{folder}measurements{suffix}" for folder in ("", "survey/")
                     for suffix in (".csv", ".csv.gz", ".parquet"))
CONTENT = ("scene.toml, twin.json, closeloop.json, compare.json, config.json of a planning run, or "
           "measurements.csv")


class PlanningRecord(Record):
    """Settings of a planning run that its page uses."""

    scene: str | None = None
    truth: str | None = None


@dataclass(eq=False)
class Run:
    """Content of a run's folder; None or empty where the folder does not hold it.

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
            run.residuals = read_table(table, RESIDUALS, {"time_s": "number or nothing"})
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
    """Return the first file of the folder, none of which a link may lead elsewhere."""
    found = next((folder / name for name in names if os.path.isfile(folder / name)), None)
    return None if found is None else require_within(folder, found, str(folder))


def _scene(run: Run, given: Path | None, named: str | None) -> Scene | None:
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
    """Read the truth, the twin's map and those in the folder, all over the scene's lattice.

    Of large maps every n-th position is read; the whole is never in memory.
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
    """Return all maps of a run by name; their values are still in their files, or not made."""
    maps: dict[str, RadioMap | MapStream] = {}
    if truth is not None and truth != "segmented":
        given = stack.enter_context(RadioMap.open(truth))
        if run.scene is not None and not given.is_over_lattice_of(run.scene):
            raise BadInput(f"{truth} is not over the lattice of {run.scene.folder}, so it cannot "
                           "be compared with the run; give a map of that scene")
        maps[TRUTH] = given
    elif truth == "segmented" and run.scene is not None:
        maps[TRUTH] = segmented_truth(run.scene)
    elif run.scene is not None and (path := _first_map(run.scene.folder)):
        found = stack.enter_context(RadioMap.open(path))
        try:
            found.require_of(run.scene)
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


def _first_map(folder: Path) -> Path | None:
    """Return the traced map of a scene's folder, which no link may lead elsewhere."""
    found = next((folder / name for name in TRUTH_MAPS if os.path.exists(folder / name)), None)
    return None if found is None else require_within(folder, found, str(folder))


def _tracks(run: Run, measurements: Path | None) -> pd.DataFrame | None:
    """Return the UAVs' positions from a planning run, measurements, or a close-loop's links."""
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
    """Return the settings of `marl.fedqmix`; empty for any other folder."""
    path = _first(folder, "config.json")
    if path is None:
        return {}
    settings = read_record(path, "settings of a planning run").get("run", {})
    if not isinstance(settings, dict):
        return {}
    return validated(PlanningRecord, settings, path, "make the run again")
