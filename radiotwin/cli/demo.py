"""The whole chain on a small scene: build, trace, survey, fit, compare, and one page of it all."""

import tempfile
from collections.abc import Callable
from pathlib import Path

from radiotwin.errors import BadInput, optional_package
from radiotwin.geo import to_geographic
from radiotwin.maps.survey import fly_survey
from radiotwin.report import read_run, write_comparison_folder, write_picture, write_report
from radiotwin.runtime.cuda import Device
from radiotwin.scene import Scene
from radiotwin.scene.presets import build_preset
from radiotwin.scene.readers import build_scene
from radiotwin.scene.readers.build import map_suffix
from radiotwin.trace import SolverSettings, trace_map
from radiotwin.twin.compare import Comparison, compare_models, split_flights

SIDE_M = 300.0  # of the square that is cut out of a large city; traced in minutes
DEVICES = 7
FLIGHTS, HELD_OUT = 6, 1
# Sionna RT finds no edge to diffract at between meshes of different materials, so roofs get the
# material of the walls.
ROOF_MATERIALS = {"sionna:munich": {"metal": "itu_marble", "wood": "itu_brick"}}


def run_demo(source: str = "preset:small", folder: Path | str = "demo", *, seed: int = 0,
             device: Device = "cpu",
             on_progress: Callable[[str], None] = lambda step: None) -> Comparison:
    """Build, trace, survey, fit and compare a small scene, and write everything into a folder.

    Args:
        source: `preset:NAME` or any source of `build_scene`.
        folder: for scene, truth, measurements, twin, comparison and `report.html`.
        seed: of placement, flights and fits.
        device: where rays are traced.
        on_progress: called with one line about each step.

    Raises:
        BadInput: a source that cannot be used.
        RunFailed: no libLLVM for tracing.
    """
    folder = Path(folder)
    solver = SolverSettings.of_quality("default", compute_device=device)
    optional_package("torch", "the demo also learns a network, which needs torch; install it with "
                              "`pip install 'radiotwin[nn]'`")
    scene = _scene(source, folder / "scene", seed, on_progress)
    on_progress(f"2 tracing {len(scene.config.devices)} devices × "
                f"{len(scene.lattice.positions_m)} positions with Sionna RT")
    truth = trace_map(scene, solver, scene.folder / "truth.nc")
    write_picture(truth, scene, folder / "truth.png")
    on_progress(f"3 flying {FLIGHTS} flights of {len(scene.config.uavs)} UAVs")
    measurements = fly_survey(scene, truth, flights=FLIGHTS, pattern="random-waypoint", seed=seed)
    measurements.save(folder / "survey" / "measurements.csv.gz")
    on_progress(f"4 learning four channel models from {FLIGHTS - HELD_OUT} flights, and finding "
                "the unknown devices")
    train, test = split_flights(measurements, HELD_OUT)
    comparison = compare_models(train, test, scene, truth, seed=seed)
    comparison.twins["segmented_nn"].save(folder / "twin")
    on_progress("5 drawing")
    write_comparison_folder(comparison, scene, folder / "comparison", truth)
    write_report(read_run(folder), folder / "report.html")
    return comparison


def _scene(source: str, folder: Path, seed: int, on_progress: Callable[[str], None]) -> Scene:
    """Load the scene that an earlier run left in the folder, or build it there."""
    if (folder / "scene.toml").is_file():
        scene = Scene.load(folder)
        found = scene.config.provenance
        same_seed = source.startswith("preset:") or found.get("seed") == str(seed)
        if found.get("source") != source or not same_seed:
            raise BadInput(f"{folder} holds a scene from {found.get('source')!r} with seed "
                           f"{found.get('seed')}, not from {source!r} with seed {seed}; choose "
                           "another folder with --out")
        on_progress(f"1 using the scene in {folder}")
        return scene
    on_progress(f"1 building a scene from {source}")
    if source.startswith("preset:"):
        build_preset(source.removeprefix("preset:"), folder)
    else:
        build_scene(source, folder, bbox=_middle(source), devices=DEVICES, seed=seed,
                    materials=ROOF_MATERIALS.get(source))
    return Scene.load(folder)


def _middle(source: str) -> tuple[float, float, float, float]:
    """Return a square of `SIDE_M` in the middle of a city, as `bbox` of `build_scene`.

    That is x_min, y_min, x_max, y_max [m]; of a map south, west, north, east [degrees].
    """
    is_map = map_suffix(source) is not None
    with tempfile.TemporaryDirectory(prefix="radiotwin-") as scratch:
        report = build_scene(source, Path(scratch) / "scene", check_only=not is_map)
        origin = Scene.load(Path(scratch) / "scene").config.origin if is_map else None
    x_min, x_max, y_min, y_max = report.extent_m
    x_m, y_m = round((x_min + x_max) / 40) * 20, round((y_min + y_max) / 40) * 20  # multiple of 20
    half_x_m, half_y_m = min(SIDE_M, x_max - x_min) / 2, min(SIDE_M, y_max - y_min) / 2
    west, east, south, north = x_m - half_x_m, x_m + half_x_m, y_m - half_y_m, y_m + half_y_m
    if origin is None:
        return west, south, east, north
    longitude_deg, latitude_deg = to_geographic(origin, [west, east], [south, north])
    (west, east), (south, north) = longitude_deg.tolist(), latitude_deg.tolist()
    return south, west, north, east
