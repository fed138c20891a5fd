"""Campaigns of a made city with one fault or none: numpy alone, nothing of the package's models.

UAVs fly and cars drive between boxes. Levels follow one law with line of sight and one without, each
device with its own smooth errors over the ground (what a wrong map does), and receivers have tolerances,
noise, steps and limits.

    campaign = draw_campaign(7)          # seed; FAULTS in turn, one of three without any, one of four in the open
    campaign.table, campaign.devices     # for Measurements
    campaign.los, campaign.change_db     # (n,) of the table's rows
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd

FAULTS = ("device_gain", "receiver_gain", "receiver_step", "receiver_drift", "device_step", "garbage_flight",
          "garbage_track", "receiver_flight", "device_flight", "device_receiver", "moved_later", "moved",
          "jammer", "park", "sector", "body", "lost_lock")
NULLS = 0.3  # share of campaigns


@dataclass(frozen=True, eq=False)
class MadeCampaign:
    """n rows of a table.

    Attributes:
        fault: one of `FAULTS`, or an empty text.
        ends: names of its device, receiver and flights, by kind.
        place_m: rectangles x, x, y, y of it [m].
        table, devices: as in the files; blank levels were not detected.
        boxes: (b, 5) buildings as the map has them, off by a metre: x, x, y, y and height [m].
        los: (n,) bool.
        change_db: (n,) what the fault adds to each reading [dB]; NaN where it takes the reading away.
    """

    fault: str
    ends: dict[str, set[str]]
    place_m: tuple[tuple[float, float, float, float], ...]
    table: pd.DataFrame
    devices: pd.DataFrame
    boxes: np.ndarray
    los: np.ndarray
    change_db: np.ndarray


def draw_campaign(seed: int) -> MadeCampaign:
    """Draw a campaign; equal seeds give equal ones."""
    rng = np.random.default_rng([41, seed])
    fault = "" if rng.random() < NULLS else FAULTS[seed % len(FAULTS)]
    while True:
        made = _Draw(rng, is_open=seed % 4 == 0)
        change_db, ends, place_m = made.add(fault)
        heard_db = made.read(change_db)
        acts = np.isnan(change_db) | (np.abs(change_db) > 0.3)
        if not fault or (acts & (np.isfinite(heard_db) | np.isnan(change_db))).sum() >= 40:
            break
    return MadeCampaign(fault, ends, place_m, made.table(heard_db), made.device_table(), made.mapped(), made.los, change_db)


class _Draw:
    """City, tracks and levels; n links, every device at every point."""

    def __init__(self, rng: np.random.Generator, is_open: bool) -> None:
        self.rng, side_m = rng, rng.uniform(350, 800)
        self.side_m = side_m
        self.boxes = _boxes(side_m, rng)[:0 if is_open else None]
        self.k, self.r = int(rng.integers(4, 10)), int(rng.choice([1, 2, 3, 4], p=[0.1, 0.4, 0.35, 0.15]))
        self.f = int(rng.integers(3, 8))
        self.device_m = np.column_stack([_outside(self.boxes, side_m, self.k, rng), rng.uniform(1.5, 25, self.k)])
        self._fly(rng)
        points = len(self.point_m)
        self.device = np.tile(np.arange(self.k), points)
        for name in ("point_m", "receiver", "flight", "time_s", "heading_deg"):
            setattr(self, name, np.repeat(getattr(self, name), self.k, axis=0))
        self.los = ~_blocked(self.device_m[self.device], self.point_m, self.boxes)
        self.law = {True: (rng.uniform(1.9, 2.2), 40.0), False: (rng.uniform(2.6, 3.6), rng.uniform(38, 48))}
        self.sd_db = {True: rng.uniform(1.5, 4) if is_open else rng.uniform(0.5, 1.5), False: rng.uniform(3, 8)}
        self.noise_db, self.step_db = rng.uniform(0.4, 2.0), float(rng.choice([0.25, 1.0]))
        self.shadowing = {los: self._fields(rng.uniform(25, 60), rng) for los in (True, False)}
        self.tolerance_db = (rng.normal(0, 0.3, self.k), rng.normal(0, 0.3, self.r))
        plain_db = self.level_db(self.device_m[self.device])
        self.limit_db = np.quantile(plain_db, rng.uniform(0.0, 0.15)) + rng.normal(0, 0.5, self.r)
        self.plain_db = plain_db

    def _fly(self, rng: np.random.Generator) -> None:
        together, drives = rng.random() < 0.6, rng.random() < 0.3
        crews = [range(self.r) if together else [flight % self.r] for flight in range(self.f)]
        if not together:
            self.f = max(self.f, 2 * self.r)
            crews = [[flight % self.r] for flight in range(self.f)]
        each = int(rng.integers(300, 420)) // sum(len(crew) for crew in crews)
        parts, start_s = [], 0.0
        for flight, crew in enumerate(crews):
            for receiver in crew:
                z_m = 1.6 if drives else rng.uniform(25, 110)
                xy_m = _track(self.boxes if z_m < 30 else self.boxes[:0], self.side_m, each, rng)
                course = np.gradient(xy_m, axis=0)
                parts.append((np.column_stack([xy_m, np.full(each, z_m)]), np.full(each, receiver),
                              np.full(each, flight), start_s + 2.0 * np.arange(each),
                              np.degrees(np.arctan2(course[:, 0], course[:, 1])) % 360))
            start_s += 2.0 * each + rng.uniform(60, 600)
        columns = (np.concatenate(column) for column in zip(*parts, strict=True))
        self.point_m, self.receiver, self.flight, self.time_s, self.heading_deg = columns

    def _fields(self, scale_m: float, rng: np.random.Generator) -> np.ndarray:
        """(n,) smooth errors of unit size: half of a device alone, a part of the place for all."""
        wave = rng.normal(0, 1 / scale_m, (self.k + 1, 30, 2))
        phase = rng.uniform(0, 2 * np.pi, (self.k + 1, 30))
        xy_m = self.point_m[:, :2]
        of_device = np.cos(np.einsum("nij,nj->ni", wave[self.device], xy_m) + phase[self.device]).sum(axis=1)
        of_all = np.cos(xy_m @ wave[-1].T + phase[-1]).sum(axis=1)
        return (0.85 * of_device + 0.5 * of_all) * np.sqrt(2 / 30)

    def level_db(self, device_m: np.ndarray) -> np.ndarray:
        """(n,) gain from devices at (n, 3) [dB]."""
        away_m = np.maximum(np.linalg.norm(self.point_m - device_m, axis=1), 2.0)
        los = ~_blocked(device_m, self.point_m, self.boxes)
        found = np.empty(len(away_m))
        for seen, (slope, intercept_db) in self.law.items():
            part = los == seen
            found[part] = (-intercept_db - 10 * slope * np.log10(away_m[part])
                           + self.sd_db[seen] * self.shadowing[seen][part])
        return found + self.tolerance_db[0][self.device] + self.tolerance_db[1][self.receiver]

    def read(self, change_db: np.ndarray) -> np.ndarray:
        """(n,) readings, NaN below the limit."""
        level_db = self.plain_db + change_db + self.rng.normal(0, self.noise_db, len(change_db))
        heard = level_db >= self.limit_db[self.receiver]
        return np.where(heard, np.round(level_db / self.step_db) * self.step_db, np.nan)

    def table(self, level_db: np.ndarray) -> pd.DataFrame:
        given_m = self.point_m + self.rng.normal(0, 0.3, (1, 3))
        return pd.DataFrame({
            "time_s": self.time_s, "flight": [f"f{one}" for one in self.flight],
            "receiver": [f"r{one}" for one in self.receiver], "receiver_x_m": given_m[:, 0].round(2),
            "receiver_y_m": given_m[:, 1].round(2), "receiver_z_m": given_m[:, 2].round(2),
            "device": [f"d{one}" for one in self.device], "gain_db": level_db, "heading_deg": self.heading_deg})

    def mapped(self) -> np.ndarray:
        """(b, 5) boxes with the errors of a map [m]."""
        return self.boxes + self.rng.normal(0, 1, self.boxes.shape) * [0.5, 0.5, 0.5, 0.5, 1.5]

    def device_table(self) -> pd.DataFrame:
        x_m, y_m, z_m = self.device_m.T.round(2)
        return pd.DataFrame({"device": [f"d{one}" for one in range(self.k)], "x_m": x_m, "y_m": y_m, "z_m": z_m,
                             "role": "anchor"})

    def add(self, fault: str) -> tuple[np.ndarray, dict[str, set[str]], tuple]:
        """Return what a fault adds (n,) [dB], its ends and its places."""
        rng, n = self.rng, len(self.device)
        d, r, f = (int(rng.integers(count)) for count in (self.k, self.r, self.f))
        r = int(self.receiver[self.flight == f][0]) if fault in ("garbage_track", "receiver_flight") else r
        of_d, of_r, of_f = self.device == d, self.receiver == r, self.flight == f
        sign, ends = rng.choice([-1, 1]), {"device": {f"d{d}"}, "receiver": {f"r{r}"}, "flight": {f"f{f}"}}

        def only(*names: str) -> dict[str, set[str]]:
            return {name: ends[name] for name in names}

        if fault == "device_gain":
            return sign * rng.uniform(1.5, 10) * of_d, only("device"), ()
        if fault == "receiver_gain":
            return sign * rng.uniform(1.5, 10) * of_r * (self.r > 1), only("receiver"), ()
        if fault == "receiver_step":
            later = self.time_s > np.quantile(self.time_s[of_r], rng.uniform(0.25, 0.75))
            return sign * rng.uniform(3, 8) * of_r * later, only("receiver"), ()
        if fault == "receiver_drift":
            share = (self.time_s - self.time_s.min()) / np.ptp(self.time_s)
            return sign * rng.uniform(5, 10) * of_r * share, only("receiver"), ()
        if fault == "device_step":
            return sign * rng.uniform(3, 8) * of_d * (self.flight >= self.f / 2), only("device"), ()
        if fault == "garbage_flight":
            return rng.normal(0, rng.uniform(8, 14), n) * of_f, only("flight"), ()
        if fault == "garbage_track":
            return rng.normal(0, rng.uniform(8, 14), n) * (of_f & of_r), only("receiver", "flight"), ()
        if fault == "receiver_flight":
            return sign * rng.uniform(3, 10) * (of_f & of_r), only("receiver", "flight"), ()
        if fault == "device_flight":
            return sign * rng.uniform(3, 10) * (of_f & of_d), only("device", "flight"), ()
        if fault == "device_receiver":
            return sign * rng.uniform(3, 10) * (of_r & of_d) * (self.r > 1), only("device", "receiver"), ()
        if fault in ("moved", "moved_later"):
            turn = rng.uniform(0, 2 * np.pi)
            true_m = self.device_m.copy()
            true_m[d, :2] += rng.uniform(25, 60) * np.array([np.cos(turn), np.sin(turn)])
            change_db = self.level_db(true_m[self.device]) - self.plain_db
            return change_db * of_d * ((fault == "moved") | (self.flight >= self.f / 2)), only("device"), ()
        if fault == "jammer":
            start_s = self.time_s[rng.integers(n)] - 30
            at_m = np.append(rng.uniform(0.2, 0.8, 2) * self.side_m, 2.0)
            on = (self.time_s >= start_s) & (self.time_s < start_s + rng.uniform(60, 150))
            away_m = np.linalg.norm(self.point_m - at_m, axis=1)
            power_db = np.median(self.plain_db) + 20 * np.log10(0.3 * self.side_m / away_m) + rng.uniform(3, 15)
            change_db = 10 * np.log10(10**(self.plain_db / 10) + on * 10**(power_db / 10)) - self.plain_db
            return change_db, {}, ((at_m[0], at_m[0], at_m[1], at_m[1]),)
        if fault == "park":
            link = int(rng.integers(n))
            middle_m = 0.5 * (self.point_m[link] + self.device_m[self.device[link]])[:2]
            radius_m = rng.uniform(25, 60)
            inside_m = _in_disc_m(self.device_m[self.device], self.point_m, middle_m, radius_m, 12.0)
            x_m, y_m = middle_m
            return (-np.minimum(inside_m * rng.uniform(0.3, 0.6), 22), {},
                    ((x_m - radius_m, x_m + radius_m, y_m - radius_m, y_m + radius_m),))
        offset_m = self.point_m - self.device_m[self.device]
        azimuth = np.arctan2(offset_m[:, 0], offset_m[:, 1])
        if fault == "sector":
            lobe = 0.5 + 0.5 * np.cos(azimuth - rng.uniform(0, 2 * np.pi))
            return of_d * np.maximum(7 + 20 * np.log10(lobe + 1e-3), -18), only("device"), ()
        if fault == "body":
            off = azimuth + np.pi - np.radians(self.heading_deg) - rng.uniform(0, 2 * np.pi)
            return -1.0 * of_r * rng.uniform(8, 16) * np.exp(np.cos(off) * 2 - 2), only("receiver"), ()
        if fault == "lost_lock":
            runs = np.repeat(rng.random(n // self.k // 4 + 1) < rng.uniform(0.25, 0.5), 4 * self.k)[:n]
            return np.where(of_r & runs & (self.r > 1), np.nan, 0.0), only("receiver"), ()
        return np.zeros(n), {}, ()


def _boxes(side_m: float, rng: np.random.Generator) -> np.ndarray:
    """(b, 5) x, x, y, y and height of boxes on a jittered grid [m]."""
    pitch_m = rng.uniform(45, 80)
    grid = np.arange(0.5 * pitch_m, side_m, pitch_m)
    x_m, y_m = (axis.ravel() + rng.uniform(-6, 6, axis.size) for axis in np.meshgrid(grid, grid))
    half_m = rng.uniform(0.15, 0.36, (2, len(x_m))) * pitch_m
    found = np.column_stack([x_m - half_m[0], x_m + half_m[0], y_m - half_m[1], y_m + half_m[1],
                             rng.uniform(8, 35, len(x_m))])
    return found[rng.random(len(found)) < 0.75]


def _outside(boxes: np.ndarray, side_m: float, count: int, rng: np.random.Generator) -> np.ndarray:
    xy_m = rng.uniform(0.1, 0.9, (count * 60, 2)) * side_m
    return xy_m[~_within(boxes, xy_m)][:count]


def _within(boxes: np.ndarray, xy_m: np.ndarray) -> np.ndarray:
    x_m, y_m = xy_m[:, :1], xy_m[:, 1:]
    return ((x_m > boxes[:, 0] - 2) & (x_m < boxes[:, 1] + 2) & (y_m > boxes[:, 2] - 2) & (y_m < boxes[:, 3] + 2)).any(axis=1)


def _track(boxes: np.ndarray, side_m: float, count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 2) a random walk of smooth turns, round the boxes."""
    at_m, course, found = _outside(boxes, side_m, 1, rng)[0], rng.uniform(0, 2 * np.pi), []
    speed_m = rng.uniform(5, 14)
    for _ in range(count):
        course += rng.normal(0, 0.15)
        for turn in (0, 0.5, -0.5, 1, -1, 1.6, -1.6, 2.4, -2.4, 3.1):
            next_m = at_m + speed_m * np.array([np.cos(course + turn), np.sin(course + turn)])
            if (next_m > 5).all() and (next_m < side_m - 5).all() and not _within(boxes, next_m[None])[0]:
                at_m, course = next_m, course + turn
                break
        found.append(at_m)
    return np.array(found)


