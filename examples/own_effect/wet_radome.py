"""A wet radome: while it rains, the water on their antennas weakens what all receivers read.

Wet antennas add a loss of their own to that of the rain on the path (Leijnse et al. 2008,
'Microwave link rainfall estimation', Advances in Water Resources 31).
"""

from collections.abc import Iterator

import numpy as np
from pydantic import Field
from typing_extensions import override

from radiotwin.effects import EffectParams, Estimate, GainEffect, Parameter, Term
from radiotwin.effects.base import LevelAt, ResidualView
from radiotwin.effects.patterns import Pattern
from radiotwin.links import Links


class WetRadome(GainEffect):
    """A loss during one episode of rain."""

    name = "wet_radome"
    of_receiver = True  # a map is of the levels that arrive, not of readings
    confused_with = ("receiver_drift",)
    calibrated_like = "episode"  # nobody has traced wet antennas
    settled_by = "repeat the flight in dry weather"
    parameter_labels = {"loss_db": "loss of the wet antennas"}

    class Params(EffectParams):
        """One episode of rain."""

        start_s: float = Field(description="Beginning of the rain [s].")
        end_s: float = Field(description="End of the rain [s].")

    params: Params

    @override
    def unavailable(self, links: Links) -> str | None:
        return None if np.isfinite(links.time_s).any() else "there is no time_s"

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        edges_s = np.linspace(view.links.first_s, view.links.last_s, 25).tolist()
        episodes = [self.Params(start_s=start_s, end_s=end_s) for number, start_s in
                    enumerate(edges_s) for end_s in edges_s[number + 1:]]
        gains = [view.score(self.with_params(each).term(view.links, view.level_at))
                 for each in episodes]
        return [episodes[int(np.argmax(gains))]]

    @override
    def term(self, links: Links, level_at: LevelAt) -> Term:
        rains = (links.time_s >= self.params.start_s) & (links.time_s <= self.params.end_s)
        return Term.of_columns(-rains[:, None].astype(float), prior_sd_db=5.0)

    @override
    def implausible(self, coefficients: np.ndarray) -> str | None:
        return None if coefficients[0] > 0 else "rain would have to amplify"

    @override
    def typical_patterns(self, view: ResidualView) -> Iterator[Pattern]:
        start_s, end_s = np.nanquantile(view.links.time_s, [0.45, 0.55])
        rain = self.with_params(self.Params(start_s=start_s, end_s=end_s))
        yield Pattern("receiver", "dB", "during a tenth of the time",
                      rain.term(view.links, view.level_at).columns[:, 0], high=10.0)

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        return {"loss_db": Parameter.normal(estimate.coefficients[0], estimate.coefficients_sd[0],
                                            "dB")}
