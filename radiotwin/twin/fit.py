"""fit_twin: fit a twin to measurements by any channel model."""

from __future__ import annotations

import warnings
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput, MissingPackage
from radiotwin.links import join_links, prepare_links
from radiotwin.links.alignment import as_measurements
from radiotwin.links.checks import (
    COPIED,
    copied_rows,
    move_anchors_out,
    refuse_empty_levels,
)
from radiotwin.links.measurements import Measurements
from radiotwin.propagation.laws import ChannelModel, channel_named, check_fit_data
from radiotwin.propagation.laws.image_paths import ImagePaths
from radiotwin.propagation.laws.log_distance import SegmentedLogDistance
from radiotwin.propagation.laws.path_kriging import PathKriging
from radiotwin.propagation.laws.published import PublishedLaw
from radiotwin.propagation.laws.segmented_nn import SegmentedNN, require_torch
from radiotwin.runtime.execution import Executor
from radiotwin.scene import Scene
from radiotwin.twin.fit_links import NO_ANCHOR, anchors_links, fit_links
from radiotwin.twin.fit_paths import fit_along_paths, fit_over_wrong_map
from radiotwin.twin.law import LAW, law_parameters
from radiotwin.twin.localize import LocalizeSettings
from radiotwin.twin.selection import AUTO, CHEAP, HELD_OUT, LOCATED_BY, UNTRIED, HeldOut
from radiotwin.twin.shadowing import MAP_ERRORS, ErrorCorrelation
from radiotwin.twin.twin import Twin

# Most links that are fitted. With 310,000 simulated links, whose errors are independent, the map
# has the error of 30,000 (0.385 dB), and devices are 0.04 to 0.3 m nearer than with 100,000, in 2.5
# times the time; errors of neighbouring measured links are correlated.
MAX_LINKS = 150_000
HEIGHT_NEEDED = ("with a 3D map every position needs one. Fill it in, in metres above the ground "
                 "of the scene (about 1.5 for a phone in the hand), here or in the table for "
                 "`radiotwin import --devices`")


def fit_twin(measurements: Measurements | pd.DataFrame | Path | str, scene: Scene | Path | str,
             model: str = AUTO, *, seed: int = 0, start: Twin | None = None,
             allow_indoor: bool = False, executor: Executor | None = None,
             compare: bool = False) -> Twin:
    """Learn the channel from the anchors' links, then locate the unknown devices with it.

    A published law (`radiotwin.propagation.laws.published`) is taken as it stands and needs no
    anchor.

    Args:
        measurements: links to anchors and unknown devices; of a file or a data frame, too.
        scene: its map and extent, and the receivers' sensitivity; or its folder.
        model: name of a channel model (`radiotwin.propagation.laws.channel_models`); `paths` traces
            paths over the 3D map, and `path_kriging` estimates errors of the map, too. `auto` is
            the simplest of `selection.CHEAP` with about the least held-out error; devices are then
            located by `segmented_nn`, if torch is installed.
        seed: of the channel's and the search's random numbers.
        start: an earlier twin; the search also starts from its positions.
        allow_indoor: whether unknown devices may be inside buildings.
        compare: whether to hold links out and note in the twin's provenance how well each of
            `selection.CHEAP` predicts them, see `HeldOut`; with the model `auto` always.
        executor: where a model that follows paths searches for devices, inside `keep_pieces`;
            None: in this process.

    Returns:
        the twin; `located` says of which devices the position is known.

    Warns:
        Repeated rows are left out; of more than `MAX_LINKS` links, as many are drawn, evenly.

    Raises:
        BadInput: no anchor, nothing detected, links that no channel can be learnt from, an unknown
            model, indoor devices with a model that traces paths, or an earlier twin in another
            frame.
    """
    scene = Scene.of(scene)
    measurements = as_measurements(measurements, scene)
    flights = measurements.flights
    measurements = _thinned(_usable(measurements), seed)
    if start is not None:
        start.require_frame(scene)
        start.warn_of_another_scene(scene, scene.content_hash())
    channel = channel_named(CHEAP[0] if model == AUTO else model)
    if channel is SegmentedNN:
        require_torch()
    if not (measurements.is_anchor.any() or issubclass(channel, PublishedLaw)):
        raise BadInput(NO_ANCHOR)
    along_paths = channel in (ImagePaths, PathKriging)
    if along_paths and allow_indoor:
        raise BadInput(f"model {model} follows paths outside buildings only; take another model "
                       "where unknown devices may be indoors")
    if not along_paths:
        _check_heights(measurements)
    links = (prepare_links if along_paths else join_links)(measurements, scene)
    links = move_anchors_out(links, scene)
    for note in links.notes:
        warnings.warn(note, stacklevel=2)
    if links.has_boresights:
        warnings.warn("azimuth_deg and tilt_deg are used by close-loop alone where no column "
                      "antenna names the file of a pattern", stacklevel=2)
    held_out: HeldOut | None = None
    locator: type[ChannelModel] | None = None
    if compare or model == AUTO:
        replacement = f", and {SegmentedLogDistance.name} locates devices in its place"
        models = usable_models(CHEAP, replacement * (model == AUTO))
        of_anchors = np.isin(links.device, sorted(links.anchors))
        geometry, level_db, limit_db = anchors_links(links)
        if model == AUTO and len(geometry):  # even if the best model does not use the map
            check_fit_data(geometry, level_db, needs_los=True)
        held_out = HeldOut.of(geometry, links.flight[of_anchors], level_db, limit_db, seed,
                              models)
        if model == AUTO:
            channel = channel_named(UNTRIED if held_out is None else held_out.best)
            locator = SegmentedNN if SegmentedNN.name in models else SegmentedLogDistance
    if along_paths:
        fit = fit_along_paths if channel is ImagePaths else fit_over_wrong_map
        twin = fit(links, scene, seed, start, executor)
    else:
        settings = LocalizeSettings(allow_indoor=allow_indoor)
        twin = fit_links(links, scene, channel, seed, start, settings, locator=locator)
    twin.provenance.update(flights=flights, seed=seed)
    if not along_paths:  # which would be followed once more
        twin.provenance[MAP_ERRORS] = asdict(ErrorCorrelation.of(twin, links, seed))
        twin.provenance[LAW] = law_parameters(twin.channel, *anchors_links(links), seed)
    if held_out is not None:
        twin.provenance[HELD_OUT] = held_out.record
    if locator is not None and not measurements.is_anchor.all():
        twin.provenance[LOCATED_BY] = locator.name
    return replace(twin, scene=scene)


