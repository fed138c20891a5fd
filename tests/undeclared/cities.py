"""The two declared cities: drawn once, kept as zipped scene folders, and redrawn with a survey's errors for the truth.

`oldtown` has crooked lanes between boxes, L-shapes and pentagons at all angles; `grid` has straight streets between
rows of houses and courtyards. Neither is drawn as the cities in `scenes/` are.
"""

import atexit
import zipfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from radiotwin.io.files import atomic_path
from radiotwin.scene import Scene
from radiotwin.scene.config import Extent, LatticeConfig, RadioConfig, SceneConfig, write_config
from radiotwin.scene.materials import Material, permittivity
from tests.undeclared.shapes import Building, corners_of, fits, turned, write_prisms

SCENES = Path(__file__).parent / "scenes.zip"
SIDE_M = 500.0
MARGIN_M = 80.0  # of ground around the extent, so that reflections near the border find it
CITIES = ("oldtown", "grid")
RADIO = {"oldtown": RadioConfig(frequency_hz=1.8e9, sensitivity_dbm=-112.0),
         "grid": RadioConfig(frequency_hz=3.5e9, sensitivity_dbm=-118.0)}
ROOM_M = 6.0  # between two buildings, so that moved walls never touch
GROUND = "asphalt_concrete"


@cache
def buildings(city: str) -> tuple[Building, ...]:
    """The buildings that the map of a city declares."""
    return tuple({"oldtown": _oldtown, "grid": _grid}[city](np.random.default_rng(CITIES.index(city) + 41)))


def _oldtown(rng: np.random.Generator) -> list[Building]:
    footprints: list[np.ndarray] = []
    found = []
    for _ in range(2500):
        centre = rng.uniform(0, SIDE_M, 2)
        turn = np.radians(17 + 28 * np.sin(2 * np.pi * (centre[0] / 430 + centre[1] / 610)) + rng.normal(0, 8))
        kind = rng.choice(["box", "ell", "pentagon"], p=[0.5, 0.35, 0.15])
        corners = turned(corners_of(kind, rng.uniform(18, 52), rng.uniform(14, 34), rng), turn) + centre
        height_m = float(np.clip(rng.lognormal(np.log(15), 0.4), 7, 38))
        material = str(rng.choice(["brick", "concrete", "wood"], p=[0.6, 0.3, 0.1]))
        square = np.hypot(*(centre - (260, 215))) < 45  # a market square stays free
        if square or corners.min() < 2 or corners.max() > SIDE_M - 2 or not fits(corners, footprints, ROOM_M):
            continue
        footprints.append(corners)
        found.append(Building(corners.round(2), round(height_m, 1), material))
    return found


def _grid(rng: np.random.Generator) -> list[Building]:
    found = []
    street_m, width_m, depth_m = 17.0, 76.0, 104.0
    for x0 in np.arange(9.0, SIDE_M - width_m, width_m + street_m):
        for y0 in np.arange(-52.0, SIDE_M, depth_m + street_m):
            if rng.random() < 0.12:  # a park
                continue
            tall = 1.7 if np.hypot(x0 - 330, y0 - 300) < 150 else 1.0
            for side in (0, 1):  # two rows of houses, back to back around a yard
                at = y0
                while at < y0 + depth_m - 16:
                    front_m = min(rng.uniform(18, 44), y0 + depth_m - at)
                    deep_m = rng.uniform(15, 29)
                    low = x0 if side == 0 else x0 + width_m - deep_m
                    corners = corners_of("box", deep_m, front_m, rng) + (low + deep_m / 2, at + front_m / 2)
                    height_m = float(np.clip(tall * rng.lognormal(np.log(15), 0.45), 6, 44))
                    material = str(rng.choice(["concrete", "brick", "glass"], p=[0.6, 0.25, 0.15]))
                    if rng.random() > 0.1 and corners.min() >= 1 and corners.max() <= SIDE_M - 1:
                        found.append(Building(corners.round(2), round(height_m, 1), material))
                    at += front_m + ROOM_M
    return found


@cache
def declared_scene(city: str) -> Scene:
    """Load the scene that a user would have; it names no device and no UAV. Its folder goes with the process."""
    folder = TemporaryDirectory(prefix="radiotwin-undeclared-")
    atexit.register(folder.cleanup)
    with zipfile.ZipFile(SCENES) as archive:
        archive.extractall(folder.name, [name for name in archive.namelist() if name.startswith(f"{city}/")])
    return Scene.load(Path(folder.name) / city)


def write_declared() -> None:
    """Write `scenes.zip` (without previews, for its size)."""
    with TemporaryDirectory() as folder, atomic_path(SCENES) as temporary:
        for city in CITIES:
            _write_scene(Path(folder) / city, city)
        with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
            for path in sorted(Path(folder).rglob("*.*")):
                archive.write(path, path.relative_to(folder))


def _write_scene(folder: Path, city: str) -> None:
    folder.mkdir()
    write_prisms(folder, SIDE_M, MARGIN_M, [(b, Material(b.material, itu=b.material)) for b in buildings(city)],
                 Material(GROUND, itu=GROUND))
    write_config(SceneConfig(
        name=city, radio=RADIO[city], extent=Extent(x_min_m=0, x_max_m=SIDE_M, y_min_m=0, y_max_m=SIDE_M),
        lattice=LatticeConfig(step_m=20, altitudes_m=[50, 65, 80]), provenance={"generator": "tests/undeclared"},
    ), folder / "scene.toml")


def write_truth(folder: Path, city: str, seed: int, *, without: int | None = None, more: Sequence[Building] = ()) -> Path:
    """Write the city as it is, which no survey (`seed`) knows: walls elsewhere, other materials, some roughness.

    The building `without` was pulled down; `more` are on no map. Returns the path of `city.xml`.
    """
    rng = np.random.default_rng([seed, 7])
    real = []
    for number, building in enumerate(buildings(city)):
        # Drawn for every building, so that one that is missing moves no other.
        shift, taller = rng.normal(0, 0.3, 2), rng.normal(0, 0.5)
        if number != without:
            real.append(Building(building.footprint_m + shift, building.height_m + taller, building.material))
    names = sorted({b.material for b in buildings(city)} | {b.material for b in more} | {GROUND})
    materials = {name: _real_material(name, RADIO[city].frequency_hz, rng) for name in names}
    write_prisms(folder, SIDE_M, MARGIN_M, [(b, materials[b.material]) for b in (*real, *more)], materials[GROUND])
    return folder / "city.xml"


def _real_material(name: str, frequency_hz: float, rng: np.random.Generator) -> Material:
    relative, conductivity, _ = permittivity(name, frequency_hz)
    relative, conductivity = np.array([relative, conductivity]) * rng.uniform(0.85, 1.15, 2)
    return Material(f"{name}-real", relative_permittivity=float(relative), conductivity_s_per_m=float(conductivity),
                    thickness_m=0.3, scattering_coefficient=0.1 if name == GROUND else 0.25, xpd_coefficient=0.1)
