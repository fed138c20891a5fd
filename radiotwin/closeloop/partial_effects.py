"""What one kept effect does, apart from all others."""

from dataclasses import dataclass, replace

import numpy as np

from radiotwin.closeloop.drawing import bins
from radiotwin.effects.fold_model import AppliedEffect
from radiotwin.links.link_data import LinkData
from radiotwin.closeloop.run import Loop
from radiotwin.inference.residual_tests import variables
from radiotwin.effects.base import Parameter

BINS = 24
MAX_MEMBERS = 6  # devices or receivers with a panel of their own
MIN_CLEAR = 300  # links with line of sight, to draw only them


@dataclass(frozen=True, eq=False)
class Acting:
    """A kept effect and what it does, all other effects staying as they are.

    Attributes:
        part, parameters: the effect.
        links: n links.
        without_db, with_db: (n,) expected level.
    """

    part: AppliedEffect
    parameters: dict[str, Parameter]
    links: LinkData
    without_db: np.ndarray
    with_db: np.ndarray

    @property
    def added_db(self) -> np.ndarray:
        return self.with_db - self.without_db

    @property
    def residual_db(self) -> np.ndarray:
        """(n,) without the effect."""
        return self.links.level_db - self.without_db

    @property
    def members(self) -> str:
        """`device` or `receiver` where it differs between those, else empty."""
        if "devices" in self.part.params:
            return "device"
        return "receiver" if self.part.effect.of_receiver else ""

    @property
    def shown(self) -> np.ndarray:
        """(n,) bool, links that are drawn: of a receiver those with line of sight, which are the surest."""
        seen = np.isfinite(self.residual_db)
        clear = seen & self.links.los
        return clear if self.part.effect.of_receiver and clear.sum() >= MIN_CLEAR else seen

    def panels(self) -> list[tuple[str, np.ndarray]]:
        """Name and links (indices) of those that it does most to."""
        seen = self.shown
        if not self.members:
            return [("all links", np.flatnonzero(seen))]
        index = getattr(self.links, self.members)
        names = getattr(self.links, f"{self.members}_names")
        links = {int(member): np.flatnonzero(seen & (index == member)) for member in np.unique(index[seen])}
        spread = {member: float(np.std(self.added_db[rows])) for member, rows in links.items()}
        most = sorted(sorted(spread, key=lambda member: -spread[member])[:MAX_MEMBERS])
        return [(f"{self.members} {names[member]}", links[member]) for member in most
                if spread[member] > 0.02 * max(spread.values())]


def acting_alone(loop: Loop, number: int, part: AppliedEffect, parameters: dict[str, Parameter]) -> Acting:
    """What the effect of that number does in the model that learned from all links."""
    whole, fit = loop.after.whole, loop.after.fits[0]
    others = [other for other in whole.parts if other is not part]
    rest = np.delete(fit.coefficients, whole.places[number])
    without_db = whole.with_parts(others).expect(replace(fit, coefficients=rest)).mean_db
    nowhere = ~whole.usable
    return Acting(part, parameters, whole.links, np.where(nowhere, np.nan, without_db),
                  np.where(nowhere, np.nan, whole.expect(fit).mean_db))


def acts_through(acting: Acting) -> tuple[str, float]:
    """The variable that stands best for what the effect adds, and for which share of it."""
    shares = {}
    for name, value in variables(acting.links, acting.without_db).items():
        if value.dtype.kind != "f" or not np.isfinite(value).any():
            continue
        by_panel = [_share(value[rows], acting.added_db[rows]) for _, rows in acting.panels()]
        shares[name] = float(np.mean(by_panel)) if by_panel else 0.0
    best = max(shares, key=lambda name: shares[name])
    return best, shares[best]


def _share(value: np.ndarray, added_db: np.ndarray) -> float:
    seen = np.isfinite(value)
    if not seen.any() or np.var(added_db[seen]) < 1e-12:
        return 0.0
    level = bins(value[seen], BINS)
    mean = np.bincount(level, weights=added_db[seen]) / np.maximum(np.bincount(level), 1)
    return float(np.var(mean[level]) / np.var(added_db[seen]))
