"""The whole chain on a small scene: build, trace, survey, fit, compare, and one page that shows it."""

from collections.abc import Callable
from pathlib import Path

from radiotwin.compare import Comparison, compare_models, split_flights
from radiotwin.comparison_output import write_comparison
from radiotwin.errors import BadInput
from radiotwin.report import read_run, write_comparison_figures, write_picture, write_report
from radiotwin.scene import Scene
from radiotwin.scene.build import BuildOptions, build_scene
from radiotwin.scene.presets import build_preset
from radiotwin.survey import fly_survey
from radiotwin.trace import SolverSettings, trace_map

PART_M = 300.0  # side of the part that is taken of a large city
DEVICES = 7
# Roofs of the walls' material: Sionna RT finds no edge to diffract at between meshes of different materials.
ONE_MATERIAL = {"sionna:munich": {"metal": "itu_marble", "wood": "itu_brick"}}
FLIGHTS, HELD_OUT = 6, 1


def run_demo(source: str, folder: Path | str, *, seed: int, say: Callable[[str], None]) -> Comparison:
    """Run the chain and write everything into `folder`.

    Args:
        source: `preset:NAME` or any source of `build_scene`.
        folder: scene, truth, measurements, twin, comparison and `report.html` go there.
        seed: of placement, flights and fits.
        say: told what is being done, a line at a time.

    Raises:
        BadInput: a source that cannot be used.
        RunFailed: no libLLVM for tracing.
    """
    folder = Path(folder)
    scene = _scene(source, folder / "scene", seed, say)
    truth_path = scene.folder / "truth.nc"
    say(f"2 tracing {len(scene.config.devices)} devices × {len(scene.lattice.positions_m)} positions with Sionna RT")
    truth = trace_map(scene, SolverSettings.of_quality("default"), truth_path)
    write_picture(truth, scene, folder / "truth.png")
    say(f"3 flying {FLIGHTS} flights of {len(scene.config.uavs)} UAVs")
    measurements = fly_survey(scene, truth, flights=FLIGHTS, pattern="random-waypoint", seed=seed)
    measurements.write(folder / "survey" / "measurements.csv.gz")
    say(f"4 learning four channel models from {FLIGHTS - HELD_OUT} flights, and finding the unknown devices")
    train, test = split_flights(measurements, HELD_OUT)
    comparison = compare_models(train, test, scene, truth, seed=seed)
    comparison.twins["segmented_nn"].save(folder / "twin")
    say("5 drawing")
    write_comparison(comparison, scene, folder / "comparison")
    write_comparison_figures(comparison, scene, truth, folder / "comparison")
    write_report(read_run(folder), folder / "report.html")
    return comparison


def _scene(source: str, folder: Path, seed: int, say) -> Scene:
    """The scene that an earlier run left, else a new one."""
    if (folder / "scene.toml").is_file():
        scene = Scene.load(folder)
        found = scene.config.provenance
        same_seed = source.startswith("preset:") or found.get("seed") == str(seed)
        if found.get("source") != source or not same_seed:
            raise BadInput(f"{folder} holds a scene from {found.get('source')!r} with seed {found.get('seed')}, not "
                           f"from {source!r} with seed {seed}; choose another folder with --out")
        say(f"1 using the scene that is in {folder}")
        return scene
    say(f"1 building a scene from {source}")
    if source.startswith("preset:"):
        build_preset(source.removeprefix("preset:"), folder)
    else:
        build_scene(source, folder, BuildOptions(bbox=_middle(source, folder), devices=DEVICES, seed=seed,
                                                 materials=ONE_MATERIAL.get(source)))
    return Scene.load(folder)


def _middle(source: str, folder: Path) -> tuple[float, float, float, float]:
    """(x_min, y_min, x_max, y_max) [m] of a square of PART_M in the middle of a city, or all of a smaller one."""
    x_min, x_max, y_min, y_max = build_scene(source, folder, check_only=True).extent_m
    x_m, y_m = (round((low + high) / 40) * 20 for low, high in ((x_min, x_max), (y_min, y_max)))
    half_x_m, half_y_m = (min(PART_M, high - low) / 2 for low, high in ((x_min, x_max), (y_min, y_max)))
    return x_m - half_x_m, y_m - half_y_m, x_m + half_x_m, y_m + half_y_m
