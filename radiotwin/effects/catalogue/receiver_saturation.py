"""`receiver_saturation`: a receiver that compresses strong signals.

Rapp's model of a solid-state amplifier (Rapp 1991, 'Effects of HPA-nonlinearity on a 4-DPSK/OFDM
signal'): output = input / (1 + (input / saturation)^(2p))^(1 / 2p), in amplitudes; here in
decibels.
"""

from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field
from typing_extensions import override

from radiotwin.effects.arrays import MIN_NATS, frequent_labels, squares_about_mean
from radiotwin.effects.base import ReceiverEffect, ResidualView
from radiotwin.effects.params import (
    Decibels,
    EffectParams,
    Estimate,
    Parameter,
    ReceiverIndex,
    Variation,
)
from radiotwin.links import Links

MIN_STRONG = 20  # links above the saturation level
MIN_LINKS = 5 * MIN_STRONG  # of a receiver
SMOOTHNESS = (1.0, 3.0)  # trial values
QUANTILES = (0.6, 0.7, 0.8, 0.88, 0.94, 0.98)  # of the predicted levels: trial saturation levels


class Compression(NamedTuple):
    """Parameters of Rapp's model.

    Attributes:
        level_db: saturation level [dB].
        smoothness: p; the higher, the sharper the knee.
    """

    level_db: Decibels
    smoothness: Annotated[float, Field(ge=1e-3, le=1000)]


class ReceiverSaturation(ReceiverEffect):
    """Compression of strong signals by receivers."""

    name = "receiver_saturation"
    in_words = "saturation of the receiver"
    acts_on = ("receiver", "level")
    settled_by = "approach a device with line of sight"
    confused_with = ("antenna_pattern", "excess_attenuation")

    class Params(EffectParams):
        """Compression of receivers."""

        receivers: dict[ReceiverIndex, Compression] = Field(
            description="Of each receiver, by index.")

    params: Params

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        """Propose a compression for each receiver whose strongest readings clearly lack power."""
        links, found = view.links, {}
        detected = np.isfinite(links.level_db)
        for receiver in frequent_labels(links.receiver[detected], MIN_LINKS):
            rows = detected & (links.receiver == receiver)
            mean_db, weight = view.mean_db[rows], view.weight[rows]
            residual_db = view.residual_db[rows]
            best_nats, best = 0.0, None
            for quantile in QUANTILES:
                level_db = float(np.quantile(mean_db, quantile))
                if (mean_db > level_db).sum() < MIN_STRONG:
                    continue
                for smoothness in SMOOTHNESS:
                    rest_db = residual_db - (_compress(mean_db, level_db, smoothness)[0] - mean_db)
                    nats = 0.5 * (squares_about_mean(residual_db, weight)
                                  - squares_about_mean(rest_db, weight))
                    if nats > best_nats:
                        best_nats, best = nats, Compression(level_db, smoothness)
            if best and best_nats > MIN_NATS:
                found[receiver] = best
        return [self.Params(receivers=found)] if found else []

    @override
    def inputs(self, links: Links) -> np.ndarray:
        by_receiver = np.full((len(links.receiver_names), 2), np.inf)
        for receiver, compression in self.params.receivers.items():
            by_receiver[receiver] = compression
        return by_receiver[links.receiver]

    @override
    def response(self, level_db: np.ndarray, inputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        reading_db, slope = level_db.copy(), np.ones_like(level_db)
        rows = np.isfinite(inputs[:, 0])
        reading_db[rows], slope[rows] = _compress(level_db[rows], *inputs[rows].T)
        return reading_db, slope

    @override
    def variation(self) -> Variation:
        """Put each receiver's saturation level [dB] and log smoothness into a search vector."""
        n = len(self.params.receivers)
        values = np.concatenate([[level_db, np.log(smoothness)]
                                 for level_db, smoothness in self.params.receivers.values()])

        def varied(numbers: np.ndarray) -> ReceiverSaturation:
            return self.with_params(self.Params(receivers={
                receiver: Compression(float(level_db), float(np.exp(log_smoothness)))
                for receiver, (level_db, log_smoothness) in zip(self.params.receivers,
                                                                numbers.reshape(-1, 2))}))

        return Variation(values, np.tile([3.0, 0.4], n), np.tile([-250.0, np.log(0.4)], n),
                         np.tile([50.0, np.log(8.0)], n), varied,
                         list(np.arange(2 * n).reshape(n, 2)))

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        """Report the level at which each receiver saturates, with a 90 % interval."""
        unit = links.level_unit
        return {f"saturation_level[{links.receiver_names[receiver]}]":
                Parameter.normal(compression.level_db, sd_db, unit)
                for (receiver, compression), sd_db in zip(self.params.receivers.items(),
                                                          estimate.params_sd[::2])}


def _compress(level_db: np.ndarray, saturation_db: float | np.ndarray,
              smoothness: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compress levels (n,) by Rapp's model: readings (n,) [dB] and their derivative (n,)."""
    over = (level_db - saturation_db) * smoothness * np.log(10) / 10
    reading_db = level_db - np.logaddexp(0, over) / smoothness * 10 / np.log(10)
    # A slope of e^-60 is practically 0 and can still be a divisor.
    return reading_db, 1 / (1 + np.exp(np.minimum(over, 60)))
