"""Names of variables, effects and parameters as a reader says them."""

VARIABLES = {
    "distance_m": ("distance", "m"), "elevation_deg": ("elevation at the device", "°"),
    "azimuth_deg": ("azimuth at the device", "° from north"),
    "body_azimuth_deg": ("direction of arrival", "° from the heading"),
    "heading_deg": ("heading of the receiver", "° from north"),
    "time_in_flight_s": ("time in the flight", "s"), "time_s": ("time", "s"), "flight": ("flight", ""),
    "altitude_m": ("altitude of the receiver", "m"), "receiver": ("receiver", ""), "device": ("device", ""),
    "los": ("line of sight", ""), "predicted_level_db": ("predicted level", "dB"),
    "metres_inside_m": ("way through buildings", "m"), "diffraction_parameter": ("diffraction parameter", ""),
    "quality": ("quality", ""),
    "place_of_ray": ("the place that a link passes over", ""), "place_of_receiver": ("the receiver's place", ""),
}
PARAMETERS = {
    "x_m": "x, east", "y_m": "y, north", "turn_deg": "turned by", "offset_db": "offset", "gain_db": "gain",
    "warm_up_db": "too much at switch-on", "warm_up_each_flight_db": "too much at take-off",
    "ageing_db": "change from first to last", "step_db": "step", "step_time_s": "time of the step",
    "time_constant_s": "time constant", "azimuth_deg": "boresight", "front_to_back_db": "front-to-back ratio",
    "tilt_deg": "tilt", "vertical_beamwidth_deg": "vertical beamwidth", "beamwidth_deg": "beamwidth",
    "lean_azimuth_deg": "leans towards, from the heading", "clearest_side_deg": "clearest side, from the heading",
    "limit": "limit of detection",
    "floor": "noise floor", "saturation_level": "saturation level", "strength_db": "strength, against theory",
    "specific_attenuation_db_km": "specific attenuation", "specific_attenuation_db_m": "specific attenuation",
    "greatest_loss_db": "greatest loss", "true_minus_given_x_m": "true minus given place, east",
    "scale_height_m": "falls to 1/e at a height of", "scattered_db": "scattered, against free space",
    "strength": "strength", "roughness_m": "roughness of the ground", "ground_m": "height of the ground",
    "lost_share": "links lost", "rise_and_fall_db": "from the least to the most",
    "level_at_100_m": "level at 100 m", "length_m": "length", "width_m": "width",
    "height_m": "height", "share": "share of it", "sigma_db": "standard deviation",
    "true_minus_given_y_m": "true minus given place, north", "true_minus_given_z_m": "true minus given height",
}
UNITS = {"deg": "°"}
LAST_RESORTS = ("correlated_shadowing", "unexplained_trend")  # they fill in and explain nothing
SUFFIXES = {"_db_km": "dB/km", "_db_m": "dB/m", "_deg": "°", "_db": "dB", "_dbm": "dBm", "_m": "m", "_s": "s"}


def plainly(name: str) -> str:
    """An effect's or a model's name: `receiver_drift` -> `receiver drift`."""
    return {"log_distance": "log-distance law", "raytrace": "ray tracer"}.get(name, name.replace("_", " "))


def variable(name: str) -> tuple[str, str]:
    """A variable in words, and its unit; of one that is not listed, as its name says it."""
    if name in VARIABLES:
        return VARIABLES[name]
    stem, unit = _without_unit(name)
    return stem.replace("_", " "), unit


def parameter(name: str) -> str:
    """A parameter in words, with whom it belongs to: `tilt_deg[uav1]` -> `tilt (uav1)`."""
    stem, bracket, member = name.partition("[")
    words = PARAMETERS.get(stem) or _without_unit(stem)[0].replace("_", " ")
    return f"{words} ({member.removesuffix(']')})" if bracket else words


def listed(names: list[str]) -> str:
    """`a, b and c`, each once."""
    names = list(dict.fromkeys(names))
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1] if names else "nothing named"


def _without_unit(name: str) -> tuple[str, str]:
    for suffix, unit in SUFFIXES.items():
        if name.endswith(suffix) and name != suffix:
            return name.removesuffix(suffix), unit
    return name, ""
