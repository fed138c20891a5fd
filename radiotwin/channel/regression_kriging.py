"""Regression kriging: the segmented log-distance law plus each device's interpolated residual."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from typing_extensions import override

from radiotwin.channel.base import ChannelModel, drop_uninformative
from radiotwin.channel.residual_field import ResidualField
from radiotwin.channel.segmented_log_distance import SegmentedLogDistance
from radiotwin.inference.gaussian import Limit, standardised
from radiotwin.links import LinkGeometry


class RegressionKriging(ChannelModel):
    """The law as trend, and for each device a Gaussian process over the receiver's position.

    The process is fitted to the residual in units of its class's standard deviation. Far from all
    measurements, and for a device without any, mean and standard deviation are the law's.

    A link that was not detected enters with its conditional mean below the limit: left out, the map
    would fill a shadow with the detected levels around it.

    A device is its index in `LinkGeometry.device`: use the same indices to fit and to predict.
    """

    name = "regression_kriging"
    uses_map = True

    def __init__(self) -> None:
        self.law = SegmentedLogDistance()
        self.field = ResidualField()

    @override
    def fit(self, links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
            seed: int = 0) -> Self:
        self.field.fit(*self._residual(links, level_db, limit_db), seed)
        return self

    def refit(self, links: LinkGeometry, level_db: np.ndarray, limit_db: Limit) -> Self:
        """Return a model of the same correlation that is fitted to other links, as of `fit`."""
        model = type(self)()
        model.field = self.field.with_points(*model._residual(links, level_db, limit_db))
        return model

    def _residual(self, links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
                  ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Fit the law; return series, positions and residual of the links that a fit can use."""
        links, level_db, limit_db = drop_uninformative(links, level_db, limit_db)
        self.law.fit(links, level_db, limit_db)
        mean_db, sd_db = self.law.predict(links)
        return links.device, links.receiver_m, standardised(level_db, mean_db, sd_db, limit_db)

    @override
    def predict(self, links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
        mean_db, sd_db = self.law.predict(links)
        mean, sd = self.field.predict(links.device, links.receiver_m)
        return mean_db + sd_db * mean, sd_db * sd

    @property
    @override
    def trend(self) -> SegmentedLogDistance:
        return self.law

    @override
    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        arrays, settings = self.law.state()
        field_arrays, field_settings = self.field.state()
        return arrays | field_arrays, settings | field_settings

    @classmethod
    @override
    def from_state(cls, arrays: dict[str, np.ndarray], settings: dict[str, Any]) -> Self:
        model = cls()
        law = {"lines": arrays["lines"]}
        model.law = SegmentedLogDistance.from_state(law, {"borrowed": settings["borrowed"]})
        model.field = ResidualField.from_state(
            {name: array for name, array in arrays.items() if name not in law},
            {name: value for name, value in settings.items() if name != "borrowed"})
        return model
