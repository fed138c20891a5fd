"""What is flown where a policy of somebody else's asks for an action that is not feasible."""

import numpy as np


def safe(action: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The actions, and instead of each that is not feasible the first one that is: hovering where the battery allows
    it, otherwise a move after which home can still be reached, and no-op after the landing.

    Args:
        action: (E, U) int.
        mask: (E, U, 6) bool, feasible actions, as `marl.features.observe` gives them.

    Returns:
        (E, U) int64 feasible actions
    """
    action = np.asarray(action, dtype=np.int64)
    feasible = np.take_along_axis(mask, action[..., None], axis=-1)[..., 0]
    return np.where(feasible, action, mask.argmax(axis=-1))
