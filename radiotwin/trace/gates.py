"""Checks that every traced map must pass, and the numerical noise of a trace.

Checks that every traced map must pass before it is kept.

The numerical noise of a trace: the change of its gains when ten times the rays are sent.
"""

from dataclasses import dataclass

import numpy as np
from scipy.constants import speed_of_light

from radiotwin.errors import RunFailed


@dataclass(frozen=True)
class _Limits:
    """Limits of physics for LoS links, relative to free space.

    The power of an LoS link is that of the direct path plus that of each reflected or diffracted
    one. None of them is stronger than the direct path, as each is longer and loses power at every
    interaction; over a city there are rarely more than the ground and two walls that come close. So
    the median LoS link lies 0 to 3 dB above free space. The fields of the same paths may also
    cancel (no lower bound). The 0.5 dB below allow for numerical noise. How far one link may lie
    above free space depends on its paths: `PathGains.solve` checks it.

    Attributes:
        median_excess_db: Lowest and highest median.
        min_excess_db: Lowest gain of a link that the tracer sees in LoS.
        max_dark_share: Share of LoS links that may lie below: the map decides LoS by a ray test of
            its own, and where a ray grazes an edge the two tests may differ.
        max_dark_links: Number of such links that is accepted however small the map.
    """

    median_excess_db: tuple[float, float] = (-0.5, 3.0)
    min_excess_db: float = -0.5
    max_dark_share: float = 0.005
    max_dark_links: int = 3


_LIMITS = _Limits()


def free_space_gain_db(distance_m: np.ndarray, frequency_hz: float) -> np.ndarray:
    """Return Friis' gain between isotropic antennas (ITU-R P.525-4, eq. 4) [dB].

    Args:
        distance_m: Distances, any shape [m].
        frequency_hz: Frequency [Hz].
    """
    return 20 * np.log10(speed_of_light / (4 * np.pi * frequency_hz * np.asarray(distance_m)))


def check_gains(gain_db: np.ndarray, los: np.ndarray, distance_m: np.ndarray, frequency_hz: float,
                solver: str, combining: str, direct_dbi: np.ndarray | float = 0.0,
                peak_dbi: np.ndarray | float = 0.0) -> dict[str, float]:
    """Check raw gains against the limits of physics.

    With antennas, a link is no weaker than its direct path, and no stronger than if all its paths
    left and arrived in the directions of the antennas' peaks.

    Args:
        gain_db: (n,) gain of links [dB]; NaN: no path.
        los: (n,) bool line of sight by the 3D map.
        distance_m: (n,) lengths of the links [m].
        frequency_hz: Frequency [Hz].
        solver: As in `SolverSettings`.
        combining: As in `SolverSettings`.
        direct_dbi: (n,) gain of both antennas along the straight line [dBi].
        peak_dbi: (n,) highest gain of both antennas [dBi].

    Returns:
        Figures for the map's attributes.

    Raises:
        RunFailed: A gain above 0 dB, no path at all, or LoS links that are far from free space.
    """
    found = np.isfinite(gain_db)
    if not found.any():
        raise RunFailed(f"none of {gain_db.size} links has a path; check that the devices are "
                        "outdoors and that the lattice lies over the city, or trace with more "
                        "samples or depth")
    if np.nanmax(gain_db) > 0:
        worst = int(np.nanargmax(gain_db))
        raise RunFailed(f"a link of {distance_m[worst]:.3g} m has a gain of {gain_db[worst]:.1f} "
                        "dB: more power would arrive than was sent; is a receiver within a "
                        "wavelength of a device?")
    figures: dict[str, float] = {"links": int(gain_db.size), "links_with_path": int(found.sum()),
                                 "links_los": int(los.sum())}
    if not los.any():
        return figures
    above_db = np.where(found, gain_db, -np.inf) - free_space_gain_db(distance_m, frequency_hz)
    excess_db, peak_excess_db = (above_db - direct_dbi)[los], (above_db - peak_dbi)[los]
    median_db, highest_db = float(np.median(excess_db)), float(peak_excess_db.max())
    dark_share = float(np.mean(excess_db < _LIMITS.min_excess_db))
    figures |= {"los_excess_median_db": median_db, "los_excess_highest_db": highest_db,
                "los_below_free_space_share": dark_share}
    powers = combining == "power"
    low_db, high_db = _LIMITS.median_excess_db
    if powers and (median_db < low_db or np.median(peak_excess_db) > high_db):
        raise RunFailed(f"LoS links lie {median_db:+.1f} dB from free space in the median; "
                        f"{low_db:+.1f} to {high_db:+.1f} dB is possible: is city.xml in metres, "
                        "and its ground below the devices?")
    if (solver == "paths" and powers and dark_share > _LIMITS.max_dark_share
            and dark_share * len(excess_db) > _LIMITS.max_dark_links):
        raise RunFailed(f"{100 * dark_share:.1f} % of the links that have LoS by the 3D map are "
                        f"weaker than free space, {100 * _LIMITS.max_dark_share:.1f} % may be: the "
                        "ray tracer and the map do not see the same city")
    return figures


def noise_figures(gain_db: np.ndarray, finer_db: np.ndarray) -> dict[str, float | str]:
    """Compare two solutions of the same links.

    Args:
        gain_db: (n,) gain as in the map [dB]; NaN: not detected.
        finer_db: (n,) gain with ten times the rays [dB]; NaN: not detected.

    Returns:
        Attributes: RMS, median and 90th percentile of the difference over links detected in both,
        and the share of links detected in one only. NaN where no link is detected in both.
    """
    both = np.isfinite(gain_db) & np.isfinite(finer_db)
    difference_db = np.abs(gain_db - finer_db)[both] if both.any() else np.array([np.nan])
    return {
        "noise_floor_db": float(np.sqrt(np.mean(difference_db**2))),
        "noise_floor_median_db": float(np.median(difference_db)),
        "noise_floor_p90_db": float(np.quantile(difference_db, 0.9)),
        "noise_floor_detection_share": float(np.mean(np.isfinite(gain_db)
                                                     != np.isfinite(finer_db))),
        "noise_floor_links": int(gain_db.size),
        "noise_floor_method": "a sample of the links solved again with ten times the rays; "
                              "RMS difference over links detected in both",
    }
