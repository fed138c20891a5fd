"""Small missions, and slow references of the tests: the mission's rules, features and networks written a second time,
number by number, without any code of the package."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import strategies as st

from marl.mission import Known, Mission, make_mission
from radiotwin.maps.survey import segmented_truth
from studies.generated import generated_mission

FAR = 2**60  # moves home from a cell without a way
STEPS = [(0, 0), (1, 0), (0, -1), (-1, 0), (0, 1), (0, 0)]  # hover, north, west, south, east, no-op: (row, column)
HOVERS = [1, 2, 2, 2, 2, 0]  # cost of each, in half battery units


@pytest.fixture(scope="session", autouse=True)
def one_thread():
    """Sums of several threads may come in another order, and small matrices are slower with them."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def moves_home(blocked, terminal):
    """(rows, columns) moves to the terminal around blocked cells: breadth first, cell by cell."""
    moves = np.full(blocked.shape, FAR, dtype=np.int64)
    queue = [tuple(terminal)] if not blocked[tuple(terminal)] else []
    for cell in queue:
        moves[cell] = 0
    while queue:
        row, column = queue.pop(0)
        for down, right in STEPS[1:5]:
            to = row + down, column + right
            if 0 <= to[0] < blocked.shape[0] and 0 <= to[1] < blocked.shape[1] and not blocked[to] and \
                    moves[to] == FAR:
                moves[to] = moves[row, column] + 1
                queue.append(to)
    return moves


