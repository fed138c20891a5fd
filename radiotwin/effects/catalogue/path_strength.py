"""`wall_reflection`, `diffraction`: power of reflected or diffracted paths added to a distance law.

The paths are followed over the 3D map by the image method and the uniform theory of diffraction
(`radiotwin.propagation.paths`). The channel's level is fitted again: without line of sight it then
covers only the power that no path explains.
"""

from typing import ClassVar

import numpy as np
from pydantic import Field
from scipy.constants import speed_of_light
from typing_extensions import override

from radiotwin.effects.arrays import NEPERS, add_power, city_of
from radiotwin.effects.base import PathEffect, ResidualView
from radiotwin.effects.params import Allowed, Decibels, EffectParams, Estimate, Parameter, Variation
from radiotwin.links import Links
from radiotwin.propagation.laws.followed_paths import path_gains

STRENGTHS_DB = (0.0, -4.0, -8.0)  # start values relative to theory
MAX_LINKS = 60_000  # bounds the time of following paths
BELOW_DB, ABOVE_DB = 30.0, 15.0  # range of strengths below and above theory
MIN_CLEAR = 20  # links with line of sight, to calibrate the level


class _Paths(PathEffect):
    """Base of effects that add the power of some kinds of paths, with one fitted strength."""

    nlos_only = True  # with line of sight they add tenths of a decibel
    in_paths = True
    parameter_labels = {"strength_db": "strength relative to theory"}
    needs_map = True
    kinds: ClassVar[tuple[str, ...]]

    class Params(EffectParams):
        """Strength of the paths."""

        strength_db: Decibels = Field(description="Level of a path whose power gain is 1 [dB].")
        level_db: Decibels = Field(description="Level that a gain of 0 dB is measured as [dB].")

    params: Params

    @override
    def unavailable(self, links: Links) -> str | None:
        """Return why paths cannot be followed (no map, or too many links); else None."""
        if missing := super().unavailable(links):
            return missing
        if len(links) > MAX_LINKS:
            return f"{len(links):,} links are too many to follow their paths; at most {MAX_LINKS:,}"
        return None

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        """Propose strengths near theory [dB]; levels are calibrated on links with line of sight."""
        links = view.links
        wavelength_m = speed_of_light / links.frequency_hz
        direct_db = 20 * np.log10(wavelength_m / (4 * np.pi * links.distance_m))
        rows = links.los & np.isfinite(view.residual_db) & np.isfinite(links.level_db)
        # Levels may be powers of unknown transmitters: calibrate them on links with line of sight.
        level_db = (float(np.median((links.level_db - direct_db)[rows]))
                    if rows.sum() > MIN_CLEAR else 0.0)
        return [self.Params(strength_db=level_db + strength_db, level_db=level_db)
                for strength_db in STRENGTHS_DB]

    @override
    def inputs(self, links: Links) -> np.ndarray:
        city_of(links, self.name)
        return path_gains(links.geometry, self.kinds)

    @override
    def response(self, level_db: np.ndarray, inputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return add_power(level_db, inputs * np.exp(self.params.strength_db * NEPERS))

    @override
    def variation(self) -> Variation:
        """Return the strength of the paths [dB] for the search, within bounds about theory."""
        level_db = self.params.level_db
        return Variation(
            np.array([self.params.strength_db]), np.array([2.0]), np.array([level_db - BELOW_DB]),
            np.array([level_db + ABOVE_DB]),
            lambda numbers: self.changed(strength_db=float(numbers[0])))

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        return {"strength_db": Parameter.normal(self.params.strength_db - self.params.level_db,
                                                estimate.params_sd[0], "dB",
                                                Allowed(-BELOW_DB, ABOVE_DB))}


class WallReflection(_Paths):
    """Specular paths off walls and the ground, up to four bounces; relative to concrete."""

    name = "wall_reflection"
    in_words = "reflections off walls"
    kinds = ("reflected_1", "reflected_2", "reflected_more")
    confused_with = ("diffraction",)


class Diffraction(_Paths):
    """Paths over one or two roof edges or round corners, also with bounces; relative to theory."""

    name = "diffraction"
    in_words = "diffraction"
    kinds = ("diffracted", "reflected_diffracted", "diffracted_2")
    confused_with = ("wall_reflection",)
