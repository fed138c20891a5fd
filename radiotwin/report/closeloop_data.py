"""The data of a close-loop's figures: links, predictions, effects; averages over bins.

Figures read these objects only, so that they do not depend on how the loop fits its models.
"""

from dataclasses import dataclass

import numpy as np

from radiotwin.closeloop.run import Loop
from radiotwin.closeloop.verdict.residual_tests import significant
from radiotwin.effects.base import Effect
from radiotwin.effects.params import Parameter
from radiotwin.effects.places import Mark
from radiotwin.links import Links, evidence_blocks, residual_variables
from radiotwin.report.labels import apart, variable_label
from radiotwin.twin.model.model import Fit

MAX_MEMBERS = 6  # devices or receivers with a panel of their own
MIN_SHARE = 0.02  # of the largest standard deviation of a contribution; below it, no panel
TIME_UNITS = (("days", 86_400.0), ("h", 3600.0), ("s", 1.0))
MIN_LOS_LINKS = 300  # with fewer, links without line of sight are drawn, too
MIN_LINKS = 6  # of a mean that is drawn


@dataclass(frozen=True, eq=False, kw_only=True)
class DrawnLinks(Links):
    """Links with devices at the model's positions (NaN: none), and variables to draw over.

    Attributes:
        block: (n,) index of the block of links with a common error.
        variables: variable -> (n,) value; integers are an index into `names` or a map cell.
    """

    block: np.ndarray
    variables: dict[str, np.ndarray]

    @property
    def names(self) -> dict[str, list[str]]:
        """Labels of the variables `device`, `receiver`, `flight` and `los`, by their index."""
        return {"device": self.device_names, "receiver": self.receiver_names,
                "flight": self.flight_names, "los": ["without", "with"]}

    @property
    def ends_m(self) -> np.ndarray:
        """Return the (n, 2, 3) positions of device and receiver of each link [m]."""
        return np.stack([self.device_m[self.device], self.receiver_m], axis=1)

    def on_axis(self, name: str, value: np.ndarray) -> tuple[np.ndarray, str]:
        """Return a variable (n,) as a plot's axis shows it, and the label of that axis.

        Only `time_s` is converted: to time since the first measurement, in days, hours or seconds.
        """
        label, unit = variable_label(name)
        if name == "time_s":
            label, value = "time since the first measurement", value - self.first_s
            span_s = np.nanmax(value, initial=0.0)
            unit, unit_s = next(each for each in TIME_UNITS if span_s >= 3 * each[1]
                                or each[0] == "s")
            value = value / unit_s
        unit = self.level_unit if unit == "dB" else unit
        return value, f"{label} [{unit}]" if unit else label


@dataclass(frozen=True, eq=False)
class EffectData:
    """An effect that was found, with levels predicted without and with it; all others stay.

    Attributes:
        found: the effect with its parameters.
        mark: how maps mark where it is; None: it has no place.
        parameters: printed parameters with their 90 % intervals.
        links: measured links.
        without_db: (n,) predicted level without the effect [dB].
        with_db: (n,) predicted level with it [dB].
    """

    found: Effect
    mark: Mark | None
    parameters: dict[str, Parameter]
    links: DrawnLinks
    without_db: np.ndarray
    with_db: np.ndarray

    @property
    def contribution_db(self) -> np.ndarray:
        """Return the (n,) change of the predicted level by the effect [dB]."""
        return self.with_db - self.without_db

    @property
    def residual_db(self) -> np.ndarray:
        """Return the (n,) measured minus predicted level without the effect [dB]."""
        return self.links.level_db - self.without_db

    @property
    def variables(self) -> dict[str, np.ndarray]:
        """Return the variables of the links; the predicted level is that without the effect."""
        return self.links.variables | {"predicted_level_db": self.without_db}

    @property
    def member_kind(self) -> str:
        """Return `device` or `receiver` if each has effect parameters of its own, else ``""``."""
        if "devices" in dict(self.found.params):
            return "device"
        return "receiver" if self.found.of_receiver else ""

    @property
    def shown(self) -> np.ndarray:
        """Return the (n,) mask of detected links to draw.

        An effect on receivers is drawn on links with line of sight alone, if at least
        `MIN_LOS_LINKS` have it.
        """
        detected = np.isfinite(self.residual_db)
        clear = detected & self.links.los
        return clear if self.found.of_receiver and clear.sum() >= MIN_LOS_LINKS else detected

    def panels(self) -> list[tuple[str, np.ndarray]]:
        """Return title and link rows of each panel: up to `MAX_MEMBERS` devices or receivers.

        They are those with the largest standard deviation of the contribution, over `MIN_SHARE` of
        the maximum. An effect that is not on single ones has a panel of all links to draw.
        """
        shown, kind = self.shown, self.member_kind
        if not kind:
            return [("all links", np.flatnonzero(shown))]
        index = self.links.variables[kind]
        rows = {int(member): np.flatnonzero(shown & (index == member))
                for member in np.unique(index[shown])}
        sd_db = {member: float(np.std(self.contribution_db[each])) for member, each in rows.items()}
        chosen = sorted(sorted(sd_db, key=lambda member: -sd_db[member])[:MAX_MEMBERS])
        names = [apart(kind, name) for name in self.links.names[kind]]
        return [(f"{kind} {names[member]}", rows[member]) for member in chosen
                if sd_db[member] > MIN_SHARE * max(sd_db.values())]


