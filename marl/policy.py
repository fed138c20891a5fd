"""A small pretrained policy that flies missions it was not trained on (`--algorithm policy`).

Each device with data is a token, and each move is described by how it approaches the devices in the
map. Tokens are pooled by mean, maximum and attention, so any number of devices is possible. All
UAVs share the weights. The network imitates the planner's plans slot by slot.
`python -m studies.policy train` trains it.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from safetensors.torch import load_file
from torch import Tensor, nn
from typing_extensions import override

from marl.environment import ACTION_COUNT, Frame, ManyWorlds, feasible
from marl.flights import Policy
from marl.learner import Learner
from marl.mission import HOVER, MOVES, NO_OP, Mission
from marl.planner import expected_data, plan
from radiotwin.runtime.compiled import List, njit

WEIGHTS = Path(__file__).with_name("policy.safetensors")
BEST_RATE = 10.0  # unit of rates, about that of the best link [bit/s/Hz]
PRICES = np.array([3.0, 12.0, 40.0])  # flight steps that are worth a factor e of the rate
FAR = 200.0  # steps that count for a device that is not heard anywhere
MOVE_COUNT = NO_OP  # actions of a flying UAV: all but the no-op
TOKEN, OWN, MOVE, APPROACH = 26, 10, 2, len(PRICES) + 1  # numbers of features


class Outlook(NamedTuple):
    """Features of a map that do not change in flight; P prices.

    Attributes:
        rate: (L, K, ny, nx) float32 expected rate in a slot [`BEST_RATE`].
        away: (L, K, ny, nx, P) float32 cost of approaching a device [steps]: the least sum over all
            cells of the steps there and the price of its lower rate.
        peak: (L, K, 2) int64 cell (row, column) with the device's highest rate.
        heard: (L, K, K) float32 rates of all devices in that cell.
    """

    rate: np.ndarray
    away: np.ndarray
    peak: np.ndarray
    heard: np.ndarray

    @classmethod
    def of(cls, mission: Mission) -> "Outlook":
        """Compute the features of a mission's map."""
        rate = expected_data(mission) / np.float32(BEST_RATE * mission.rate_scale)
        levels, devices, rows, columns = rate.shape
        places = rate.reshape(levels, devices, -1)
        best = places.argmax(axis=2)
        heard = np.stack([each[:, at].T for each, at in zip(places, best)])
        away = np.empty((*rate.shape, len(PRICES)), np.float32)
        _spread(rate, away)
        return cls(rate, away, np.stack(np.unravel_index(best, (rows, columns)), axis=-1),
                   np.ascontiguousarray(heard))


class Seen(NamedTuple):
    """Input features of the network for N flying UAVs and K devices.

    Attributes:
        token: (N, K, TOKEN) float32 features of each device for the UAV.
        waiting: (N, K) bool, devices that have data and are heard somewhere; others are masked.
        own: (N, OWN) float32 features of the UAV and the team.
        approach: (N, MOVE_COUNT, K, APPROACH) float32 how much a move approaches each device.
        move: (N, MOVE_COUNT, MOVE) float32 features of each move.
        mask: (N, MOVE_COUNT) bool feasible moves.
    """

    token: np.ndarray
    waiting: np.ndarray
    own: np.ndarray
    approach: np.ndarray
    move: np.ndarray
    mask: np.ndarray

    @classmethod
    def blank(cls, count: int, devices: int) -> "Seen":
        """Return zero features of `count` UAVs."""
        shapes = ((devices, TOKEN), (devices,), (OWN,), (MOVE_COUNT, devices, APPROACH),
                  (MOVE_COUNT, MOVE), (MOVE_COUNT,))
        return cls(*(np.zeros((count, *shape), np.bool_ if i in (1, 5) else np.float32)
                     for i, shape in enumerate(shapes)))

    def first(self, count: int) -> list[Tensor]:
        """Return a copy of the first `count` rows as tensors, and reset these rows to zero."""
        rows = [torch.tensor(array[:count]) for array in self]
        for array in self:
            array[:count] = 0
        return rows


