"""`device_gain_offset`, `receiver_gain_offset`: constant gain errors of devices or receivers.

Cable and connector loss, antenna efficiency, transmit power and calibration add constants to the
link budget (ITU-R P.341, 'The concept of transmission loss for radio links').
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import ClassVar

import numpy as np
from pydantic import Field
from typing_extensions import override

from radiotwin.effects.arrays import frequent_labels, one_hot
from radiotwin.effects.base import GainEffect, LevelAt, ResidualView, Term
from radiotwin.effects.params import (
    DeviceIndex,
    EffectParams,
    Estimate,
    Parameter,
    ReceiverIndex,
    Unique,
)
from radiotwin.effects.patterns import Pattern, members
from radiotwin.links import Links
from radiotwin.links.sites import inseparable_end

PRIOR_SD_DB = 10.0  # wide: an error of a cable, a connector or a declared power
MIN_LINKS = 30  # of a device or receiver; with fewer, shadowing dominates
MAX_MEMBERS = 200  # bounds the number of coefficients
MIN_OFFSET_DB = 0.5  # accuracy of good power meters


class _GainOffset(GainEffect):
    """Base of effects with one gain offset per device, or per receiver."""

    figure = "intervals"
    sparse = True
    end: ClassVar[str]  # "device" or "receiver"

    class Params(EffectParams):
        """Who has an offset."""

        members: Unique[int] = Field(description="Indices of those with an offset.")
        offsets_sd_db: float = Field(ge=0, le=1000,
                                     description="Standard deviation of the offsets [dB].")

    params: Params

    def _index(self, links: Links) -> np.ndarray:
        """Return the index (n,) of each link's device, or receiver."""
        return getattr(links, self.end)

    @override
    def unavailable(self, links: Links) -> str | None:
        """Return why offsets cannot be compared (fewer than two, or too many); else None."""
        members = frequent_labels(self._index(links), MIN_LINKS)
        if len(members) < 2:
            return f"needs two {self.end}s with {MIN_LINKS} links each, to compare them"
        if len(members) > MAX_MEMBERS:
            return (f"{len(members)} {self.end}s are too many to give each an offset; at most "
                    f"{MAX_MEMBERS}")
        return None

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        if len(frequent_labels(self._index(view.links), MIN_LINKS)) < 2:
            return []  # a fold may have too few links
        return self._of_members(view, view.in_group(self._index(view.links)))

    @override
    def propose_for_fold(self, view: ResidualView) -> list[Params]:
        return self._of_members(view, self.params.members)

    def _of_members(self, view: ResidualView, among: list[int]) -> list[Params]:
        """Propose offsets of members of `among` with `MIN_LINKS` links, and the sd of offsets."""
        index = self._index(view.links)
        members = [member for member in frequent_labels(index, MIN_LINKS) if member in among]
        if not members:
            return []
        offsets_db = [np.average(view.residual_db[index == member],
                                 weights=view.weight[index == member]) for member in members]
        return [self.Params(members=members, offsets_sd_db=float(np.std(offsets_db)))]

    @override
    def term(self, links: Links, level_at: LevelAt) -> Term:
        index = self._index(links)
        unknown = ~np.isin(index, self.params.members)
        return replace(Term.of_columns(one_hot(index, self.params.members), PRIOR_SD_DB),
                       unheard_sd_db=np.where(unknown, self.params.offsets_sd_db, 0.0))

    @override
    def rivals(self, links: Links, parameters: Mapping[str, Parameter]) -> list[str]:
        """Name the offset of the other end, if these links cannot tell which end has it."""
        names = getattr(links, f"{self.end}_names")
        largest = max(self.params.members,
                      key=lambda member: abs(parameters[f"offset_db[{names[member]}]"].value))
        other = inseparable_end(links, self.end, {largest})
        return [] if other is None else [self.name.replace(self.end, other)]

    @override
    def typical_patterns(self, view: ResidualView) -> Iterator[Pattern]:
        for mask in members(self._index(view.links)):
            yield Pattern(self.end, "dB", f"a constant of one {self.end}", mask * 1.0,
                          low=MIN_OFFSET_DB)

    @override
    def implausible(self, coefficients: np.ndarray) -> str | None:
        """Return a sentence if all offsets are within an instrument's tolerance; else None."""
        largest_db = np.abs(_relative_db(coefficients)).max()
        if largest_db < MIN_OFFSET_DB:
            return (f"none of them is off by more than {largest_db:.1f} dB, which is within any "
                    "instrument's tolerance")
        return None

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        """Report each offset minus the median one [dB]: what all share is the channel's level."""
        order = np.argsort(estimate.coefficients)
        median = order[len(order) // 2]
        contrast = np.eye(len(order))
        if len(order) > 1:
            contrast -= contrast[median].copy()
        sd_db, names = estimate.sd_of(contrast), getattr(links, f"{self.end}_names")
        return {f"offset_db[{names[member]}]": Parameter.normal(value_db, value_sd_db, "dB")
                for member, value_db, value_sd_db in zip(
                    self.params.members, contrast @ estimate.coefficients, sd_db)}


class DeviceGainOffset(_GainOffset):
    """Devices that radiate more or less power than the others."""

    name = "device_gain_offset"
    in_words = "power, cable or antenna of the device"
    settled_by = "measure the device's power next to it, with line of sight"
    of_device = True
    end = "device"
    acts_on = ("device",)
    confused_with = ("antenna_pattern", "device_position_error")

    class Params(_GainOffset.Params):
        """Devices with an offset."""

        members: Unique[DeviceIndex] = Field(description="Indices of those with an offset.")

    params: Params


class ReceiverGainOffset(_GainOffset):
    """Receivers whose readings are higher or lower than the others'."""

    name = "receiver_gain_offset"
    in_words = "gain, cable or antenna of the receiver"
    settled_by = "let the receivers measure side by side"
    end = "receiver"
    of_receiver = True
    acts_on = ("receiver",)
    confused_with = ("receiver_drift", "antenna_pattern")

    class Params(_GainOffset.Params):
        """Receivers with an offset."""

        members: Unique[ReceiverIndex] = Field(description="Indices of those with an offset.")

    params: Params

    @override
    def reading_offsets_db(self, coefficients: np.ndarray) -> dict[int, float]:
        return dict(zip(self.params.members, _relative_db(coefficients).tolist(), strict=True))


def _relative_db(coefficients: np.ndarray) -> np.ndarray:
    """Subtract from offsets (q,) their median; a single one is relative to the others already."""
    return coefficients - np.median(coefficients) if len(coefficients) > 1 else coefficients
