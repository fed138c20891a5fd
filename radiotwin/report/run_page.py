"""Make the page of a run: the viewer on top, tables and figures below, all in one file."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps

from radiotwin import __version__
from radiotwin.report.closeloop_page import closeloop_context
from radiotwin.report.comparison import comparison_context
from radiotwin.report.html import Table, read_picture, write_page
from radiotwin.report.run_folder import Run
from radiotwin.report.viewer import (
    MAX_DEVICES,
    bounds_m,
    city_mesh,
    device_layer,
    flight_layer,
    link_layer,
    map_layers,
)

ROUGH_M = 100.0  # 90 % radius above which a device is not said to be found
SCALES = {"gain": "viridis", "sigma": "cividis", "error": "coolwarm", "link": "coolwarm_r"}
SCRIPTS = (("pythreejs", "three.js"), ("radiotwin.report", "stage.js"),
           ("radiotwin.report", "overlay.js"), ("radiotwin.report", "viewer.js"))
LOS_COLOURS = [[209, 73, 91], [42, 127, 158]]  # RGB of no and of line of sight


def write_report(run: Run, path: Path | str) -> None:
    """Write the page of a run; it opens without a network.

    Args:
        run: content of the page.
        path: HTML file, written completely or not at all.

    Raises:
        BadInput: a damaged `closeloop.json` or figure, or a path that cannot be written.
        RunFailed: the disk is full.
    """
    title = run.scene.config.name if run.scene else run.folder.resolve().name
    shown = run.scene or run.tracks is not None or run.residuals is not None or run.twin
    viewer = _viewer_data(run) if shown else None
    comparison = None
    if run.comparison is not None and run.comparison_folder is not None:
        comparison = comparison_context(run.comparison, run.comparison_folder)
    write_page("run.html", path, {
        "title": title, "page_title": f"radiotwin: {title}", "viewer": viewer, "notes": run.notes,
        "closeloop": _closeloop(run), "comparison": comparison, "planning": _planning(run),
        "estimates": _estimates(run), "facts": _facts(run)},
        SCRIPTS if viewer else ())


def _viewer_data(run: Run) -> dict[str, Any]:
    """Return the data that `viewer.js` reads; adds to `run.notes`."""
    city, note = city_mesh(run.scene) if run.scene else (None, "")
    if note:
        run.notes.append(note)
    maps = map_layers(run)
    heights_m = [z for layer in maps for z in layer["z"]]
    if run.scene:
        heights_m.append(float(run.scene.city.vertices[:, 2].max()))
    if run.tracks is not None:
        heights_m.append(float(run.tracks["z_m"].fillna(0.0).max()))
    scales = {kind: (255 * colormaps[name](np.linspace(0, 1, 101))[:, :3]).round().astype(int)
              .tolist() for kind, name in SCALES.items()} | {"los": LOS_COLOURS}
    devices = device_layer(run)
    if len(devices) > MAX_DEVICES:
        run.notes.append(f"Of {len(devices):,} devices the first {MAX_DEVICES:,} are drawn.")
    return {"scales": scales, "bounds": bounds_m(run), "top_m": max(heights_m, default=1.0),
            "city": city, "maps": maps, "links": link_layer(run), "devices": devices[:MAX_DEVICES],
            "flights": flight_layer(run)}


def _closeloop(run: Run) -> dict[str, Any] | None:
    if run.closeloop is None or run.closeloop_folder is None:
        return None
    return closeloop_context(run.closeloop, run.closeloop_folder)


def _planning(run: Run) -> dict[str, Any] | None:
    if run.planning is None:
        return None
    rows = [[row.method, row.trained_in, f"{row.real_episodes:,.0f}", f"{row.truth_ratio:.3f}"]
            for row in run.planning.itertuples()]
    columns = ("method", "trained in", "real episodes", "collected in the truth")
    return {"table": Table(columns, rows, "Share of all data that is collected in the truth", 2),
            "pictures": [
                read_picture(run.folder, "curve.png", "Collected data over real episodes"),
                read_picture(run.folder, "trajectories.png", "Trajectories of one flight")]}


def _estimates(run: Run) -> Table | None:
    """Return the table of the unknown devices with a position; None where there are none."""
    rows = []
    for device in device_layer(run):
        estimate, true = device["estimate"], device["true"]
        if device["role"] == "anchor" or not estimate:
            continue
        error_m = np.hypot(estimate[0] - true[0], estimate[1] - true[1]) if true else np.nan
        radius_m = np.nan if device["radius_m"] is None else device["radius_m"]
        rows.append([device["name"], _how_sure(device), float(estimate[0]), float(estimate[1]),
                     float(error_m), radius_m])
    columns = ("device", "position", "x [m]", "y [m]", "error [m]", "90 % radius [m]")
    return Table(columns, rows, text_columns=2) if rows else None


def _how_sure(device: dict) -> str:
    """Say in words how far the data determine a device's position."""
    if not device["located"] or device["radius_m"] is None:
        return "not determined by these data"
    rough = device["radius_m"] > ROUGH_M
    text = "a region, no place" if rough else "found"
    if device["second"]:
        x_m, y_m, weight = device["second"]
        text += f"; or near ({x_m:.0f}, {y_m:.0f}) m with {100 * weight:.0f} %"
    return text


def _facts(run: Run) -> list[str]:
    facts = [f"radiotwin {__version__}"]
    if run.scene:
        config = run.scene.config
        facts += [f"scene {config.provenance.get('source', config.name)}",
                  f"{config.radio.frequency_hz / 1e9:g} GHz"]
    return facts + [f"{name}: {radio_map.dataset.attrs.get('source', 'no source given')}"
                    for name, radio_map in run.maps.items()]