@dataclass(frozen=True, eq=False)
class LoopData:
    """Data of a close-loop that its figures draw.

    Attributes:
        links: measured links, with the devices where the final model has them.
        base: name of the base model.
        before_db: (n,) held-out prediction of the base alone [dB]; NaN: none.
        after_db: (n,) held-out prediction with all effects that a map can contain [dB].
        changed: whether anything was added to the base.
        added: names of the effects that were added to the base, in the order in which they were.
        drivers: variables that the residual depends on, those before the effects first.
        effects: the effects that were found.
        interpolated_db: (n,) held-out contribution of correlated shadowing [dB]; None: not added.
    """

    links: DrawnLinks
    base: str
    before_db: np.ndarray
    after_db: np.ndarray
    changed: bool
    added: list[str]
    drivers: list[str]
    effects: list[EffectData]
    interpolated_db: np.ndarray | None


def collect(loop: Loop) -> LoopData:
    """Collect what figures draw from a finished close-loop: links, predictions, kept effects."""
    model = loop.after
    links = _links(model.whole, loop.before.held_out_mean_db)
    before = loop.dependences_before
    dependences = [*significant(before, loop.criteria), *loop.remaining]
    in_base = sum(each.is_declared for each in model.whole.effects)  # declared ones are kept first
    interpolated_db = None
    if model.whole.shadowing:
        interpolated_db = model.held_out_shadowing[0] * model.held_out_scales[0]
    return LoopData(
        links, loop.base, loop.before.held_out_mean_db, model.on_map[0],
        model is not loop.before,
        [trial.name for trial in loop.found.log.kept][in_base:],
        [each.variable for each in dependences or before[:3]], _effects(loop, links),
        interpolated_db)


def _links(model: Fit, predicted_db: np.ndarray) -> DrawnLinks:
    """Return a fit's links to draw; devices that the fit could not locate are at NaN.

    `predicted_db` (n,) [dB] is among the variables that residuals are drawn over.
    """
    links, device_m = model.links, model.links.device_m.copy()
    device_m[links.device[~model.usable]] = np.nan
    drawn = links.with_devices(device_m).with_los(links.los)
    return DrawnLinks(
        columns=drawn.columns, ends=drawn.ends, world=drawn.world, block=evidence_blocks(links),
        variables=residual_variables(links, predicted_db))


def _effects(loop: Loop, links: DrawnLinks) -> list[EffectData]:
    """Predict all links with all effects, and once without each, by the model fitted to all links.

    Links to a device that the model could not locate get NaN.
    """
    whole = loop.after.whole
    if not whole.effects:
        return []
    with_db = np.where(whole.usable, whole.readings().mean_db, np.nan)
    effects = []
    for number, (effect, parameters) in enumerate(zip(whole.effects, loop.parameters,
                                                       strict=True)):
        without_db = whole.without(number).readings().mean_db
        effects.append(EffectData(effect, effect.mark(whole.links), parameters, links,
                                  np.where(whole.usable, without_db, np.nan), with_db))
    return effects


@dataclass(frozen=True, eq=False)
class BinMeans:
    """Means over bins of links.

    Attributes:
        at: (b,) mean of the variable in each bin, in its unit.
        mean: (b,) mean of the residuals or levels [dB].
        error: (b,) standard error of the mean [dB].
    """

    at: np.ndarray
    mean: np.ndarray
    error: np.ndarray


def bin_index(value: np.ndarray, count: int) -> np.ndarray:
    """Return the bin of finite values (n,): up to `count` bins of about equally many values.

    If there are no more than `count` distinct values, each of them is a bin.
    """
    values = np.unique(value)
    if len(values) <= count:
        return np.searchsorted(values, value)
    inner = np.unique(np.quantile(value, np.linspace(0, 1, count + 1)[1:-1]))
    return np.searchsorted(inner, value, side="right")


def bin_means(index: np.ndarray, value: np.ndarray, residual_db: np.ndarray,
              block: np.ndarray) -> BinMeans:
    """Average the residuals of links (n,) in each bin; bins of fewer than `MIN_LINKS` drop out.

    The standard error is that of independent blocks, but at least that of independent links.

    Args:
        index: (n,) bin of each link.
        value: (n,) variable that was binned, in any unit; its mean is where a bin is drawn.
        residual_db: (n,) what is averaged [dB].
        block: (n,) index of each link's block of links with a common error.
    """
    count = np.bincount(index)
    mean = np.bincount(index, weights=residual_db) / np.maximum(count, 1)
    deviation_db = residual_db - mean[index]
    pairs, pair = np.unique(np.column_stack([index, block]), axis=0, return_inverse=True)
    sums = np.bincount(pair.ravel(), weights=deviation_db)
    by_blocks = np.bincount(pairs[:, 0], weights=sums**2)
    # In a bin of a single block the deviations sum to zero.
    by_links = np.bincount(index, weights=deviation_db**2)
    error = np.sqrt(np.maximum(by_blocks, by_links)) / np.maximum(count, 1)
    centre = np.bincount(index, weights=value) / np.maximum(count, 1)
    used = count >= MIN_LINKS
    return BinMeans(centre[used], mean[used], error[used])
