"""Effects of receivers and devices: gains, drifts, noise, faults of a flight, and electronics with a memory."""

import numpy as np

from tests.undeclared.foreign.draws import between, cut, device, either, receiver, times
from tests.undeclared.foreign.scenario import Hidden, Scenario


def receiver_gain_offset(at: Scenario, rng: np.random.Generator) -> Hidden:
    """A receiver reads too much, or its cable takes too much."""
    name, mine = receiver(at, rng)
    offset_db = either(rng, 0.8, 9)
    change_db = mine * offset_db
    truth = {"receiver": name, "offset_db": round(offset_db, 3)}
    if offset_db < 0:
        return Hidden("receiver_gain_offset", True, truth, air_db=change_db)
    return Hidden("receiver_gain_offset", True, truth, reads=lambda level_db: level_db + change_db)


def device_gain_offset(at: Scenario, rng: np.random.Generator) -> Hidden:
    """A device sends more or less than all others."""
    number, name = device(at, rng)
    offset_db = either(rng, 0.8, 10)
    return Hidden("device_gain_offset", True, {"device": name, "offset_db": round(offset_db, 3)},
                  air_db=(at.device == number) * offset_db)


def _course(at: Scenario, rng: np.random.Generator) -> tuple[dict, np.ndarray]:
    """(n,) a gain in time, 0 at first: a step, a slope, or warming up."""
    time_s = at.of_links("time_s")
    kind, size_db = str(rng.choice(["step", "ageing", "warm_up"])), either(rng, 1, 9)
    if kind == "step":
        step_s = cut(at, rng)
        return {"kind": kind, "step_db": round(size_db, 3), "time_s": step_s}, size_db * (time_s >= step_s)
    span_s = time_s.max() - time_s.min()
    if kind == "ageing":
        return {"kind": kind, "last_db": round(size_db, 3)}, size_db * (time_s - time_s.min()) / span_s
    constant_s = span_s * rng.uniform(0.08, 0.3)
    return ({"kind": kind, "final_db": round(size_db, 3), "time_constant_s": round(constant_s)},
            size_db * -np.expm1(-(time_s - time_s.min()) / constant_s))


def receiver_drift(at: Scenario, rng: np.random.Generator) -> Hidden:
    """A receiver's gain changes in time."""
    (name, mine), (truth, change_db) = receiver(at, rng), _course(at, rng)
    return Hidden("receiver_drift", True, {"receiver": name} | truth, reads=lambda level_db: level_db + mine * change_db)


def device_drift(at: Scenario, rng: np.random.Generator) -> Hidden:
    """A device's power changes in time."""
    (number, name), (truth, change_db) = device(at, rng), _course(at, rng)
    return Hidden("device_drift", True, {"device": name} | truth, air_db=(at.device == number) * change_db)


def receiver_saturation(at: Scenario, rng: np.random.Generator) -> Hidden:
    """A receiver's strongest readings come out too low: a hard limit of a converter, or a soft one."""
    name, mine = receiver(at, rng)
    heard = mine & np.isfinite(at.plain_db)
    most_db = float(np.quantile(at.plain_db[heard], 1 - between(rng, 0.05, 0.5)))
    kind = str(rng.choice(["hard", "soft"]))

    def reads(level_db: np.ndarray) -> np.ndarray:
        if kind == "hard":
            return np.where(mine, np.minimum(level_db, most_db), level_db)
        amplitude = 10**((level_db - most_db) / 20)
        with np.errstate(divide="ignore"):
            return np.where(mine, most_db + 20 * np.log10(np.tanh(amplitude)), level_db)

    return Hidden("receiver_saturation", True, {"receiver": name, "kind": kind, "saturation_db": round(most_db, 2)},
                  reads=reads)


def noise_floor(at: Scenario, rng: np.random.Generator) -> Hidden:
    """A receiver's readings contain its own noise."""
    name, mine = receiver(at, rng)
    floor_db = float(np.quantile(at.plain_db[mine & np.isfinite(at.plain_db)], between(rng, 0.1, 0.5)))
    return Hidden("noise_floor_censoring", True, {"receiver": name, "floor_db": round(floor_db, 2)},
                  adds_db=np.where(mine, floor_db, -np.inf))


