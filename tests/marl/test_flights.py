"""Records of flights."""

import numpy as np
import pytest

from marl.environment import Environment
from marl.flights import fly, track_table
from marl.heuristics import HeuristicPolicy


class Watching:
    """Keeps the frames and actions of another policy."""

    def __init__(self, policy):
        self.policy, self.frames, self.actions = policy, [], []

    def start(self, mission, flights):
        self.policy.start(mission, flights)

    def act(self, frame):
        self.frames.append(frame.copy())
        self.actions.append(self.policy.act(frame).copy())
        return self.actions[-1]


def test_a_record_holds_every_frame_and_action(city_mission):
    rng = np.random.default_rng(0)
    watching = Watching(HeuristicPolicy("random", rng))
    flights = fly(Environment(city_mission, 5, rng), watching)
    for slot, (frame, action) in enumerate(zip(watching.frames, watching.actions)):
        for kept, seen in zip(flights.frames, frame):
            np.testing.assert_array_equal(kept[:, slot], seen)
        np.testing.assert_array_equal(flights.action[:, slot], action)
    for e, length in enumerate(flights.length):
        batteries = [frame.battery[e].max() for frame in watching.frames]
        assert batteries[length - 1] > 0 and all(battery == 0 for battery in batteries[length:])
    assert flights.length.max() == len(watching.frames) <= city_mission.longest


def test_a_track_table_says_where_each_uav_was_and_what_it_collected(small_scene, city_mission):
    flights = fly(Environment(city_mission, 3, np.random.default_rng(0)),
                  HeuristicPolicy("random", np.random.default_rng(1)))
    table = track_table(small_scene, city_mission, flights, 2)
    assert table["collected"].sum() == pytest.approx(float(flights.collected[2].sum()), rel=1e-5)
    for u, uav in enumerate(small_scene.config.uavs):
        track = table[table["uav"] == uav.uav]
        assert track.iloc[0][["x_m", "y_m", "z_m"]].tolist() == [uav.start_x_m, uav.start_y_m, uav.altitude_m]
        assert set(np.diff(track["time_s"])) == {small_scene.config.mission.slot_s}
        moves_m = np.hypot(np.diff(track["x_m"]), np.diff(track["y_m"]))
        assert set(moves_m) <= {0.0, 20.0} and (track["collected"] > 0).any()
        assert (track.loc[track["collected"] > 0, "device"] != "").all()