def _blocked(a_m: np.ndarray, b_m: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """(n,) whether a segment enters a box (slabs)."""
    way_m = np.where(np.abs(b_m - a_m) < 1e-9, 1e-9, b_m - a_m)
    found = np.zeros(len(a_m), dtype=bool)
    for x0, x1, y0, y1, top in boxes:
        low, high = np.array([x0, y0, 0.0]), np.array([x1, y1, top])
        first, second = (low - a_m) / way_m, (high - a_m) / way_m
        enter = np.minimum(first, second).max(axis=1).clip(0)
        leave = np.maximum(first, second).min(axis=1).clip(max=1)
        found |= enter < leave
    return found


def _in_disc_m(a_m: np.ndarray, b_m: np.ndarray, middle_m: np.ndarray, radius_m: float, top_m: float) -> np.ndarray:
    """(n,) length of segments over a disc below a height [m]."""
    share = (np.arange(60) + 0.5) / 60
    found = np.zeros(len(a_m))
    for one in share:
        at_m = a_m + one * (b_m - a_m)
        found += (np.hypot(*(at_m[:, :2] - middle_m).T) < radius_m) & (at_m[:, 2] < top_m)
    return found / 60 * np.linalg.norm(b_m - a_m, axis=1)


def solids(boxes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (8 b, 3) [m] and triangles (12 b, 3) of boxes (b, 5)."""
    corner = np.array([[x, y, z] for x in (0, 1) for y in (2, 3) for z in (5, 4)])
    heights = np.column_stack([boxes, np.zeros(len(boxes))])
    vertices = np.stack([heights[:, corner[:, axis]] for axis in range(3)], axis=-1).reshape(-1, 3)
    sides = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6],
                      [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]])
    return vertices, (sides[None] + 8 * np.arange(len(boxes))[:, None, None]).reshape(-1, 3)
