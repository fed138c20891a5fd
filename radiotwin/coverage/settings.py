"""Settings of a coverage prediction."""

from dataclasses import dataclass, field

import numpy as np

from radiotwin.errors import BadInput

Bounds = tuple[float, float, float, float]
MIN_STEP_M = 0.01


@dataclass(frozen=True)
class RateModel:
    """Rate of a link by its SINR: the attenuated and truncated Shannon bound.

    The rate over bandwidth is 0 below `min_sinr_db`, else the smaller of `max_bps_hz` and
    `share` log2(1 + SINR) (3GPP TR 36.942, Annex A.1; the defaults are those of its Table A.1 for
    the downlink of LTE).

    Attributes:
        share: of Shannon's bound that an implementation reaches.
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
        height_m: height of the receivers above the ground [m]; of a radio map, the one of its
            altitudes to use. None: 1.5 m, or the map's lowest altitude.
        step_m: side of a cell [m]; None: 5 m, or the map's.
        extent_m: (x_min, x_max, y_min, y_max) [m]; None: that of the scene, or of the map.
        tx_power_dbm: of transmitters that declare none [dBm]; None: that of the scene.
        bandwidth_hz: None: that of the scene.
        noise_figure_db: of the receivers [dB]; None: that which the scene's noise_dbm implies.
        load: share of the time that transmitters which declare none are active, 0 to 1.
        threshold_dbm: received power that the service needs [dBm].
        classes_dbm: lower ends of the legend's classes of received power, descending [dBm].
        reliability: share of the locations in a cell that must reach the threshold.
        indoor_loss_db: loss into buildings [dB]; None: cells inside buildings are left out.
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
    rate: RateModel = field(default_factory=RateModel)

    def check(self) -> None:
        """Raise BadInput for an impossible value."""
        limits = (
            ("height", self.height_m, 0.01, 1e5, "m"),
            ("step", self.step_m, MIN_STEP_M, 1e5, "m"),
            ("transmit power", self.tx_power_dbm, -100.0, 100.0, "dBm"),
            ("bandwidth", self.bandwidth_hz, 1.0, 450e9, "Hz"),
            ("noise figure", self.noise_figure_db, 0.0, 60.0, "dB"),
            ("load", self.load, 0.0, 1.0, ""),
            ("threshold", self.threshold_dbm, -250.0, 100.0, "dBm"),
            ("reliability", self.reliability, 0.5, 0.999, ""),
            ("indoor loss", self.indoor_loss_db, 0.0, 200.0, "dB"),
            ("share of Shannon's bound", self.rate.share, 1e-3, 1.0, ""),
            ("least SINR", self.rate.min_sinr_db, -50.0, 50.0, "dB"),
            ("greatest spectral efficiency", self.rate.max_bps_hz, 1e-3, 100.0, "bit/s/Hz"))
        for name, value, low, high, unit in limits:
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
