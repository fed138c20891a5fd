"""`body_shadowing`: the receiver's body (airframe, car) attenuates arrivals from its direction.

Loss = depth ((1 + cos angle) / 2)^k, with the angle between arrival and body; 0 on the opposite
side. The width is the full angle at half the depth: k = 1, the first harmonic, is 180° wide, and a
large k approaches a normal curve. Airframe shadowing is described by Khawaja et al., 'A survey of
air-to-ground propagation channel modeling for unmanned aerial vehicles', IEEE COMST 21(3), 2019.
With a 3D map each path has the loss of its direction of arrival; a link without any path has that
of the straight line.
"""

from typing import NamedTuple

import numpy as np
from pydantic import Field
from typing_extensions import override

from radiotwin.effects.antennas import BodyFrameEffect, linear, report_patterns
from radiotwin.effects.arrays import MIN_NATS, subsample
from radiotwin.effects.base import ResidualView
from radiotwin.effects.params import (
    EffectParams,
    Estimate,
    Parameter,
    ReceiverIndex,
    quantities,
    quantity,
)
from radiotwin.effects.patterns import Pattern
from radiotwin.links import Links
from radiotwin.propagation.laws.followed_paths import Rays

DEPTH_SD_DB = 16.0  # prior standard deviation of the depth in the proposal, a ridge
SEARCH_STEP_DEG, SEARCHED_WIDTHS_DEG = 15.0, (60.0, 120.0, 180.0)
MAX_LINKS = 2000  # drawn at random for the proposal


class Body(EffectParams):
    """Direction, width and loss of a body as seen from the receiver's antenna."""

    depth_db: float = quantity(0.0, unit="dB", low=0.0, high=40.0, step=2.0,
                               description="Loss of what arrives through its middle.")
    azimuth_deg: float = quantity(0.0, unit="deg", low=-720.0, high=1080.0, step=15.0,
                                  description="Direction of its middle, clockwise from the nose.")
    elevation_deg: float = quantity(0.0, unit="deg", low=-90.0, high=90.0, step=15.0,
                                    description="Direction of its middle, up from the deck.")
    width_deg: float = quantity(180.0, unit="deg", low=40.0, high=240.0, step=30.0,
                                description="Angle across, within which half of it is lost.")

    def loss_db(self, arrival: np.ndarray) -> np.ndarray:
        """Compute the loss (n,) [dB] of arrivals, unit vectors (n, 3) along right, nose, top."""
        middle = _directions(self.azimuth_deg, self.elevation_deg)
        return self.depth_db * _relative_loss(arrival @ middle, self.width_deg)


class _Arrivals(NamedTuple):
    """Rays of n links' paths at their receivers, and unit vectors along right, nose, top."""

    rays: Rays
    direction: np.ndarray  # (p, 3) towards where each ray comes from
    straight: np.ndarray  # (n, 3) along the straight line to the device

    @classmethod
    def of(cls, links: Links, rows: np.ndarray) -> "_Arrivals":
        """Find the arrivals of some links, with paths over the map."""
        links = links.select(rows)
        rays = Rays.of(links, of_device=False)
        return cls(rays, _in_body(links, rays), _straight(links))

    def gain_db(self, body: Body) -> np.ndarray:
        """Compute the gain (n,), at most 0, of each link by a body [dB]."""
        along_db = self.rays.through_antenna_db(linear(-body.loss_db(self.direction)))
        return np.where(np.isnan(along_db), -body.loss_db(self.straight), along_db)


