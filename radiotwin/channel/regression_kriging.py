"""Regression kriging: the segmented log-distance law plus an interpolation of what each device leaves over."""

from __future__ import annotations

from typing import Any, Self

import numpy as np

from radiotwin.channel.base import ChannelModel, drop_uninformative
from radiotwin.inference.gaussian import standardised
from radiotwin.links.geometry import LinkGeometry
from radiotwin.channel.residual_field import ResidualField
from radiotwin.channel.segmented_log_distance import SegmentedLogDistance


class RegressionKriging(ChannelModel):
    """Law as trend, and per device a Gaussian process over the receiver's position on the residual.

    The residual is in units of its class's sigma. Far from all measurements, and for a device without any, mean and
    sigma are the law's.

    A link that was not detected enters with its conditional mean below the limit: left out, the map would fill a
    shadow with the detected levels around it.

    A device is its index in `LinkGeometry.device`: use the same indices for fitting and predicting.
    """

    name = "regression_kriging"
    uses_map = True

    def __init__(self) -> None:
        self.law = SegmentedLogDistance()
        self.field = ResidualField()

    def fit(self, links: LinkGeometry, level_db: np.ndarray, limit_db: float | None, seed: int = 0) -> Self:
        """Law first, then the process on its residual; see ChannelModel.fit. The seed picks points where there are
        too many."""
        links, level_db = drop_uninformative(links, level_db, limit_db)
        self.law.fit(links, level_db, limit_db)
        mean_db, sigma_db = self.law.predict(links)
        residual = standardised(level_db, mean_db, sigma_db, limit_db)
        self.field.fit(links.device, links.receiver_m, residual, seed)
        return self

    def predict(self, links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
        """Mean and standard deviation [dB], (n,) each."""
        mean_db, sigma_db = self.law.predict(links)
        mean, sigma = self.field.predict(links.device, links.receiver_m)
        return mean_db + sigma_db * mean, sigma_db * sigma

    @property
    def trend(self) -> SegmentedLogDistance:
        """The law, which is all that a device without measurements gets."""
        return self.law

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """See ChannelModel.state."""
        arrays, settings = self.law.state()
        more, own = self.field.state()
        return arrays | more, settings | own

    @classmethod
    def from_state(cls, arrays: dict[str, np.ndarray], settings: dict[str, Any]) -> Self:
        """See ChannelModel.from_state."""
        model = cls()
        model.law = SegmentedLogDistance.from_state(arrays, settings)
        model.field = ResidualField.from_state(arrays, settings)
        return model
