"""Paths that a statistical model of the channel does not know: reflections off walls, and diffraction at edges.

Found by the image method and the uniform theory of diffraction over the 3D map (`radiotwin.paths`); their powers add to
what the base says of a link, whose level is fitted again: without line of sight it then stands only for what no path
explains.
"""

import numpy as np
from scipy.constants import speed_of_light

from radiotwin.closeloop.paths import paths_of
from radiotwin.effects.base import NEPERS, Effect, Parameter, Term, Variation, View
from radiotwin.effects.noise_floor import with_power

STRENGTHS_DB = (0.0, -4.0, -8.0)
MOST_LINKS = 60_000


class _Paths(Effect):
    """Power of some kinds of paths, with one common strength."""

    stage = "paths"
    nlos_only = True  # where there is line of sight they add tenths of a decibel
    kinds: tuple[str, ...]

    def lacks(self, records) -> str | None:
        if records.city is None:
            return "there is no 3D map"
        if len(records) > MOST_LINKS:
            return f"{len(records):,} links are too many to follow their paths; at most {MOST_LINKS:,}"
        return None

    def propose(self, view: View) -> list[dict]:
        records = view.records
        direct_db = 20 * np.log10(speed_of_light / records.frequency_hz / (4 * np.pi * records.distance_m))
        rows = records.los & np.isfinite(view.residual_db) & np.isfinite(records.level_db)
        # Levels may be powers of unknown transmitters: links with line of sight tell what stands for a gain of 0 dB.
        level_db = float(np.median((records.level_db - direct_db)[rows])) if rows.sum() > 20 else 0.0
        return [{"strength_db": level_db + strength_db, "level_db": level_db} for strength_db in STRENGTHS_DB]

    def term(self, records, setting, at) -> Term:
        term = Term.of_offset(np.zeros(len(records)))
        return Term(term.offset_db, term.columns, term.spread_db, [], paths_of(records, self.kinds))

    def bend(self, level_db, setting, extra):
        return with_power(level_db, extra * np.exp(setting["strength_db"] * NEPERS))

    def vary(self, setting) -> Variation:
        level_db = setting["level_db"]
        return Variation(np.array([setting["strength_db"]]), np.array([2.0]), np.array([level_db - 30.0]),
                         np.array([level_db + 15.0]), lambda numbers: setting | {"strength_db": float(numbers[0])})

    def parameters(self, records, setting, found) -> dict[str, Parameter]:
        return {"strength_db": Parameter.normal(setting["strength_db"] - setting["level_db"],
                                                found.setting_deviations[0], "dB")}


class WallReflection(_Paths):
    """Specular paths off walls and the ground, up to four bounces; the strength is relative to concrete."""

    name = "wall_reflection"
    kinds = ("reflected_1", "reflected_2", "reflected_more")
    confused_with = ("diffraction",)


class Diffraction(_Paths):
    """Paths over one roof edge or round one corner, with bounces before and behind it; relative to theory."""

    name = "diffraction"
    kinds = ("diffracted", "reflected_diffracted")
    confused_with = ("wall_reflection",)
