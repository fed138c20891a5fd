"""The page: the viewer on top, the tables and figures of whatever the run holds below, all in one file."""

import html
import json
from importlib.resources import files
from pathlib import Path

import numpy as np
from matplotlib import colormaps

from radiotwin import __version__
from radiotwin.closeloop.page import MORE_STYLE
from radiotwin.closeloop.page import sections as closeloop_sections
from radiotwin.errors import BadInput
from radiotwin.files import atomic_path
from radiotwin.pages import STYLE, image, table
from radiotwin.report.city import city_mesh
from radiotwin.report.comparison import comparison_lead, comparison_sections
from radiotwin.report.layers import bounds_m, device_layer, flight_layer, link_layer, map_layers
from radiotwin.report.run_folder import Run

# The browser itself refuses whatever would go to a network.
POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; " \
         "img-src data: blob:"
# three.js comes with pythreejs, as one file that needs nothing else.
SCRIPTS = (("pythreejs", "static/three.js"), ("radiotwin.report", "stage.js"), ("radiotwin.report", "overlay.js"),
           ("radiotwin.report", "viewer.js"))
SCALES = {"gain": "viridis", "sigma": "cividis", "residual": "coolwarm", "link": "coolwarm_r"}
LOS_COLOURS = [[209, 73, 91], [42, 127, 158]]
CONTROLS = """
<div class="controls">
<label>show <select id="control-view"></select></label>
<label>device <select id="control-device"></select></label>
<label>altitude <select id="control-altitude"></select></label>
<label><input type="checkbox" id="control-buildings" checked> buildings</label>
<label><input type="checkbox" id="control-devices" checked> devices</label>
<button id="control-oblique">oblique</button><button id="control-above">from above</button></div>
<div id="viewer"></div>
<div class="controls" id="scale"><span id="control-title"></span><span id="control-low"></span>
<span id="control-colours"></span><span id="control-high"></span><span id="control-hover"></span></div>
<div class="controls" id="flight-controls"><label>flight <select id="control-flight"></select></label>
<button id="control-play" aria-label="play">▶</button>
<input type="range" id="control-time" aria-label="time" min="0" value="0"><span id="control-clock"></span></div>
<p class="legend"><span id="control-legend"></span> Diamonds: anchors; orange: devices to be found; red crosses:
estimates, each with its error and the circle that holds 90 % of the posterior. Drag turns, right or shift drag moves,
the wheel zooms.</p>
"""
VIEWER_STYLE = """
#viewer { height: min(72vh, 760px); border: 1px solid #dde2e6; border-radius: 6px; overflow: hidden; position: relative;
          touch-action: none; cursor: grab }
#viewer canvas { position: absolute; inset: 0; width: 100%; height: 100% }
#control-colours { width: 14rem; height: .8rem; border: 1px solid #dde2e6 } #control-hover { margin-left: auto }
.controls { display: flex; flex-wrap: wrap; gap: .4rem 1rem; align-items: center; margin: .6rem 0 }
.controls label[hidden], .controls[hidden] { display: none } .controls select { max-width: 22rem }
#control-time { flex: 1 1 16rem } #control-clock { min-width: 8rem; font-variant-numeric: tabular-nums }
.legend, .notes { color: #4a5964; font-size: .9rem } .legend { max-width: none }
"""


