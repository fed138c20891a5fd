"""Random actions in the place of the best ones, each kept for a while.

Steps of one slot each take a UAV to and fro, and hardly ever to a device at the other end of the city. Kept for longer
they do (temporally extended ε-greedy exploration; Dabney, Ostrovski and Barreto, ICLR 2021, with a geometric
distribution in the place of their zeta distribution).
"""

import numpy as np


class Exploration:
    """Exploration of E flights with U UAVs, each for itself.

    Args:
        epsilon: share of the slots that UAVs spend on excursions.
        mean_slots: mean length of an excursion, 1 or more; it ends before its time where its action is not feasible.
        rng: of when, how long and where.
    """

    def __init__(self, epsilon: float, mean_slots: float, rng: np.random.Generator):
        self._mean_slots, self._rng = mean_slots, rng
        # Of the slots in which a UAV follows its policy or begins to leave it, so many are beginnings.
        self._chance = epsilon / (mean_slots - epsilon * (mean_slots - 1))

    def start(self, flights: int, uavs: int) -> None:
        """Forget the flights before."""
        self._kept = np.zeros((flights, uavs), dtype=np.int64)
        self._left = np.zeros((flights, uavs), dtype=np.int64)

    def change(self, action: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """What is flown in this slot.

        Args:
            action: (E, U) what the policy would do.
            mask: (E, U, 6) feasible actions.

        Returns:
            (E, U) feasible actions
        """
        sets_out = (self._rng.random(action.shape) < self._chance) & (self._left == 0)
        lots = np.where(mask, self._rng.random(mask.shape), -1.0).argmax(axis=-1)
        self._kept[sets_out] = lots[sets_out]
        self._left[sets_out] = self._slots(action.shape)[sets_out]
        out = (self._left > 0) & np.take_along_axis(mask, self._kept[..., None], axis=-1)[..., 0]
        self._left = np.where(out, self._left - 1, 0)
        return np.where(out, self._kept, action)

    def _slots(self, shape: tuple[int, ...]) -> np.ndarray:
        if self._mean_slots == 1:
            return np.ones(shape, dtype=np.int64)
        return self._rng.geometric(1 / self._mean_slots, shape)
