"""`interference`: an unknown emitter near the ground adds its power to the readings.

Powers of signal and interference add (ITU-R SM.1753) at the end that reads: the receiver, or the
device if it is a gateway that listens (`reads_levels`). With a 3D map the interference follows the
channel, as from a device at the emitter's place, buildings included; without one free space, 20
log10 d (ITU-R P.525), as an exponent fitted to readings with interference is too small.
"""

from collections.abc import Sequence

import numpy as np
from pydantic import Field
from typing_extensions import override

from radiotwin.effects.arrays import MIN_NATS, NEPERS, subsample
from radiotwin.effects.base import LevelAt, ReceiverEffect, ResidualView, Term
from radiotwin.effects.params import Decibels, EffectParams, Estimate, Metres, Parameter, Variation
from radiotwin.effects.places import Mark
from radiotwin.links import Links
from radiotwin.links.declared import NOTHING

HEIGHT_M = 1.5  # height of the emitter above the ground
REFERENCE_M = 100.0  # distance at which its level is given
MIN_POSITIONS, SAME_POSITION_M = 20, 10.0  # positions of reading ends, and grid that counts them
AROUND_M = 100.0  # margin of the search area; an emitter farther away acts as a noise floor
EDGE_M = 10.0  # distance to the edge of the area below which an estimate means "outside"
MAX_CELLS, MIN_CELL_M = 300, 20.0  # number and least side of the cells of the search
QUANTILES = (0.05, 0.2, 0.4, 0.6, 0.8)  # of readings minus the emitter's path gain: trial levels
MAX_LINKS = 2000  # drawn at random for the search
MAX_PROPOSALS, APART_M = 2, 60.0  # number of proposals, and least distance between them


class Interference(ReceiverEffect):
    """One emitter that interferes at every end that reads levels."""

    name = "interference"
    in_words = "an emitter beside the devices"
    acts_on = ("receiver", "device x receiver", "place", "level")
    parameter_labels = {"over_a_device_db": "power over a device's"}
    settled_by = "listen with the devices switched off"
    figure = "links"
    confused_with = ("noise_floor_censoring", "receiver_drift")

    class Params(EffectParams):
        """Position and level of the emitter."""

        place_m: tuple[Metres, Metres] = Field(description="x and y of the emitter [m].")
        level_db: Decibels = Field(description=(
            "Its level at a distance of 100 m in free space [dB]; through the channel, its power "
            "over that of a device [dB]."))
        within_m: tuple[Metres, Metres, Metres, Metres] = Field(
            description="Least x and y, and greatest x and y, of the searched area [m].")
        through_channel: bool = Field(False, description=(
            "Whether its power falls by the channel, as it was found over a 3D map."))

    params: Params

    @override
    def unavailable(self, links: Links) -> str | None:
        """Return why no emitter can be located (readings at too few positions); else None."""
        positions = np.unique((_reading_m(links)[:, :2] / SAME_POSITION_M).round(), axis=0)
        if len(positions) < MIN_POSITIONS:
            return (f"levels were read at {len(positions)} positions; {MIN_POSITIONS} are needed "
                    "to locate an emitter")
        return None

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        """Propose places and powers of an interfering emitter that fit best, from a grid."""
        links = view.links
        low = _reading_m(links)[:, :2].min(axis=0) - AROUND_M
        high = _reading_m(links)[:, :2].max(axis=0) + AROUND_M
        step_m = max(MIN_CELL_M, float(np.sqrt(np.prod(high - low) / MAX_CELLS)))
        axes = (np.arange(a, b, step_m) for a, b in zip(low, high))
        positions_m = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
        if links.city is not None:
            height_m = HEIGHT_M + links.city.ground_height_m(*positions_m.T)
            positions_m = positions_m[~links.city.inside(np.column_stack([positions_m, height_m]))]
        rows = subsample(np.arange(len(links)), MAX_LINKS)
        nats, levels_db = _gains_nats(view, rows, positions_m)
        nats = nats * len(links) / len(rows)
        found: list[Interference.Params] = []
        for number in np.argsort(-nats.max(axis=1)):
            best = nats[number].argmax()
            if nats[number, best] < MIN_NATS or len(found) == MAX_PROPOSALS:
                break
            position_m = positions_m[number]
            if all(np.hypot(*(position_m - other.place_m)) > APART_M for other in found):
                found.append(self.Params(place_m=tuple(position_m.tolist()),
                                         level_db=float(levels_db[number, best]),
                                         within_m=(*low.tolist(), *high.tolist()),
                                         through_channel=links.city is not None))
        return found

    @override
    def propose_for_fold(self, view: ResidualView) -> list[Params]:
        """Propose anew from the fold's residuals, and also the parameters found on all links."""
        return [*self.propose(view), self.params]

    @override
    def term(self, links: Links, level_at: LevelAt) -> Term:
        params = self.params
        path_db = _path_gain_db(links, params.place_m,
                                level_at if params.through_channel else None)
        return Term.of_inputs(np.exp((params.level_db + path_db) * NEPERS))

    @override
    def variation(self) -> Variation:
        """Put the emitter's x and y [m] and level [dB] into a search vector."""
        level_db = self.params.level_db
        low, high = np.reshape(self.params.within_m, (2, 2)).tolist()

        def varied(numbers: np.ndarray) -> Interference:
            x_m, y_m, level_db = numbers.tolist()
            return self.changed(place_m=(x_m, y_m), level_db=level_db)

        return Variation(np.array([*self.params.place_m, level_db]), np.array([20.0, 20.0, 3.0]),
                         np.array([*low, level_db - 40]), np.array([*high, level_db + 40]), varied)

    @override
    def implausible(self, coefficients: np.ndarray) -> str | None:
        """Return why the emitter's place is unknown, at the edge of the searched area; or None."""
        low, high = np.reshape(self.params.within_m, (2, 2))
        if (np.minimum(self.params.place_m - low, high - self.params.place_m) < EDGE_M).any():
            return ("the emitter would be at the edge of the searched area or beyond: its position "
                    "is unknown")
        return None

    @override
    def mark(self, links: Links) -> Mark:
        return Mark(self.label, np.array(self.params.place_m))

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        level = ("over_a_device_db", "dB") if self.params.through_channel else (
            f"level_at_{REFERENCE_M:.0f}_m", links.level_unit)
        units = {"x_m": "m", "y_m": "m", level[0]: level[1]}
        return self.variation().parameters(units, estimate.params_sd)


