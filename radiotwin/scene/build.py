"""Build a self-contained scene folder from a city model, and report on it.

`BuildOptions`, `finish_scene` and the report are shared with `radiotwin.scene.readers`, for maps.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import trimesh
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from radiotwin.errors import BadInput
from radiotwin.geo import local_crs
from radiotwin.io.budgets import DEVICES, UAVS
from radiotwin.io.cells import write_csv
from radiotwin.io.files import atomic_folder
from radiotwin.io.forms import MAX_COORDINATE_M, Origin
from radiotwin.runtime.console import print_table
from radiotwin.scene.checks import Problem
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.config import (
    Extent,
    LatticeConfig,
    RadioConfig,
    SceneConfig,
    TerrainConfig,
    parse_config,
    write_config,
)
from radiotwin.scene.folder import (
    CityShape,
    check_target,
    find_source,
    keep_declarations,
    scene_name,
    source_text,
    write_city,
)
from radiotwin.scene.importer import ImportedCity, import_city
from radiotwin.scene.materials import (
    STANDARD,
    MaterialTable,
    Names,
    constants,
    traceable_materials,
)
from radiotwin.scene.placement import (
    BuiltGrid,
    building_bounds,
    building_tops,
    choose_altitudes,
    choose_extent,
    choose_step,
    make_extent,
    place_devices,
    place_uavs,
)
from radiotwin.scene.plot import draw_preview
from radiotwin.scene.scene import Scene
from radiotwin.scene.streets import write_streets
from radiotwin.scene.vegetation import VegetationConfig

_COLOURS = {"error": "bold red", "warning": "yellow", "fixed": "green"}
_RADIO = RadioConfig()  # a scene is built with all of its defaults but the frequency
_TITLE: dict[str, Any] = {"title_justify": "left", "title_style": "bold"}
MIN_STEP_M = 0.01  # of a lattice


@dataclass(frozen=True)
class MaterialUse:
    """A material of a scene, for the report.

    Attributes:
        name: Name in `city.xml`.
        kind: `ITU` of that name, `ITU concrete`, or `own constants`.
        shapes: Number of shapes made of it.
        relative_permittivity: Real part at the scene's frequency.
        conductivity_s_per_m: Conductivity at the scene's frequency [S/m].
        in_range: Whether the ITU table covers the frequency.
    """

    name: str
    kind: str
    shapes: int
    relative_permittivity: float
    conductivity_s_per_m: float
    in_range: bool


@dataclass(frozen=True)
class BuildReport:
    """Report of `build_scene`. Only counts and problems are set if tracing would fail.

    Attributes:
        source: Source of the city as the user gave it.
        folder: Scene folder; None if it was only checked.
        frequency_hz: Frequency of the scene [Hz].
        shapes, triangles: Numbers written.
        extent_m: (x_min, x_max, y_min, y_max) of the lattice [m].
        tallest_m: Highest point of a building above the ground datum [m]; 0 without buildings.
        tallest: Name of its shape.
        built_fraction: Share of the extent's area under buildings.
        altitudes_m: Altitudes of the lattice [m].
        devices, uavs: Numbers placed.
        materials: Materials in use.
        problems: Problems, errors first.
        facts: More lines of the report, (subject, finding).
        step_m: Step of the lattice [m].
        altitudes_given: Whether the user chose the altitudes.
        altitudes_above: Reference of the lattice's altitudes: `datum` or `ground`.
    """

    source: str
    folder: Path | None
    frequency_hz: float
    shapes: int
    triangles: int
    extent_m: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    tallest_m: float = 0.0
    tallest: str = ""
    built_fraction: float = 0.0
    altitudes_m: tuple[float, ...] = ()
    devices: int = 0
    uavs: int = 0
    materials: tuple[MaterialUse, ...] = ()
    problems: tuple[Problem, ...] = ()
    facts: tuple[tuple[str, str], ...] = ()
    step_m: float = 0.0
    altitudes_given: bool = False
    altitudes_above: str = "datum"

    @property
    def tracing_would_fail(self) -> bool:
        """Whether there is an error among the problems."""
        return any(problem.severity == "error" for problem in self.problems)

    def load_scene(self) -> Scene:
        """Load the scene that was written when the report was made.

        Raises:
            BadInput: it was only checked.
        """
        if self.folder is None:
            raise BadInput(f"{self.source} was only checked, no scene was written; build it "
                           "without check_only")
        return Scene.load(self.folder)


def print_report(report: BuildReport, console: Console) -> None:
    """Print a report as tables, the problems last."""
    facts = Table(title="Scene from " + escape(report.source), show_header=False, **_TITLE)
    facts.add_column()
    facts.add_column(overflow="fold")
    facts.add_row("shapes, triangles", f"{report.shapes:,}, {report.triangles:,}")
    if report.altitudes_m:
        x_min, x_max, y_min, y_max = report.extent_m
        sides = f"x {x_min:g} … {x_max:g}, y {y_min:g} … {y_max:g}"
        facts.add_row("extent", f"{x_max - x_min:.5g} × {y_max - y_min:.5g} m   ({sides})")
        tallest = f"{report.tallest_m:.1f} m   ({report.tallest})" if report.tallest else "none"
        facts.add_row("tallest building", tallest)
        facts.add_row("built fraction", f"{report.built_fraction:.1%}")
        altitudes = ", ".join(f"{altitude:g}" for altitude in report.altitudes_m)
        above = "" if report.altitudes_above == "datum" else f" above the {report.altitudes_above}"
        how = "" if report.altitudes_given else "   (from 10 m above 95 % of the roofs)"
        facts.add_row("lattice altitudes", f"{altitudes} m{above}{how}")
        facts.add_row("lattice step", f"{report.step_m:g} m")
        facts.add_row("devices, UAVs", f"{report.devices}, {report.uavs}")
    facts.add_row("radio", f"{report.frequency_hz / 1e9:g} GHz" + "   (default: --frequency-hz or "
                  "--measurements)" * (report.frequency_hz == BuildOptions().frequency_hz)
                  + f"; bandwidth {_RADIO.bandwidth_hz / 1e6:g} MHz, noise "
                  f"{_RADIO.noise_dbm:g} dBm, power {_RADIO.tx_power_dbm:g} dBm, weakest "
                  f"level {_RADIO.sensitivity_dbm:g} dBm   (defaults: table radio of scene.toml)")
    for subject, finding in report.facts:
        facts.add_row(subject, escape(finding))
    print_table(facts, console)
    if report.materials:
        materials = Table(title=f"Materials at {report.frequency_hz / 1e9:g} GHz", **_TITLE)
        materials.add_column("material", overflow="fold")
        materials.add_column("kind", overflow="fold")
        for heading in ("shapes", "relative permittivity", "conductivity [S/m]"):
            materials.add_column(heading, justify="right", overflow="fold")
        for use in report.materials:
            materials.add_row(use.name, use.kind + ("" if use.in_range else " (out of range)"),
                              f"{use.shapes:,}", f"{use.relative_permittivity:.3f}",
                              f"{use.conductivity_s_per_m:.4g}")
        print_table(materials, console)
    if not report.problems:
        console.print("No problems found.")
        return
    problems = Table(title="Problems", show_header=False, show_lines=True, **_TITLE)
    problems.add_column()
    problems.add_column(overflow="fold")
    for problem in report.problems:
        problems.add_row(Text(problem.severity, style=_COLOURS[problem.severity]),
                         Text(problem.message))
    console.print(problems)


@dataclass(frozen=True)
class BuildOptions:
    """Options for reading a city model or a map, and for what is added to it.

    Attributes have the names and meanings of the arguments of `radiotwin.build_scene`. `scale` and
    `up` are for city models only, those from `default_height_m` on for maps only.
    """

    frequency_hz: float = 2.4e9
    materials: Mapping[str, str] | None = None
    bbox: tuple[float, float, float, float] | None = None
    devices: int = 0
    uavs: int = 3
    seed: int = 0
    origin: Origin | None = None
    extent_m: tuple[float, float, float, float] | None = None
    step_m: float | None = None
    altitudes_m: tuple[float, ...] | None = None
    scale: float | None = None
    up: str | None = None
    default_height_m: float | None = None
    height_column: str | None = None
    ground_column: str | None = None
    material_table: MaterialTable = STANDARD
    terrain: Path | str | None = None
    terrain_unit: str | None = None
    crs: str | None = None
    layers: tuple[str, ...] = ()

    def check(self) -> None:
        """Raise BadInput for an impossible value; `check_map_options` checks those for maps."""
        if self.scale is not None and not 0 < self.scale < float("inf"):
            raise BadInput(f"scale {self.scale:g} is not possible; give a positive factor (feet: "
                           "0.3048)")
        if self.up not in (None, "x", "y", "z"):
            raise BadInput(f"up axis {self.up!r} is not possible; give x, y or z")
        if self.devices < 0 or self.uavs < 0:
            raise BadInput(f"{min(self.devices, self.uavs)} devices or UAVs are not possible; give "
                           "0 or more")
        DEVICES.check(self.devices, "devices to place")
        UAVS.check(self.uavs, "UAVs to place")
        if self.bbox is not None:
            x_min, y_min, x_max, y_max = self.bbox
            if not (np.isfinite(self.bbox).all() and x_min < x_max and y_min < y_max):
                raise BadInput(f"bbox {self.bbox} is not possible; give x_min,y_min,x_max,y_max in "
                               "metres, the minimum below the maximum")
        if self.extent_m is not None:
            x_min, x_max, y_min, y_max = self.extent_m
            if not (np.isfinite(self.extent_m).all() and x_min < x_max and y_min < y_max):
                raise BadInput(f"an extent of x {x_min:g} to {x_max:g} m, y {y_min:g} to {y_max:g} "
                               "m is not possible; the minimum must be below the maximum")
        if self.step_m is not None and not MIN_STEP_M <= self.step_m <= MAX_COORDINATE_M:
            raise BadInput(f"a step of {self.step_m:g} m is not possible; give {MIN_STEP_M:g} to "
                           f"{MAX_COORDINATE_M:g} m")
        if self.altitudes_m is not None:
            given = ", ".join(f"{altitude_m:g}" for altitude_m in self.altitudes_m)
            if not given or not all(0 < altitude_m <= MAX_COORDINATE_M
                                    for altitude_m in self.altitudes_m):
                raise BadInput(f"altitudes of {given} m are not possible; give some above 0 and at "
                               f"most {MAX_COORDINATE_M:g} m")
            if len(set(self.altitudes_m)) < len(self.altitudes_m):
                raise BadInput(f"an altitude is given twice in {given} m; every one must be unique")


def build_scene(source: Path | str, out_folder: Path | str, options: BuildOptions = BuildOptions(),
                check_only: bool = False) -> BuildReport:
    """Read a city, check it, correct what can be corrected, and write a scene folder.

    Args:
        source: Path of a Mitsuba or Sionna RT XML file, or `sionna:NAME`.
        out_folder: Scene folder to write; a scene that is already in it is replaced.
        options: How to read the city, and what to add to it; options for maps are ignored.
        check_only: Write nothing, and return errors in the report instead of raising them.

    Returns:
        The report; its `tracing_would_fail` says whether an error was found.

    Raises:
        BadInput: The source cannot be read; an option is impossible; or tracing would fail (unless
            `check_only`).
    """
    out_folder = Path(out_folder)
    options.check()
    path = find_source(source)
    if not check_only:
        check_target(out_folder, source=path)
    city = import_city(path, options.materials or {}, options.scale, options.up, options.bbox)
    errors = [problem.message for problem in city.problems if problem.severity == "error"]
    if errors and not check_only:
        raise BadInput("\n".join([f"{source}: tracing would fail:", *errors]))
    if errors:
        triangles = 0 if city.surfaces is None else len(city.surfaces.faces)
        return BuildReport(str(source), None, options.frequency_hz, len(city.names), triangles,
                           problems=_by_severity(city.problems))
    if options.origin is not None and any(city.moved_m[:2]):
        raise BadInput(f"{source} lies too far from its x = y = 0 for --origin to say where that "
                       "is: it was moved to the middle; move it nearer, or write [origin] into "
                       "scene.toml")
    extent, bounds_m = None, options.extent_m
    if bounds_m is None and options.bbox is not None:
        bounds_m = options.bbox[0], options.bbox[2], options.bbox[1], options.bbox[3]
    if bounds_m is not None:
        east_m, north_m, _ = city.moved_m
        extent = make_extent((bounds_m[0] + east_m, bounds_m[1] + east_m,
                              bounds_m[2] + north_m, bounds_m[3] + north_m))
    declared = Declared(str(source), scene_name(source), extent, options.origin,
                        _provenance(city, str(source), options))
    return finish_scene(city, declared, out_folder, options, check_only)


@dataclass(frozen=True)
class Declared:
    """Declarations of a scene besides its geometry.

    Attributes:
        source: Source of the city.
        name: Name of the scene.
        extent: Extent of the lattice; None: chosen around the buildings.
        origin: WGS84 position of the frame's origin; None: unknown.
        provenance: Entries for `scene.toml`.
        facts: More lines for the report.
        vegetation: Areas of vegetation.
        terrain: Ground that is not flat; None: flat ground at z = 0.
        streets_m: (n, 2) corners of each street [m].
    """

    source: str
    name: str
    extent: Extent | None
    origin: Origin | None
    provenance: dict[str, str]
    facts: tuple[tuple[str, str], ...] = ()
    vegetation: Sequence[VegetationConfig] = ()
    terrain: TerrainConfig | None = None
    streets_m: Sequence[np.ndarray] = ()


def finish_scene(city: ImportedCity, declared: Declared, out_folder: Path, options: BuildOptions,
                 check_only: bool, buildings: pd.DataFrame | None = None) -> BuildReport:
    """Choose a city's lattice, devices and UAVs, write its scene folder, and report on it.

    Args:
        city: City in the scene's frame without errors; problems of materials are appended.
        declared: Declarations besides the geometry.
        out_folder: Scene folder to write; a scene that is already in it is replaced.
        options: Frequency, lattice, devices, UAVs and seed.
        check_only: Write nothing.
        buildings: Table for `buildings.csv`.

    Raises:
        BadInput: No room for devices or UAVs, an impossible value, or the folder cannot be written.
    """
    shapes, material_problems = _city_shapes(city, options.frequency_hz)
    city.problems.extend(material_problems)
    config, built_fraction, tallest_m, tallest = _plan(city, declared, options)
    if not check_only:
        write_scene(out_folder, shapes, config, buildings, declared.streets_m)
    return BuildReport(
        declared.source, None if check_only else out_folder, config.radio.frequency_hz, len(shapes),
        sum(len(shape.mesh.faces) for shape in shapes), config.extent.bounds, tallest_m, tallest,
        built_fraction, tuple(config.lattice.altitudes_m), len(config.devices), len(config.uavs),
        _materials_in_use(city, shapes, config.radio.frequency_hz), _by_severity(city.problems),
        declared.facts, config.lattice.step_m, options.altitudes_m is not None,
        config.lattice.above or "datum")


def write_scene(folder: Path, shapes: list[CityShape], config: SceneConfig,
                buildings: pd.DataFrame | None = None,
                streets_m: Sequence[np.ndarray] = ()) -> None:
    """Write a scene folder: `city.xml`, `scene.toml`, its tables, and a preview picture.

    A `scene.toml` that it replaces is kept beside it, see `keep_declarations`. `buildings.csv`
    needs a table of buildings, `streets.geojson` an origin and streets.
    """
    with atomic_folder(folder) as temporary:
        write_city(temporary, shapes)
        write_config(config, temporary / "scene.toml")
        keep_declarations(folder, temporary)
        if buildings is not None:
            write_csv(buildings, temporary / "buildings.csv")
        if config.origin is not None and len(streets_m):
            write_streets(streets_m, config.origin, temporary)
        draw_preview(Scene.load(temporary), temporary / "preview.png")


def _city_shapes(city: ImportedCity, frequency_hz: float
                 ) -> tuple[list[CityShape], list[Problem]]:
    """Return a city's shapes with materials that Sionna RT accepts, and what was changed."""
    assert city.surfaces is not None  # without an error among the problems
    materials = [material for material in city.materials if material is not None]
    taken = Names(name.lower() for name in city.names)
    written, problems = traceable_materials(materials, frequency_hz, taken)
    shapes = [CityShape(name, trimesh.Trimesh(vertices, faces, process=False), written[material])
              for name, material, (vertices, faces)
              in zip(city.names, materials, city.surfaces.meshes())]
    return shapes, problems


