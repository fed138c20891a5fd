"""Constant errors of gain: a device that radiates, or a receiver that reads, more or less than is declared.

Cable and connector loss, antenna efficiency, transmit power and calibration add to the link budget as constants
(ITU-R P.341, 'The concept of transmission loss for radio links').
"""

from dataclasses import replace

import numpy as np

from radiotwin.effects.base import Effect, Parameter, Term, View, measured, one_hot

SPREAD_DB = 10.0
LEAST_LINKS = 30
MOST_MEMBERS = 200
LEAST_OFFSET_DB = 0.5


class _GainOffset(Effect):
    """An offset for each member of an index."""

    def _index(self, records) -> np.ndarray:
        raise NotImplementedError

    def _names(self, records) -> list[str]:
        raise NotImplementedError

    def lacks(self, records) -> str | None:
        members = measured(self._index(records), LEAST_LINKS)
        kind = self.name.split("_")[0]
        if len(members) < 2:
            return f"needs two {kind}s with {LEAST_LINKS} links each, to tell one from the other"
        if len(members) > MOST_MEMBERS:
            return f"{len(members)} {kind}s are too many to give each an offset; at most {MOST_MEMBERS}"
        return None

    def propose(self, view: View) -> list[dict]:
        index = self._index(view.records)
        members = measured(index, LEAST_LINKS)
        if len(members) < 2:  # a fold may have fewer than all links
            return []
        offsets_db = [np.average(view.residual_db[index == member], weights=view.weight[index == member])
                      for member in members]
        return [{"members": members, "spread_db": float(np.std(offsets_db))}]

    def term(self, records, setting, at) -> Term:
        names, index = self._names(records), self._index(records)
        term = Term.of_columns(one_hot(index, setting["members"]), SPREAD_DB,
                               [names[member] for member in setting["members"]])
        return replace(term, unsure_db=np.where(np.isin(index, setting["members"]), 0.0, setting["spread_db"]))

    def unphysical(self, setting, coefficients) -> str | None:
        most_db = np.abs(coefficients - np.median(coefficients)).max()
        if most_db < LEAST_OFFSET_DB:
            return f"none of them is off by more than {most_db:.1f} dB, which is within any instrument's tolerance"
        return None

    def parameters(self, records, setting, found) -> dict[str, Parameter]:
        names = self._names(records)
        # Against the median member: a common offset is the channel's intercept.
        order = np.argsort(found.coefficients)
        middle = order[len(order) // 2]
        contrast = np.eye(len(order)) - np.eye(len(order))[middle]
        deviations = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", contrast, found.covariance, contrast), 0))
        return {f"offset_db[{names[member]}]": Parameter.normal(value, deviation, "dB") for member, value, deviation in
                zip(setting["members"], contrast @ found.coefficients, deviations)}


class DeviceGainOffset(_GainOffset):
    """A device radiates more or less than the others do."""

    name = "device_gain_offset"
    confused_with = ("antenna_pattern", "device_position_error")

    def _index(self, records):
        return records.device

    def _names(self, records):
        return records.device_names


class ReceiverGainOffset(_GainOffset):
    """A receiver reads more or less than the others do."""

    name = "receiver_gain_offset"
    of_receiver = True
    confused_with = ("receiver_drift", "antenna_pattern")

    def _index(self, records):
        return records.receiver

    def _names(self, records):
        return records.receiver_names
