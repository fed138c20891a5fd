"""Settings of a coverage prediction; noise, interference, rate and location probability."""

from dataclasses import dataclass, field

import numpy as np
from scipy.constants import Boltzmann
from scipy.special import ndtr

from radiotwin.errors import BadInput

Bounds = tuple[float, float, float, float]
MIN_STEP_M = 0.01
REFERENCE_K = 290.0  # reference temperature of noise figures (ITU-R P.372-16, Sec. 2)
LEAKAGE_CHANNELS = 2  # adjacent channels on each side that a transmitter leaks into


@dataclass(frozen=True)
class RateModel:
    """Rate of a link as a function of SINR: the attenuated and truncated Shannon bound.

    The rate over bandwidth is 0 below `min_sinr_db`, else the smaller of `max_bps_hz` and
    `share` log2(1 + SINR) (3GPP TR 36.942, Annex A.1; the defaults are those of its Table A.1 for
    the downlink of LTE).

    Attributes:
        share: fraction of Shannon's bound that an implementation reaches.
        min_sinr_db: SINR below which nothing is received [dB].
        max_bps_hz: spectral efficiency of the highest modulation and code rate [bit/s/Hz].
    """

    share: float = 0.6
    min_sinr_db: float = -10.0
    max_bps_hz: float = 4.4


@dataclass(frozen=True)
class CoverageSettings:
    """Settings of a coverage prediction.

    Attributes:
        height_m: height of the receivers above the ground [m]; with a radio map, one of its
            altitudes. None: 1.5 m, or the map's lowest altitude.
        step_m: side of a cell [m]; None: 5 m, or the map's.
        extent_m: (x_min, x_max, y_min, y_max) [m]; None: that of the scene, or of the map.
        tx_power_dbm: default transmit power [dBm]; None: that of the scene.
        bandwidth_hz: None: that of the scene.
        noise_figure_db: of the receivers [dB]; None: derived from the scene's noise_dbm.
        load: default share of the time that a transmitter is active, 0 to 1.
        threshold_dbm: received power that the service requires [dBm].
        classes_dbm: lower ends of the legend's classes of received power, descending [dBm].
        reliability: share of the locations in a cell that must reach the threshold.
        indoor_loss_db: loss into buildings [dB]; None: cells inside buildings are left out.
        aclr_db: adjacent-channel leakage ratio of the transmitters [dB]; 45 dB is required of base
            stations of LTE and NR (3GPP TS 36.104, Sec. 6.6.2; TS 38.104, Sec. 6.6.3).
        rate: rate by SINR.
    """

    height_m: float | None = None
    step_m: float | None = None
    extent_m: Bounds | None = None
    tx_power_dbm: float | None = None
    bandwidth_hz: float | None = None
    noise_figure_db: float | None = None
    load: float = 1.0
    threshold_dbm: float = -105.0
    classes_dbm: tuple[float, ...] = (-75.0, -85.0, -95.0, -105.0, -115.0)
    reliability: float = 0.9
    indoor_loss_db: float | None = None
    aclr_db: float = 45.0
    rate: RateModel = field(default_factory=RateModel)

    def check(self) -> None:
        """Raise BadInput if a value is outside its allowed range."""
        ranges = (
            ("height", self.height_m, 0.01, 1e5, "m"),
            ("step", self.step_m, MIN_STEP_M, 1e5, "m"),
            ("transmit power", self.tx_power_dbm, -100.0, 100.0, "dBm"),
            ("bandwidth", self.bandwidth_hz, 1.0, 450e9, "Hz"),
            ("noise figure", self.noise_figure_db, 0.0, 60.0, "dB"),
            ("load", self.load, 0.0, 1.0, ""),
            ("threshold", self.threshold_dbm, -250.0, 100.0, "dBm"),
            ("reliability", self.reliability, 0.5, 0.999, ""),
            ("indoor loss", self.indoor_loss_db, 0.0, 200.0, "dB"),
            ("adjacent-channel leakage ratio", self.aclr_db, 0.0, 200.0, "dB"),
            ("share of Shannon's bound", self.rate.share, 1e-3, 1.0, ""),
            ("least SINR", self.rate.min_sinr_db, -50.0, 50.0, "dB"),
            ("greatest spectral efficiency", self.rate.max_bps_hz, 1e-3, 100.0, "bit/s/Hz"))
        for name, value, low, high, unit in ranges:
            if value is not None and not low <= value <= high:
                given, least, greatest = (f"{each:g} {unit}".rstrip() for each in
                                          (value, low, high))
                raise BadInput(f"a {name} of {given} is not possible; allowed are {least} to "
                               f"{greatest}")
        classes = np.asarray(self.classes_dbm, dtype=float)
        if not (1 <= len(classes) <= 20 and (np.abs(classes) <= 250).all()
                and (np.diff(classes) < 0).all()):
            raise BadInput(f"classes of {', '.join(f'{each:g}' for each in classes)} dBm are not "
                           "possible; give up to 20 levels in descending order, such as "
                           "-75,-85,-95")
        if self.extent_m is not None:
            x_min, x_max, y_min, y_max = self.extent_m
            if not (np.isfinite(self.extent_m).all() and x_min < x_max and y_min < y_max):
                raise BadInput(f"an extent of x {x_min:g} to {x_max:g} m, y {y_min:g} to {y_max:g} "
                               "m is not possible; the minimum must be below the maximum")