def _plan(city: ImportedCity, declared: Declared, options: BuildOptions
          ) -> tuple[SceneConfig, float, float, str]:
    """Return the content of `scene.toml`, the built fraction, and the tallest building.

    Extent, altitudes, devices and UAVs are chosen where they are not declared. The built fraction
    is the share of the extent under buildings; of the tallest building, its height above the ground
    [m] and its name are returned.
    """
    assert city.surfaces is not None  # without an error among the problems
    surfaces, solid = city.surfaces, ~city.ground
    if declared.extent is None:
        bounds = building_bounds(surfaces, solid)
        extent = choose_extent(bounds)
    else:
        bounds, extent = declared.extent.bounds, declared.extent
    on_terrain = declared.terrain is not None
    buildings, ground = (
        CityMap(surfaces.vertices, surfaces.faces[faces],
                terrain=np.full(np.count_nonzero(faces), is_terrain)) if faces.any() else None
        for faces, is_terrain in ((solid, False), (city.ground, on_terrain)))
    tops_m, heights_m = building_tops(surfaces, solid, ground)
    highest = int(heights_m.argmax())
    lattice = LatticeConfig(
        step_m=options.step_m or choose_step(bounds), above="ground" if on_terrain else None,
        altitudes_m=list(options.altitudes_m or choose_altitudes(
            (heights_m if on_terrain else tops_m)[heights_m > 0])))
    grid = BuiltGrid.over(extent, buildings)
    config = {
        "name": declared.name,
        "radio": {"frequency_hz": options.frequency_hz},
        "extent": extent,
        "lattice": lattice,
        "devices": place_devices(options.devices, grid, ground,
                                 np.random.default_rng(options.seed)),
        "uavs": place_uavs(options.uavs, extent, lattice, buildings,
                           ground if on_terrain else None),
        "provenance": declared.provenance,
        "vegetation": list(declared.vegetation),
        "terrain": declared.terrain,
    }
    if declared.origin is not None:
        config |= {"origin": declared.origin, "crs": local_crs(declared.origin)}
    return (parse_config(config, Path("scene.toml")), grid.fraction, float(heights_m[highest]),
            city.names[highest] if solid.any() else "")


