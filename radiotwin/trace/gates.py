"""Checks that every traced map must pass before it is kept."""

import numpy as np
from scipy.constants import speed_of_light

from radiotwin.errors import RunFailed

# The power of an LoS link is that of the direct path plus that of each reflected or diffracted one. None of them
# is stronger than the direct path, as each is longer and loses power where it turns; over a city there are
# rarely more than the ground and two walls that come close. So the median LoS link lies 0 to 3 dB above free
# space, and none 10 dB (nine more paths as strong as the direct one). The fields of the same paths may also
# cancel (no lower bound) or add up to 20 dB.
LOS_MEDIAN_EXCESS_DB = (-0.5, 3.0)
LOS_LOWEST_EXCESS_DB = -0.5
LOS_HIGHEST_EXCESS_DB = {"power": 10.0, "coherent": 20.0}
# The map decides LoS by a ray test of its own; where a ray grazes an edge the two tests may differ.
LOS_DISAGREEMENT = 0.005
LOS_DISAGREEMENT_LINKS = 3  # so few prove nothing, however small the map


def free_space_gain_db(distance_m: np.ndarray, frequency_hz: float) -> np.ndarray:
    """Friis' gain between isotropic antennas (ITU-R P.525-4, eq. 4) [dB].

    Args:
        distance_m: distances [m], any shape.
        frequency_hz: frequency [Hz].
    """
    return 20 * np.log10(speed_of_light / (4 * np.pi * frequency_hz * np.asarray(distance_m)))


def check_gains(gain_db: np.ndarray, los: np.ndarray, distance_m: np.ndarray, frequency_hz: float,
                solver: str, combining: str, direct_dbi: np.ndarray | float = 0.0,
                peak_dbi: np.ndarray | float = 0.0) -> dict[str, float]:
    """Check raw gains against what physics allows.

    Args:
        gain_db: (n,) gain of links; NaN = no path.
        los: (n,) bool line of sight by the 3D map.
        distance_m: (n,) lengths of the links [m].
        frequency_hz: frequency [Hz].
        solver, combining: as in `SolverSettings`.
        direct_dbi, peak_dbi: (n,) what the antennas of both ends add along the straight line, and at most [dB]; zero
            where both are isotropic. A link is no weaker than its direct path, and no stronger than if all its paths
            met the antennas at their best.

    Returns:
        Figures for the map's attributes.

    Raises:
        RunFailed: a gain above 0 dB, no path at all, or LoS links that are far from free space.
    """
    found = np.isfinite(gain_db)
    if not found.any():
        raise RunFailed(f"none of {gain_db.size} links has a path; check that the devices are outdoors and that the "
                        "lattice lies over the city, or trace with more samples or depth")
    if np.nanmax(gain_db) > 0:
        worst = int(np.nanargmax(gain_db))
        raise RunFailed(f"a link of {distance_m[worst]:.3g} m has a gain of {gain_db[worst]:.1f} dB: more power would "
                        "arrive than was sent; is a receiver within a wavelength of a device?")
    figures: dict[str, float] = {"links": int(gain_db.size), "links_with_path": int(found.sum()),
                                 "links_los": int(los.sum())}
    if not los.any():
        return figures
    above_db = np.where(found, gain_db, -np.inf) - free_space_gain_db(distance_m, frequency_hz)
    excess_db, most_db = (above_db - direct_dbi)[los], (above_db - peak_dbi)[los]
    median_db, highest_db = float(np.median(excess_db)), float(most_db.max())
    too_low = float(np.mean(excess_db < LOS_LOWEST_EXCESS_DB))
    figures |= {"los_excess_median_db": median_db, "los_excess_highest_db": highest_db,
                "los_below_free_space_share": too_low}
    low_db, high_db = LOS_MEDIAN_EXCESS_DB
    bound_db = LOS_HIGHEST_EXCESS_DB[combining]
    if (median_db < low_db or np.median(most_db) > high_db) and combining == "power":
        raise RunFailed(f"LoS links lie {median_db:+.1f} dB from free space in the median; {low_db:+.1f} to "
                        f"{high_db:+.1f} dB is possible: is city.xml in metres, and its ground below the devices?")
    if solver == "paths" and highest_db > bound_db:
        raise RunFailed(f"an LoS link lies {highest_db:+.1f} dB above free space; at most {bound_db:+.1f} dB is "
                        "possible: are there surfaces in city.xml that lie on one another?")
    if solver == "paths" and combining == "power" and too_low > LOS_DISAGREEMENT \
            and too_low * len(excess_db) > LOS_DISAGREEMENT_LINKS:
        raise RunFailed(f"{100 * too_low:.1f} % of the links that have LoS by the 3D map are weaker than free space, "
                        f"{100 * LOS_DISAGREEMENT:.1f} % may be: the ray tracer and the map do not see the same city")
    return figures
