"""Make the part of a run's page on a comparison of models."""

from pathlib import Path
from typing import Any

from radiotwin.compare import Comparison
from radiotwin.report.html import Table, read_picture

FIGURES = (
    ("maps.png", "One device: truth, twin and log-distance model",
     "Gain of the truth, of the learned twin and of the log-distance model, and the differences."),
    ("scatter.png", "Held-out flights",
     "Predicted over measured gain of every detected link of flights that no model was fitted to."),
    ("estimates.png", "Positions of the unknown devices",
     "Estimates by the log-distance model and by the twin; a circle contains 90 % of the "
     "posterior."),
)


def comparison_context(comparison: Comparison, folder: Path) -> dict[str, Any]:
    """Collect the variables of the template `comparison_sections.html`.

    Args:
        comparison: scores and located devices.
        folder: of the figures.
    """
    pictures = [read_picture(folder, name, title, text) for name, title, text in FIGURES]
    return {"lead": _summary(comparison),
            "tables": [Table(list(columns), rows, title)
                       for title, columns, rows in comparison.tables()],
            "figures": [picture for picture in pictures if picture]}


def _summary(comparison: Comparison) -> str:
    """Summarise the result in a sentence; empty without a whole map to compare on."""
    scores = comparison.scores.query(
        "against == 'whole map' and positions == 'estimated' and links == 'all'")
    rmse_db = scores.set_index("model")["rmse_db"]
    located = comparison.location_summary().set_index("model")
    if not {"segmented_nn", "log_distance"} <= set(rmse_db.index) & set(located.index):
        return ""
    median_m = located["median_m"]
    return ("Fitted to a few flights, the twin predicts the gain over the whole map with an RMSE "
            f"of {rmse_db['segmented_nn']:.1f} dB (log-distance model: "
            f"{rmse_db['log_distance']:.1f} dB) and locates the unknown devices with a median "
            f"error of {median_m['segmented_nn']:.1f} m (log-distance model: "
            f"{median_m['log_distance']:.1f} m).")
