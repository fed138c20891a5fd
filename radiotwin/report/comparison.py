"""The part of a page on a comparison of models."""

import html
from pathlib import Path

from radiotwin.compare import Comparison
from radiotwin.pages import image, table

FIGURES = (
    ("maps.png", "One device in three models",
     "What the truth says, what the learned twin says, what the log-distance model says, and the differences."),
    ("scatter.png", "A flight that no model has seen",
     "Predicted against measured gain of every link that was detected."),
    ("estimates.png", "Where the unknown devices are",
     "Estimates of the log-distance model and of the twin; a circle holds 90 % of the posterior."),
)


def comparison_lead(comparison: Comparison) -> str:
    """The result in a sentence, whichever way it comes out; empty where it was not judged on a whole map."""
    scores = comparison.scores.query("against == 'whole map' and positions == 'estimated' and links == 'all'")
    rmse_db, where = scores.set_index("model")["rmse_db"], comparison.location_summary().set_index("model")
    if not {"segmented_nn", "log_distance"} <= set(rmse_db.index) & set(where.index):
        return ""
    median_m = where["median_m"]
    return (f'<p class="lead">Learned from a few flights, the twin predicts the gain over the whole map with an error '
            f"of {rmse_db['segmented_nn']:.1f} dB (log-distance model: {rmse_db['log_distance']:.1f} dB) and finds the "
            f"unknown devices to {median_m['segmented_nn']:.1f} m in the median (log-distance model: "
            f"{median_m['log_distance']:.1f} m).</p>")


def comparison_sections(comparison: Comparison, folder: Path) -> list[str]:
    """Tables of a comparison, and the figures that lie in its folder."""
    parts = ["<h2>Models compared</h2>"]
    for title, columns, rows in comparison.tables():
        parts.append(table(title, list(columns), rows))
    for name, title, text in FIGURES:
        if (folder / name).is_file():
            parts.append(f"<h2>{html.escape(title)}</h2><p>{html.escape(text)}</p>{image(folder / name, title)}")
    return parts