def build(rng, rows=5, columns=5, uavs=2, devices=3, battery=(12, 15, 9), start=None, terminal=None, blocked=None,
          snr_db=None, sigma_db=0.0, data_units=None, known_m=None, step_m=20.0, rate_scale=100.0, threshold_db=10.0,
          detection_db=-np.inf, max_rate=False):
    """A mission from arrays; what is not given is drawn."""
    blocked = np.zeros((rows, columns), dtype=bool) if blocked is None else blocked
    centre = [(rows // 2, columns // 2)] * uavs
    start, terminal = start or centre, terminal or centre
    shape = (uavs, devices, rows, columns)
    snr_db = rng.uniform(-5, 35, shape) if snr_db is None else snr_db
    data_units = rng.uniform(200, 3000, devices) if data_units is None else data_units
    if known_m is None:
        known_m = rng.uniform(0, 1, (devices, 2)) * step_m * np.array([columns - 1, rows - 1])
    return Mission(
        np.broadcast_to(snr_db, shape).astype(np.float32), np.broadcast_to(sigma_db, shape).astype(np.float32),
        np.array([moves_home(blocked, end) for end in terminal]), np.array(start, dtype=np.int64),
        np.array(battery[:uavs], dtype=np.int64), np.arange(uavs), 50.0 + 5.0 * np.arange(uavs), np.array(data_units, dtype=float),
        np.array(known_m, dtype=float), float(step_m), float(rate_scale), float(threshold_db),
        float(detection_db), np.array([72.0, -25.0]), bool(max_rate))


@st.composite
def any_mission(draw):
    """Missions of all shapes, with buildings, silent links, unlocated devices, shadowing and unequal UAVs."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    rows, columns = draw(st.integers(1, 6)), draw(st.integers(1, 6))
    uavs, devices = draw(st.integers(1, 4)), draw(st.integers(1, 6))
    blocked = rng.random((rows, columns)) < draw(st.sampled_from([0.0, 0.2, 0.4]))
    start, terminal, battery = [], [], []
    for _ in range(uavs):
        end = int(rng.integers(rows)), int(rng.integers(columns))
        blocked[end] = False
        terminal.append(end)
    for end in terminal:
        moves = moves_home(blocked, end)
        free = np.argwhere(moves < FAR)
        begin = tuple(int(i) for i in free[rng.integers(len(free))])
        start.append(begin)
        battery.append(max(2 * int(moves[begin]) + int(rng.integers(0, 20)), 1))
    shape = (uavs, devices, rows, columns)
    snr_db = rng.uniform(-10, 40, shape)
    snr_db[rng.random(shape) < 0.2] = -np.inf
    known_m = rng.uniform(-20, 140, (devices, 2))
    known_m[rng.random(devices) < 0.3] = np.nan
    sigma_db = draw(st.sampled_from([0.0, 3.0])) * (rng.random(shape) < 0.8)
    return build(rng, rows, columns, uavs, devices, battery, start, terminal, blocked, snr_db, sigma_db,
                 rng.uniform(1, 2000, devices), known_m, draw(st.sampled_from([7.5, 20.0, 400.0])), 100.0,
                 draw(st.sampled_from([0.0, 10.0])), draw(st.booleans()))


def ways_home(mission, uav):
    """(battery + 1, rows, columns) bool: whether the terminal can be reached, found by trying every action in every
    state; it knows blocked cells and terminal, but no distances."""
    moves = mission.steps_home[uav]
    blocked, rows, columns = moves >= FAR, *moves.shape
    home = np.zeros((int(mission.battery[uav]) + 1, rows, columns), dtype=bool)
    for battery in range(len(home)):
        for row in range(rows):
            for column in range(columns):
                home[battery, row, column] = not blocked[row, column] and (
                    moves[row, column] == 0 or any(can_do(home, a, row, column, battery) for a in range(5)))
    return home


def can_do(home, action, row, column, battery):
    """Whether an action of a UAV that has not landed leaves it on the map and with a way home."""
    to = row + STEPS[action][0], column + STEPS[action][1]
    left = battery - HOVERS[action]
    return left >= 0 and 0 <= to[0] < home.shape[1] and 0 <= to[1] < home.shape[2] and bool(home[left][to])


def feasible(home, row, column, battery):
    """[6] of hover, north, west, south, east, no-op."""
    return [can_do(home, action, row, column, battery) for action in range(5)] + [battery == 0]


def rate(snr_db, scale):
    return scale * math.log(1 + 10 ** (float(snr_db) / 10)) / math.log(2)


def assign(links, max_rate):
    """{uav: device} from {(uav, device): SNR} of the links that can be used."""
    if max_rate:
        best = {u: max((k for v, k in links if v == u), key=lambda k: links[u, k]) for u in {u for u, _ in links}}
        return {u: k for u, k in best.items() if all(links[u, k] >= links[v, k] for v in best if best[v] == k)}
    given = {}
    for u, k in sorted(links, key=links.get, reverse=True):
        if u not in given and k not in given.values():
            given[u] = k
    return given


def usable(mission, frame, e):
    """{(uav, device): SNR} of the links that can be used in a slot of flight e."""
    return {(u, k): float(frame.snr_db[e, u, k]) for u in range(mission.uavs) for k in range(mission.devices)
            if frame.battery[e, u] > 0 and frame.data_units[e, k] > 0 and
            frame.snr_db[e, u, k] >= mission.threshold_db}


def shown_db(mission, snr_db):
    return float(np.clip((snr_db - mission.threshold_db) / 20, -2, 3))


def observation(mission, frame, e, u):
    """Features of UAV u in flight e."""
    side_m = max(mission.steps_home.shape[1] - 1, mission.steps_home.shape[2] - 1, 1) * mission.step_m
    row, column = (int(i) for i in frame.cell[e, u])
    battery = int(frame.battery[e, u])
    seen = []
    for k in range(mission.devices):
        snr_db = float(frame.snr_db[e, u, k])
        works = snr_db >= mission.threshold_db
        offset = (mission.known_m[k] - [column * mission.step_m, row * mission.step_m]) / side_m
        offset = np.zeros(2) if np.isnan(offset).any() else offset
        seen += [shown_db(mission, snr_db), float(works),
                 float(frame.data_units[e, k]) / mission.data_units[k] if works else 0.0,
                 math.hypot(*offset), *offset, float(frame.assigned[e, u] == k)]
    for v in range(mission.uavs):
        if v != u:
            north_m, east_m = (frame.cell[e, v].astype(float) - [row, column]) * mission.step_m
            up_m = mission.altitude_m[v] - mission.altitude_m[u]
            distance_m = math.sqrt(north_m**2 + east_m**2 + up_m**2)
            snr_db = mission.uav_link_db[0] + mission.uav_link_db[1] * math.log10(max(distance_m, 1))
            shown = [1.0, distance_m / side_m, east_m / side_m, north_m / side_m,
                     int(frame.battery[e, v]) / mission.battery[v]]
            seen += [shown_db(mission, snr_db), *(shown if snr_db >= mission.threshold_db else [0.0] * 5)]
    seen += [float(one) for one in feasible(ways_home(mission, u), row, column, battery)]
    return [*seen, battery / mission.battery[u], 2 * mission.steps_home[u, row, column] / mission.battery[u]]


def state(mission, frame, e):
    """The mixer's view of flight e."""
    side_m = max(mission.steps_home.shape[1] - 1, mission.steps_home.shape[2] - 1, 1) * mission.step_m
    seen = []
    for u in range(mission.uavs):
        row, column = (int(i) for i in frame.cell[e, u])
        battery, full = int(frame.battery[e, u]), mission.battery[u]
        seen += [battery / full, 2 * mission.steps_home[u, row, column] / full, column * mission.step_m / side_m,
                 row * mission.step_m / side_m, float(battery == 0)]
    for k in range(mission.devices):
        x, y = (0.5, 0.5) if np.isnan(mission.known_m[k]).any() else mission.known_m[k] / side_m
        seen += [float(frame.data_units[e, k]) / mission.data_units[k], x, y]
    return seen


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


def agent_values(weights, seen, last):
    """Action values of one flight in double precision: (T, U, 6).

    Args:
        weights: {name: array} of the agent.
        seen: (T, U, observation)
        last: (T, U) actions of the slot before, -1 for none.
    """
    w = {name: np.asarray(value, dtype=float) for name, value in weights.items()}
    hidden = len(w["head.weight"][0])
    values = np.empty((*seen.shape[:2], 6))
    for u in range(seen.shape[1]):
        h = np.zeros(hidden)
        for t in range(len(seen)):
            before = [float(last[t, u] == action) for action in range(6)]
            number = [float(u == v) for v in range(seen.shape[1])]
            x = w["encoder.weight"] @ np.concatenate([seen[t, u], before, number]) + w["encoder.bias"]
            i = w["memory.weight_ih_l0"] @ np.maximum(x, 0) + w["memory.bias_ih_l0"]
            j = w["memory.weight_hh_l0"] @ h + w["memory.bias_hh_l0"]
            r, z = sigmoid(i[:hidden] + j[:hidden]), sigmoid(i[hidden:-hidden] + j[hidden:-hidden])
            h = (1 - z) * np.tanh(i[-hidden:] + r * j[-hidden:]) + z * h
            values[t, u] = w["head.weight"] @ h + w["head.bias"]
    return values


def mixed_value(weights, chosen, seen):
    """Q_tot in double precision of one slot: (U,) values, (state,)."""
    w = {name: np.asarray(value, dtype=float) for name, value in weights.items()}

    def layer(name):
        return w[f"{name}.weight"] @ seen + w[f"{name}.bias"]

    hidden = np.abs(layer("first_weight")).reshape(len(chosen), -1).T @ chosen + layer("first_bias")
    hidden = np.where(hidden > 0, hidden, np.exp(np.minimum(hidden, 0)) - 1)
    value = w["value.2.weight"] @ np.maximum(layer("value.0"), 0) + w["value.2.bias"]
    return float(hidden @ np.abs(layer("last_weight")) + value[0])


@pytest.fixture(scope="session")
def slow():
    """Slow reference implementations."""
    return SimpleNamespace(moves_home=moves_home, ways_home=ways_home, feasible=feasible, rate=rate, assign=assign,
                           usable=usable, observation=observation, state=state, agent_values=agent_values,
                           mixed_value=mixed_value, steps=STEPS, hovers=HOVERS, far=FAR)


@pytest.fixture(scope="session")
def tiny():
    """`tiny(seed, …)` is a mission of two UAVs and three devices on 5 x 5 cells, unless options change it."""
    return lambda seed=0, **options: build(np.random.default_rng(seed), **options)


@pytest.fixture(scope="session")
def corners(tiny):
    """A mission, and the largest share of its data that two UAVs can collect.

    Two devices in opposite corners are heard well in the corner and badly one cell beside it; both UAVs start in the
    middle. There and back costs 16 of 24 hovers, so a UAV spends 8 hovers and the slot of its leaving in a corner,
    and passes a cell beside it twice. More of a device than one UAV takes is never there to be had.
    """
    snr_db = np.full((2, 2, 5, 5), -np.inf)
    for k, (corner, beside) in enumerate([((0, 0), [(0, 1), (1, 0)]), ((4, 4), [(4, 3), (3, 4)])]):
        snr_db[(slice(None), k, *corner)] = 25.0
        for cell in beside:
            snr_db[(slice(None), k, *cell)] = 10.0
    mission = tiny(0, devices=2, snr_db=snr_db, battery=(24, 24), data_units=[10_000.0, 10_000.0],
                   known_m=[[0, 0], [80, 80]])
    return mission, 2 * (9 * rate(25.0, 100) + 2 * rate(10.0, 100)) / 20_000


@pytest.fixture(scope="session")
def missions():
    """A hypothesis strategy."""
    return any_mission()


@pytest.fixture(scope="session")
def city():
    """A generated city with 8 devices."""
    return generated_mission(3, devices=8, side_m=(400.0, 300.0))


@pytest.fixture(scope="session")
def city_mission(small_scene):
    """Two UAVs over the small preset, in the statistical truth."""
    return make_mission(small_scene, segmented_truth(small_scene), Known.truth(small_scene))
