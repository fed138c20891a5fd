"""Plan flights over a twin's map (`radiotwin plan`): scene, mission, plan, predicted share."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from shapely.geometry.base import BaseGeometry

from marl.airspace import keep_out
from marl.belief import Prior
from marl.mission import MAX_UNITS, Known, Mission, make_mission
from marl.promise import TRIED_PLANS, Promise, Size, bases, promise, sizes
from marl.settings import stream
from marl.worlds import twin_prior
from radiotwin.errors import BadInput
from radiotwin.io.cells import as_numbers, as_text, read_cells, refuse
from radiotwin.scene import Scene
from radiotwin.scene.config import ANTENNA_HEIGHT_M, DeviceConfig, UavConfig
from radiotwin.twin import Twin

MAX_COUNTS = 8  # numbers of UAVs that a sizing tries, up to twice the mission's
BATTERIES = (0.5, 0.75, 1.0, 1.5, 2.0)  # batteries that a sizing tries, times the mission's


@dataclass(frozen=True, kw_only=True)
class PlanSettings:
    """Settings of a plan.

    Attributes:
        uavs: number of UAVs, copies of the scene's in turn; None: those of the scene.
        battery: battery of each UAV [moves]; None: the scene's.
        base_m: (x, y) of start and terminal of all UAVs [m]; None: the scene's.
        data: table with columns `device` and `data_units`; None: the scene's data.
        silent: probability that a device does not transmit.
        data_spread: relative half-width of the uniform distribution of each device's data.
        areas: no-fly areas in the scene's frame.
        clearance_m: distance that UAVs keep from buildings [m].
        sizes: whether to evaluate other numbers of UAVs, batteries and bases.
        wanted: wanted share of the data.
        worlds: number of worlds in which a plan is evaluated.
        iterations: plans tried in a search.
        seed: random seed.
    """

    uavs: int | None = None
    battery: float | None = None
    base_m: tuple[float, float] | None = None
    data: Path | None = None
    silent: float = 0.0
    data_spread: float = 0.0
    areas: Sequence[BaseGeometry] = ()
    clearance_m: float = 5.0
    sizes: bool = False
    wanted: float = 0.95
    worlds: int = 200
    iterations: int = 20_000
    seed: int = 0


@dataclass(frozen=True, eq=False)
class PlannedFlights:
    """A plan in the twin's map, with its predicted share of data; `scene` has the UAVs that fly."""

    scene: Scene
    mission: Mission
    prior: Prior
    promised: Promise
    sizes: list[Size]


def plan_flights(twin: Twin, scene: Scene, settings: PlanSettings,
                 on_progress: Callable[..., None] = lambda *_: None) -> PlannedFlights:
    """Plan flights over a twin's map, and predict the share of data that they collect.

    `on_progress` is called with the per cent of the work done since the last call, and with a text.

    Raises:
        BadInput: no UAV, a battery that does not reach the terminal, a blocked base, an unusable
            table of data, or a twin of another map.
    """
    flown = planned_scene(scene, twin, settings)
    on_progress(0, "predicting the map")
    radio_map = twin.radio_map(scene)
    mission = make_mission(flown, radio_map, Known.of(twin.devices),
                           keep_out=keep_out(flown, settings.areas, settings.clearance_m))
    on_progress(0, "drawing worlds")
    prior = twin_prior(twin, flown, radio_map, stream(settings.seed, "learning"), settings.silent,
                       settings.data_spread)
    mission = mission._replace(shadowing_share=prior.share, shadowing_m=prior.length_m)
    names = [uav.uav for uav in flown.config.uavs]
    counts = np.unique(np.linspace(1, 2 * mission.uavs, MAX_COUNTS).round().astype(int)).tolist() \
        if settings.sizes else []
    missions = 1 + len(bases(mission, names)) * len(counts) * len(BATTERIES)

    def search(count: int) -> None:
        on_progress(100 * count / (missions * TRIED_PLANS), "planning")
    search(0)
    made = settings.worlds, settings.iterations, settings.seed, search
    promised = promise(prior, mission, *made)
    usual = max(uav.battery for uav in flown.config.uavs)
    table = sizes(prior, mission, names, counts, [factor * usual for factor in BATTERIES],
                  settings.wanted, *made)
    return PlannedFlights(flown, mission, prior, promised, table)


