"""Readings that hold the receiver's own noise, too: near the floor they stop falling with distance.

Powers of signal and noise add: reading = 10 log10(10^(signal / 10) + 10^(floor / 10)). Readings such as RSSI hold both;
those of a known reference signal do not (ITU-R SM.1753, 'Methods for measurements of radio noise').
"""

from dataclasses import replace

import numpy as np

from radiotwin.effects.base import LEAST_POWER, NEPERS, Effect, Parameter, Term, Variation, View, measured

LEAST_LINKS = 40
LEAST_RECEIVERS = 3  # of which something is known, to tell what is usual
COMMON_QUANTILES = (0.03, 0.15)
QUANTILES = (0.01, 0.05, 0.1, 0.2, 0.35, 0.5)


class NoiseFloor(Effect):
    """A floor for each receiver."""

    name = "noise_floor_censoring"
    of_receiver = True
    stage = "receiver"
    confused_with = ("interference", "excess_attenuation")

    def propose(self, view: View) -> list[dict]:
        records, found = view.records, {}
        seen = np.isfinite(records.level_db)
        for receiver in measured(records.receiver[seen], LEAST_LINKS):
            rows = seen & (records.receiver == receiver)
            mean, residual, weight = view.mean_db[rows], view.residual_db[rows], view.weight[rows]
            found[str(receiver)] = max(
                (-float(weight @ (residual + mean - floored(mean, floor)[0]) ** 2), float(floor))
                for floor in np.quantile(records.level_db[rows], QUANTILES))[1]
        if not found:
            return []
        # A law that was fitted without a floor is too flat, and asks for none: where it lies may have to be tried.
        tried = [{receiver: float(np.nanquantile(records.level_db[records.receiver == int(receiver)], share))
                  for receiver in found} for share in COMMON_QUANTILES]
        return [{"receivers": floors} for floors in (found, *tried)]

    def term(self, records, setting, at) -> Term:
        floors = list(setting["receivers"].values())
        # A receiver of which nothing is known has the usual one.
        usual = np.median(floors) if len(floors) >= LEAST_RECEIVERS else -np.inf
        floor = np.full(len(records.receiver_names), usual)
        for receiver, floor_db in setting["receivers"].items():
            floor[int(receiver)] = floor_db
        return replace(Term.of_offset(np.zeros(len(records))), extra=np.exp(floor * NEPERS)[records.receiver])

    def bend(self, level_db, setting, extra):
        return with_power(level_db, extra)

    def vary(self, setting) -> Variation:
        receivers = list(setting["receivers"])

        def again(numbers: np.ndarray) -> dict:
            return {"receivers": dict(zip(receivers, map(float, numbers)))}
        times = len(receivers)
        return Variation(np.array(list(setting["receivers"].values())), np.full(times, 2.0), np.full(times, -250.0),
                         np.full(times, 50.0), again, list(np.arange(times)[:, None]))

    def parameters(self, records, setting, found) -> dict[str, Parameter]:
        spreads = found.setting_deviations
        return {f"floor[{records.receiver_names[int(receiver)]}]": Parameter.normal(floor, spread,
                                                                                    "dB" if records.is_gain else "dBm")
                for (receiver, floor), spread in zip(setting["receivers"].items(), spreads)}


def floored(level_db, floor_db):
    """What is read, and the slope of it."""
    return with_power(level_db, np.exp(floor_db * NEPERS))


def with_power(level_db: np.ndarray, floor_power: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same for a floor's power, in units of that of 0 dB."""
    power = np.maximum(np.exp(level_db * NEPERS), LEAST_POWER)
    total = power + floor_power
    return np.log(total) / NEPERS, power / total
