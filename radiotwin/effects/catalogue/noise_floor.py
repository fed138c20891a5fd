"""`noise_floor_censoring`: readings that contain the receiver's noise and level off at its floor.

Powers of signal and noise add: reading = 10 log10(10^(signal / 10) + 10^(floor / 10)). Readings
such as RSSI contain both; those of a known reference signal do not (ITU-R SM.1753, 'Methods for
measurements of radio noise').

Hardly any reading is then far below the floor, however weak the signal: none by 6 dB for 30
receivers whose noise was measured separately (`powder_frs`). If many are, weak links are stronger
than predicted for another reason, such as scattering or paths that are not followed.
"""

import numpy as np
from pydantic import Field
from typing_extensions import override

from radiotwin.effects.arrays import MIN_NATS, NEPERS, add_power, frequent_labels
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

MIN_LINKS = 40  # of a receiver, to estimate its floor
MIN_RECEIVERS = 3  # with a floor, for their median to apply to other receivers
QUANTILES = (0.01, 0.05, 0.1, 0.2, 0.35, 0.5)  # of a receiver's readings: trial floors
COMMON_QUANTILES = (0.03, 0.15)  # trial floors of all receivers at once
MAX_BELOW, BELOW_DB = 0.01, 6.0  # largest share of readings so far below the floor
AT_BOUND_DB = 0.1  # distance to the highest allowed floor that counts as being at the bound


class NoiseFloor(ReceiverEffect):
    """A noise floor for each receiver."""

    name = "noise_floor_censoring"
    in_words = "a limit of detection"
    acts_on = ("receiver", "level")
    parameter_labels = {"floor": "noise floor"}
    confused_with = ("interference", "excess_attenuation")
    nlos_only = True  # as good as: over a map, links with line of sight are far above a floor

    class Params(EffectParams):
        """Floors of receivers."""

        receivers: dict[ReceiverIndex, Decibels] = Field(
            description="Floor of each receiver, by index [dB].")
        highest: dict[ReceiverIndex, Decibels] = Field({}, description=(
            "Highest floor that a receiver's own readings allow, by index [dB]; empty: any."))
        alone: bool = Field(False, description=(
            "Whether no other receiver has a floor; else those without an estimate have the "
            "median, where three or more have one."))

    params: Params

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        """Propose noise floors of receivers [dB], among quantiles of their readings."""
        links, found, sure, highest = view.links, {}, {}, {}
        detected = np.isfinite(links.level_db)
        for receiver in frequent_labels(links.receiver[detected], MIN_LINKS):
            rows = detected & (links.receiver == receiver)
            mean_db, weight = view.mean_db[rows], view.weight[rows]
            residual_db = view.residual_db[rows]
            highest[receiver] = float(np.quantile(links.level_db[rows], MAX_BELOW)) + BELOW_DB
            floors_db = np.minimum(np.quantile(links.level_db[rows], QUANTILES), highest[receiver])
            found[receiver] = max(
                (-float(weight @ (residual_db + mean_db - floored(mean_db, floor_db)[0]) ** 2),
                 float(floor_db)) for floor_db in floors_db)[1]
            with_blanks = np.flatnonzero(links.receiver == receiver)
            all_db = view.mean_db[with_blanks]
            nats, floor_db = max(
                (float(view.gain_nats(with_blanks, floored(all_db, floor_db)[0] - all_db).sum()),
                 float(floor_db)) for floor_db in floors_db)
            if nats > MIN_NATS:
                sure[receiver] = floor_db
        if not found:
            return []
        # A law fitted without a floor is too flat and hides it, so typical floors are tried, too.
        tried = [{receiver: min(highest[receiver], float(np.nanquantile(
            links.level_db[links.receiver == receiver], quantile))) for receiver in found}
            for quantile in COMMON_QUANTILES]
        # If links are blank below a limit of detection, most receivers cannot have a noise floor
        # above that limit, but a few may.
        single = sure and sure.keys() != found.keys()
        return [*([self.Params(receivers=sure, highest=highest, alone=True)] if single else []),
                *(self.Params(receivers=floors_db, highest=highest)
                  for floors_db in (found, *tried))]

    @override
    def inputs(self, links: Links) -> np.ndarray:
        """Return the noise power (n,) of each link's receiver, linear; 0 if it has no floor."""
        floors_db = list(self.params.receivers.values())
        # A receiver without an estimate has the median floor, unless only single ones have a floor.
        usual = len(floors_db) >= MIN_RECEIVERS and not self.params.alone
        usual_db = np.median(floors_db) if usual else -np.inf
        by_receiver_db = np.full(len(links.receiver_names), usual_db)
        by_receiver_db[list(self.params.receivers)] = floors_db
        return np.exp(by_receiver_db * NEPERS)[links.receiver]

    @override
    def variation(self) -> Variation:
        """Put the receivers' floors [dB] into a search vector, each searched by itself."""
        params = self.params
        n = len(params.receivers)
        return Variation(
            np.array(list(params.receivers.values())), np.full(n, 2.0), np.full(n, -250.0),
            np.array([params.highest.get(receiver, 50.0) for receiver in params.receivers]),
            lambda numbers: self.changed(receivers=dict(zip(params.receivers, numbers.tolist()))),
            list(np.arange(n)[:, None]))

    @override
    def implausible(self, coefficients: np.ndarray) -> str | None:
        """Return a sentence if most floors are at the highest that readings allow; else None."""
        at_bound = [floor_db > self.params.highest.get(receiver, np.inf) - AT_BOUND_DB
                    for receiver, floor_db in self.params.receivers.items()]
        if 2 * sum(at_bound) <= len(at_bound):
            return None
        return (f"the levels would have it higher, but more than {MAX_BELOW:.0%} of the readings "
                f"would be {BELOW_DB:.0f} dB below it then: it is no floor")

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        unit = links.level_unit
        return {f"floor[{links.receiver_names[receiver]}]": Parameter.normal(floor_db, sd_db, unit)
                for (receiver, floor_db), sd_db in zip(self.params.receivers.items(),
                                                       estimate.params_sd)}


def floored(level_db: np.ndarray, floor_db: float) -> tuple[np.ndarray, np.ndarray]:
    """Compute the reading (n,) of levels (n,) with a noise floor [dB], and its derivative (n,)."""
    return add_power(level_db, np.exp(floor_db * NEPERS))