def planned_scene(scene: Scene, twin: Twin, settings: PlanSettings) -> Scene:
    """Return a scene with exactly a twin's devices at its positions, and the UAVs that fly.

    Devices that the twin lacks are dropped. A device without a position is put into the middle of
    the extent, one without a height to `ANTENNA_HEIGHT_M`.

    Raises:
        BadInput: no UAV, a base outside the lattice, or an unusable table of data.
    """
    declared = {device.device: device for device in scene.config.devices}
    data = {} if settings.data is None else _read_data(settings.data,
                                                       [each.device for each in twin.devices])
    x_min, x_max, y_min, y_max = scene.config.extent.bounds
    devices = []
    for each in twin.devices:
        known = bool(np.isfinite([each.x_m, each.y_m]).all())
        given = declared.get(each.device)
        # Not validated: a device may be outside the extent or without a position.
        devices.append(DeviceConfig.model_construct(
            device=each.device, x_m=each.x_m if known else (x_min + x_max) / 2,
            y_m=each.y_m if known else (y_min + y_max) / 2,
            z_m=each.z_m if np.isfinite(each.z_m) else ANTENNA_HEIGHT_M, role=each.role,
            data_units=data.get(each.device, None if given is None else given.data_units)))
    config = scene.config.model_copy(update={"devices": devices, "uavs": _uavs(scene, settings)})
    return replace(scene, config=config)


def _read_data(path: Path, names: list[str]) -> dict[str, float]:
    """Read data units by device from a table; devices must be among the twin's `names`."""
    cells = read_cells(path, ("device", "data_units"), ())
    device, text = (as_text(cells[name]).fillna("").str.strip()
                    for name in ("device", "data_units"))
    units = as_numbers(text)
    refuse(path, "device", device, ~device.isin(names), "is no device of the twin, which has "
           f"{', '.join(names[:10])}{', …' * (len(names) > 10)}; correct the name or leave the row "
           "out")
    refuse(path, "device", device, device.duplicated(), "is listed twice; leave one row out")
    refuse(path, "data_units", text, ~((units > 0) & (units <= MAX_UNITS)),
           f"is not a number above 0, up to {MAX_UNITS:g}; give the data that wait at the device")
    return dict(zip(device, units.tolist(), strict=True))


def _uavs(scene: Scene, settings: PlanSettings) -> list[UavConfig]:
    """Return the UAVs that fly: the scene's or copies, with battery and base of the settings.

    The base is the nearest lattice point, at most one step away, or BadInput. A scene without UAVs
    gets one, or as many as the settings say, at the lattice's altitudes in turn.
    """
    templates, lattice = scene.config.uavs, scene.lattice
    path = scene.folder / "scene.toml"
    changes: dict[str, float] = {}
    if settings.battery is not None:
        changes["battery"] = settings.battery
    if settings.base_m is not None:
        x_m, y_m = (float(axis[np.abs(axis - at).argmin()])
                    for axis, at in zip((lattice.x_m, lattice.y_m), settings.base_m, strict=True))
        if max(abs(x_m - settings.base_m[0]), abs(y_m - settings.base_m[1])) > lattice.step_m:
            raise BadInput(f"--base {settings.base_m[0]:g},{settings.base_m[1]:g} is not over the "
                           f"lattice of {path} (x {lattice.x_m[0]:g} to {lattice.x_m[-1]:g} m, y "
                           f"{lattice.y_m[0]:g} to {lattice.y_m[-1]:g} m); give a place in it")
        changes |= {"start_x_m": x_m, "start_y_m": y_m, "terminal_x_m": x_m, "terminal_y_m": y_m}
    if not templates:
        if settings.base_m is None or settings.battery is None:
            raise BadInput(f"{path} has no [[uavs]], so it is not known who flies; add them, or "
                           "give --base X,Y, --battery MOVES and --uavs N")
        templates = [UavConfig(uav=f"uav{number}", altitude_m=altitude_m, battery=settings.battery,
                               start_x_m=0.0, start_y_m=0.0, terminal_x_m=0.0, terminal_y_m=0.0)
                     for number, altitude_m in enumerate(lattice.z_m.tolist())]
    count = settings.uavs or (len(templates) if scene.config.uavs else 1)
    found = []
    for number in range(count):
        copy, lap = templates[number % len(templates)], number // len(templates)
        name = copy.uav if not lap else f"{copy.uav}-{lap + 1}"
        found.append(copy.model_copy(update=changes | {"uav": name}))
    return found
