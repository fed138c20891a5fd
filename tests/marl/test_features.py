"""Observations and states, number by number."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from marl.environment import Environment, global_state, observation_size, observe, state_size
from marl.heuristics import random_actions


@given(st.data(), st.integers(0, 2**32 - 1), st.integers(0, 4))
@settings(max_examples=40, deadline=None)
def test_features_are_those_of_the_paper(missions, slow, data, seed, slots):
    mission, rng = data.draw(missions), np.random.default_rng(seed)
    environment = Environment(mission, 2, rng)
    environment.reset()
    for _ in range(slots):
        environment.step(random_actions(mission, environment.frame, rng))
    observation, mask = observe(mission, environment.frame)
    state = global_state(mission, environment.frame)
    assert observation.shape == (2, mission.uavs, observation_size(mission))
    assert state.shape == (2, state_size(mission))
    for e in range(2):
        np.testing.assert_allclose(state[e], slow.state(mission, environment.frame, e), atol=2e-6)
        for u in range(mission.uavs):
            np.testing.assert_allclose(observation[e, u], slow.observation(mission, environment.frame, e, u), atol=2e-6)
            np.testing.assert_array_equal(mask[e, u], observation[e, u, -8:-2])
    assert np.isfinite(observation).all() and np.isfinite(state).all()


def test_features_use_the_known_positions_not_the_true_ones(tiny):
    # The same radio, other beliefs: agents see them, and nothing else changes.
    mission = tiny(0)
    moved = mission._replace(known_m=mission.known_m + 8.0)
    frame = Environment(mission, 1, np.random.default_rng(0)).reset()
    seen, elsewhere = observe(mission, frame)[0][0, 0], observe(moved, frame)[0][0, 0]
    changed = np.flatnonzero(seen != elsewhere)
    assert set(changed % 7) <= {3, 4, 5} and changed.max() < 7 * mission.devices
