"""An unknown emitter adds its power to all readings: the more, the closer the receiver is.

Powers of signal and interference add (ITU-R SM.1753), and that of the emitter falls by the
free-space law, 20 log10 d (ITU-R P.525). It depends on the receiver's position only. The emitter is
assumed to be near the ground. Where there is a 3D map, receivers that it does not see get less, by
a loss that is fitted.
"""

from collections.abc import Sequence

import numpy as np
from pydantic import Field
from typing_extensions import override

from radiotwin.channel.segmented_log_distance import NLOS_LOSS_DB, NLOS_LOSS_SD_DB
from radiotwin.effects.arrays import subsample
from radiotwin.effects.base import ReceiverEffect
from radiotwin.effects.params import (
    Allowed,
    Decibels,
    EffectParams,
    Estimate,
    Metres,
    Parameter,
    Variation,
)
from radiotwin.effects.power import NEPERS, add_power
from radiotwin.effects.residual_view import ResidualView
from radiotwin.links import LinkData

HEIGHT_M = 1.5  # of the emitter
REFERENCE_M = 100.0  # distance of its level
MIN_POSITIONS, SAME_POSITION_M = 20, 10.0  # of receivers, and what counts as one
AROUND_M = 100.0  # searched beyond the receivers; farther away it would be a noise floor
EDGE_M = 10.0  # of the searched area, where an estimate means "outside"
MAX_CELLS, MIN_CELL_M = 300, 20.0  # of the search
QUANTILES = (0.05, 0.2, 0.4, 0.6, 0.8)  # of the readings, tried as the emitter's level
MAX_LINKS = 2000  # that the search looks at
MAX_PROPOSALS, APART_M = 2, 60.0  # and their distance from each other
MIN_NATS = 4.0  # that an emitter must gain to be proposed
MAX_HIDDEN_LOSS_DB = 60.0  # behind buildings