def lock_loss(at: Scenario, rng: np.random.Generator) -> Hidden:
    """A receiver loses lock: for a few readings in a row its levels drop, or are blank."""
    name, mine = receiver(at, rng)
    share, run = between(rng, 0.06, 0.4), rng.uniform(2, 9)
    state = np.zeros(at.points, dtype=bool)
    for point in range(1, at.points):  # two states in turn, whose mean lengths give the share
        leave = 1 / run if state[point - 1] else share / (1 - share) / run
        state[point] = state[point - 1] ^ (rng.random() < leave)
    out = state[at.point] & mine
    truth = {"receiver": name, "lost_share": round(float(out.sum() / mine.sum()), 3)}
    if rng.random() < 0.5:
        return Hidden("lock_loss", True, truth | {"kind": "blank"}, lost=out)
    drop_db = rng.uniform(10, 40)
    return Hidden("lock_loss", True, truth | {"kind": "drop", "drop_db": round(drop_db, 1)},
                  reads=lambda level_db: level_db - drop_db * out)


def faulty_flight(at: Scenario, rng: np.random.Generator) -> Hidden:
    """One flight of one receiver: a wrong cable, a noisy amplifier, or a receiver whose position hangs."""
    campaign = at.where.campaign
    flight = int(rng.choice(np.unique(campaign.flight)))
    number = int(rng.choice(np.unique(campaign.receiver[campaign.flight == flight])))
    its = (campaign.flight == flight) & (campaign.receiver == number)
    kind = str(rng.choice(["cable", "noise", "stale"], p=[0.5, 0.25, 0.25]))
    truth = {"flight": f"f{flight + 1}", "receiver": f"r{number + 1}", "kind": kind}
    if kind == "cable":
        offset_db = -between(rng, 3, 15)
        return Hidden("faulty_flight", True, truth | {"offset_db": round(offset_db, 2)}, air_db=its[at.point] * offset_db)
    if kind == "noise":
        noise_db = between(rng, 4, 12)
        more_db = rng.normal(0, noise_db, at.links) * its[at.point]
        return Hidden("faulty_flight", True, truth | {"noise_db": round(noise_db, 2)}, reads=lambda level_db: level_db + more_db)
    hang, written_m = int(rng.integers(6, 25)), campaign.points_m.copy()
    rows = np.flatnonzero(its)
    written_m[rows] = campaign.points_m[rows[np.arange(len(rows)) // hang * hang]]
    return Hidden("faulty_flight", True, truth | {"readings_a_position": hang}, written_m=written_m)


def episode(at: Scenario, rng: np.random.Generator) -> Hidden:
    """Between two times levels are lower, of one receiver or of all."""
    (name, mine), everyone = receiver(at, rng), rng.random() < 0.5
    start_s, end_s = times(at, rng, rng.uniform(0.05, 0.3))
    loss_db, time_s = between(rng, 3, 15), at.of_links("time_s")
    during = (time_s >= start_s) & (time_s < end_s) & (everyone | mine)
    return Hidden("episode", True, {"receiver": "all" if everyone else name, "start_s": start_s, "end_s": end_s,
                                    "loss_db": round(loss_db, 2)}, air_db=-loss_db * during)


def agc_hysteresis(at: Scenario, rng: np.random.Generator) -> Hidden:
    """A receiver's attenuator goes in above one level and out below a lower one; readings are corrected badly."""
    name, mine = receiver(at, rng)
    rows = np.flatnonzero(mine)
    heard_db = at.plain_db[rows][np.isfinite(at.plain_db[rows])]
    upper_db, width_db, wrong_db = float(np.quantile(heard_db, rng.uniform(0.5, 0.85))), rng.uniform(6, 15), either(rng, 2.5, 8)
    order = rows[np.lexsort((at.device[rows], at.of_links("time_s")[rows], at.device[rows]))]
    is_in, state, last = np.zeros(at.links, dtype=bool), False, -1
    for link in order:
        state = state and at.device[link] == last
        state = at.plain_db[link] > (upper_db - width_db if state else upper_db)
        is_in[link], last = state, at.device[link]
    return Hidden("agc_hysteresis", False, {"receiver": name, "upper_db": round(upper_db, 1), "width_db": round(width_db, 1),
                                            "wrong_db": round(wrong_db, 2)}, reads=lambda level_db: level_db + wrong_db * is_in)


def heater_cycle(at: Scenario, rng: np.random.Generator) -> Hidden:
    """A heater near a receiver's amplifier goes on and off: its gain follows as a saw-tooth."""
    name, mine = receiver(at, rng)
    size_db, period_s = between(rng, 2, 7), rng.uniform(40, 400)
    tooth = np.abs((at.of_links("time_s") / period_s + rng.random()) % 1 * 2 - 1) - 0.5
    change_db = size_db * tooth * mine
    return Hidden("heater_cycle", False, {"receiver": name, "size_db": round(size_db, 2), "period_s": round(period_s)},
                  reads=lambda level_db: level_db + change_db)
