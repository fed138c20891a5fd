"""The page of a run: what was found, the viewer, tables and figures, all in one file."""

from pathlib import Path, PurePath
from typing import Any

import numpy as np

from radiotwin import __version__
from radiotwin.io.forms import Origin
from radiotwin.report.closeloop_page import closeloop_context
from radiotwin.report.comparison import comparison_context
from radiotwin.report.folders import Run
from radiotwin.report.html import Table, read_picture, write_page
from radiotwin.report.labels import attribution, name_label, place_words, source_label
from radiotwin.report.viewer_data import device_layer, marks, viewer_data
from radiotwin.twin.law import LAW
from radiotwin.twin.selection import HeldOut

MAX_NAMED = 4  # devices in a sentence
ROUGH_M = 100.0  # 90 % radius above which a device is not said to be found
SCRIPTS = (("pythreejs", "three.js"), ("radiotwin.report", "stage.js"),
           ("radiotwin.report", "overlay.js"), ("radiotwin.report", "viewer.js"))


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
    has_place = run.scene or run.tracks is not None or run.residuals is not None or run.twin
    viewer = viewer_data(run) if has_place else None
    comparison = closeloop = None
    if run.comparison is not None and run.comparison_folder is not None:
        comparison = comparison_context(run.comparison, run.comparison_folder)
    if run.closeloop is not None and run.closeloop_folder is not None:
        closeloop = closeloop_context(run.closeloop, run.closeloop_folder)
    lead = [comparison and comparison["lead"], _located_words(run), _channel_words(run)]
    write_page("run.html", path, {
        "title": title, "page_title": f"radiotwin: {title}", "viewer": viewer,
        "marks": marks(run), "notes": run.notes, "lead": list(filter(None, lead)),
        "closeloop": closeloop, "comparison": comparison, "planning": _planning(run),
        "estimates": _located_table(run), "law": _law_table(run), "facts": _facts(run)},
        SCRIPTS if viewer else ())


def _planning(run: Run) -> dict[str, Any] | None:
    """Return the table of collected data and the pictures of a planning run; None for others."""
    if run.planning is None:
        return None
    rows = [[row.method, row.trained_in, f"{row.real_episodes:,.0f}", f"{row.truth_ratio:.3f}"]
            for row in run.planning.itertuples()]
    columns = ("method", "trained in", "real episodes", "collected in the truth")
    return {"table": Table(columns, rows, "Share of all data that is collected in the truth", 2),
            "pictures": [
                read_picture(run.folder, "curve.png", "Collected data over real episodes"),
                read_picture(run.folder, "trajectories.png", "Trajectories of one flight")]}


def _located(run: Run) -> list[dict]:
    """Return the unknown devices that have an estimated position."""
    return [device for device in device_layer(run)
            if device["role"] != "anchor" and device["estimate"]]


def _origin(run: Run) -> Origin | None:
    """Return the origin of the scene's frame, or of the twin's."""
    if run.scene is not None:
        return run.scene.config.origin
    return None if run.twin is None else run.twin.origin


def _located_words(run: Run) -> str:
    """Say where unknown devices are, if their 90 % radius is at most `ROUGH_M`; empty if none."""
    found = [device for device in _located(run) if _is_found(device)]
    words = []
    for device in found[:MAX_NAMED]:
        x_m, y_m, _ = device["estimate"]
        words.append(f"{device['name']} at {place_words(x_m, y_m, _origin(run))}, within "
                     f"{device['radius_m']:.0f} m")
    more = f"; {len(found) - MAX_NAMED:,} more are in the table" if len(found) > MAX_NAMED else ""
    return f"Located, with 90 % probability: {'; '.join(words)}{more}." if words else ""


def _channel_words(run: Run) -> str:
    """State the held-out RMSE of the twin's channel model and of others; empty if not computed.

    It is empty for a close-loop, whose page has errors of its own.
    """
    held_out = HeldOut.from_provenance(run.twin.provenance) \
        if run.twin and not run.closeloop else None
    if held_out is None or run.twin is None or run.twin.channel.name not in held_out.rmse_db:
        return ""
    name = run.twin.channel.name
    others = [f"{name_label(each)} {rmse_db:.1f} dB"
              for each, rmse_db in held_out.rmse_db.items() if each != name]
    return (f"Levels are predicted by {name_label(name)}. Its RMSE on the anchors' links, held out "
            f"by {held_out.by}, is {held_out.rmse_db[name]:.1f} dB ({', '.join(others)}).")


def _law_table(run: Run) -> Table | None:
    """Return a table of the twin's fitted channel law; None without one, or for a close-loop."""
    if run.twin is None or run.closeloop or not run.twin.provenance.get(LAW):
        return None
    law = run.twin.params
    return Table(list(law.columns), law.to_numpy(dtype=object).tolist(), "with 90 % intervals", 2)


def _located_table(run: Run) -> Table | None:
    """Return the positions of the unknown devices; None if no device has an estimated one."""
    rows, origin = [], _origin(run)
    for device in _located(run):
        (x_m, y_m, _), true = device["estimate"], device["true"]
        radius_m = np.nan if device["radius_m"] is None else device["radius_m"]
        place = [place_words(x_m, y_m, origin)] if origin else []
        error_m = float(np.hypot(x_m - true[0], y_m - true[1])) if true else np.nan
        rows.append([device["name"], _how_sure(device, origin), *place, float(x_m), float(y_m),
                     radius_m, error_m])
    texts = ["device", "position"] + ["latitude, longitude"] * bool(origin)
    columns = [*texts, "x [m]", "y [m]", "90 % radius [m]", "error [m]"]
    if all(np.isnan(row[-1]) for row in rows):  # no true position is known
        columns, rows = columns[:-1], [row[:-1] for row in rows]
    return Table(columns, rows, text_columns=len(texts)) if rows else None


def _is_found(device: dict) -> bool:
    """Return whether a device was located to within `ROUGH_M` (90 % radius)."""
    radius_m = device["radius_m"]
    return device["located"] and radius_m is not None and radius_m <= ROUGH_M


def _how_sure(device: dict, origin: Origin | None) -> str:
    """Say whether the data determine a device's position, and its second likeliest place."""
    if not device["located"] or device["radius_m"] is None:
        return "not determined by these data"
    text = "found" if _is_found(device) else "a region, no place"
    if device["second"]:
        x_m, y_m, weight = device["second"]
        text += f"; or near {place_words(x_m, y_m, origin)} with {100 * weight:.0f} %"
    return text


def _facts(run: Run) -> list[str]:
    """Return the footer: version, scene, frequency, credit of the map, source of each radio map."""
    facts = [f"radiotwin {__version__}"]
    if run.scene:
        config = run.scene.config
        source = config.provenance.get("source", config.name)
        facts += [f"scene {PurePath(source).name}", f"{config.radio.frequency_hz / 1e9:g} GHz",
                  *[f"map {credit}" for credit in [attribution(run.scene)] if credit]]
    return facts + [f"{name}: {source_label(radio_map)}" for name, radio_map in run.maps.items()]
