"""The demonstration's page: one HTML file with its figures inside, which opens without a network."""

import base64
import html
from pathlib import Path

from radiotwin.compare import Comparison
from radiotwin.files import atomic_path
from radiotwin.radiomap import RadioMap
from radiotwin.scene import Scene

FIGURES = (
    ("scene/preview.png", "The city",
     "Buildings by height. The twin knows the 3D map and where the anchors are; it has to find the other devices."),
    ("truth.png", "The truth",
     "Channel gain from each device to every position of a UAV, traced with Sionna RT. White: not detected."),
    ("comparison/maps.png", "One device in three models",
     "What the ray tracer says, what the learned twin says, what the log-distance model says, and the differences."),
    ("comparison/scatter.png", "A flight that no model has seen",
     "Predicted against measured gain of every link that was detected."),
    ("comparison/estimates.png", "Where the unknown devices are",
     "Estimates of the log-distance model and of the twin; a circle holds 90 % of the posterior."),
)

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #1c2733; background: #f6f7f8; margin: 0 }
main { max-width: 1080px; margin: 0 auto; padding: 2rem 1.2rem 4rem }
h1 { font-size: 1.9rem; margin: 0 } h2 { font-size: 1.2rem; margin: 2.4rem 0 .3rem }
p { margin: .3rem 0 .8rem; max-width: 46rem } .lead { font-size: 1.1rem }
img { max-width: 100%; background: #fff; border: 1px solid #dde2e6; border-radius: 6px }
table { border-collapse: collapse; background: #fff; font-variant-numeric: tabular-nums; font-size: .92rem }
caption { text-align: left; font-weight: 600; padding: .3rem 0 } .scroll { overflow-x: auto; margin: 1rem 0 }
th, td { padding: .3rem .7rem; text-align: right; border: 1px solid #dde2e6 }
th:first-child, td:first-child { text-align: left } th { background: #eef1f3 }
footer { margin-top: 3rem; color: #5b6b78; font-size: .85rem }
"""


def write_page(comparison: Comparison, scene: Scene, truth: RadioMap, folder: Path) -> None:
    """Write `report.html` from the figures that lie in `folder` already.

    Args:
        comparison: its tables are shown.
        scene, truth: facts of them are told.
        folder: of the demonstration.
    """
    parts = [f"<h1>A radio twin of {html.escape(scene.config.name)}</h1>", _lead(comparison)]
    parts += [_table(*table) for table in comparison.tables()]
    for name, title, text in FIGURES:
        if (folder / name).is_file():
            data = base64.b64encode((folder / name).read_bytes()).decode()
            parts.append(f'<h2>{title}</h2><p>{text}</p><img alt="{title}" src="data:image/png;base64,{data}">')
    parts.append(f"<footer>{html.escape(_facts(scene, truth))}</footer>")
    page = (f'<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
            f"<title>radiotwin: {html.escape(scene.config.name)}</title><style>{STYLE}</style>"
            f"<main>{''.join(parts)}</main></html>")
    with atomic_path(folder / "report.html") as temporary:
        temporary.write_text(page, encoding="utf-8")


def _lead(comparison: Comparison) -> str:
    """The result in a sentence, whichever way it comes out."""
    rmse = comparison.scores.query("against == 'whole map' and positions == 'estimated' and links == 'all'")
    rmse = rmse.set_index("model")["rmse_db"]
    where = comparison.location_summary().set_index("model")["median_m"]
    return (f'<p class="lead">Learned from a few flights, the twin predicts the gain over the whole map with an error '
            f"of {rmse['segmented_nn']:.1f} dB (log-distance model: {rmse['log_distance']:.1f} dB) and finds the "
            f"unknown devices to {where['segmented_nn']:.1f} m in the median (log-distance model: "
            f"{where['log_distance']:.1f} m).</p>")


def _table(title: str, columns: dict[str, str], rows: list[list]) -> str:
    def text(cell) -> str:
        if isinstance(cell, float):
            return "–" if cell != cell else f"{cell:.2f}"
        return html.escape(str(cell))
    head = "".join(f"<th>{html.escape(column)}</th>" for column in columns)
    body = "".join(f"<tr>{''.join(f'<td>{text(cell)}</td>' for cell in row)}</tr>" for row in rows)
    return f'<div class="scroll"><table><caption>{html.escape(title)}</caption><tr>{head}</tr>{body}</table></div>'


def _facts(scene: Scene, truth: RadioMap) -> str:
    attributes = truth.dataset.attrs
    facts = [f"scene {scene.config.provenance.get('source', '')}",
             f"{scene.config.radio.frequency_hz / 1e9:g} GHz"]
    facts += [f"{name} {attributes[name]}" for name in ("sionna_rt_version", "radiotwin_version", "samples_per_src",
                                                        "max_depth", "combining", "noise_floor_db")
              if name in attributes]
    return " · ".join(facts)
