"""Base of effects with an end at another position: the channel predicts the links again from it."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable
from typing import Any

import numpy as np
from typing_extensions import override

from radiotwin.effects.arrays import MIN_LINKS, MIN_NATS, subsample
from radiotwin.effects.base import Effect, GainEffect, LevelAt, ResidualView, Term
from radiotwin.links import Links

MAX_ENDS = 60  # ends whose positions are tested; more take too long
MAX_PROPOSE_LINKS = 600  # of an end, drawn at random to test moves


class MovedEnd(GainEffect):
    """A device or receiver at another position than given; each search step finds the worst one."""

    repeatable = True
    always_exact = True  # paths along streets determine the position
    params: Any

    @override
    def propose_for_fold(self, view: ResidualView) -> list[Any]:
        rows = np.isin(np.arange(len(view.links)), self.rows(view.links))
        return self.propose(view.of_group(rows)) if rows.sum() >= MIN_LINKS else []

    def rows(self, links: Links) -> np.ndarray:
        """Return the rows (r,) of the moved end's links; by default of a receiver."""
        return np.flatnonzero(links.receiver == self.params.receiver)

    @abstractmethod
    def moved(self, links: Links) -> Links:
        """Return these links with the end at its new position."""

    @override
    def term(self, links: Links, level_at: LevelAt) -> Term:
        """Return the change of predicted levels if the end is at its new position [dB]."""
        offset_db, rows = np.zeros(len(links)), self.rows(links)
        given = links.select(rows)
        offset_db[rows] = level_at(self.moved(given), self.is_exact) \
            - level_at(given, self.is_exact)
        return Term.of_offset(offset_db)

    @override
    def exactly(self) -> Effect:
        return self.with_params(self.params, "exact")

    def best_move(self, view: ResidualView, ends: Iterable[list[Any]]) -> list[Any]:
        """Find the position correction of the highest log-likelihood gain; [] if below `MIN_NATS`.

        Args:
            view: residuals.
            ends: for each device or receiver, the parameters of its trial positions.
        """
        links, best, most_nats = view.links, [], MIN_NATS
        for moves in ends:
            all_rows = self.with_params(moves[0]).rows(links)
            rows = subsample(all_rows, MAX_PROPOSE_LINKS)
            given, links_per_row = links.select(rows), len(all_rows) / len(rows)
            before_db = view.level_at(given)
            for params in moves:
                change_db = view.level_at(self.with_params(params).moved(given)) - before_db
                nats = links_per_row * view.gain_nats(rows, change_db).sum()
                if nats > most_nats:
                    best, most_nats = [params], nats
        return best
