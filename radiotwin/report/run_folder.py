"""Read the folder of a run: of a demo, a twin, a close-loop, a planning run, or a scene."""

import json
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd

from radiotwin.cells import without_quotes
from radiotwin.closeloop.result_file import SCHEMA, SCHEMA_1, upgrade_report
from radiotwin.compare import Comparison
from radiotwin.errors import BadInput
from radiotwin.measurements import read_measurements
from radiotwin.radiomap import RadioMap
from radiotwin.scene import Scene
from radiotwin.survey import segmented_truth
from radiotwin.twin import Twin

TRUTH = "truth"
MEASUREMENTS = tuple(f"{folder}measurements{suffix}" for folder in ("", "survey/")
                     for suffix in (".csv", ".csv.gz", ".parquet"))
POSITION = ["x_m", "y_m", "z_m"]
TRACK = ["flight", "uav", "time_s", *POSITION]
RESIDUALS = ["flight", "receiver", "device", "los", *(f"receiver_{name}" for name in POSITION),
             *(f"device_{name}" for name in POSITION), "before_db", "after_db"]
CONTENT = ("scene.toml, twin.json, closeloop.json, compare.json, config.json of a planning run, or "
           "measurements.csv")


@dataclass(eq=False)
class Run:
    """Content of a run's folder; None or empty where the folder does not hold it.

    Attributes:
        folder: folder of the run.
        scene: 3D map and radio.
        maps: name -> radio map; the truth is called `truth`.
        twin: twin with the estimates of the devices' positions.
        tracks: flight, uav, time_s, x_m, y_m, z_m: one row for each UAV and time.
        residuals: held-out links of a close-loop, see `radiotwin.closeloop.residual_table`.
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
    if not folder.is_dir():
        raise BadInput(f"{folder} is not a folder; give the folder of a run: it holds {CONTENT}")
    run = Run(folder)
    run.closeloop, run.closeloop_folder = _find_record(
        (folder, folder / "closeloop"), "closeloop.json", SCHEMA, SCHEMA_1)
    if run.closeloop is not None:
        run.closeloop = _upgraded(run.closeloop, f"{run.closeloop_folder}/closeloop.json")
    record, run.comparison_folder = _find_record(
        (folder, folder / "comparison"), "compare.json", "radiotwin.comparison/1")
    run.comparison = _comparison(record, run.comparison_folder)
    settings = _planning_settings(folder)
    inputs = (run.closeloop or {}).get("inputs", {})
    run.scene = _scene(run, scene, inputs.get("scene") or settings.get("scene"))
    run.twin = next((Twin.load(path) for path in (folder, folder / "twin")
                     if (path / "twin.json").is_file()), None)
    if settings and (folder / "comparison.csv").is_file():
        run.planning = _read_table(folder / "comparison.csv",
                                   ["method", "trained_in", "real_episodes", "truth_ratio"])
    _read_maps(run, truth or ("segmented" if settings.get("truth") == "segmented" else None))
    if run.closeloop_folder is not None:
        path = run.closeloop_folder / "residuals.csv.gz"
        run.residuals = _read_table(path, RESIDUALS) if path.is_file() else None
    run.tracks = _tracks(run, measurements)
    if all(part is None for part in (run.scene, run.twin, run.closeloop, run.comparison,
                                     run.planning, run.tracks)):
        raise BadInput(f"{folder} holds nothing to show; a run's folder holds {CONTENT}")
    return run


def _scene(run: Run, given: Path | None, named: str | None) -> Scene | None:
    if given is not None:
        return Scene.load(given)
    for path in (run.folder, run.folder / "scene"):
        if (path / "scene.toml").is_file():
            return Scene.load(path)
    if named and (Path(named) / "scene.toml").is_file():
        return Scene.load(named)
    reason = f"the scene {named} does not exist" if named else "the run names no scene"
    run.notes.append(f"No 3D map: {reason}; give one with --scene.")
    return None


def _read_maps(run: Run, truth: str | None) -> None:
    """Read the truth, the twin's map and those in the folder, all over the scene's lattice."""
    if truth is not None and truth != "segmented":
        run.maps[TRUTH] = RadioMap.read(truth)
        if run.scene is not None and not run.scene.over_lattice(run.maps[TRUTH]):
            raise BadInput(f"{truth} is not over the lattice of {run.scene.folder}, so it cannot "
                           "be compared with the run; give a map of that scene")
    elif truth == "segmented" and run.scene is not None:
        run.maps[TRUTH] = segmented_truth(run.scene)
    elif run.scene is not None and (run.scene.folder / "truth.nc").is_file():
        found = RadioMap.read(run.scene.folder / "truth.nc")
        try:
            run.scene.check_map(found)
            run.maps[TRUTH] = found
        except BadInput as error:
            run.notes.append(f"{run.scene.folder / 'truth.nc'} is not shown: {error}.")
    if run.twin is not None and run.scene is not None:
        corrected = run.twin.is_corrected
        run.maps["twin, corrected" if corrected else "twin"] = run.twin.radio_map(run.scene)
    truth_path = run.scene and (run.scene.folder / "truth.nc").resolve()
    for path in sorted(run.folder.glob("*.nc")):
        if path.stem in run.maps or path.resolve() == truth_path:
            continue
        found = RadioMap.read(path)
        if run.scene is not None and not run.scene.over_lattice(found):
            run.notes.append(
                f"{path} is not shown: it is not over the lattice of {run.scene.folder}.")
        else:
            run.maps[path.stem] = found


def _tracks(run: Run, measurements: Path | None) -> pd.DataFrame | None:
    """Return the UAVs' positions from a planning run, measurements, or a close-loop's links."""
    path = run.folder / "flights.csv"
    if measurements is None and path.is_file():
        return _read_table(path, TRACK)
    found = measurements or next((run.folder / name for name in MEASUREMENTS
                                  if (run.folder / name).is_file()), None)
    if found is not None:
        links = read_measurements(found).table
    elif run.residuals is not None and "time_s" in run.residuals:
        links = run.residuals
    else:
        return None
    tracks = links.rename(
        columns={"receiver": "uav"} | {f"receiver_{name}": name for name in POSITION})
    if "time_s" not in tracks or tracks["time_s"].isna().any():
        return None  # positions without an order are no flight
    return tracks[TRACK].drop_duplicates().reset_index(drop=True)


def _comparison(record: dict | None, folder: Path | None) -> Comparison | None:
    if record is None:
        return None
    try:
        scores, locations = (pd.DataFrame(record[name]) for name in ("scores", "locations"))
        numbers = ["rmse_db", "mae_db", "bias_db"]
        scores[numbers] = scores[numbers].astype(float)
        if len(locations):
            locations["error_m"] = locations["error_m"].astype(float)
        return Comparison(scores, locations, {}, pd.DataFrame())
    except (KeyError, TypeError, ValueError) as error:
        raise BadInput(f"{folder}/compare.json is damaged ({type(error).__name__}: {error}); run "
                       "`radiotwin compare` again") from None


def _planning_settings(folder: Path) -> dict:
    """Return the settings of `marl.fedqmix`; empty for any other folder."""
    path = folder / "config.json"
    settings = _read_json(path).get("run", {}) if path.is_file() else {}
    return settings if isinstance(settings, dict) else {}


def _find_record(folders: tuple[Path, ...], name: str,
                 *schemas: str) -> tuple[dict | None, Path | None]:
    """Return the content of the first file of a name, and its folder."""
    for folder in folders:
        path = folder / name
        if path.is_file():
            record = _read_json(path)
            if record.get("schema") not in schemas:
                raise BadInput(f"{path}: schema is {record.get('schema')!r}, this version reads "
                               f"{' and '.join(map(repr, schemas))}; make the run again")
            return record, folder
    return None, None


def _upgraded(record: dict, path: str) -> dict:
    """Return the content of a `closeloop.json` of any version as of this one."""
    try:
        return upgrade_report(record)
    except (KeyError, TypeError, AttributeError) as error:
        raise BadInput(f"{path} is damaged ({type(error).__name__}: {error}); run "
                       "`radiotwin close-loop` again") from None


def _read_json(path: Path) -> dict:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise BadInput(f"{path} cannot be read as JSON ({error}); make the run again") from None
    if not isinstance(record, dict):
        raise BadInput(f"{path} is no JSON object; make the run again")
    return record


def _read_table(path: Path, columns: list[str]) -> pd.DataFrame:
    """Read a table that has at least the columns given."""
    text = dict.fromkeys(("flight", "uav", "receiver", "device", "method"), str)
    try:
        table = pd.read_csv(path, dtype=text)
    except (OSError, ValueError, EOFError) as error:
        raise BadInput(f"{path} cannot be read: {error}; make the run again") from None
    missing = [name for name in columns if name not in table]
    if missing:
        raise BadInput(f"{path}: column {missing[0]!r} is missing; make the run again")
    return without_quotes(table)