class Interference(ReceiverEffect):
    """One emitter that all receivers hear."""

    name = "interference"
    figure = "links"
    confused_with = ("noise_floor_censoring", "receiver_drift")

    class Params(EffectParams):
        """Position and level of the emitter."""

        place_m: tuple[Metres, Metres] = Field(description="x and y of the emitter [m].")
        level_db: Decibels = Field(description="Its level at a distance of 100 m [dB].")
        within_m: tuple[Metres, Metres, Metres, Metres] = Field(
            description="Least x and y, and greatest x and y, of the searched area [m].")
        hidden_loss_db: float | None = Field(None, ge=0, le=1000, description=(
            "Loss where buildings hide it [dB]; None: it was found without a 3D map."))

    @override
    def unavailable(self, links: LinkData) -> str | None:
        positions = np.unique((links.receiver_m[:, :2] / SAME_POSITION_M).round(), axis=0)
        if len(positions) < MIN_POSITIONS:
            return (f"receivers were at {len(positions)} positions; {MIN_POSITIONS} are needed to "
                    "locate an emitter")
        return None

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        links = view.links
        low = links.receiver_m[:, :2].min(axis=0) - AROUND_M
        high = links.receiver_m[:, :2].max(axis=0) + AROUND_M
        step_m = max(MIN_CELL_M, float(np.sqrt(np.prod(high - low) / MAX_CELLS)))
        axes = (np.arange(a, b, step_m) for a, b in zip(low, high))
        positions_m = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
        if links.city is not None:
            height_m = HEIGHT_M + links.city.ground_height_m(*positions_m.T)
            positions_m = positions_m[~links.city.inside(np.column_stack([positions_m, height_m]))]
        levels_db = np.nanquantile(links.level_db, QUANTILES)
        rows = subsample(np.arange(len(links)), MAX_LINKS)
        nats = _gains(view, rows, positions_m, levels_db) * len(links) / len(rows)
        found: list[Interference.Params] = []
        for number in np.argsort(-nats.max(axis=1)):
            if nats[number].max() < MIN_NATS or len(found) == MAX_PROPOSALS:
                break
            position_m = positions_m[number]
            if all(np.hypot(*(position_m - other.place_m)) > APART_M for other in found):
                found.append(self.Params(place_m=tuple(position_m.tolist()),
                                         level_db=float(levels_db[nats[number].argmax()]),
                                         within_m=(*low.tolist(), *high.tolist()),
                                         hidden_loss_db=_hidden_loss_db(links)))
        return found

    @override
    def propose_like(self, view: ResidualView, params: Params) -> list[Params]:
        """Return also what all links proposed: every link bears on it, in each part alike."""
        return [*self.propose(view), params]

    @override
    def inputs(self, links: LinkData, params: Params) -> np.ndarray:
        return np.exp(_arriving_db(links, params.place_m, params.level_db, params.hidden_loss_db)
                      * NEPERS)

    @override
    def response(self, level_db: np.ndarray, params: Params,
                 inputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return add_power(level_db, inputs)

    @override
    def variation(self, params: Params) -> Variation:
        level_db, hidden_db = params.level_db, params.hidden_loss_db
        values = np.array([*params.place_m, level_db, hidden_db or 0.0])
        steps = np.array([20.0, 20.0, 3.0, 5.0])
        low = np.array([*params.within_m[:2], level_db - 40, 0.0])
        high = np.array([*params.within_m[2:], level_db + 40, MAX_HIDDEN_LOSS_DB])
        count = 3 if hidden_db is None else 4

        def changed(numbers: np.ndarray) -> Interference.Params:
            x_m, y_m, level_db, *hidden = numbers.tolist()
            return params.model_copy(update={"place_m": (x_m, y_m), "level_db": level_db,
                                             "hidden_loss_db": hidden[0] if hidden else None})

        return Variation(values[:count], steps[:count], low[:count], high[:count], changed)

    @override
    def neg_log_prior(self, params: Params) -> float:
        if params.hidden_loss_db is None:
            return 0.0
        return 0.5 * ((params.hidden_loss_db - NLOS_LOSS_DB) / NLOS_LOSS_SD_DB) ** 2

    @override
    def implausible(self, params: Params, coefficients: np.ndarray) -> str | None:
        low, high = np.reshape(params.within_m, (2, 2))
        if (np.minimum(params.place_m - low, high - params.place_m) < EDGE_M).any():
            return ("the emitter would be at the edge of the searched area or beyond: its position "
                    "is unknown")
        return None

    @override
    def parameters(self, links: LinkData, params: Params,
                   estimate: Estimate) -> dict[str, Parameter]:
        names = "x_m", "y_m", f"level_at_{REFERENCE_M:.0f}_m", "hidden_loss_db"
        units = "m", "m", links.level_unit, "dB"
        of = self.variation(params)
        return {name: Parameter.normal(value, sd, unit, Allowed(float(low), float(high)))
                for name, value, sd, unit, low, high in zip(
                    names, of.values.tolist(), estimate.params_sd, units, of.low, of.high)}


def interference_db(receiver_m: np.ndarray, position_m: Sequence[float] | np.ndarray,
                    level_db: float, ground_m: float = 0.0) -> np.ndarray:
    """Return the level of an emitter at receivers.

    Args:
        receiver_m: (n, 3) [m].
        position_m: x and y of the emitter [m].
        level_db: at `REFERENCE_M` [dB].
        ground_m: height of the ground below the emitter [m].

    Returns:
        (n,) [dB].
    """
    distance_m = np.linalg.norm(receiver_m - [*position_m, ground_m + HEIGHT_M], axis=1)
    return level_db - 20 * np.log10(np.maximum(distance_m, 1.0) / REFERENCE_M)


def _hidden_loss_db(links: LinkData) -> float | None:
    """Return the loss behind buildings that a search begins with [dB]; None without a map."""
    return None if links.city is None else NLOS_LOSS_DB


def _arriving_db(links: LinkData, position_m: Sequence[float] | np.ndarray, level_db: float,
                 hidden_loss_db: float | None) -> np.ndarray:
    """Return the level (n,) of an emitter at the receivers, behind buildings less [dB]."""
    ground_m = 0.0 if links.city is None else float(links.city.ground_height_m(*position_m))
    arriving_db = interference_db(links.receiver_m, position_m, level_db, ground_m)
    if hidden_loss_db is None or links.city is None:
        return arriving_db
    seen = links.city.line_of_sight(np.array([*position_m, ground_m + HEIGHT_M]), links.receiver_m)
    return np.where(seen, arriving_db, arriving_db - hidden_loss_db)


def _gains(view: ResidualView, rows: np.ndarray, positions_m: np.ndarray,
           levels_db: np.ndarray) -> np.ndarray:
    """Return half of the drop of the weighted squares of some links by an emitter [nats].

    A level and a slope for each class of line of sight are fitted beside it, because the channel's
    have taken up part of the interference.

    Args:
        view: residuals.
        rows: (r,) links.
        positions_m: (p, 2) x and y of emitters [m].
        levels_db: (l,) their levels [dB].

    Returns:
        (p, l).
    """
    part = view.links.select(rows)
    root = np.sqrt(view.weight[rows])
    decades = np.log10(part.distance_m)
    columns = np.column_stack([part.los, part.los * decades, ~part.los, ~part.los * decades])
    basis, size, _ = np.linalg.svd(columns * root[:, None], full_matrices=False)
    basis = basis[:, size > 1e-9 * size[0]]
    target = root * view.residual_db[rows]
    target = target - basis @ (basis.T @ target)
    nats = np.empty((len(positions_m), len(levels_db)))
    for number, position_m in enumerate(positions_m):
        power_db = _arriving_db(part, position_m, 0.0, _hidden_loss_db(part)) + levels_db[:, None]
        rise_db = root * 10 * np.log10(1 + 10 ** ((power_db - view.mean_db[rows]) / 10))
        rise_db = rise_db - (rise_db @ basis) @ basis.T
        nats[number] = rise_db @ target - 0.5 * (rise_db**2).sum(axis=1)
    return nats
