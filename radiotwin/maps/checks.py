"""Checks that a stranger's dataset is a radio map: of its form, then of its values by parts."""

import math
from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
import xarray as xr

from radiotwin.io.budgets import DEVICES, MAP_AXIS
from radiotwin.io.forms import MAX_NAME, MAX_POSITION_M
from radiotwin.maps.form import BLOCK_VALUES, DIMS, GAIN_RANGE_DB, GROUND, MAX_SIGMA_DB, VARIABLES
from radiotwin.runtime.console import progress

MIN_STEP_M = 1e-3
_NUMBERS = ("frequency_hz", "gain_limit_db", "origin_latitude_deg", "origin_longitude_deg",
            "origin_altitude_m", "shadowing_share", "shadowing_length_m")  # among the attributes


def form_problem(dataset: xr.Dataset) -> str | None:
    """Return the first reason why a dataset is not a radio map that is seen without its values."""
    for name in VARIABLES:
        if name not in dataset.data_vars:
            if name == "sigma_db":
                continue
            return f"it lacks {name}; it has {list(dataset.data_vars)[:20]}"
        if dataset[name].dims != DIMS:
            return f"{name} has the dims {dataset[name].dims}, it needs {DIMS}"
        if dataset[name].dtype.kind not in ("biuf" if name == "los" else "iuf"):
            return f"{name} holds {dataset[name].dtype}, not numbers"
    for axis in DIMS:
        if (axis not in dataset.coords or dataset[axis].dims != (axis,)
                or dataset.sizes[axis] == 0):
            return f"the coordinate {axis} is missing or empty"
        budget = DEVICES if axis == "device" else MAP_AXIS
        budget.check(dataset.sizes[axis], f"axis {axis} of the radio map")
    if GROUND in dataset.variables and (
            dataset[GROUND].dims != ("y", "x") or dataset[GROUND].dtype.kind not in "iuf"):
        return f"{GROUND} is not numbers with the dims ('y', 'x')"
    for name in _NUMBERS:
        value = dataset.attrs.get(name, 0.0)
        if not isinstance(value, int | float | np.number) or not math.isfinite(value):
            return f"the attribute {name} is {str(value)[:60]!r}, not a finite number"
    for name, most in (("latitude", 90), ("longitude", 180)):
        if abs(dataset.attrs.get(f"origin_{name}_deg", 0.0)) > most:
            return f"the attribute origin_{name}_deg is not within {most} degrees of 0"
    return None


def axis_problem(dataset: xr.Dataset) -> str | None:
    """Return the first reason why the axes of a dataset cannot be those of a radio map."""
    for axis in "xyz":
        values = dataset[axis].values
        if (values.dtype.kind not in "iuf" or not np.isfinite(values).all()
                or not (np.diff(values) > 0).all()):
            return f"the coordinate {axis} must hold finite numbers in ascending order [m]"
        if max(-float(values[0]), float(values[-1])) > MAX_POSITION_M or (
                len(values) > 1 and np.diff(values).min() < MIN_STEP_M):
            return (f"the coordinate {axis} must lie within {MAX_POSITION_M:,.0f} m of 0, with "
                    f"steps of at least {MIN_STEP_M:g} m")
    if GROUND in dataset and not (np.abs(dataset[GROUND].values) <= MAX_POSITION_M).all():
        return f"{GROUND} must hold finite heights within {MAX_POSITION_M:,.0f} m of 0"
    names = dataset["device"].values.astype(str)
    unique, count = np.unique(names, return_counts=True)
    if len(unique) < len(names):
        return f"two devices have one name, {str(unique[count > 1][0])[:MAX_NAME]!r}"
    for name in names.tolist():
        if not name.isprintable() or not 0 < len(name) <= MAX_NAME:
            return (f"device name {name[:MAX_NAME]!r} is empty, longer than {MAX_NAME} "
                    "characters, or has some that cannot be printed")
    return None


def value_problem(dataset: xr.Dataset) -> str | None:
    """Return the first reason why the values of a dataset cannot be those of a radio map.

    They are read in parts, each of whole pieces as the file stores them.

    Args:
        dataset: of the right form; its values may still be in the file.
    """
    names = [name for name in VARIABLES if name in dataset]
    regions = {name: list(_regions(dataset[name])) for name in names}
    with progress("checking the map", total=sum(map(len, regions.values()))) as advance:
        for name in names:
            for where in regions[name]:
                problem = _part_problem(name, dataset[name][where].values)
                if problem:
                    return problem
                advance()
    return None


def _part_problem(name: str, values: np.ndarray) -> str | None:
    if name == "los":
        is_right = values.dtype == bool or np.isin(values, (0, 1)).all()
        return None if is_right else "los holds other values than 0 and 1"
    low_db, high_db = np.fmin.reduce(values, axis=None), np.fmax.reduce(values, axis=None)
    if name == "sigma_db":
        if low_db < 0:
            return "sigma_db is negative somewhere"
        if high_db > MAX_SIGMA_DB:
            return f"sigma_db is above {MAX_SIGMA_DB:g} dB somewhere"
        return None
    if np.isinf(low_db) or np.isinf(high_db):
        return "gain_db is infinite somewhere; where nothing is detected it must be NaN"
    if low_db < GAIN_RANGE_DB[0] or high_db > GAIN_RANGE_DB[1]:
        return (f"gain_db goes from {low_db:g} to {high_db:g} dB; allowed is "
                f"{GAIN_RANGE_DB[0]:g} to {GAIN_RANGE_DB[1]:g}")
    return None


def _regions(values: xr.DataArray) -> Iterator[tuple[slice, ...]]:
    """Return slices that cover an array, of whole pieces of its file; small pieces are joined."""
    encoding: dict[Any, Any] = values.encoding
    stored = encoding.get("chunks") or encoding.get("chunksizes") or (1,) * values.ndim
    step = [min(part, size) for part, size in zip(stored, values.shape)]
    for axis in reversed(range(values.ndim)):
        fits = max(BLOCK_VALUES // math.prod(step), 1)
        step[axis] = min(step[axis] * fits, values.shape[axis])
    return (tuple(slice(start, start + length) for start, length in zip(starts, step))
            for starts in product(*(range(0, size, length)
                                    for size, length in zip(values.shape, step))))
