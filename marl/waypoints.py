"""Flights that go about to measure, as actions of the mission: straight from one random cell to the next."""

import numpy as np

from marl.mission import COSTS, HOVER, MOVES, NO_OP, Mission
from radiotwin.scene import Scene
from radiotwin.survey.campaign import fly

PATTERN = "random-waypoint"


def waypoint_actions(scene: Scene, mission: Mission, rng: np.random.Generator) -> np.ndarray:
    """Random-waypoint flights of all UAVs (`radiotwin.survey.patterns`); what the battery has left when no other cell
    can be flown to and home from is hovered away.

    Args:
        scene: its UAVs and buildings.
        mission: the same, as arrays.
        rng: of the paths.

    Returns:
        (T, U) int8 feasible actions
    """
    moves = {tuple(move): action for action, move in enumerate(MOVES) if action not in (HOVER, NO_OP)}
    actions = np.full((mission.longest, mission.uavs), NO_OP, dtype=np.int8)
    for u, uav in enumerate(scene.config.uavs):
        flown = [moves[tuple(step)] for step in np.diff(fly(scene, uav, PATTERN, rng), axis=0)]
        hovers = int(mission.battery[u]) - COSTS[flown].sum()
        actions[:len(flown) + hovers, u] = [*flown, *[HOVER] * hovers]
    return actions