def _reading_m(links: Links) -> np.ndarray:
    """Return the position (n, 3) of the end that reads each level [m]."""
    if links.reads is None:
        return links.receiver_m
    return np.where(links.reads[links.device, None], links.device_m[links.device], links.receiver_m)


def _path_gain_db(links: Links, position_m: Sequence[float] | np.ndarray,
                  level_at: LevelAt | None) -> np.ndarray:
    """Compute the gain (n,) from an emitter near the ground to the measuring end of each link [dB].

    `level_at` predicts it with the fitted channel model. Without it: free space, in dB relative to
    the gain at a distance of `REFERENCE_M`.
    """
    ground_m = 0.0 if links.city is None else float(links.city.ground_height_m(*position_m))
    emitter_m = np.array([*position_m, ground_m + HEIGHT_M])
    if level_at is not None:
        emitter = links.with_receivers(_reading_m(links)).with_devices(
            np.tile(emitter_m, (len(links.device_m), 1)))
        return level_at(emitter.with_ends(declared=NOTHING)) + links.declared.usual_db
    distance_m = np.linalg.norm(_reading_m(links) - emitter_m, axis=1)
    return -20 * np.log10(np.maximum(distance_m, 1.0) / REFERENCE_M)


def _gains_nats(view: ResidualView, rows: np.ndarray,
                positions_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the log-likelihood gains of p trial emitters with q powers each, over rows (r,).

    Half of the reduction of the weighted squared residuals. A level and a slope, each with and
    without sight, are fitted as well: the channel's own have absorbed part of the interference.

    Returns:
        (p, q) gains [nats], and (p, q) levels of the emitters [dB].
    """
    part = view.links.select(rows)
    root = np.sqrt(view.weight[rows])
    decades = np.log10(part.distance_m)
    columns = np.column_stack([part.los, part.los * decades, ~part.los, ~part.los * decades])
    basis, singular_values, _ = np.linalg.svd(columns * root[:, None], full_matrices=False)
    basis = basis[:, singular_values > 1e-9 * singular_values[0]]
    target = root * view.residual_db[rows]
    target = target - basis @ (basis.T @ target)
    nats, levels_db = np.empty((2, len(positions_m), len(QUANTILES)))
    for number, position_m in enumerate(positions_m):
        path_db = _path_gain_db(part, position_m, None if part.city is None else view.level_at)
        levels_db[number] = np.nanquantile(part.level_db - path_db, QUANTILES)
        power_db = path_db + levels_db[number][:, None]
        rise_db = root * 10 * np.log10(1 + 10 ** ((power_db - view.mean_db[rows]) / 10))
        rise_db = rise_db - (rise_db @ basis) @ basis.T
        nats[number] = rise_db @ target - 0.5 * (rise_db**2).sum(axis=1)
    return nats, levels_db
