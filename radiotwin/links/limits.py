"""Estimate each receiver's limit of detection from its readings; a declared limit may be wrong.

A receiver reports a level y with the probability Φ((y - limit) / width). A link may also be lost at
any level. The likelihood of a limit has two factors: the readings, few of which are below it, and
the blanks, which crude predictions put below it (Tobit: Tobin 1958; p-tobit: Deaton and Irish
1984). The width and the share of lost links are averaged out.

The crude prediction has one slope over distance and a level for each device and receiver. It needs
neither a map nor line of sight. Links of devices without a known position have no distance.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import log_ndtr, logsumexp, ndtr, stdtr

from radiotwin.display import some
from radiotwin.inference.student import DOF
from radiotwin.io.texts import percent
from radiotwin.links.evidence import design_effect, evidence_blocks
from radiotwin.links.links import Links

SLOPE_DB, SLOPE_SD_DB = -30.0, 10.0  # prior per decade of distance: path-loss exponent 2 to 4
END_SD_DB = 8.0  # prior spread of the levels of devices, and of receivers
MIN_LINKS = 5  # of a device or receiver, to estimate a level for it
LEVEL_ROUNDS = 8  # EM iterations
FIRST_SD_DB, MIN_SD_DB = 8.0, 6.0  # first and smallest standard deviation of crude predictions
LOST = 0.02  # probability that a link is blank although its level is above the limit
FIRST_BELOW_DB = 3.0  # first guess of how far a blank is below its limit
MIN_READINGS, MIN_BLANKS = 30, 10  # of a receiver, to estimate its limit
BIN_DB, FINE_DB = 0.5, 0.05  # rounding of predicted levels, and of readings, to save time
WIDTHS_DB = (0.2, 0.7, 1.5, 3.0)  # of the transition from never to always detected
WIDTH_SHARES = (0.4, 0.3, 0.2, 0.1)  # prior of these: most transitions are sharp
LOST_SHARES = (1e-3, 0.01, 0.03, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 1.0)  # of the blanks
OUTLIER = 1e-3  # probability of a reading below the limit
OUTLIER_SHARE = 2e-3  # share of the lowest readings that may be outliers
STEP_DB, MAX_STEPS = 0.25, 160  # grid of candidate limits
BELOW_DB, HIGHEST = 8.0, 0.3  # lowest candidate below the readings; quantile of the highest one
SD_SHARE = np.sqrt((DOF - 2) / DOF)  # scale of a t distribution over its standard deviation
MIN_NATS = 5.0  # evidence for a limit, or against a declared one: odds of 150 to 1
RISE_DB, FALL_DB = 2.0, 1.0  # an estimate so far above or below a declared limit agrees with it
SURE_SDS = 3.0  # standard deviations beyond that interval, to overrule a declared limit
ROUNDS = 2  # alternate estimates of levels and of limits
QUANTILE_90 = 1.645  # half a 90 % interval of a normal distribution, in standard deviations
MIN_OFF_DB = 0.5  # a declared limit that is off by less is used
MIN_BELOW, BELOW_SHARE = 3, 0.002  # readings below a declared limit that contradict it
FAR_DB = 20.0  # a declared limit so far below all readings is ignored
DIFFER_DB = 3.0  # difference between receivers that a note reports
DEAF_DB, DEAF_SDS = 6.0, 4.5  # excess over the usual limit of an insensitive receiver
MAX_NAMED = 5  # receivers in a note


def crude_level(level_db: np.ndarray, limit_db: np.ndarray, distance_m: np.ndarray,
                device: np.ndarray, receiver: np.ndarray) -> tuple[np.ndarray, float]:
    """Predict levels by a line over lg distance and an offset per device and receiver.

    Links (n,) that were not detected count as below the limit, by EM for censored normal levels
    (Dempster, Laird and Rubin 1977, 'Maximum likelihood from incomplete data via the EM algorithm',
    JRSS B 39, Sec. 4.2), or not at all if the limit is -inf (unknown). An unknown distance is NaN.
    Returned are the predicted level of each link, and the standard deviation of its error [dB].
    """
    blank = np.isnan(level_db)
    limited = blank & np.isfinite(limit_db)
    limit = np.where(limited, limit_db, 0.0)
    filled_db = np.where(blank, limit - FIRST_BELOW_DB, level_db)
    counted = ~blank | limited
    filled_db[~counted] = filled_db[counted].mean()
    distance = np.log10(distance_m)
    known = np.isfinite(distance)
    distance = np.where(known, distance, distance[known].mean() if known.any() else 0.0)
    distance = distance - distance.mean()
    ends = [_frequent(device), _frequent(receiver)]
    end_db = [np.zeros(end.max() + 1) for end in ends]
    slope_db, sd_db, variance = SLOPE_DB, FIRST_SD_DB, np.zeros(len(level_db))
    for _ in range(LEVEL_ROUNDS):
        for number, end in enumerate(ends):
            residual_db = filled_db - slope_db * distance - end_db[1 - number][ends[1 - number]]
            residual_db = residual_db - residual_db[counted].mean()
            sums = np.bincount(end[counted], residual_db[counted], len(end_db[number]))
            count = np.bincount(end[counted], minlength=len(end_db[number]))
            end_db[number] = sums / (count + (sd_db / END_SD_DB) ** 2)
        residual_db = filled_db - sum(each_db[end] for each_db, end in
                                      zip(end_db, ends, strict=True))
        x, y = distance[counted], residual_db[counted] - residual_db[counted].mean()
        x = x - x.mean()
        weight = (sd_db / SLOPE_SD_DB) ** 2
        slope_db = float((x @ y + weight * SLOPE_DB) / (x @ x + weight))
        residual_db = residual_db - slope_db * distance
        mean_db = residual_db[counted].mean() + filled_db - residual_db
        error = ((filled_db - mean_db) ** 2 + variance)[counted]
        sd_db = max(float(np.sqrt(error.mean())), MIN_SD_DB)
        z = (limit - mean_db) / sd_db
        ratio = np.exp(-0.5 * z * z - 0.5 * np.log(2 * np.pi) - log_ndtr(z))
        below = (1 - LOST) * ndtr(z)
        below = below / (below + LOST)  # probability that a blank was too weak, and not lost
        shift = np.where(limited, below * -ratio, 0.0)
        filled_db = np.where(blank, mean_db + sd_db * shift, level_db)
        variance = np.where(limited, sd_db**2 * np.clip(1 - ratio * (ratio + z), 0, 1), 0.0)
    return mean_db, sd_db


def _frequent(label: np.ndarray) -> np.ndarray:
    """Renumber labels (n,) from 1; labels of fewer than `MIN_LINKS` links share the number 0."""
    frequent = np.bincount(label) >= MIN_LINKS
    return np.where(frequent, np.cumsum(frequent), 0)[label]


@dataclass(frozen=True)
class LimitEstimate:
    """Estimated limit of detection of one receiver.

    Attributes:
        limit_db: posterior mean under a flat prior [dB].
        sd_db: posterior standard deviation [dB].
        nats: log odds of a limit against blanks that do not depend on the level.
        over_declared_nats: log-likelihood ratio to the declared limit; 0 without one.
    """

    limit_db: float
    sd_db: float
    nats: float
    over_declared_nats: float = 0.0

    @property
    def is_sure(self) -> bool:
        """Whether a limit explains the blanks clearly better than lost links do."""
        return self.nats > MIN_NATS


def receiver_limit(level_db: np.ndarray, mean_db: np.ndarray, scale_db: np.ndarray,
                   links_per_observation: float, declared_db: float = -np.inf,
                   ) -> LimitEstimate | None:
    """Estimate the weakest level that one receiver detects; None with few readings or blanks.

    Levels (n,) are NaN if not detected; predicted levels and their error scales (Student-t, `DOF`)
    are (n,) [dB], too. `links_per_observation`, see `design_effect`, count as one.
    """
    blank = np.isnan(level_db)
    read_db = np.sort(level_db[~blank])
    if len(read_db) < MIN_READINGS or blank.sum() < MIN_BLANKS:
        return None
    low_db = read_db[int(OUTLIER_SHARE * len(read_db))]
    high_db = max(np.quantile(read_db, HIGHEST), low_db + BELOW_DB)
    count = min(int((high_db - low_db + BELOW_DB) / STEP_DB) + 2, MAX_STEPS)
    tried_db = np.append(np.linspace(low_db - BELOW_DB, high_db, count),
                         declared_db if np.isfinite(declared_db) else low_db)
    nats, no_limit_nats = _log_likelihoods(tried_db, read_db, mean_db[blank], scale_db[blank],
                                           links_per_observation)
    nats, declared = nats[:-1], nats[-1]
    weight = np.exp(nats - nats.max())
    weight /= weight.sum()
    limit_db = float(weight @ tried_db[:-1])
    variance = float(weight @ (tried_db[:-1] - limit_db) ** 2) + (tried_db[1] - tried_db[0])**2 / 12
    over_declared = float(nats.max() - declared) if np.isfinite(declared_db) else 0.0
    odds = float(logsumexp(nats) - np.log(len(nats)) - no_limit_nats)
    return LimitEstimate(limit_db, float(np.sqrt(variance)), odds, over_declared)


def _log_likelihoods(tried_db: np.ndarray, read_db: np.ndarray, mean_db: np.ndarray,
                     scale_db: np.ndarray, links_per_observation: float,
                     ) -> tuple[np.ndarray, float]:
    """Return the log-likelihood [nats] of candidate limits of detection (k,), and of no limit.

    Readings ascend; predicted level and error scale [dB] are of the blanks (m,). A blank is below
    the limit, or lost at any level; lost share and width of the transition are averaged over.
    """
    readings, blanks = len(read_db), len(mean_db)
    mean_db = np.round(mean_db / BIN_DB) * BIN_DB
    predicted, times = np.unique(mean_db + 1j * scale_db, return_counts=True)
    below = stdtr(DOF, (tried_db[:, None] - predicted.real) / predicted.imag)
    share = blanks / (readings + blanks)
    lost = np.array(LOST_SHARES) * share
    of_blanks = np.array([np.log(p + (1 - p) * below) @ times for p in lost])
    of_blanks += readings * np.log1p(-lost)[:, None]
    levels_db, times = np.unique(np.round(read_db[read_db < tried_db.max() + 4 * max(WIDTHS_DB)]
                                          / FINE_DB) * FINE_DB, return_counts=True)
    of_readings = np.array([
        np.log(OUTLIER + (1 - OUTLIER) * ndtr((levels_db - tried_db[:, None]) / width)) @ times
        for width in WIDTHS_DB])
    log_likelihood = (of_readings[:, None] + of_blanks) / links_per_observation
    prior = np.array(WIDTH_SHARES)[:, None, None] / len(lost)
    nats = logsumexp(log_likelihood, axis=(0, 1), b=prior)
    return nats, (blanks * np.log(share) + readings * np.log1p(-share)) / links_per_observation


def estimate_limits(links: Links, declared_db: float | None) -> tuple[np.ndarray, list[str]]:
    """Estimate the weakest level that each receiver detects, and test the limit that is declared.

    The present limits are ignored. Returned are the limit (n,) of each link, as levels, and notes.
    The limit is -inf of a receiver without blanks and declared limit, or with blanks at any level.
    """
    declared = -np.inf if declared_db is None else declared_db
    ignored = _reason_to_ignore(links, declared)
    if ignored is not None:
        declared = -np.inf
    count = np.bincount(links.receiver, minlength=len(links.receiver_names))
    rows = np.split(np.argsort(links.receiver, kind="stable"), np.cumsum(count)[:-1])
    found, pooled = _estimates(links, rows, declared)
    usual_db = _usual_db(links, rows, found, pooled, declared)
    limits_db, lost = np.full(len(rows), -np.inf), []
    for receiver, part in enumerate(rows):
        estimate, level_db = found[receiver], links.level_db[part]
        read_db = level_db[np.isfinite(level_db)]
        trusted = np.isfinite(declared) and not contradict_limit(read_db, declared)
        if estimate is not None and estimate.is_sure:
            near = abs(estimate.limit_db - declared) < MIN_OFF_DB  # despite outliers below it
            trusted = near or trusted and not _overrules(estimate, read_db, declared)
            limits_db[receiver] = declared if trusted else estimate.limit_db
        elif len(read_db) == len(level_db):
            limits_db[receiver] = declared if trusted and usual_db == declared else -np.inf
        elif usual_db is not None and not contradict_limit(read_db, usual_db - RISE_DB):
            limits_db[receiver] = usual_db  # too few blanks for an estimate
        else:
            lost.append(receiver)
    notes = _notes(links, rows, limits_db, found, declared, lost)
    if ignored is not None:
        used = _used_instead(links, limits_db, found, list(range(len(rows))))
        notes.insert(0, f"{ignored}. {used}")
    return limits_db[links.receiver], notes


def _reason_to_ignore(links: Links, declared_db: float) -> str | None:
    """Return why a declared limit of detection is ignored, a sentence; None if it may be right.

    Of levels that vary continuously, some would lie just above a real limit.
    """
    readings, lowest_db = int(np.isfinite(links.level_db).sum()), _lowest_db(links.level_db)
    blanks = len(links) - readings
    if not np.isfinite(declared_db) or not readings or blanks < MIN_BLANKS:
        return None
    if lowest_db - declared_db < FAR_DB:
        return None
    return (f"{_declared_text(links, declared_db)} is not used: but for odd ones, the weakest of "
            f"{readings:,} readings is {lowest_db:g} {links.level_unit}, far above it, though "
            f"{blanks:,} links are blank")


def _declared_text(links: Links, declared_db: float) -> str:
    """Return words for a declared limit: its value, and where it is declared."""
    of = "sensitivity_dbm less tx_power_dbm" if links.is_gain else "sensitivity_dbm"
    return (f"the declared limit of detection, {declared_db:g} {links.level_unit} ({of} in "
            "scene.toml),")


def _usual_db(links: Links, rows: list[np.ndarray], found: list[LimitEstimate | None],
              pooled: LimitEstimate | None, declared_db: float) -> float | None:
    """Return the limit [dB] for receivers without an estimate of their own; None if unknown.

    The declared one, unless most sure estimates overrule it; else their median, else the estimate
    from all links if it is sure, or the lowest reading if there is none.
    """
    sure = [(each, part) for each, part in zip(found, rows, strict=True) if each and each.is_sure]
    if np.isfinite(declared_db):
        estimates = sure or ([(pooled, np.arange(len(links)))] if pooled else [])
        against = sum(_overrules(each, np.sort(links.level_db[part]), declared_db)
                      for each, part in estimates)
        if 2 * against <= len(estimates):
            return declared_db
    if sure:
        return float(np.quantile([each.limit_db for each, _ in sure], 0.5, method="lower"))
    if pooled is None:
        return float(np.nanmin(links.level_db))
    return pooled.limit_db if pooled.is_sure else None


def contradict_limit(read_db: np.ndarray, limit_db: float) -> bool:
    """Return whether more readings (n,) are `FALL_DB` below a limit than outliers explain."""
    below = np.count_nonzero(read_db < limit_db - FALL_DB)
    return bool(below >= max(MIN_BELOW, BELOW_SHARE * len(read_db)))


def _overrules(found: LimitEstimate, read_db: np.ndarray, declared_db: float) -> bool:
    """Return whether an estimated limit of detection is to replace the declared one.

    They must differ by more than their errors explain, the likelihood be clearly against the
    declared limit, and no readings (n,) [dB] reach down to that.
    """
    rise_db = found.limit_db - declared_db
    off_db = max(rise_db - RISE_DB, -rise_db - FALL_DB)
    reaches = rise_db > 0 and contradict_limit(read_db, declared_db + RISE_DB + FALL_DB)
    sure = off_db > SURE_SDS * found.sd_db and found.over_declared_nats > MIN_NATS
    return found.is_sure and sure and not reaches


def _estimates(links: Links, rows: list[np.ndarray], declared_db: float,
               ) -> tuple[list[LimitEstimate | None], LimitEstimate | None]:
    """Estimate the limit of each receiver, by its links `rows`, and of all; None: too few links."""
    blank = np.isnan(links.level_db)
    if not blank.any():
        return [None] * len(rows), None
    lowest_db = np.array([_lowest_db(links.level_db[part]) for part in rows])
    limits_db = np.where(np.isfinite(lowest_db), lowest_db, lowest_db.min())
    block = evidence_blocks(links)
    for _ in range(ROUNDS):
        crude_db, crude_sd_db = crude_level(links.level_db, limits_db[links.receiver],
                                            links.distance_m, links.device, links.receiver)
        z = np.where(blank, 0.0, (links.level_db - crude_db) / crude_sd_db)
        links_per_observation = design_effect(block, z)
        scale_db = np.full(len(links), SD_SHARE * crude_sd_db)
        *found, pooled = [
            receiver_limit(links.level_db[part], crude_db[part], scale_db[part],
                           links_per_observation, declared_db)
            for part in (*rows, np.arange(len(links)))]
        before_db, limits_db = limits_db, np.array([
            each.limit_db if each is not None and each.is_sure else limit_db
            for each, limit_db in zip(found, limits_db, strict=True)])
        if np.abs(limits_db - before_db).max() < STEP_DB:
            break
    return found, pooled


def _lowest_db(level_db: np.ndarray) -> float:
    """Return the lowest level [dB] that is no outlier, of levels (n,); inf without a reading."""
    read_db = np.sort(level_db[np.isfinite(level_db)])
    return float(read_db[int(OUTLIER_SHARE * len(read_db))]) if len(read_db) else np.inf


def _notes(links: Links, rows: list[np.ndarray], limits_db: np.ndarray,
           found: list[LimitEstimate | None], declared_db: float, lost: list[int]) -> list[str]:
    """Note receivers whose limit is not the declared one, limits that differ, and `lost` links."""
    unit, notes = links.level_unit, []
    other = [r for r, limit_db in enumerate(limits_db)
             if np.isfinite(declared_db) and limit_db != declared_db]
    known_db = limits_db[np.isfinite(limits_db)]
    if other:
        level_db = links.level_db[np.concatenate([rows[r] for r in other])]
        read_db = level_db[np.isfinite(level_db)]
        below = int((read_db < declared_db).sum())
        fact = "no reading lies near it"
        if below:
            fact = (f"{below:,} of {len(read_db):,} readings ({percent(below / len(read_db))}) lie "
                    f"below it, down to {read_db.min():g}")
        notes.append(f"{_declared_text(links, declared_db)} does not fit the readings: {fact}. "
                     f"{_used_instead(links, limits_db, found, other)}")
    elif len(known_db) and np.ptp(known_db) > DIFFER_DB:
        low, high = (links.receiver_names[int(np.flatnonzero(limits_db == end)[0])]
                     for end in (known_db.min(), known_db.max()))
        notes.append(f"limits of detection differ between receivers: from {known_db.min():.1f} "
                     f"{unit} ({low}) to {known_db.max():.1f} {unit} ({high}), by their readings")
    unsure = [r for r in lost if (each := found[r]) is not None and each.nats > 0]
    for receivers, what in (([r for r in lost if r not in unsure], "are blank at any level"),
                            (unsure, "may be blank at any level, or below a limit")):
        if receivers:
            names = some([links.receiver_names[r] for r in receivers])
            notes.append(f"links of receiver {names} {what}: they count as lost, "
                         "not as weak")
    return notes


def _used_instead(links: Links, limits_db: np.ndarray, found: list[LimitEstimate | None],
                  receivers: list[int]) -> str:
    """Return a sentence with the limits that replace a declared one, of `MAX_NAMED` receivers."""
    used = "; ".join(_limit_text(links.receiver_names[r], limits_db[r], found[r], links.level_unit)
                     for r in receivers[:MAX_NAMED])
    more = len(receivers) - MAX_NAMED
    return f"Used instead: {used}" + f" and {more:,} more" * (more > 0)


def _limit_text(name: str, limit_db: float, found: LimitEstimate | None, unit: str) -> str:
    """Describe a receiver's limit of detection, with half its 90 % interval if it was estimated."""
    if np.isinf(limit_db):
        return f"none for {name}, as no blank shows one"
    estimated = found is not None and limit_db == found.limit_db
    how = f" ± {QUANTILE_90 * found.sd_db:.1f}" if found is not None and estimated else ""
    return f"{limit_db:.1f}{how} {unit} for {name}"


def with_usual_limits(links: Links) -> Links:
    """Set limits that are unknown, or far above the usual limit of detection, to the usual one.

    Blanks that are predicted above it then need another explanation. If no limit is known and there
    are blanks, the lowest reading is taken for the limit of all.
    """
    usual_db = links.usual_limit_db
    if usual_db is None:
        if not np.isnan(links.level_db).any():
            return links
        lowest_db = np.full(len(links), np.nanmin(links.level_db))
        return links.with_columns(limit_db=lowest_db)
    off_db = links.receiver_limits_db - usual_db
    scatter_db = 1.48 * np.quantile(np.abs(off_db[np.isfinite(off_db)]), 0.5, method="lower")
    deaf = off_db > max(DEAF_DB, DEAF_SDS * scatter_db)
    shift_db = np.where(deaf, off_db, 0.0)[links.receiver]
    return links.with_columns(limit_db=np.where(
        np.isfinite(links.limit_db), links.limit_db - shift_db, usual_db))
