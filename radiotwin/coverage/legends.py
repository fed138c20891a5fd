"""Classes of the rasters, with the labels and colours that maps, overlays and vectors share."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_hex

from radiotwin.coverage.areas import class_lists
from radiotwin.coverage.run import Coverage

BELOW_COLOUR = "#c9c9c9"
SERVER_COLOURS = "tab20"
GREYS = 14, 15  # of these: a building is grey
# Title, unit in labels, factor from the raster's unit to it, colours from bad to good.
_RASTERS: dict[str, tuple[str, str, float, str]] = {
    "received_power_dbm": ("Received power", "dBm", 1.0, "RdYlGn"),
    "sinr_db": ("SINR", "dB", 1.0, "RdYlGn"),
    "snr_db": ("SNR", "dB", 1.0, "RdYlGn"),
    "rate_bps": ("Rate of one user", "Mbit/s", 1e-6, "viridis"),
    "coverage_probability": ("Probability of coverage", "%", 100.0, "RdYlGn")}


@dataclass(frozen=True, eq=False)
class Legend:
    """Classes of a raster.

    Attributes:
        title: of the raster.
        lower: (k,) lower end of each class but the last, descending; empty for servers.
        labels: of each class, the best first; the last is what lies below all.
        colours: of each class, `#rrggbb`.
    """

    title: str
    lower: tuple[float, ...]
    labels: tuple[str, ...]
    colours: tuple[str, ...]

    def classes(self, values: np.ndarray) -> np.ndarray:
        """Return the class of each value, -1 for NaN.

        Args:
            values: any shape; numbers of servers where there are no lower ends.
        """
        if not self.lower:
            return values.astype(np.int32)
        ends = np.asarray(self.lower[::-1], dtype=float)
        found = len(ends) - np.searchsorted(ends, np.nan_to_num(values), side="right")
        return np.where(np.isnan(values), -1, found).astype(np.int32)


def legend_of(name: str, coverage: Coverage) -> Legend:
    """Return the classes of a raster.

    Args:
        name: of a variable of `Coverage.dataset`, one of `drawn_rasters`.
        coverage: of the network.
    """
    if name == "best_server":
        palette = colormaps[SERVER_COLOURS].colors  # type: ignore[attr-defined]
        both = [*range(0, len(palette), 2), *range(1, len(palette), 2)]  # strong before pale
        order = [each for each in both if each not in GREYS]
        names = [each.name for each in coverage.transmitters]
        colours = [to_hex(palette[order[row % len(order)]]) for row in range(len(names))]
        return Legend("Best server", (), tuple(names), tuple(colours))
    title, unit, factor, colours_name = _RASTERS[name]
    lower = class_lists(coverage.settings, coverage.dataset.attrs["bandwidth_hz"])[name]
    shown = [f"{each * factor:.4g}".replace("-", "−") for each in lower]
    if name == "coverage_probability":
        title += f", received power ≥ {_text(coverage.settings.threshold_dbm)} dBm"
    shades = colormaps[colours_name](np.linspace(0.95, 0.05, len(lower)))
    return Legend(title, lower, (*(f"≥ {each} {unit}" for each in shown), f"< {shown[-1]} {unit}"),
                  (*map(to_hex, shades), BELOW_COLOUR))


def drawn_rasters(coverage: Coverage) -> Sequence[str]:
    """Return the names of the rasters that are drawn, in their order."""
    return [name for name in ("received_power_dbm", "best_server", "sinr_db", "rate_bps",
                              "coverage_probability") if name in coverage.dataset]


def file_stem(name: str) -> str:
    """Return the name of a raster's files.

    >>> file_stem("received_power_dbm")
    'received_power'
    """
    for ending in ("_dbm", "_db", "_bps"):
        name = name.removesuffix(ending)
    return name


def _text(value: float) -> str:
    return f"{value:g}".replace("-", "−")
