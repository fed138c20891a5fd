"""Built-in scenes: random cities of blocks between avenues and streets, each with a mission.

`rbm` and `rdm` follow the maps of Chen et al., "Model-aided Federated Reinforcement Learning for
Multi-UAV Trajectory Planning in IoT Networks", GLOBECOM Workshops 2023; their buildings are drawn
anew. `small` is for demonstration.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh

from radiotwin.errors import BadInput
from radiotwin.io.files import scratch_folder
from radiotwin.scene.build import (
    BuildOptions,
    BuildReport,
    build_scene,
    check_target,
    write_scene,
)
from radiotwin.scene.config import (
    DeviceConfig,
    Extent,
    LatticeConfig,
    MissionConfig,
    SceneConfig,
    UavConfig,
)
from radiotwin.scene.folder import CityShape
from radiotwin.scene.materials import itu_material


@dataclass(frozen=True)
class CityParameters:
    """Parameters of a random city, lengths in metres.

    Attributes:
        width_m, depth_m: Size of the map along x and y.
        avenue_width_m: Width of an avenue.
        avenue_spacing_m: Side of the large block between two avenues.
        street_width_m: Width of the streets that cut large blocks into small ones.
        block_mean_m, block_min_m: Side of a small block: Poisson(mean), at least the minimum.
        side_min_m, side_mean_m: Side of a building: max(min, Exp(mean)), clipped to its block.
        mean_height_m: Mean height of buildings.
        first_block_m: South-west corner of the first large block; may lie off the map.
        min_height_m, max_height_m: Heights are clipped to this range.
        side_kept_m: A building with a shorter side, after clipping, is dropped.
        buildings_per_m2: Density of buildings in a small block, before any is dropped.
        clearance_m: Free ground on each side of a device.
    """

    width_m: float
    depth_m: float
    avenue_width_m: float
    avenue_spacing_m: float
    street_width_m: float
    block_mean_m: float
    block_min_m: float
    side_min_m: float
    mean_height_m: float
    first_block_m: tuple[float, float]
    max_height_m: float = 50.0
    side_mean_m: float = 80.0
    side_kept_m: float = 30.0
    min_height_m: float = 5.0
    buildings_per_m2: float = 0.001
    clearance_m: float = 10.0


def draw_buildings(parameters: CityParameters, keep_free_m: np.ndarray, seed: int) -> np.ndarray:
    """Draw the buildings of a city at random: axis-aligned boxes, which may overlap.

    None comes closer than `clearance_m` to any of the points `keep_free_m` (k, 2) [m].

    Returns:
        (n, 5) x_min, y_min, x_max, y_max, height [m].
    """
    rng = np.random.default_rng(seed)
    boxes = []
    period_m = parameters.avenue_spacing_m + parameters.avenue_width_m
    for x0 in np.arange(parameters.first_block_m[0], parameters.width_m, period_m):
        for y0 in np.arange(parameters.first_block_m[1], parameters.depth_m, period_m):
            columns = _small_blocks(x0, parameters.width_m, parameters, rng)
            for row in _small_blocks(y0, parameters.depth_m, parameters, rng):
                for column in columns:
                    boxes += _buildings_in(column, row, parameters, keep_free_m, rng)
    return np.array(boxes).reshape(-1, 5)


def _small_blocks(low: float, length_m: float, p: CityParameters, rng: np.random.Generator
                  ) -> list[tuple[float, float]]:
    """Cut one side of a large block at random into small blocks with streets between them.

    The side begins at `low` and is an avenue spacing long. Returned are start and end of each small
    block [m], clipped to the map (0 to `length_m`), without those too short for a building.
    """
    blocks, high = [], low + p.avenue_spacing_m
    while high - low >= 2 * p.block_min_m + p.street_width_m:
        side = max(rng.poisson(p.block_mean_m), p.block_min_m)
        side = min(side, high - low - p.street_width_m - p.block_min_m)
        blocks.append((low, low + side))
        low += side + p.street_width_m
    clipped = [(max(a, 0.0), min(b, length_m)) for a, b in [*blocks, (low, high)]]
    return [(a, b) for a, b in clipped if b - a >= p.side_kept_m]


def _buildings_in(column: tuple[float, float], row: tuple[float, float], p: CityParameters,
                  keep_free_m: np.ndarray, rng: np.random.Generator) -> list[tuple]:
    """Draw the buildings (x_min, y_min, x_max, y_max, height) [m] of one small block at random.

    It spans `column` in x and `row` in y. A building that becomes too narrow is dropped.
    """
    (x0, x1), (y0, y1) = column, row
    boxes = []
    for _ in range(rng.poisson((x1 - x0) * (y1 - y0) * p.buildings_per_m2)):
        centre = rng.uniform((x0, y0), (x1, y1))
        sides = np.maximum(p.side_min_m, rng.exponential(p.side_mean_m, 2))
        height = min(rng.exponential(p.mean_height_m),
                     abs(rng.normal()) * 3 * np.sqrt(p.max_height_m - p.mean_height_m)
                     + p.mean_height_m)
        low = np.maximum(centre - sides / 2, (x0, y0))
        high = np.minimum(centre + sides / 2, (x1, y1))
        low, high = _trim_clear(low, high, keep_free_m, p.clearance_m)
        if np.all(high - low >= p.side_kept_m):
            boxes.append((*low.round(2), *high.round(2),
                          round(float(np.clip(height, p.min_height_m, p.max_height_m)), 2)))
    return boxes


def _trim_clear(low: np.ndarray, high: np.ndarray, keep_free_m: np.ndarray, clearance_m: float
                ) -> tuple[np.ndarray, np.ndarray]:
    """Cut a rectangle back until it is `clearance_m` away from every point (k, 2) [m].

    For each point, the side is moved that costs the least area.
    """
    for point in keep_free_m:
        near, far = point - clearance_m, point + clearance_m
        if np.any(far <= low) or np.any(near >= high):
            continue
        choices = []
        for axis in (0, 1):
            for side, value in ((high, near[axis]), (low, far[axis])):
                trimmed = side.copy()
                trimmed[axis] = value
                choices.append((trimmed, high) if side is low else (low, trimmed))
        low, high = max(choices, key=lambda c: np.prod(np.maximum(c[1] - c[0], 0.0)))
    return low, high


def building_meshes(boxes: np.ndarray) -> list[trimesh.Trimesh]:
    """Unite boxes (n, 5) that touch into watertight solids, from west to east.

    Otherwise the ray tracer would hit coplanar walls and roofs twice. A box is x_min, y_min, x_max,
    y_max, height [m].
    """
    solids = [trimesh.creation.box(bounds=[[x0, y0, 0.0], [x1, y1, height]])
              for x0, y0, x1, y1, height in boxes]
    union = trimesh.boolean.union(solids, engine="manifold")
    return sorted(union.split(), key=lambda mesh: tuple(mesh.bounds[0]))


@dataclass(frozen=True)
class Preset:
    """A generated city and the mission in it.

    Attributes:
        city: Parameters of the city.
        devices_m: (x, y) of the devices [m].
        anchors: Indices of the devices that are anchors.
        start_m, terminal_m: (x, y) where all UAVs start and end [m].
        battery: Battery units of each UAV.
        data_units: Data at each device.
        altitudes_m: Altitudes of the lattice, with one UAV at each [m].
        seed: Seed of the city.
    """

    city: CityParameters
    devices_m: tuple[tuple[float, float], ...]
    anchors: tuple[int, ...]
    start_m: tuple[float, float]
    terminal_m: tuple[float, float]
    battery: float
    data_units: float
    altitudes_m: tuple[float, ...]
    seed: int = 0


PRESETS = {
    "rbm": Preset(
        CityParameters(600, 800, avenue_width_m=60, avenue_spacing_m=200, street_width_m=20,
                       block_mean_m=100, block_min_m=80, side_min_m=50, mean_height_m=15,
                       first_block_m=(-169, -34)),
        ((20, 200), (60, 320), (60, 760), (120, 600), (200, 80), (320, 120), (320, 760),
         (460, 720), (460, 200), (580, 520)),
        anchors=(1, 5, 9),
        start_m=(320, 460), terminal_m=(320, 460), battery=60, data_units=16_000,
        altitudes_m=(55, 60, 65)),
    "rdm": Preset(
        CityParameters(1000, 1200, avenue_width_m=90, avenue_spacing_m=300, street_width_m=30,
                       block_mean_m=120, block_min_m=100, side_min_m=75, side_mean_m=100,
                       mean_height_m=30, first_block_m=(-72, -25)),
        ((200, 700), (280, 1100), (360, 500), (460, 400), (540, 700), (660, 220), (600, 1100),
         (660, 800), (800, 520), (860, 920)),
        anchors=(1, 4, 8),
        start_m=(280, 300), terminal_m=(660, 920), battery=80, data_units=20_000,
        altitudes_m=(55, 60, 65)),
    "small": Preset(
        CityParameters(300, 300, avenue_width_m=40, avenue_spacing_m=160, street_width_m=20,
                       block_mean_m=70, block_min_m=60, side_min_m=40, mean_height_m=18,
                       first_block_m=(-100, -60)),
        ((80, 40), (280, 60), (80, 200), (160, 120), (280, 280), (200, 200), (80, 280)),
        anchors=(0, 5, 6),
        start_m=(80, 120), terminal_m=(80, 120), battery=40, data_units=8_000,
        altitudes_m=(55, 60)),
}


def preset_config(name: str) -> SceneConfig:
    """Return the `scene.toml` of a preset, a key of `PRESETS`; BadInput if there is none."""
    preset = _preset_named(name)
    (start_x_m, start_y_m), (terminal_x_m, terminal_y_m) = preset.start_m, preset.terminal_m
    return SceneConfig(
        name=name,
        extent=Extent(x_min_m=0, x_max_m=preset.city.width_m,
                      y_min_m=0, y_max_m=preset.city.depth_m),
        lattice=LatticeConfig(step_m=20, altitudes_m=list(preset.altitudes_m)),
        devices=[DeviceConfig(device=f"d{i}", x_m=x_m, y_m=y_m,
                              role="anchor" if i in preset.anchors else "unknown")
                 for i, (x_m, y_m) in enumerate(preset.devices_m)],
        uavs=[UavConfig(uav=f"uav{i}", altitude_m=altitude_m, start_x_m=start_x_m,
                        start_y_m=start_y_m, terminal_x_m=terminal_x_m, terminal_y_m=terminal_y_m,
                        battery=preset.battery)
              for i, altitude_m in enumerate(preset.altitudes_m)],
        mission=MissionConfig(data_units=preset.data_units),
        provenance={"source": f"preset:{name}", "seed": str(preset.seed),
                    "generator": "after Chen et al., GLOBECOM Workshops 2023"},
    )


def preset_boxes(name: str) -> np.ndarray:
    """Return the buildings (n, 5) of a preset: x_min, y_min, x_max, y_max, height [m]."""
    preset = _preset_named(name)
    return draw_buildings(preset.city, np.array(preset.devices_m, dtype=float), preset.seed)


def build_preset(name: str, folder: Path | str) -> None:
    """Write the scene folder of a preset.

    Args:
        name: Key of `PRESETS`.
        folder: Folder to write.

    Raises:
        BadInput: No such preset, or the folder cannot be written or holds something else.
    """
    preset, folder = _preset_named(name), Path(folder)
    check_target(folder)
    low, (x_high, y_high) = -100.0, (preset.city.width_m + 100.0, preset.city.depth_m + 100.0)
    ground = trimesh.Trimesh(
        vertices=[[low, low, 0], [x_high, low, 0], [x_high, y_high, 0], [low, y_high, 0]],
        faces=[[0, 1, 2], [0, 2, 3]], process=False)
    shapes = [CityShape("ground", ground, itu_material("asphalt_concrete"))]
    shapes += [CityShape(f"building_{i:03d}", mesh, itu_material("concrete"))
               for i, mesh in enumerate(building_meshes(preset_boxes(name)))]
    write_scene(folder, shapes, preset_config(name))


def build_preset_scene(name: str, folder: Path | str, check_only: bool = False) -> BuildReport:
    """Write the scene folder of a preset, and report on it as `build_scene` does.

    With `check_only` it is written to a temporary folder, and nothing remains.

    Raises:
        BadInput: As `build_preset`.
    """
    if check_only:
        with scratch_folder() as temporary:
            return replace(build_preset_scene(name, temporary / name), folder=None)
    build_preset(name, folder)
    config = preset_config(name)
    report = build_scene(Path(folder) / "city.xml", folder,
                         BuildOptions(frequency_hz=config.radio.frequency_hz), check_only=True)
    return replace(report, source=f"preset:{name}", folder=Path(folder),
                   extent_m=config.extent.bounds, altitudes_m=tuple(config.lattice.altitudes_m),
                   devices=len(config.devices), uavs=len(config.uavs))


def _preset_named(name: str) -> Preset:
    """Return a preset by its name; BadInput if there is none."""
    if name not in PRESETS:
        raise BadInput(f"preset {name!r} does not exist; allowed are {', '.join(PRESETS)}")
    return PRESETS[name]
