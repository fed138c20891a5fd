"""Ends of links that are elsewhere: the channel predicts again, lines of sight included."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable
from typing import Any

import numpy as np
from typing_extensions import override

from radiotwin.effects.arrays import subsample
from radiotwin.effects.base import Effect, GainEffect, LevelAt, ResidualView, Term
from radiotwin.links import Links

MIN_LINKS = 60  # of an end that is moved about
MAX_ENDS = 60  # that are moved about, or it takes too long
MIN_NATS = 6.0  # that a move must gain to be proposed
MAX_PROPOSE_LINKS = 600  # of an end, on which moves are tried


class MovedEnd(GainEffect):
    """An end that is not where its links have it; one step finds one, the worst."""

    repeatable = True
    always_exact = True  # a map's streets are what shows where it was
    params: Any

    @override
    def propose_like(self, view: ResidualView) -> list[Any]:
        rows = np.isin(np.arange(len(view.links)), self.rows(view.links))
        return self.propose(view.of_group(rows)) if rows.sum() >= MIN_LINKS else []

    @abstractmethod
    def rows(self, links: Links) -> np.ndarray:
        """Return the rows (r,) of the links of that end."""

    @abstractmethod
    def moved(self, links: Links) -> Links:
        """Return links of that end with it where it is."""

    @override
    def term(self, links: Links, level_at: LevelAt) -> Term:
        offset_db, rows = np.zeros(len(links)), self.rows(links)
        mine = links.select(rows)
        offset_db[rows] = level_at(self.moved(mine), self.is_exact) - level_at(mine, self.is_exact)
        return Term.of_offset(offset_db)

    @override
    def exactly(self) -> Effect:
        return self.with_params(self.params, "exact")

    def best_move(self, view: ResidualView, ends: Iterable[list[Any]]) -> list[Any]:
        """Return the parameters with which links gain most; none where they gain too little.

        Args:
            view: residuals.
            ends: of each end that may be elsewhere, parameters with the moves that are tried.
        """
        links, best, most_nats = view.links, [], MIN_NATS
        for moves in ends:
            every = self.with_params(moves[0]).rows(links)
            rows = subsample(every, MAX_PROPOSE_LINKS)
            mine, share = links.select(rows), len(every) / len(rows)
            before_db = view.level_at(mine)
            for params in moves:
                change_db = view.level_at(self.with_params(params).moved(mine)) - before_db
                nats = share * view.gain_nats(rows, change_db).sum()
                if nats > most_nats:
                    best, most_nats = [params], nats
        return best
