"""`building_entry`: loss of links with one end inside a building of the map (ITU-R P.2109).

The recommendation gives the distribution of the loss over buildings and places in them. The loss is
the median for one of its two classes of buildings plus a fitted offset, whose prior is the spread
of that distribution. The scatter from place to place is fitted, too.

Positions of receivers have errors of metres, so each has a probability to be inside
(`chance_inside`), and its mean loss is that share of the entry loss; a link with line of sight has
none.
"""

from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np
from pydantic import Field
from scipy.special import ndtri
from typing_extensions import override

from radiotwin.effects.arrays import city_of
from radiotwin.effects.base import GainEffect, LevelAt, ResidualView, Term
from radiotwin.effects.params import EffectParams, Estimate, Parameter, quantity
from radiotwin.links import Links
from radiotwin.links.checks import chance_inside

MIN_LINKS = 30  # with one end inside a building
MIN_HZ, MAX_HZ = 80e6, 100e9  # range of the recommendation
MIN_LOSS_DB = 1.0  # 1 % of traditional buildings lose below 1.6 dB, at 2.4 GHz
START_SD_DB = 5.0  # start value of the scatter
MAX_PROBABILITY = 0.99  # quantile of the entry loss above which a fitted loss is implausible


class _Class(NamedTuple):
    """Coefficients of a class of buildings (ITU-R P.2109-2, Table 1)."""

    r: float
    s: float
    t: float
    u: float
    v: float
    w: float
    x: float
    y: float
    z: float


Building = Literal["traditional", "thermally_efficient"]
CLASSES: dict[Building, _Class] = {
    "traditional": _Class(12.64, 3.72, 0.96, 9.6, 2.0, 9.1, -3.0, 4.5, -2.0),
    "thermally_efficient": _Class(28.19, -3.00, 8.48, 13.5, 3.8, 27.8, -2.9, 9.4, -2.1)}


def entry_loss_db(frequency_hz: float, elevation_deg: np.ndarray | float, building: Building,
                  probability: float = 0.5) -> np.ndarray:
    """Compute a quantile (n,) of the building entry loss (ITU-R P.2109-2, Eqs. 1 to 10) [dB].

    Args:
        frequency_hz: carrier frequency, 80 MHz to 100 GHz [Hz].
        elevation_deg: (n,) elevation of the path at the facade [deg]; its sign does not matter.
        building: class of the building.
        probability: probability that the loss is lower, over buildings and places in them.
    """
    c, log_f = CLASSES[building], np.log10(frequency_hz / 1e9)
    horizontal_db = c.r + c.s * log_f + c.t * log_f**2
    first_db = horizontal_db + 0.212 * np.abs(elevation_deg)
    quantile = ndtri(probability)
    a_db = quantile * (c.u + c.v * log_f) + first_db
    b_db = quantile * (c.y + c.z * log_f) + c.w + c.x * log_f
    return 10 * np.log10(10 ** (a_db / 10) + 10 ** (b_db / 10) + 10**-0.3)


class BuildingEntry(GainEffect):
    """Entry loss of links with one end inside a building."""

    name = "building_entry"
    in_words = "loss into buildings"
    acts_on = ("receiver", "place")
    parameter_labels = {"entry_loss_db": "building entry loss",
                        "scatter_sd_db": "standard deviation from place to place"}
    needs_map = True
    figure = "histogram"
    nlos_only = True
    confused_with = ("missing_obstacle", "receiver_gain_offset")

    class Params(EffectParams):
        """Class of the buildings."""

        building: Building = Field(description="Class of ITU-R P.2109.")
        frequency_hz: float = Field(ge=MIN_HZ, le=MAX_HZ, description="Of the radio [Hz].")
        scatter_sd_db: float = quantity(
            0.0, unit="dB", low=0.0, high=30.0, step=2.0,
            description="Standard deviation of the loss, over buildings and places in them [dB].")

    params: Params

    @override
    def unavailable(self, links: Links) -> str | None:
        """Return why entry loss cannot be fitted (frequency, too few links indoors); else None."""
        if missing := super().unavailable(links):
            return missing
        if not MIN_HZ <= links.frequency_hz <= MAX_HZ:
            return ("the frequency is not known, or outside the 80 MHz to 100 GHz of ITU-R P.2109; "
                    "give frequency_hz")
        count = int(self._chance(links).sum())
        if count < MIN_LINKS:
            return (f"{count} links probably have one end inside a building; {MIN_LINKS} are "
                    "needed")
        return None

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        return [self.Params(building=building, frequency_hz=view.links.frequency_hz,
                            scatter_sd_db=START_SD_DB) for building in CLASSES]

    @override
    def term(self, links: Links, level_at: LevelAt) -> Term:
        """Return ITU-R's entry loss and its spread, times the chance that one end is indoors."""
        params = self.params
        chance = self._chance(links)
        median_db = entry_loss_db(params.frequency_hz, links.elevation_deg, params.building)
        low_db, high_db = (entry_loss_db(params.frequency_hz, 0.0, params.building, probability)
                           for probability in (0.1587, 0.8413))  # -1 and +1 standard deviation
        return Term(-chance * median_db, -chance[:, None], np.array([(high_db - low_db) / 2]),
                    random_effect_sd_db=np.sqrt(chance) * params.scatter_sd_db)

    @override
    def implausible(self, coefficients: np.ndarray) -> str | None:
        """Return why the entry loss is negative, tiny, or above its 99 % quantile; else None."""
        loss_db, most_db = self._loss_db(self.params, coefficients), entry_loss_db(
            self.params.frequency_hz, 0.0, self.params.building, MAX_PROBABILITY)
        if loss_db < 0:
            return f"buildings would have to amplify, by {-loss_db:.1f} dB"
        if loss_db < MIN_LOSS_DB:
            return f"its links lose {loss_db:.1f} dB only: they scatter, and do not enter buildings"
        if loss_db > most_db:
            return (f"an entry loss of {loss_db:.0f} dB is above the {most_db:.0f} dB that 99 % of "
                    "such buildings stay below (ITU-R P.2109)")
        return None

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        scatter = Parameter.normal(self.params.scatter_sd_db, estimate.params_sd[0], "dB")
        return {"entry_loss_db": Parameter.normal(self._loss_db(self.params, estimate.coefficients),
                                                  estimate.coefficients_sd[0], "dB"),
                "scatter_sd_db": replace(scatter, low=max(scatter.low, 0.0))}

    @staticmethod
    def _loss_db(params: Params, coefficients: np.ndarray) -> float:
        """Compute the fitted entry loss of a horizontal path [dB]."""
        return float(entry_loss_db(params.frequency_hz, 0.0, params.building) + coefficients[0])

    def _chance(self, links: Links) -> np.ndarray:
        """Compute the chance (n,) that one end only is indoors, 0 with line of sight; cached."""
        def chance_of_entry() -> np.ndarray:
            city = city_of(links, self.name)
            device = city.inside(links.device_m)[links.device]
            receiver = city.inside(links.receiver_m).astype(float)
            measured = links.receiver >= 0  # others are points of a map, known exactly
            receiver[measured] = chance_inside(city, links.receiver_m[measured])
            return np.where(links.los, 0.0, np.where(device, 1 - receiver, receiver))
        return self.of_links.get(links, None, chance_of_entry)