def _provenance(city: ImportedCity, source: str, options: BuildOptions) -> dict[str, str]:
    """Return `[provenance]` of a city model's scene: source, seed, and options that were given."""
    known = {"source": source_text(source), "seed": str(options.seed)}
    if any(city.moved_m):
        known["moved_m"] = ", ".join(f"{value:.3f}" for value in city.moved_m)
    for name in ("scale", "up", "bbox", "materials"):
        value = getattr(options, name)
        if value is not None:
            known[name] = str(value)
    return known


def _materials_in_use(city: ImportedCity, shapes: list[CityShape],
                      frequency_hz: float) -> tuple[MaterialUse, ...]:
    """Return the materials of a city for the report, the most frequent first."""
    uses, declared = [], dict(zip((shape.material for shape in shapes), city.materials))
    for material, count in Counter(shape.material for shape in shapes).most_common():
        original = declared[material]
        assert original is not None
        kind = ("own constants" if original.itu is None else
                "ITU" if original.itu == material.name else f"ITU {original.itu}")
        uses.append(MaterialUse(material.name, kind, count, *constants(original, frequency_hz)))
    return tuple(uses)


def _by_severity(problems: list[Problem]) -> tuple[Problem, ...]:
    """Return problems, errors first."""
    order = ("error", "warning", "fixed")
    return tuple(sorted(problems, key=lambda problem: order.index(problem.severity)))
