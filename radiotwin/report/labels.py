"""The common look of pages and figures: printed names and numbers, colours, canvas, PNG files."""

import io
import re
from collections.abc import Mapping
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from radiotwin.effects.registry import LAST_RESORTS, catalogue, effects_named
from radiotwin.geo import to_geographic
from radiotwin.io.files import atomic_file
from radiotwin.io.forms import Origin
from radiotwin.io.texts import moment
from radiotwin.maps.radiomap import RadioMap
from radiotwin.scene import Scene
from radiotwin.scene.streets import CREDIT
from radiotwin.twin.model.correlated_shadowing import NAME as SHADOWING

VARIABLES = {  # label and unit
    "distance_m": ("distance", "m"), "elevation_deg": ("elevation at the device", "°"),
    "azimuth_deg": ("azimuth at the device", "° from north"),
    "body_azimuth_deg": ("direction of arrival", "° from the heading"),
    "heading_deg": ("heading of the receiver", "° from north"),
    "time_in_flight_s": ("time in flight", "s"), "time_s": ("time", "s"),
    "flight": ("flight", ""), "altitude_m": ("receiver altitude", "m"),
    "receiver": ("receiver", ""), "device": ("device", ""), "los": ("line of sight", ""),
    "predicted_level_db": ("predicted level", "dB"),
    "metres_inside_m": ("path length inside buildings", "m"),
    "diffraction_parameter": ("diffraction parameter", ""), "quality": ("quality", ""),
    "place_of_ray": ("position of the link's midpoint", ""),
    "place_of_receiver": ("receiver position", ""),
}
PARAMETERS = {  # of any effect; what only one has, is in its `parameter_labels`
    "x_m": "x, east", "y_m": "y, north", "turn_deg": "orientation", "offset_db": "offset",
    "gain_db": "gain", "azimuth_deg": "boresight", "front_to_back_db": "front-to-back ratio",
    "tilt_deg": "tilt", "vertical_beamwidth_deg": "vertical beamwidth",
    "beamwidth_deg": "beamwidth",
    "specific_attenuation_db_km": "specific attenuation",
    "specific_attenuation_db_m": "specific attenuation", "greatest_loss_db": "maximum loss",
    "scattered_db": "scattered power, relative to free space", "length_m": "length",
    "width_m": "width", "height_m": "height", "share": "share that belongs to places",
    "receiver_share": "share that belongs to a receiver", "sigma_db": "standard deviation",
}
SUFFIXES = {"_db_km": "dB/km", "_db_m": "dB/m", "_deg": "°", "_db": "dB", "_dbm": "dBm",
            "_m": "m", "_s": "s"}
MODELS = {"log_distance": "log-distance", "segmented_log_distance": "segmented log-distance",
          "segmented_nn": "segmented NN", "kriging": "kriging",
          "regression_kriging": "kriging",
          "extra_trees": "extra trees", "hist_gradient_boosting": "gradient boosting",
          "trees_of_levels": "extra trees, blanks included",
          "boosting_of_levels": "gradient boosting, blanks included",
          "tr36777_uma": "TR 36.777 UMa", "tr36777_umi": "TR 36.777 UMi",
          "al_hourani_suburban": "Al-Hourani suburban", "al_hourani_urban": "Al-Hourani urban",
          "al_hourani_dense_urban": "Al-Hourani dense urban",
          "al_hourani_high_rise": "Al-Hourani high-rise", "p1411": "ITU-R P.1411",
          "cost231_wi": "COST 231 W-I"}
NAMES = MODELS | {"log_distance": "log-distance law", "raytrace": "ray tracer"}
LOS_COLOUR, NLOS_COLOUR = "#2a7f9e", "#d1495b"
BEFORE, AFTER, FITTED, FOUND = "#c2571a", "#1f6f8b", "#22272c", "#7a0177"
DPI = 110
DATES_S = 1e9, 4e9  # times from 2001 to 2096; no other number of seconds is as large


def name_label(name: str) -> str:
    """Return the printed name of an effect or a base: `receiver_drift` -> `receiver drift`."""
    return NAMES.get(name, name.replace("_", " "))


def apart(kind: str, name: str) -> str:
    """Put a name in quotes if it is the word for its kind: a device "device" becomes `'device'`."""
    return f"'{name}'" if name.lower() == kind else name


def source_label(radio_map: RadioMap) -> str:
    """Return what made a radio map: `twin:segmented_nn` -> `segmented NN`."""
    source = str(radio_map.dataset.attrs.get("source", "no source given"))
    return name_label(source.removeprefix("twin:"))


def interpolations() -> frozenset[str]:
    """Return the names of effects that interpolate the residual and explain nothing."""
    found = (each.name for each in (*catalogue(), *LAST_RESORTS)
             if not each.is_cause and not each.is_declared)
    return frozenset({SHADOWING, *found})