def write_report(run: Run, path: Path | str) -> None:
    """Write the page of a run; it opens without a network.

    Args:
        run: what there is to show.
        path: of the HTML file; whole or not at all.

    Raises:
        BadInput: a damaged `closeloop.json`, or a path that cannot be written.
    """
    title = run.scene.config.name if run.scene else run.folder.resolve().name
    parts = [f"<h1>{html.escape(title)}</h1>", comparison_lead(run.comparison) if run.comparison else ""]
    scripts = ""
    if run.scene or run.tracks is not None or run.residuals is not None or run.twin:
        data = _data(run)
        parts += [CONTROLS]
        text = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
        scripts = f'<script type="application/json" id="radiotwin-data">{text}</script>'
        for package, name in SCRIPTS:
            scripts += f"<script>{files(package).joinpath(name).read_text(encoding='utf-8')}</script>"
    parts += [f'<p class="notes">{html.escape(note)}</p>' for note in run.notes]
    if run.closeloop is not None and run.closeloop_folder is not None:
        try:
            parts += closeloop_sections(run.closeloop, run.closeloop_folder)
        except (KeyError, TypeError, ValueError) as error:
            raise BadInput(f"{run.closeloop_folder}/closeloop.json is damaged ({type(error).__name__}: {error}); run "
                           "`radiotwin close-loop` again") from None
    if run.comparison is not None and run.comparison_folder is not None:
        parts += comparison_sections(run.comparison, run.comparison_folder)
    parts += _planning(run) + _devices(run)
    parts.append(f"<footer>{html.escape(_facts(run))}</footer>")
    page = ('<!doctype html><html lang="en"><meta charset="utf-8">'
            f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f"<title>radiotwin: {html.escape(title)}</title><style>{STYLE}{MORE_STYLE}{VIEWER_STYLE}</style>"
            f"<body><main>{''.join(parts)}</main>{scripts}</body></html>")
    with atomic_path(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def _data(run: Run) -> dict:
    """What `viewer.js` reads; fills `run.notes`."""
    city, note = city_mesh(run.scene) if run.scene else (None, "")
    if note:
        run.notes.append(note)
    maps = map_layers(run)
    heights_m = [z for layer in maps for z in layer["z"]]
    if run.scene:
        heights_m.append(float(run.scene.city.vertices[:, 2].max()))
    if run.tracks is not None:
        heights_m.append(float(run.tracks["z_m"].fillna(0.0).max()))
    scales = {kind: (255 * colormaps[name](np.linspace(0, 1, 101))[:, :3]).round().astype(int).tolist()
              for kind, name in SCALES.items()} | {"los": LOS_COLOURS}
    return {"scales": scales, "bounds": bounds_m(run), "top_m": max(heights_m, default=1.0), "city": city,
            "maps": maps, "links": link_layer(run), "devices": device_layer(run), "flights": flight_layer(run)}


def _planning(run: Run) -> list[str]:
    if run.planning is None:
        return []
    rows = [[row.method, "" if row.trained_in != row.trained_in else row.trained_in, f"{row.real_episodes:,}",
             f"{row.truth_ratio:.3f}"] for row in run.planning.itertuples()]
    columns = ["method", "trained in", "real episodes", "collected in the truth"]
    return ["<h2>Planning</h2>", table("Share of all data that is collected in the truth", columns, rows, left=2),
            image(run.folder / "curve.png", "Collected data over real episodes"),
            image(run.folder / "trajectories.png", "Trajectories of one flight")]


def _devices(run: Run) -> list[str]:
    rows = []
    for device in device_layer(run):
        estimate, true = device["estimate"], device["true"]
        if device["role"] == "anchor" or not estimate:
            continue
        error_m = ((estimate[0] - true[0]) ** 2 + (estimate[1] - true[1]) ** 2) ** 0.5 if true else float("nan")
        radius_m = device["radius_m"] if device["radius_m"] is not None else float("nan")
        rows.append([device["name"], "yes" if device["located"] else "no: the data do not say where it is",
                     float(estimate[0]), float(estimate[1]), error_m, radius_m])
    columns = ["device", "located", "x [m]", "y [m]", "error [m]", "90 % radius [m]"]
    return ["<h2>Devices that were to be found</h2>", table("", columns, rows, left=2)] if rows else []


def _facts(run: Run) -> str:
    facts = [f"radiotwin {__version__}"]
    if run.scene:
        facts += [f"scene {run.scene.config.provenance.get('source', run.scene.config.name)}",
                  f"{run.scene.config.radio.frequency_hz / 1e9:g} GHz"]
    for name, radio_map in run.maps.items():
        facts.append(f"{name}: {radio_map.dataset.attrs.get('source', 'no source given')}")
    return " · ".join(facts)