def thermal_noise_dbm(bandwidth_hz: float) -> float:
    """Return the thermal noise power k T0 B [dBm] of a receiver's bandwidth [Hz]."""
    return float(10 * np.log10(Boltzmann * REFERENCE_K * bandwidth_hz / 1e-3))


def rate_bps(sinr_db: np.ndarray, bandwidth_hz: float, model: RateModel) -> np.ndarray:
    """Return the rate of links of any shape [bit/s], see `RateModel`; 0 where the SINR is NaN."""
    with np.errstate(invalid="ignore"):
        bound = model.share * np.log2(1 + 10 ** (sinr_db / 10))
        usable = sinr_db >= model.min_sinr_db
    return bandwidth_hz * np.where(usable, np.minimum(bound, model.max_bps_hz), 0.0)


def location_probability(power_dbm: np.ndarray, sd_db: np.ndarray,
                         threshold_dbm: float) -> np.ndarray:
    """Return the probability that log-normal received power reaches a threshold [dBm].

    The median power [dBm] and its standard deviation [dB] have any one shape. The result is 0 if
    nothing is detected (NaN), and NaN if the standard deviation is unknown.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        certain = np.where(power_dbm >= threshold_dbm, 1.0, 0.0)
        share = np.where(sd_db > 0, ndtr((power_dbm - threshold_dbm) / sd_db), certain)
    share = np.where(np.isnan(power_dbm), 0.0, share)
    return np.where(np.isnan(sd_db) & ~np.isnan(power_dbm), np.nan, share)


def channel_overlap(frequencies_hz: np.ndarray, bandwidth_hz: float,
                    aclr_db: float) -> np.ndarray:
    """Return the share of a transmitter's power that falls into a receiver's channel.

    The transmitter's power density is flat within its channel, and lower by the leakage ratio in
    the two adjacent channels on each side. The receiver's filter passes its whole channel and
    nothing else. Of centre frequencies (f,) [Hz], rows of the result (f, f) are receivers, columns
    transmitters.
    """
    offset = np.abs(frequencies_hz[:, None] - frequencies_hz) / bandwidth_hz
    inside = np.clip(1 - offset, 0, 1)
    near = np.clip(LEAKAGE_CHANNELS + 1 - offset, 0, 1)  # within the channel or adjacent ones
    return inside + (near - inside) * 10 ** (-aclr_db / 10)


class ServerTally:
    """Best server and interference at n receivers, updated as transmitters are added.

    Every transmitter but the best server interferes, with its power times its load times the share
    that falls into the server's channel. The best server's `power_dbm`, `sd_db` and row `server`
    (n,) are NaN, NaN and -1 where nothing is detected.

    Args:
        n: number of receivers.
        overlap: (f, f) share of power from channel to channel, see `channel_overlap`.
    """

    def __init__(self, n: int, overlap: np.ndarray) -> None:
        self.power_dbm = np.full(n, np.nan)
        self.sd_db = np.full(n, np.nan)
        self.server = np.full(n, -1, dtype=np.int32)
        self._overlap = overlap
        self._channel = np.zeros(n, dtype=np.int64)
        self._load = np.zeros(n)
        self._others_mw = np.zeros((len(overlap), n))

    def add(self, row: int, power_dbm: np.ndarray, sd_db: np.ndarray | float, load: float,
            channel: int) -> None:
        """Add a transmitter: make it the best server where it is strongest, else interference.

        Its received power is (n,) [dBm], NaN if not detected; `channel` is its row in `overlap`.
        """
        detected = np.isfinite(power_dbm)
        best = detected & ((self.server < 0) | (power_dbm > self.power_dbm))
        replaced = np.flatnonzero(best & (self.server >= 0))
        self._others_mw[self._channel[replaced], replaced] += (
            self._load[replaced] * 10 ** (self.power_dbm[replaced] / 10))
        interfering = detected & ~best
        self._others_mw[channel, interfering] += load * 10 ** (power_dbm[interfering] / 10)
        self.power_dbm[best] = power_dbm[best]
        self.sd_db[best] = np.broadcast_to(sd_db, best.shape)[best]
        self.server[best], self._load[best], self._channel[best] = row, load, channel

    def sinr_db(self, noise_dbm: float) -> np.ndarray:
        """Return the SINR (n,) [dB] of the best server (NaN: none), for a noise power [dBm]."""
        others_mw = np.einsum("nf,fn->n", self._overlap[self._channel], self._others_mw)
        return self.power_dbm - 10 * np.log10(10 ** (noise_dbm / 10) + others_mw)
