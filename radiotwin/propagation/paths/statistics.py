"""Figures of a link's paths: spreads of delay, angle and Doppler, K factor, impulse response.

Paths are ragged: arrays of all paths, and the row of the link that each belongs to.
"""

import numpy as np

EDGE_TAPS = 16  # before the first and after the last path: a path between two taps rings that long


def sums(values: np.ndarray, link: np.ndarray, links: int) -> np.ndarray:
    """Return the sum (links,) of real or complex values (p,) over the paths of each link.

    Args:
        values: (p,) of the paths.
        link: (p,) row of each path's link.
        links: number of links.
    """
    if np.iscomplexobj(values):
        return sums(values.real, link, links) + 1j * sums(values.imag, link, links)
    return np.bincount(link, weights=values, minlength=links)


def rms_spread(values: np.ndarray, power: np.ndarray, link: np.ndarray, links: int) -> np.ndarray:
    """Return the power-weighted standard deviation of a quantity over the paths of each link.

    Of delays this is the RMS delay spread (Rappaport, "Wireless Communications", 2nd ed., 2002, eq.
    5.35), of Doppler shifts the RMS Doppler spread.

    Args:
        values: (p,) of the paths.
        power: (p,) linear.
        link: (p,) row of each path's link.
        links: number of links.

    Returns:
        (links,) in the unit of `values`; NaN where there is no path.
    """
    total = sums(power, link, links)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = sums(power * values, link, links) / total
        return np.sqrt(sums(power * (values - mean[link]) ** 2, link, links) / total)


def angular_spread_deg(angle_rad: np.ndarray, power: np.ndarray, link: np.ndarray, links: int
                       ) -> np.ndarray:
    """Return the circular angular spread of each link (3GPP TR 38.901, Annex A.1).

    Args:
        angle_rad: (p,) azimuths or zeniths [rad].
        power: (p,) linear.
        link: (p,) row of each path's link.
        links: number of links.

    Returns:
        (links,) [degrees]; NaN where there is no path.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        resultant = np.abs(sums(power * np.exp(1j * angle_rad), link, links)) \
            / sums(power, link, links)
        return np.degrees(np.sqrt(-2 * np.log(np.clip(resultant, 1e-300, 1))))


def k_factor_db(power: np.ndarray, direct: np.ndarray, link: np.ndarray, links: int) -> np.ndarray:
    """Return the power of the direct path over that of all others [dB].

    Args:
        power: (p,) linear.
        direct: (p,) bool: the path has no interaction.
        link: (p,) row of each path's link.
        links: number of links.

    Returns:
        (links,); NaN where there is no direct path, or no other.
    """
    first, rest = sums(power * direct, link, links), sums(power * ~direct, link, links)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where((first > 0) & (rest > 0), 10 * np.log10(first / rest), np.nan)


def doppler_hz(arrival: np.ndarray, velocity_m_s: np.ndarray, wavelength_m: float) -> np.ndarray:
    """Return the Doppler shifts (p,) of paths to a moving receiver, positive where it approaches.

    Args:
        arrival: (p, 3) unit vectors from the receiver along the paths.
        velocity_m_s: (3,) of the receiver [m/s].
        wavelength_m: of the carrier [m].
    """
    return arrival @ velocity_m_s / wavelength_m


def tap_count(excess_s: np.ndarray, bandwidth_hz: float) -> int:
    """Return the number of taps that hold paths of these excess delays, (p,) [s]."""
    return 2 * EDGE_TAPS + 1 + int(np.ceil(float(excess_s.max(initial=0.0)) * bandwidth_hz))


def impulse_response(amplitude: np.ndarray, excess_s: np.ndarray, link: np.ndarray, links: int,
                     bandwidth_hz: float, taps: int) -> np.ndarray:
    """Return the band-limited impulse response of each link, sampled at the bandwidth.

    Tap l of an ideal low-pass is the sum of a sinc(l - B τ) over the paths (Tse and Viswanath,
    "Fundamentals of Wireless Communication", 2005, eq. 2.34). Tap `EDGE_TAPS` is at the excess
    delay 0; those before and after hold the ringing of the low-pass.

    Args:
        amplitude: (p,) complex, with the phase of the carrier over the whole delay.
        excess_s: (p,) delays after the link's first path [s].
        link: (p,) row of each path's link, ascending.
        links: number of links.
        bandwidth_hz: B [Hz].
        taps: number of taps, see `tap_count`.

    Returns:
        (links, taps) complex.
    """
    response = np.zeros((links, taps), dtype=complex)
    at = np.arange(taps) - EDGE_TAPS
    bounds = np.searchsorted(link, np.arange(links + 1))
    for row, (first, end) in enumerate(zip(bounds[:-1], bounds[1:])):
        shape = np.sinc(at - bandwidth_hz * excess_s[first:end, None])
        response[row] = amplitude[first:end] @ shape
    return response
