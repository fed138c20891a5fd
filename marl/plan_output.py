"""Write the folder of `radiotwin plan`: plan.json, flight files and figures."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from marl.figures import COLOURS, MARKERS, save, trajectories_figure
from marl.flights import evaluate
from marl.mission import COSTS, MOVES, Mission, levels_of
from marl.plan_flights import PlannedFlights
from marl.planner import PlanPolicy
from marl.promise import Size
from radiotwin.io.files import atomic_path
from radiotwin.maps.export.flight_files import Route, write_flight_files
from radiotwin.scene import Scene

FILES = frozenset({"plan.json", "plan.png", "sizes.png", "flights.csv", "flights.kml",
                   "flights.geojson", "*.plan"})


def routes(scene: Scene, mission: Mission, actions: np.ndarray) -> list[Route]:
    """Convert the actions (T, U) of a plan to the route of each UAV, for flight files."""
    lattice, slot_s = scene.lattice, scene.config.mission.slot_s
    positions_m = lattice.positions_m.reshape(*lattice.shape, 3)
    speed_m_s = lattice.step_m / slot_s
    found = []
    for u, (uav, level) in enumerate(zip(scene.config.uavs, levels_of(scene), strict=True)):
        flown = actions[:, u][COSTS[actions[:, u]] > 0]
        cells = mission.start[u] + np.concatenate([np.zeros((1, 2), int),
                                                   np.cumsum(MOVES[flown], axis=0)])
        track_m = positions_m[level, cells[:, 0], cells[:, 1]]
        found.append(Route.along(uav.uav, track_m, slot_s, speed_m_s,
                                 float(scene.city.ground_height_m(*track_m[0, :2]))))
    return found


def write_plan(folder: Path, planned: PlannedFlights, wanted: float, facts: dict) -> list[str]:
    """Write a plan to a folder, with more `facts` in `plan.json`; return the names of the files."""
    scene, mission, promised = planned.scene, planned.mission, planned.promised
    found = routes(scene, mission, promised.plan.actions)
    flights = [{"uav": each.name, "time_s": round(float(each.arrival_s[-1] + each.hold_s[-1]), 1),
                "length_m": round(float(np.linalg.norm(
                    np.diff(each.position_m, axis=0), axis=1).sum()), 1),
                "waypoints": len(each.position_m)} for each in found]
    names = [each.device for each in scene.config.devices]
    record = promised.record(names, planned.prior.silent) | {
        "flights": flights, "wanted": wanted,
        "sizes": [asdict(each) for each in planned.sizes]} | facts
    with atomic_path(folder / "plan.json") as temporary:
        temporary.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    flown = evaluate(mission, PlanPolicy(promised.plan.actions), 1, np.random.default_rng(0))
    figure = trajectories_figure(scene, mission, flown, 0, None)
    p10, p50, p90 = promised.quantiles.values()
    figure.suptitle(f"{scene.config.name}: {p50:.0%} of the data expected, {p10:.0%} to {p90:.0%} "
                    "in eight of ten worlds")
    save(figure, folder / "plan.png")
    written = ["plan.json", "plan.png", *write_flight_files(found, scene.config.origin, folder)]
    if planned.sizes:
        save(sizes_figure(planned.sizes, wanted), folder / "sizes.png")
        written.append("sizes.png")
    return written


def sizes_figure(sizes: list[Size], wanted: float) -> Figure:
    """Draw the collected share (P50, P10 to P90) against battery, by number of UAVs and base."""
    base_names = list(dict.fromkeys(row.base for row in sizes))
    figure = Figure(figsize=(5.2 * len(base_names), 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, base in zip(figure.subplots(1, len(base_names), squeeze=False, sharey=True)[0],
                          base_names, strict=True):
        of_base = [row for row in sizes if row.base == base]
        for number, uavs in enumerate(sorted({row.uavs for row in of_base})):
            rows = sorted((row for row in of_base if row.uavs == uavs),
                          key=lambda row: row.battery)
            battery, p10, p50, p90 = np.array([[row.battery, row.p10, row.p50, row.p90]
                                               for row in rows]).T
            colour = COLOURS[number % len(COLOURS)]
            axes.plot(battery, p50, marker=MARKERS[number % len(MARKERS)], color=colour,
                      label=f"{uavs} UAV{'s' * (uavs > 1)}")
            axes.fill_between(battery, p10, p90, color=colour, alpha=0.18, linewidth=0)
        axes.axhline(wanted, color="black", linestyle="--", linewidth=1.1)
        axes.set(xlabel="battery of each UAV [moves]", ylim=(0, 1.02),
                 title=f"base {base}" if len(base_names) > 1 else "")
        axes.grid(alpha=0.3)
        axes.legend(frameon=False)
    figure.axes[0].set_ylabel("share of the data collected: P50, P10 to P90")
    return figure
