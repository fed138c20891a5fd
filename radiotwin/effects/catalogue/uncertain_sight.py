"""`uncertain_sight`: near walls and roofs with errors of metres, the line of sight is uncertain.

The probability of line of sight of a link is its frequency over randomly perturbed maps
(`perturbed_map`). Where it is neither 0 nor 1, the level is between those with and without line of
sight, and errors are larger; both are fitted. Otherwise a box or a grove that hides a few links
near a wall would explain the effect of the wall's error.
"""

from dataclasses import replace

import numpy as np
from typing_extensions import override

from radiotwin.effects.arrays import MIN_LINKS, city_of
from radiotwin.effects.base import GainEffect, LevelAt, ResidualView, Term
from radiotwin.effects.params import Allowed, EffectParams, Estimate, Parameter, quantity
from radiotwin.links import Links
from radiotwin.scene.citymap import perturbed_map

# Between the accuracies of buildings as blocks with roofs (2 m) and of surveyed ones (0.5 m): LoD2
# and LoD3 of CityGML 2.0 (OGC 12-019, Table 1); heights are often counted from storeys.
WALL_SD_M, HEIGHT_SD_M = 1.0, 2.0
MAPS = 8  # number of perturbed maps, in addition to the given one
PRIOR_SD_DB = 20.0  # of the difference of level between both classes
CONTRASTS_DB = (6.0, 12.0, 20.0)  # start values


class UncertainSight(GainEffect):
    """Levels between those with and without line of sight near walls, and larger errors."""

    name = "uncertain_sight"
    parameter_labels = {"contrast_db": "difference of both classes, by their scatter",
                        "loss_without_sight_db": "loss where a link may have no line of sight",
                        "gain_with_sight_db": "gain where it may have one"}
    variant = "walls and roofs that are off by metres"
    figure = "histogram"
    is_declared = True
    needs_map = True
    is_cause = False

    class Params(EffectParams):
        """How much lines of sight are worth where walls decide."""

        contrast_db: float = quantity(
            12.0, unit="dB", low=0.5, high=60.0, step=3.0, description=(
                "Difference of level between both classes that errors near walls are of [dB]."))

    params: Params

    @override
    def unavailable(self, links: Links) -> str | None:
        """Return why doubtful lines of sight cannot be tested (no map, or too few); else None."""
        if missing := super().unavailable(links):
            return missing
        chance = self._chance(links)
        count = int(((chance > 0) & (chance < 1)).sum())
        if count < MIN_LINKS:
            return (f"walls that are {WALL_SD_M:g} m off decide over {count} links; {MIN_LINKS} "
                    "are needed")
        return None

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        return [self.Params(contrast_db=contrast_db) for contrast_db in CONTRASTS_DB]

    @override
    def term(self, links: Links, level_at: LevelAt) -> Term:
        """Return fitted loss in sight, and gain out of it, times the chance of a wrong map."""
        params = self.params
        chance, los = self._chance(links), links.los
        columns = np.column_stack([np.where(los, chance - 1.0, 0.0), np.where(los, 0.0, chance)])
        return replace(Term.of_columns(columns, PRIOR_SD_DB),
                       random_effect_sd_db=params.contrast_db * np.sqrt(chance * (1.0 - chance)))

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        """Report contrast, loss without sight and gain with sight, each in dB."""
        contrast = Parameter.normal(self.params.contrast_db, estimate.params_sd[0], "dB",
                                    Allowed(low=0.0))
        names = "loss_without_sight_db", "gain_with_sight_db"
        return {"contrast_db": contrast} | {
            name: Parameter.normal(value_db, sd_db, "dB") for name, value_db, sd_db in
            zip(names, estimate.coefficients, estimate.coefficients_sd, strict=True)}

    def _chance(self, links: Links) -> np.ndarray:
        """Compute the share (n,) of randomly altered maps with line of sight on a link; cached."""
        def share_of_maps() -> np.ndarray:
            city = city_of(links, self.name)
            seen = links.los.astype(float)
            for seed in range(MAPS):
                seen += links.with_city(perturbed_map(city, WALL_SD_M, HEIGHT_SD_M, seed)).los
            return seen / (MAPS + 1)
        return self.of_links.get(links, None, share_of_maps)