@njit(cache=True, nogil=True)
def _spread(rate: np.ndarray, away: np.ndarray) -> None:
    """Fill `away`, the costs of `Outlook.away`, from rates by a two-pass distance transform."""
    levels, devices, rows, columns = rate.shape
    for level, k in np.ndindex(levels, devices):
        for p in range(len(PRICES)):
            steps = away[level, k, :, :, p]
            for i, j in np.ndindex(rows, columns):
                here = rate[level, k, i, j]
                steps[i, j] = min(-PRICES[p] * np.log(here), FAR) if here > 0 else FAR
                if i > 0:
                    steps[i, j] = min(steps[i, j], steps[i - 1, j] + 1)
                if j > 0:
                    steps[i, j] = min(steps[i, j], steps[i, j - 1] + 1)
            for i in range(rows - 1, -1, -1):
                for j in range(columns - 1, -1, -1):
                    if i < rows - 1:
                        steps[i, j] = min(steps[i, j], steps[i + 1, j] + 1)
                    if j < columns - 1:
                        steps[i, j] = min(steps[i, j], steps[i, j + 1] + 1)


@njit(cache=True, nogil=True)
def _write_features(mission: Mission, outlook: Outlook, frame: Frame, e: int, seen: Seen, n: int,
                    ) -> int:
    """Write features of flight `e`'s flying UAVs to `seen` from row `n`; return the next row."""
    battery, left = frame.battery[e], frame.data_units[e]
    uavs, devices = len(battery), len(left)
    mask, drain, waiting = np.empty(ACTION_COUNT, np.bool_), np.zeros(devices), left > 0
    for u in range(uavs):
        if battery[u] == 0:
            continue
        level, row, column = mission.level[u], frame.cell[e, u, 0], frame.cell[e, u, 1]
        home = mission.steps_home[u, row, column]
        slack = battery[u] - 2 * home
        for k in range(devices):
            best = outlook.heard[level, k, k]
            waiting[k] = left[k] > 0 and best > 0
            # Slots needed to collect its data from the best cell
            drain[k] = left[k] / (best * BEST_RATE * mission.rate_scale) if waiting[k] else 0.0
        count = waiting.sum()
        own = seen.own[n]
        own[0], own[1] = battery[u] / 100, home / 40
        own[2], own[3] = slack / 40, np.exp(-slack / 10)
        own[4] = drain.sum() / battery.sum()
        own[5], own[6] = (battery > 0).sum() / 5, count / 15
        own[7] = left.sum() / mission.data_units.sum()
        own[8] = np.log(1 + drain.sum() / max(count, 1)) / 3
        own[9] = frame.assigned[e, u] >= 0
        for k in range(devices):
            seen.waiting[n, k] = waiting[k]
            if waiting[k]:
                _write_device_features(mission, outlook, frame, e, u, k, drain[k],
                                       left.sum() / count, slack, seen.token[n, k])
        feasible(mission, u, row, column, battery[u], mask)
        for move in range(MOVE_COUNT):
            seen.mask[n, move] = mask[move]
            if not mask[move]:
                continue
            to_row, to_column = row + MOVES[move, 0], column + MOVES[move, 1]
            seen.move[n, move, 0] = move == HOVER
            seen.move[n, move, 1] = mission.steps_home[u, to_row, to_column] - home
            for k in range(devices):
                if waiting[k]:
                    away, rate = outlook.away[level, k], outlook.rate[level, k]
                    nearer = seen.approach[n, move, k]
                    nearer[:-1] = away[row, column] - away[to_row, to_column]
                    nearer[-1] = 5 * (rate[to_row, to_column] - rate[row, column])
        n += 1
    return n


