"""`antenna_pattern` of a receiver: an undeclared half-wave dipole, tilted, fixed to its body.

Far field of a half-wave dipole, cos(π/2 cos θ) / sin θ in its polar direction (Balanis, Antenna
Theory, Sec. 4.6), directivity 1.64, times the projection on the polarisation of the wave of an
upright transmitting antenna. With a 3D map each path has the gain of its direction of arrival; the
power on paths that are not followed is fitted and has the mean gain of the pattern.
"""

from typing import NamedTuple

import numpy as np
from pydantic import Field
from typing_extensions import override

from radiotwin.effects.antennas import BodyFrameEffect, report_patterns
from radiotwin.effects.arrays import MIN_NATS, squares_about_mean
from radiotwin.effects.base import ResidualView
from radiotwin.effects.params import EffectParams, Estimate, Parameter, ReceiverIndex, quantity
from radiotwin.links import Links
from radiotwin.propagation.laws.followed_paths import Rays

DIRECTIVITY = 1.64  # of a half-wave dipole (Balanis, Sec. 4.6)
MIN_GAIN = 10**-2.5  # relative to the maximum, linear: no real antenna has deeper nulls
MEAN_GAIN = 0.5  # over all directions and both polarisations
TILTS_DEG = np.arange(0.0, 60.1, 5.0)  # trial values
AZIMUTHS_DEG = np.arange(0.0, 360.0, 15.0)


class DipoleParams(EffectParams):
    """Tilt of one receiver's dipole in the body frame."""

    tilt_deg: float = quantity(0.0, unit="deg", low=0.0, high=85.0, step=4.0,
                               description="Angle between the dipole and the body's top.")
    lean_azimuth_deg: float = quantity(0.0, unit="deg", low=-720.0, high=1080.0, step=10.0,
                                       description="Side it leans to, clockwise from the nose.")
    scattered_db: float = quantity(-35.0, unit="dB", low=-80.0, high=0.0, step=6.0,
                                   description="Power on paths that are not followed.")


def dipole_gain(ray: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Compute the gain of a half-wave dipole for vertically polarised waves, linear.

    Args:
        ray: (…, 3) unit vectors towards the source of the wave; up is z.
        axis: (…, 3) unit vectors along the dipole.

    Returns:
        (…,) relative to an isotropic antenna.
    """
    cosine = np.einsum("...i,...i->...", ray, axis)
    # The electric field of the wave is in the vertical plane through the ray.
    flat = np.sqrt(np.maximum(1 - ray[..., 2] ** 2, 1e-9))
    along = (axis[..., 2] - ray[..., 2] * cosine) / flat
    field = np.cos(np.pi / 2 * cosine) / np.maximum(1 - cosine**2, 1e-6) * along
    return DIRECTIVITY * np.maximum(field**2, MIN_GAIN)


class _Arrivals(NamedTuple):
    """Rays of n links' paths at their receivers, and the receivers' body axes (n, 3, 3)."""

    rays: Rays
    axes: np.ndarray

    @classmethod
    def of(cls, links: Links, rows: np.ndarray) -> "_Arrivals":
        """Find the arrivals of some links, with paths over the map."""
        links = links.select(rows)
        return cls(Rays.of(links, of_device=False), links.receiver_axes)

    def gain_db(self, dipole: DipoleParams) -> np.ndarray:
        """Compute each link's gain (n,) by a dipole instead of an isotropic antenna [dB]."""
        axis = _axis(self.axes, dipole.tilt_deg, dipole.lean_azimuth_deg)
        gain = dipole_gain(self.rays.direction,
                           axis.astype(self.rays.direction.dtype)[self.rays.link])
        return self.rays.through_antenna_db(gain, dipole.scattered_db, MEAN_GAIN)


class TiltedDipole(BodyFrameEffect):
    """A tilted dipole for each receiver that fits better with one."""

    name = "antenna_pattern"
    acts_on = ("receiver", "direction")
    variant = "tilted dipole of a receiver"
    in_words = "tilt of the receiver's antenna"
    parameter_labels = {"lean_azimuth_deg": "azimuth of the tilt, from the heading"}
    confused_with = ("body_shadowing", "receiver_gain_offset")
    arrivals = _Arrivals.of

    class Params(EffectParams):
        """Dipoles of receivers."""

        receivers: dict[ReceiverIndex, DipoleParams] = Field(
            description="Dipole of each receiver, by index.")

    params: Params

    @override
    def usable(self, links: Links) -> np.ndarray:
        return links.los & np.isfinite(links.heading_deg)

    @override
    def best_pattern(self, view: ResidualView, rows: np.ndarray) -> DipoleParams | None:
        """Find the trial tilt that fits best on straight lines; None if below `MIN_NATS`."""
        links = view.links.select(rows)
        length_m = np.linalg.norm(links.offset_m, axis=1, keepdims=True)
        ray = -(links.offset_m / np.maximum(length_m, 1e-9))
        residual_db, weight = view.residual_db[rows], view.weight[rows]

        def squares_left(tilt: float, azimuth: float) -> float:
            gain = dipole_gain(ray, _axis(links.receiver_axes, tilt, azimuth))
            return squares_about_mean(residual_db - 10 * np.log10(gain), weight)

        best, tilt, azimuth = min((squares_left(tilt, azimuth), tilt, azimuth)
                                  for tilt in TILTS_DEG for azimuth in AZIMUTHS_DEG)
        if 0.5 * (squares_about_mean(residual_db, weight) - best) > MIN_NATS:
            return DipoleParams(tilt_deg=tilt, lean_azimuth_deg=azimuth)
        return None

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        return report_patterns(self.params.receivers, estimate.params_sd, links.receiver_names,
                               with_scattered=links.city is not None)


def _axis(axes: np.ndarray, tilt_deg: float, azimuth_deg: float) -> np.ndarray:
    """Compute the direction (n, 3) in the map frame of dipoles on bodies with axes (n, 3, 3)."""
    tilt, lean = np.radians(tilt_deg), np.radians(azimuth_deg)
    in_body = np.array([np.sin(tilt) * np.sin(lean), np.sin(tilt) * np.cos(lean), np.cos(tilt)])
    return np.einsum("i,nij->nj", in_body, axes)

