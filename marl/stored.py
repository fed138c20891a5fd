"""Checks of what a checkpoint holds, before it is used: compiled code checks no index."""

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from marl.checkpoint import Damaged
from marl.environment import ACTION_COUNT, feasible
from marl.mission import COSTS, MOVES, Mission

MAX_COUNT = 10**15
_GENERATOR = {"state": 2**128, "inc": 2**128, "has_uint32": 2, "uinteger": 2**32}


def require_fields(state: Any, names: Collection[str]) -> dict:
    """Return a dict after a check that it has these names and no others.

    Raises:
        Damaged: it has not.
    """
    if not isinstance(state, dict) or set(state) != set(names):
        raise Damaged(f"a part should have the fields {', '.join(sorted(names))}")
    return state


def require_count(value: Any, high: int = MAX_COUNT) -> int:
    """Return a whole number from 0 to `high` after a check.

    Raises:
        Damaged: it is none.
    """
    if type(value) is not int or not 0 <= value <= high:
        raise Damaged(f"{str(value)[:40]} should be a whole number from 0 to {high}")
    return value


def require_array(value: Any, like: np.ndarray, low: ArrayLike, high: ArrayLike) -> np.ndarray:
    """Return an array after a check of type, shape and range.

    Args:
        value: to check.
        like: of the same type and shape.
        low: least value; NaN is none.
        high: greatest value.

    Raises:
        Damaged: it differs.
    """
    if not isinstance(value, np.ndarray) or value.dtype != like.dtype or value.shape != like.shape:
        raise Damaged(f"an array should be {like.dtype.name} of the shape {like.shape}")
    if not ((value >= low) & (value <= high)).all():
        raise Damaged(f"an array should hold numbers from {low!s} to {high!s}")
    return value


def require_tensors(given: Any, like: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return named tensors after a check of names, types and shapes; all numbers are finite.

    Raises:
        Damaged: they differ.
    """
    for name, tensor in require_fields(given, like).items():
        if not isinstance(tensor, torch.Tensor) or tensor.dtype != like[name].dtype \
                or tensor.shape != like[name].shape or not tensor.isfinite().all():
            raise Damaged(f"weights {name} should be finite, of the shape "
                          f"{tuple(like[name].shape)}")
    return given


def require_generator(state: Any) -> dict:
    """Return the state of numpy's default generator after a check.

    Raises:
        Damaged: it is none.
    """
    require_fields(state, ("bit_generator", "state", "has_uint32", "uinteger"))
    require_fields(state["state"], ("state", "inc"))
    for name, end in _GENERATOR.items():
        require_count((state if name in state and name != "state" else state["state"])[name],
                      end - 1)
    if state["bit_generator"] != "PCG64":
        raise Damaged("the generator of random numbers is another one")
    return state


def require_plan(actions: Any, mission: Mission) -> np.ndarray:
    """Return (T, U) actions of a plan after a check that they can be flown.

    Args:
        actions: to check.
        mission: to be flown; its map does not matter.

    Raises:
        Damaged: one of them is not feasible.
    """
    like = np.zeros((mission.longest, mission.uavs), np.int8)
    require_array(actions, like, 0, ACTION_COUNT - 1)
    possible = np.zeros(ACTION_COUNT, dtype=np.bool_)
    for uav in range(mission.uavs):
        (row, column), battery = map(int, mission.start[uav]), int(mission.battery[uav])
        for action in map(int, actions[:, uav]):
            feasible(mission, uav, row, column, battery, possible)
            if not possible[action]:
                raise Damaged("a plan leaves the map, or does not come home")
            row, column = row + int(MOVES[action, 0]), column + int(MOVES[action, 1])
            battery -= int(COSTS[action])
    return actions