def effect_picture(rank: int, name: str) -> str:
    """Return the file name of an effect's figure, in safe characters."""
    return f"effect_{rank}_{re.sub(r'[^A-Za-z0-9_.-]', '_', name)[:100]}.png"


def variable_label(name: str) -> tuple[str, str]:
    """Return label and unit of a variable, from its name if it is not in `VARIABLES`."""
    if name in VARIABLES:
        return VARIABLES[name]
    stem, unit = _split_unit(name)
    return stem.replace("_", " "), unit


def parameter_labels(effect: str) -> dict[str, str]:
    """Return `PARAMETERS` with the labels that an effect declares for its own parameters."""
    return PARAMETERS | {name: label for each in reversed(effects_named(effect))
                         for name, label in each.parameter_labels.items()}


def parameter_label(name: str, labels: Mapping[str, str] = PARAMETERS) -> str:
    """Return a parameter's label with its device or receiver: `tilt_deg[uav1]` -> `tilt (uav1)`.

    Args:
        name: as `closeloop.json` has it.
        labels: by parameter without the brackets, see `parameter_labels`.
    """
    stem, bracket, member = name.partition("[")
    label = labels.get(stem) or _split_unit(stem)[0].replace("_", " ")
    return f"{label} ({member.removesuffix(']')})" if bracket else label


def join_names(names: list[str]) -> str:
    """Join names as `a, b and c`, each once; no names become "no variable"."""
    names = list(dict.fromkeys(names))
    if not names:
        return "no variable"
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]


def number(value: float | None) -> str:
    """Format a number: two decimals; int or from 1000: none; below 0.1: two digits; None: dash."""
    if value is None:
        return "–"
    if isinstance(value, int):
        text = f"{value:,}"
    elif 0.005 <= abs(value) < 0.1:
        text = f"{value:.2g}"
    else:
        text = f"{value:.2f}" if abs(value) < 1000 else f"{value:,.0f}"
    return "0.00" if text == "-0.00" else text.replace("-", "−")


def quantity(value: float | None, unit: str) -> str:
    """Return the number of a parameter, a small one with two digits; times since 1970 are dates."""
    if value is not None and unit == "s" and DATES_S[0] < value < DATES_S[1]:
        return moment(value)
    if value is None or not 0 < abs(value) < 0.005:
        return number(value)
    return f"{value:.2g}".replace("-", "−")


def two_digits(value: float) -> str:
    """Round a number to two significant digits: 110 for 106.2."""
    return f"{float(f'{value:.2g}'):,.10g}"


def signed(value: float, digits: int = 1) -> str:
    """Return a number with this many decimals; 0 has no sign."""
    text = f"{value:,.{digits}f}"
    return text.removeprefix("-") if not float(text.replace(",", "")) else text.replace("-", "−")


def origin_of(report: dict) -> Origin | None:
    """Return the origin of the local frame in a `closeloop.json`; None if it has none."""
    origin = (report.get("inputs") or {}).get("origin")
    return Origin(**origin) if origin else None


def place_words(x_m: float, y_m: float, origin: Origin | None) -> str:
    """Return a place as latitude and longitude, or as x and y [m] if the origin is not known."""
    if origin is None:
        return f"x {signed(x_m, 0)} m, y {signed(y_m, 0)} m"
    longitude_deg, latitude_deg = (float(each) for each in to_geographic(origin, x_m, y_m))
    return (f"{abs(latitude_deg):.5f}° {'NS'[latitude_deg < 0]}, "
            f"{abs(longitude_deg):.5f}° {'EW'[longitude_deg < 0]}")


def attribution(scene: Scene) -> str:
    """Return the credit that a scene's map requires (OpenStreetMap); else empty."""
    source = scene.config.provenance.get("source", "").lower()
    return CREDIT if source.endswith((".osm", ".osm.pbf")) else ""


def probability(value: float | None) -> str:
    """Return a probability with two decimals, between "< 0.01" and "> 0.99"."""
    if value is None:
        return "–"
    return "> 0.99" if value > 0.99 else "< 0.01" if value < 0.01 else f"{value:.2f}"


def _split_unit(name: str) -> tuple[str, str]:
    """Split a name into stem and unit by its suffix: `time_s` -> `time`, `s`."""
    for suffix, unit in SUFFIXES.items():
        if name.endswith(suffix) and name != suffix:
            return name.removesuffix(suffix), unit
    return name, ""


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure that is drawn without a screen; sizes in inches."""
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save(figure: Figure, path: Path | str) -> None:
    """Write a figure as a PNG file, completely or not at all."""
    data = io.BytesIO()  # Pillow hides why a write to a file failed
    figure.savefig(data, dpi=DPI, format="png", metadata={"Software": "radiotwin"})
    with atomic_file(path) as file:
        file.write(data.getbuffer())


def hide_spines(ax: Axes) -> None:
    """Draw the axes on two sides only."""
    ax.spines[["top", "right"]].set_visible(False)

