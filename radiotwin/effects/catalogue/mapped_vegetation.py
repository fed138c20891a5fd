"""`mapped_vegetation`: loss through woods, parks or rows of trees that the map shows.

Loss over d metres inside: A_m (1 − exp(−γ d / A_m)) (ITU-R P.833-10, Eq. 1), with A_m of the
frequency and one fitted specific attenuation γ per kind. The ray tracer and the paths over the map
do not include vegetation.
"""

from typing import Literal

import numpy as np
from pydantic import Field
from typing_extensions import override

from radiotwin.effects.arrays import MIN_LINKS, city_of
from radiotwin.effects.base import GainEffect, ResidualView
from radiotwin.effects.losses import UNKNOWN_MAX_LOSS_DB, max_loss_db
from radiotwin.effects.params import Allowed, EffectParams, Estimate, Parameter, quantity
from radiotwin.links import Links
from radiotwin.scene.vegetation import KINDS

MIN_THROUGH_M = 3.0  # least length in vegetation of a link that counts
SPECIFIC_DB_M = (0.05, 0.15, 0.4, 1.0)  # start values
MIN_SPECIFIC_DB_M = 0.005  # 0.5 dB over 100 m; a lower value is no loss


class MappedVegetation(GainEffect):
    """Loss through the mapped vegetation of one kind; each search step finds one kind."""

    name = "mapped_vegetation"
    in_words = "vegetation of the map"
    repeatable = True
    needs_map = True
    confused_with = ("foliage", "excess_attenuation")

    class Params(EffectParams):
        """Loss over the metres inside."""

        specific_attenuation_db_m: float = quantity(
            0.15, unit="dB/m", low=0.001, high=5.0, step=0.1,
            description="Of the first metres of vegetation.")
        kind: Literal["wood", "park", "tree_row"] = Field("wood", description="Of vegetation.")
        greatest_loss_db: float = Field(UNKNOWN_MAX_LOSS_DB, gt=0, le=1000, description=(
            "Of a link through it, at the frequency [dB]."))

    params: Params

    @override
    def unavailable(self, links: Links) -> str | None:
        """Return why mapped vegetation cannot be tested (none, or few links in it); else None."""
        if missing := super().unavailable(links):
            return missing
        if not len(city_of(links, self.name).vegetation):
            return "the map shows no vegetation"
        if not self._kinds(links):
            return (f"fewer than {MIN_LINKS} links pass {MIN_THROUGH_M:g} m or more of vegetation "
                    "of one kind")
        return None

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        """Propose trial attenuations [dB/m] of each kind of mapped vegetation."""
        known = view.found_params(self.name, "kind")
        most_db = max_loss_db(view.links.frequency_hz)
        return [self.Params(kind=kind, specific_attenuation_db_m=specific, greatest_loss_db=most_db)
                for kind in self._kinds(view.links) if kind not in known
                for specific in SPECIFIC_DB_M]

    @override
    def gain_db(self, links: Links) -> np.ndarray:
        most_db = self.params.greatest_loss_db
        through_m = self._through_m(links, self.params.kind)
        return most_db * np.expm1(-through_m * self.params.specific_attenuation_db_m / most_db)

    @override
    def implausible(self, coefficients: np.ndarray) -> str | None:
        if self.params.specific_attenuation_db_m < MIN_SPECIFIC_DB_M:
            return f"the {self.params.kind.replace('_', ' ')} would have to cost nothing"
        return None

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        return {f"specific_attenuation_db_m[{self.params.kind}]": Parameter.normal(
            self.params.specific_attenuation_db_m, estimate.params_sd[0], "dB/m",
            Allowed(low=0.0, high=5.0))}

    def _kinds(self, links: Links) -> list[str]:
        """List the kinds of vegetation that enough links pass through."""
        return [kind for kind in KINDS
                if (self._through_m(links, kind) >= MIN_THROUGH_M).sum() >= MIN_LINKS]

    def _through_m(self, links: Links, kind: str) -> np.ndarray:
        """Measure the length (n,) of links inside vegetation of a kind [m]; cached."""
        def measure() -> np.ndarray:
            city = city_of(links, self.name)
            vegetation = city.vegetation.of_kind(kind)
            if not len(vegetation):
                return np.zeros(len(links))
            return vegetation.metres_through(links.device_m[links.device], links.receiver_m,
                                             city.ground_height_m if city.terrain is not None
                                             else None)
        return self.of_links.get(links, kind, measure)
