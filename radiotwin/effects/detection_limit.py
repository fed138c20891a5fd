"""A receiver that is deafer than declared: its links are blank below a limit of its own.

A blank then says "below that limit" (Tobin 1958, 'Estimation of relationships for limited dependent variables',
Econometrica 26) and not "below the declared one". The likeliest limit is the lowest level that the receiver has read.
"""

import numpy as np
from scipy.stats import t

from radiotwin.effects.base import Effect, Parameter, Term, View, measured

LEAST_READ = 40
LEAST_BLANK = 10
LEAST_NATS = 4.0
LEAST_RISE_DB = 2.0
DOF = 4.0
LOWEST = 0.005  # quantile: one odd reading below the limit does not count
NEAREST = 10  # readings that tell how close to the limit they come
CHANCE = np.log(10.0)  # a gap this many times the usual one is as rare as one in ten


class DetectionLimit(Effect):
    """A limit for each receiver that it helps."""

    name = "noise_floor_censoring"
    variant = "a receiver's own limit of detection"
    of_receiver = True
    stage = "limit"
    confused_with = ("lock_loss", "missing_obstacle", "receiver_gain_offset")

    def lacks(self, records) -> str | None:
        return None if np.isnan(records.level_db).any() else "no link is blank"

    def propose(self, view: View) -> list[dict]:
        records, found = view.records, {}
        blank = np.isnan(records.level_db)
        for receiver in measured(records.receiver[~blank], LEAST_READ):
            mine = records.receiver == receiver
            missed = mine & blank
            if missed.sum() < LEAST_BLANK:
                continue
            limit_db = float(np.quantile(records.level_db[mine & ~blank], LOWEST))
            declared_db = -np.inf if records.limit_db is None else records.limit_db
            mean_db, scale_db = view.mean_db[missed], view.scale_db[missed]
            nats = (t.logcdf((limit_db - mean_db) / scale_db, DOF)
                    - (t.logcdf((declared_db - mean_db) / scale_db, DOF) if np.isfinite(declared_db) else 0.0))
            if limit_db > declared_db + LEAST_RISE_DB and nats.sum() / view.design_effect > LEAST_NATS:
                found[str(receiver)] = limit_db
        return [{"receivers": found}] if found else []

    def term(self, records, setting, at) -> Term:
        return Term.of_offset(np.zeros(len(records)))

    def limits_db(self, records, setting) -> np.ndarray:
        limit_db = np.full(len(records.receiver_names), -np.inf)
        for receiver, value in setting["receivers"].items():
            limit_db[int(receiver)] = value
        return limit_db[records.receiver]

    def parameters(self, records, setting, found) -> dict[str, Parameter]:
        result = {}
        for receiver, limit_db in setting["receivers"].items():
            read_db = np.sort(records.level_db[(records.receiver == int(receiver)) & (records.level_db >= limit_db)])
            gap_db = (read_db[min(NEAREST, len(read_db) - 1)] - read_db[0]) / min(NEAREST, len(read_db) - 1)
            result[f"limit[{records.receiver_names[int(receiver)]}]"] = Parameter(
                limit_db, limit_db - CHANCE * float(gap_db), float(read_db[0]), "dB" if records.is_gain else "dBm")
        return result
