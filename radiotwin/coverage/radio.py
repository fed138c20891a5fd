"""Noise, interference and rate of links to the best server."""

import numpy as np
from scipy.constants import Boltzmann
from scipy.special import ndtr

from radiotwin.coverage.settings import RateModel

REFERENCE_K = 290.0  # temperature that noise figures refer to (ITU-R P.372-16, Sec. 2)


def thermal_noise_dbm(bandwidth_hz: float) -> float:
    """Return the thermal noise power k T0 B [dBm].

    Args:
        bandwidth_hz: of the receiver [Hz].
    """
    return float(10 * np.log10(Boltzmann * REFERENCE_K * bandwidth_hz / 1e-3))


def rate_bps(sinr_db: np.ndarray, bandwidth_hz: float, model: RateModel) -> np.ndarray:
    """Return the rate of links [bit/s], see `RateModel`; 0 where the SINR is NaN.

    Args:
        sinr_db: any shape [dB].
        bandwidth_hz: of the channel [Hz].
        model: rate by SINR.
    """
    with np.errstate(invalid="ignore"):
        bound = model.share * np.log2(1 + 10 ** (sinr_db / 10))
        usable = sinr_db >= model.min_sinr_db
    return bandwidth_hz * np.where(usable, np.minimum(bound, model.max_bps_hz), 0.0)


def location_probability(power_dbm: np.ndarray, sd_db: np.ndarray,
                         threshold_dbm: float) -> np.ndarray:
    """Return the probability that log-normally distributed power reaches a threshold.

    Args:
        power_dbm: median [dBm]; NaN: not detected.
        sd_db: standard deviation, same shape [dB]; NaN: not known.
        threshold_dbm: [dBm]

    Returns:
        Of the same shape; 0 where nothing is detected, NaN where the deviation is not known.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        certain = np.where(power_dbm >= threshold_dbm, 1.0, 0.0)
        share = np.where(sd_db > 0, ndtr((power_dbm - threshold_dbm) / sd_db), certain)
    share = np.where(np.isnan(power_dbm), 0.0, share)
    return np.where(np.isnan(sd_db) & ~np.isnan(power_dbm), np.nan, share)


class ServerTally:
    """Best server and interference of n receivers, while transmitters are added one by one.

    Transmitters of one frequency interfere with each other, each with its power times its load.

    Args:
        n: number of receivers.
        frequencies: number of different frequencies.
    """

    def __init__(self, n: int, frequencies: int) -> None:
        self.power_dbm = np.full(n, np.nan)
        self.sd_db = np.full(n, np.nan)
        self.server = np.full(n, -1, dtype=np.int32)
        self._frequency = np.zeros(n, dtype=np.int64)
        self._load = np.zeros(n)
        self._others_mw = np.zeros((frequencies, n))

    def add(self, row: int, power_dbm: np.ndarray, sd_db: np.ndarray | float, load: float,
            frequency: int) -> None:
        """Add a transmitter.

        Args:
            row: its number.
            power_dbm: (n,) received from it [dBm]; NaN where it is not detected.
            sd_db: (n,) standard deviation of that [dB].
            load: share of the time that it is active.
            frequency: number of its frequency.
        """
        heard = np.isfinite(power_dbm)
        best = heard & ((self.server < 0) | (power_dbm > self.power_dbm))
        beaten = np.flatnonzero(best & (self.server >= 0))
        self._others_mw[self._frequency[beaten], beaten] += (
            self._load[beaten] * 10 ** (self.power_dbm[beaten] / 10))
        weaker = heard & ~best
        self._others_mw[frequency, weaker] += load * 10 ** (power_dbm[weaker] / 10)
        self.power_dbm[best] = power_dbm[best]
        self.sd_db[best] = np.broadcast_to(sd_db, best.shape)[best]
        self.server[best], self._load[best], self._frequency[best] = row, load, frequency

    def sinr_db(self, noise_dbm: float) -> np.ndarray:
        """Return the (n,) ratio of the best server's power to noise and interference [dB].

        Args:
            noise_dbm: noise power [dBm].
        """
        others_mw = self._others_mw[self._frequency, np.arange(len(self.server))]
        return self.power_dbm - 10 * np.log10(10 ** (noise_dbm / 10) + others_mw)
