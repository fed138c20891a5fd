"""A receiver that compresses strong signals.

Rapp's model of a solid-state amplifier (Rapp 1991, 'Effects of HPA-nonlinearity on a 4-DPSK/OFDM signal'): output =
input / (1 + (input / saturation)^(2p))^(1 / 2p), in amplitudes; here in decibels.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from radiotwin.effects.base import Effect, Parameter, Term, Variation, View, measured

LEAST_STRONG = 20
SMOOTHNESS = (1.0, 3.0)
QUANTILES = (0.6, 0.7, 0.8, 0.88, 0.94, 0.98)


class ReceiverSaturation(Effect):
    """Receivers that read less than they receive at the strong end; those that are helped share one curve each."""

    name = "receiver_saturation"
    of_receiver = True
    stage = "receiver"
    confused_with = ("antenna_pattern", "excess_attenuation")

    def propose(self, view: View) -> list[dict]:
        records, found = view.records, dict[str, Any]()
        seen = np.isfinite(records.level_db)
        members = measured(records.receiver[seen], 5 * LEAST_STRONG)
        for receiver in members:
            rows = seen & (records.receiver == receiver)
            mean, residual, weight = view.mean_db[rows], view.residual_db[rows], view.weight[rows]
            best: tuple[float, Any] = 0.0, None
            for quantile in QUANTILES:
                level = float(np.quantile(mean, quantile))
                if (mean > level).sum() < LEAST_STRONG:
                    continue
                for smoothness in SMOOTHNESS:
                    drop = _compress(mean, level, smoothness)[0] - mean
                    rest = residual - drop
                    nats = 0.5 * (weight @ (residual - weight @ residual / weight.sum()) ** 2
                                  - weight @ (rest - weight @ rest / weight.sum()) ** 2)
                    if nats > best[0]:
                        best = nats, [level, smoothness]
            if best[0] > 3.0:
                found[str(receiver)] = best[1]
        return [{"receivers": found}] if found else []

    def term(self, records, setting, at) -> Term:
        by_receiver = np.full((len(records.receiver_names), 2), np.inf)
        for receiver, numbers in setting["receivers"].items():
            by_receiver[int(receiver)] = numbers
        return replace(Term.of_offset(np.zeros(len(records))), extra=by_receiver[records.receiver])

    def bend(self, level_db, setting, extra):
        bent, slope = level_db.copy(), np.ones_like(level_db)
        mine = np.isfinite(extra[:, 0])
        bent[mine], slope[mine] = _compress(level_db[mine], *extra[mine].T)
        return bent, slope

    def vary(self, setting) -> Variation:
        receivers = list(setting["receivers"])
        values = np.concatenate([[level, np.log(smooth)] for level, smooth in setting["receivers"].values()])

        def again(numbers: np.ndarray) -> dict:
            return {"receivers": {receiver: [float(level), float(np.exp(smooth))]
                                  for receiver, (level, smooth) in zip(receivers, np.reshape(numbers, (-1, 2)))}}
        times = len(receivers)
        return Variation(values, np.tile([3.0, 0.4], times), np.tile([-250.0, np.log(0.4)], times),
                         np.tile([50.0, np.log(8.0)], times), again,
                         list(np.arange(len(values)).reshape(times, -1)))

    def parameters(self, records, setting, found) -> dict[str, Parameter]:
        result = {}
        spreads = np.reshape(found.setting_deviations, (-1, 2))
        for (receiver, (level, _)), spread in zip(setting["receivers"].items(), spreads):
            result[f"saturation_level[{records.receiver_names[int(receiver)]}]"] = Parameter.normal(
                level, spread[0], "dB" if records.is_gain else "dBm")
        return result


def _compress(level_db: np.ndarray, saturation_db: float, smoothness: float) -> tuple[np.ndarray, np.ndarray]:
    """What is read, and the slope of it."""
    over = (level_db - saturation_db) * smoothness * np.log(10) / 10
    # A slope of e^-60 is none, but can be divided by.
    return level_db - np.logaddexp(0, over) / smoothness * 10 / np.log(10), 1 / (1 + np.exp(np.minimum(over, 60)))