@njit(cache=True, nogil=True)
def _write_device_features(mission: Mission, outlook: Outlook, frame: Frame, e: int, u: int, k: int,
                           drain: float, mean_left: float, slack: float, token: np.ndarray) -> None:
    """Write the features of device `k` for UAV `u` of flight `e` to `token` (TOKEN,).

    `drain` is the slots needed to collect its data, `mean_left` the mean data of waiting devices,
    `slack` the battery beyond the way home [hovers].
    """
    level, row, column = mission.level[u], frame.cell[e, u, 0], frame.cell[e, u, 1]
    battery, left, assigned = frame.battery[e], frame.data_units[e], frame.assigned[e]
    away = outlook.away[level, k, row, column]
    rate = outlook.rate[level, k, row, column]
    to_row, to_column = outlook.peak[level, k]
    steps = abs(to_row - row) + abs(to_column - column)
    home = min(mission.steps_home[u, to_row, to_column], sum(mission.steps_home.shape[1:]))
    lacking = max(2 * (steps + home) - battery[u], 0)
    token[0] = left[k] / mission.data_units[k]
    token[1], token[2] = drain / 10, np.log(1 + drain) / 2
    token[3], token[15] = rate, outlook.heard[level, k, k]
    snr_db = frame.snr_db[e, u, k]
    if snr_db >= mission.threshold_db:
        token[4] = np.log2(1 + 10 ** (snr_db / 10)) / BEST_RATE
    token[5] = assigned[u] == k
    token[6:9] = away / 20
    token[9], token[10] = steps / 20, np.exp(-steps / 5)
    token[11], token[12], token[13] = home / 20, lacking / 20, lacking > 0
    for j in range(len(left)):
        if j != k and left[j] > 0:
            token[14] += outlook.heard[level, k, j]
    nearest, ahead = FAR, 0
    for v in range(len(battery)):
        if v != u and battery[v] > 0:
            place = mission.level[v], k, frame.cell[e, v, 0], frame.cell[e, v, 1]
            of_other = outlook.away[place][1]
            nearest = min(nearest, of_other)
            ahead += of_other < away[1] or (of_other == away[1] and v < u)
            token[20] += assigned[v] == k
            token[21] = max(token[21], outlook.rate[place])
    token[16] = min(nearest, 60) / 20
    token[17] = min(max((nearest - away[1]) / 20, -2), 2)
    token[18], token[19] = ahead / 2, ahead == 0
    token[22] = 2 * (steps + home) / battery[u]
    token[23] = min(drain / slack, 3) if slack > 1 else 1
    token[24], token[25] = left[k] / mean_left / 2, rate > 0


@njit(cache=True, nogil=True)
def _write_features_of_flights(mission: Mission, outlook: Outlook, frame: Frame, seen: Seen) -> int:
    """Write the features of all UAVs flying in a mission to `seen`; return their number."""
    n = 0
    for e in range(len(frame.battery)):
        n = _write_features(mission, outlook, frame, e, seen, n)
    return n


@njit(cache=True, nogil=True)
def _write_features_of_worlds(missions: "List[Mission]", outlooks: "List[Outlook]",
                              frames: "List[Frame]", seen: Seen) -> int:
    """Write the features of all UAVs flying in many worlds to `seen`; return their number."""
    n = 0
    for w in range(len(missions)):
        n = _write_features(missions[w], outlooks[w], frames[w], 0, seen, n)
    return n


