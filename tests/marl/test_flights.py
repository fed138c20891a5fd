"""Records of flights."""

import numpy as np
import pytest

from marl.environment import Environment
from marl.flights import fly, track_table
from marl.heuristics import HeuristicPolicy


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
