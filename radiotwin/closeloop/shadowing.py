"""`correlated_shadowing`, the last resort: what no named effect explains is interpolated over the ground.

A Gaussian process over the place of the end that moves, one field for each of the ends that do not (the exponential
model of shadowing, Gudmundson 1991, Electronics Letters 27), and beside it an error of each receiver in each field. It
explains nothing: it says that the rest of the error has a place. It is no candidate among the effects, because it would
fit part of whatever they stand for.
"""

from dataclasses import dataclass

import numpy as np

from radiotwin.channel.residual_field import ResidualField
from radiotwin.closeloop.model import Side
from radiotwin.closeloop.records import Records
from radiotwin.closeloop.regression import Solution, expect, residual_db

NAME = "correlated_shadowing"
MOST_Z = 6.0  # an outlier counts as this many scales


@dataclass(frozen=True, eq=False)
class Shadowing:
    """A field for each end that does not move.

    Attributes:
        field: of the residual in units of its own standard deviation.
        sigma: that standard deviation, in units of the error scale.
        receivers_move: whether devices stand still and receivers move, or the other way round.
        certain: whether it lowers the error scale where it was measured.
    """

    field: ResidualField
    sigma: float
    receivers_move: bool
    certain: bool = True

    @classmethod
    def fit(cls, side: Side, solution: Solution, seed: int) -> "Shadowing":
        """Learn from the training links of a side what its base and effects leave over."""
        problem = side.training
        z = np.clip(residual_db(problem, solution) / expect(problem, solution).scale_db, -MOST_Z, MOST_Z)
        sigma = max(float(z.std()), 1e-6)
        shadowing = cls(ResidualField(), sigma, receivers_move(side.records))
        series, position_m, kind = shadowing._points(side.records.select(side.train))
        shadowing.field.fit(series, position_m, (z - z.mean()) / sigma, seed, kind)
        return shadowing

    def at(self, records: Records) -> tuple[np.ndarray, np.ndarray]:
        """What it adds (n,) [error scales], and the factor (n,) that is left of the error scale."""
        mean, spread = self.field.predict(*self._points(records))
        return self.sigma * mean, spread if self.certain else np.ones_like(spread)

    def state(self) -> dict:
        """What JSON can hold and `from_state` reads; positions to the decimetre."""
        arrays, settings = self.field.state()
        return {"sigma": self.sigma, "receivers_move": self.receivers_move, "certain": self.certain,
                "settings": settings,
                "arrays": {name: array.round(1 if name.startswith("position") else 4).tolist()
                           for name, array in arrays.items()}}

    @classmethod
    def from_state(cls, state: dict) -> "Shadowing":
        """What `state` gave."""
        arrays = {name: np.array(array, dtype=float) for name, array in state["arrays"].items()}
        return cls(ResidualField.from_state(arrays, state["settings"]), state["sigma"], state["receivers_move"],
                   state["certain"])

    def _points(self, records: Records) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Series, position and kind of links. Where two receivers were at one place, their difference shows."""
        if self.receivers_move:
            return records.device, records.receiver_m, records.receiver
        return records.receiver, records.device_m[records.device], None


def receivers_move(records: Records) -> bool:
    """Whether receivers have been in more places than devices are in."""
    return len(np.unique(records.receiver_m[:, :2].round(), axis=0)) >= len(records.device_names)