class EntityNetwork(nn.Module):
    """Network that scores the moves of N UAVs.

    Attention weights tell how much each device attracts the UAV. A move is scored by how it
    approaches the devices, weighted by attention. Half of the heads also pool the device features.
    """

    def __init__(self, width: int = 48, heads: int = 6) -> None:
        super().__init__()
        self.device, self.own = nn.Linear(TOKEN, width), nn.Linear(OWN, width)
        self.again, self.pooled = nn.Linear(width, width), nn.Linear(2 * width, width)
        self.attention = nn.Linear(width, heads)
        self.state = nn.Linear((heads // 2 + 1) * width, width)
        self.move, self.beside = nn.Linear(heads * APPROACH + MOVE, width), nn.Linear(width, width)
        self.score = nn.Linear(width, 1)

    def forward(self, token: Tensor, waiting: Tensor, own: Tensor, approach: Tensor, move: Tensor,
                mask: Tensor) -> Tensor:
        """Return the (N, MOVE_COUNT) scores of the moves; arguments are those of `Seen`."""
        valid = waiting[..., None]
        device = (self.device(token) + self.own(own)[:, None]).relu() * valid
        mean = device.sum(1) / valid.sum(1).clamp(min=1)
        pooled = self.pooled(torch.cat([mean, device.amax(1)], 1))
        device = (self.again(device) + pooled[:, None]).relu() * valid
        weight = self.attention(device).masked_fill(~valid, -1e9).softmax(1).transpose(1, 2)
        weight = weight * waiting[:, None]
        pooled = (weight[:, :weight.shape[1] // 2] @ device).flatten(1)
        state = self.state(torch.cat([pooled, mean], 1)).relu()
        near = (weight[:, None] @ approach).flatten(2)
        hidden = self.move(torch.cat([near, move], 2)) + self.beside(state)[:, None]
        return self.score(hidden.relu())[..., 0].masked_fill(~mask, -1e9)


class EntityPolicy:
    """Policy that flies the move with the best score, given the map that the UAVs have."""

    def __init__(self, network: EntityNetwork, believed: Mission) -> None:
        self._network, self._mission = network, believed
        self._outlook = Outlook.of(believed)

    def start(self, mission: Mission, flights: int) -> None:
        """See `marl.flights.Policy`; the map of the mission that is flown is not read."""
        self._seen = Seen.blank(flights * self._mission.uavs, self._mission.devices)

    def act(self, frame: Frame) -> np.ndarray:
        """See `marl.flights.Policy`."""
        action = np.full(frame.battery.shape, NO_OP)
        count = _write_features_of_flights(self._mission, self._outlook, frame, self._seen)
        with torch.inference_mode():
            score = self._network(*self._seen.first(count))
        action[frame.battery > 0] = score.argmax(1).numpy()
        return action


class Pretrained(Learner):
    """`--algorithm policy`: fly the pretrained network of this package."""

    learns = False

    @override
    def policy(self, rng: np.random.Generator) -> Policy:
        return EntityPolicy(read_network(WEIGHTS), self.mission)


def read_network(path: Path) -> EntityNetwork:
    """Load a network from a safetensors file."""
    network = EntityNetwork()
    network.load_state_dict(load_file(path))
    return network


def demonstrations(missions: list[Mission], iterations: int, rng: np.random.Generator,
                   ) -> list[Tensor]:
    """Plan in many missions, fly the plans, and record features and moves for imitation.

    Returns:
        The fields of `Seen`, each with a row for every UAV and slot in which it still flew, in all
        missions (N rows), and (N,) the move that it then took.
    """
    uavs, devices = (max(sizes) for sizes in zip(*((m.uavs, m.devices) for m in missions)))
    slots = max(mission.longest for mission in missions)
    actions = np.full((slots, len(missions), uavs), NO_OP)
    for world, mission in enumerate(missions):
        planned = plan(mission, iterations, int(rng.integers(2**31))).actions
        actions[:len(planned), world, :mission.uavs] = planned
    worlds = ManyWorlds(missions, uavs, rng)
    outlooks = List([Outlook.of(mission) for mission in missions])
    seen, parts = Seen.blank(actions[0].size, devices), []
    for action in actions:
        count = _write_features_of_worlds(worlds.missions, outlooks, worlds.frames, seen)
        parts.append((*seen.first(count), torch.from_numpy(action[worlds.battery > 0])))
        worlds.step(action)
    return [torch.cat(each) for each in zip(*parts)]


def imitate(shown: list[Tensor], updates: int, seed: int, batch: int = 1024, rate: float = 3e-3,
            on_progress: Callable[[int], None] = lambda _: None) -> EntityNetwork:
    """Train a network to predict the moves of `demonstrations` (cross entropy, Adam).

    The learning rate falls linearly to a hundredth of `rate`.
    """
    torch.manual_seed(seed)
    network, rng = EntityNetwork(), np.random.default_rng(seed)
    optimiser = torch.optim.Adam(network.parameters(), rate)
    decay = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.01, updates)
    for _ in range(updates):
        rows = torch.from_numpy(rng.integers(0, len(shown[0]), batch))
        *seen, move = (each[rows] for each in shown)
        loss = nn.functional.cross_entropy(network(*seen), move)
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        decay.step()
        on_progress(1)
    return network