def usable_models(models: tuple[str, ...], and_so: str = "") -> tuple[str, ...]:
    """Return the models to compare; without torch not the network, with a warning that says so."""
    try:
        require_torch()
    except MissingPackage:
        warnings.warn(f"{SegmentedNN.name} is not among the models compared{and_so}: it needs "
                      "torch (`pip install 'radiotwin[nn]'`)", stacklevel=3)
        return tuple(name for name in models if name != SegmentedNN.name)
    return models


def _usable(measurements: Measurements) -> Measurements:
    """Drop rows that repeat a link exactly; raise BadInput if levels are empty or all equal."""
    refuse_empty_levels(measurements.level_db, measurements.level_column)
    copied = copied_rows(measurements.table)
    if not copied.any():
        return measurements
    warnings.warn(f"{copied.sum():,} of {len(copied):,} links left out: {COPIED}", stacklevel=3)
    return measurements.select(~copied)


def _thinned(measurements: Measurements, seed: int) -> Measurements:
    """Draw MAX_LINKS random links, evenly among devices (each at least one), and warn, if more."""
    device = measurements.device_index
    if len(device) <= MAX_LINKS:
        return measurements
    links = np.bincount(device)
    quota, too_many = 1, len(device)  # of a device: fits into MAX_LINKS, or not
    while too_many - quota > 1:
        middle = (quota + too_many) // 2
        fits = np.minimum(links, middle).sum() <= max(MAX_LINKS, len(links))
        quota, too_many = (middle, too_many) if fits else (quota, middle)
    shuffled = np.random.default_rng(seed).permutation(len(device))
    by_device = shuffled[np.argsort(device[shuffled], kind="stable")]
    number = np.arange(len(device)) - np.repeat(np.cumsum(links) - links, links)
    keep = np.zeros(len(device), dtype=bool)
    keep[by_device[number < quota]] = True
    warnings.warn(f"{len(device):,} links were measured, {keep.sum():,} of them are fitted: at "
                  f"most {quota:,} of each device, drawn at random; the result is as certain as so "
                  "many links make it", stacklevel=3)
    return measurements.select(keep)


def _check_heights(measurements: Measurements) -> None:
    """Raise BadInput if a receiver or measured device has no height; the message names the row."""
    empty = np.flatnonzero(measurements.table["receiver_z_m"].isna())
    if len(empty):
        raise BadInput(f"{measurements.files[0]}, row {empty[0] + 2}, column receiver_z_m: the "
                       f"receiver's height is empty; {HEIGHT_NEEDED}, or import the file again "
                       "with one for all rows, radiotwin import --columns \"…,height=always 1.5\"")
    measured = np.unique(measurements.device_index)
    for index in measured[np.isnan(measurements.device_m[measured, 2])]:
        raise BadInput(f"{measurements.files[1]}, row {index + 2}, column z_m: the height "
                       f"of device {measurements.devices['device'][index]!r} is empty; "
                       f"{HEIGHT_NEEDED}")
