"""Which devices and receivers a fitted effect belongs to, to be named in the report."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from radiotwin.effects.fold_model import FittedEffect
from radiotwin.links import LinkData


def ends_of(fitted: FittedEffect, links: LinkData) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of the devices and of the receivers that parameters belong to.

    Where each end has a coefficient, and few are off, that is the one that is off most.

    Args:
        fitted: effect with its parameters.
        links: that it was fitted to.

    Returns:
        names of devices, names of receivers; both empty for an effect of all links.
    """
    params, effect = fitted.params, fitted.effect
    if effect.sparse and hasattr(params, "members"):
        off = np.abs(fitted.coefficients - np.median(fitted.coefficients))
        most = [params.members[int(off.argmax())]]
        return (_names(most, links.device_names) if effect.of_device else (),
                _names(most, links.receiver_names) if effect.of_receiver else ())
    return (_names(_indices(params, "device"), links.device_names),
            _names(_indices(params, "receiver"), links.receiver_names))


def _indices(params: object, end: str) -> list[int]:
    """Return the indices in `device` or `devices`, whatever an effect has."""
    one, many = getattr(params, end, None), getattr(params, f"{end}s", ())
    return [each for each in (one, *many) if isinstance(each, int)]


def _names(indices: list[int], names: Sequence[str]) -> tuple[str, ...]:
    return tuple(str(names[each]) for each in indices if 0 <= each < len(names))