class BodyShadowing(BodyFrameEffect):
    """Receivers whose body attenuates arrivals from one side."""

    name = "body_shadowing"
    acts_on = ("receiver", "direction")
    variant = "loss around the body"
    in_words = "the body that carries the receiver"
    parameter_labels = {"body_depth_db": "loss through the body",
                        "body_azimuth_deg": "body, from the heading",
                        "body_elevation_deg": "body, up from the deck",
                        "body_width_deg": "body, across, to half its loss"}
    confused_with = ("antenna_pattern",)
    arrivals = _Arrivals.of

    class Params(EffectParams):
        """Bodies that shadow."""

        receivers: dict[ReceiverIndex, Body] = Field(
            min_length=1, description="Body of each receiver, by index.")

    params: Params

    @override
    def usable(self, links: Links) -> np.ndarray:
        return np.isfinite(links.heading_deg) & np.isfinite(links.level_db)

    @override
    def best_pattern(self, view: ResidualView, rows: np.ndarray) -> Body | None:
        """Find the best shadow of a grid, each with fitted depth and level (ridge regression)."""
        drawn = subsample(rows, MAX_LINKS)
        weight = view.weight[drawn] * (len(rows) / len(drawn))
        residual_db, total = view.residual_db[drawn], weight.sum()
        residual_db = residual_db - weight @ residual_db / total
        azimuth_deg, elevation_deg = (each.ravel() for each in np.meshgrid(
            np.arange(0.0, 360.0, SEARCH_STEP_DEG),
            np.arange(-90.0 + SEARCH_STEP_DEG, 90.0, SEARCH_STEP_DEG)))
        cosine = _straight(view.links.select(drawn)) @ _directions(azimuth_deg, elevation_deg).T
        best, most_nats = None, MIN_NATS
        for width_deg in SEARCHED_WIDTHS_DEG:
            share = _relative_loss(cosine, width_deg)
            share -= weight @ share / total
            moment = np.maximum(-(weight * residual_db) @ share, 0.0)
            precision = weight @ share**2 + DEPTH_SD_DB**-2
            nats = 0.5 * moment**2 / precision
            index = int(nats.argmax())
            if nats[index] > most_nats:
                most_nats = float(nats[index])
                best = Body(depth_db=min(float(moment[index] / precision[index]), 40.0),
                            azimuth_deg=float(azimuth_deg[index]),
                            elevation_deg=float(elevation_deg[index]), width_deg=width_deg)
        return best

    @override
    def propose_for_fold(self, view: ResidualView) -> list[Params]:
        """Propose anew from the fold's residuals, and also the parameters found on all links."""
        return [*self.propose(view), self.params]

    @override
    def typical_patterns(self, view: ResidualView) -> list[Pattern]:
        """Return the level change by a shadow 1 dB deep behind the body; [] without headings."""
        azimuth_deg, depth = view.links.body_azimuth_deg, quantities(Body)["depth_db"]
        if not np.isfinite(azimuth_deg).any():
            return []
        back = 0.5 - 0.5 * np.cos(np.radians(np.nan_to_num(azimuth_deg)))
        return [Pattern("attitude", "dB", "behind the receiver's body", -back, low=depth["low"],
                        high=depth["high"])]

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        return report_patterns(self.params.receivers, estimate.params_sd, links.receiver_names,
                               prefix="body_")


def _straight(links: Links) -> np.ndarray:
    """Compute unit vectors (n, 3) towards the devices in the receivers' body frame."""
    return _in_body(links, Rays.of(links, of_device=False, straight=True))


def _in_body(links: Links, rays: Rays) -> np.ndarray:
    """Transform the directions of rays (p, 3) to the receivers' body frame."""
    axes = links.receiver_axes.astype(rays.direction.dtype)
    return np.einsum("pij,pj->pi", axes[rays.link], rays.direction)


def _directions(azimuth_deg: np.ndarray | float, elevation_deg: np.ndarray | float) -> np.ndarray:
    """Convert azimuth and elevation in the body frame to unit vectors (..., 3)."""
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    return np.stack([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation),
                     np.sin(elevation)], axis=-1)


def _relative_loss(cosine: np.ndarray, width_deg: float) -> np.ndarray:
    """Compute loss over depth, 0 to 1, from the cosine of the angle to the body's middle."""
    exponent = np.log(0.5) / (2 * np.log(np.cos(np.radians(width_deg / 4))))
    return np.clip((1 + cosine) / 2, 0.0, 1.0) ** exponent
