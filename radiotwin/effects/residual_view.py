"""Training links and their residual, as effects see them."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from radiotwin.effects.base import Term
from radiotwin.effects.params import EffectParams
from radiotwin.links import LinkData, design_effect, evidence_blocks


class LevelAt(Protocol):
    """Levels (n,) [dB] that the channel predicts for other links, such as with moved devices."""

    def __call__(self, links: LinkData, exact: bool = False) -> np.ndarray:
        """Return them quickly, or exactly (following paths, where the channel does)."""


@dataclass(frozen=True, eq=False)
class ResidualView:
    """Training links, and the residual of the model so far.

    Attributes:
        links: n links.
        residual_db: (n,) measured minus predicted [dB]; of blanks, how far below the prediction
            they lie at least.
        scale_db: (n,) scale of the errors [dB].
        mean_db: (n,) predicted level [dB].
        level_at: the channel's levels of other links, such as with devices elsewhere.
        found: name and parameters of the effects so far.
    """

    links: LinkData
    residual_db: np.ndarray
    scale_db: np.ndarray
    mean_db: np.ndarray
    level_at: LevelAt
    found: tuple[tuple[str, EffectParams], ...] = ()

    def found_params(self, name: str, parameter: str) -> list[Any]:
        """Return the values of a parameter of the effects of that name that were found before."""
        return [getattr(params, parameter) for kept, params in self.found
                if kept == name and hasattr(params, parameter)]

    @cached_property
    def design_effect(self) -> float:
        """How many links count as one, because links close to each other err alike."""
        return design_effect(evidence_blocks(self.links), self.residual_db / self.scale_db)

    @cached_property
    def weight(self) -> np.ndarray:
        """(n,) weight of each link's square [1/dB²].

        1 / variance, less for outliers, divided by the design effect: sums of weighted squares are
        nats that can be believed.
        """
        z = self.residual_db / self.scale_db
        return 5.0 / (4.0 + z * z) / self.scale_db**2 / self.design_effect

    def gain_nats(self, rows: np.ndarray, change_db: np.ndarray) -> np.ndarray:
        """Return how much likelier links become if their mean changes (r,) [nats].

        With heavy tails before and after: `weight` knows the old outliers only, and a change makes
        others. A blank is satisfied with any level that is below the limit of detection.

        Args:
            rows: (r,) links.
            change_db: (r,) change of the mean [dB].
        """
        scale_db, blank = self.scale_db[rows], np.isnan(self.links.level_db[rows])
        before = (self.residual_db[rows] / scale_db) ** 2
        # That of a blank is cut off at 0; how far it may rise, its distance to the limit says.
        spare_db = self.links.limit_db[rows] - self.mean_db[rows]
        spare_db = np.where(np.isfinite(spare_db), spare_db, np.inf)
        # It may be blank for another reason than its level, by as much as its residual is less.
        share = np.where(spare_db < 0, self.residual_db[rows] / np.minimum(spare_db, -1e-9), 1.0)
        rest_db = np.where(blank, share * np.minimum(spare_db - change_db, 0.0),
                           self.residual_db[rows] - change_db)
        after = (rest_db / scale_db) ** 2
        return 2.5 * (np.log1p(before / 4.0) - np.log1p(after / 4.0)) / self.design_effect

    def score(self, term: Term) -> float:
        """Return how much a term would help [nats].

        Half of the drop of the weighted squares, after its coefficients and a level for each class
        of line of sight are fitted.
        """
        weight = self.weight
        target = self.residual_db - term.offset_db
        level = np.column_stack([self.links.los, ~self.links.los]).astype(float)
        before = _weighted_squares(level, np.full(2, np.inf), self.residual_db, weight)
        prior_sd_db = np.concatenate([np.full(2, np.inf), term.prior_sd_db])
        after = _weighted_squares(np.hstack([level, term.columns]), prior_sd_db, target, weight)
        return 0.5 * (before - after)


def _weighted_squares(columns: np.ndarray, prior_sd: np.ndarray, target: np.ndarray,
                      weight: np.ndarray) -> float:
    weighted = columns.T * weight
    precision = 1.0 / np.square(prior_sd) + 1e-9
    moments = weighted @ target
    coefficients = np.linalg.solve(weighted @ columns + np.diag(precision), moments)
    return float(weight @ (target * target) - coefficients @ moments)
