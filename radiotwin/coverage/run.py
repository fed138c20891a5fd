"""Predict a network's coverage: received power, best server, SINR, rate, location probability."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from scipy.special import ndtri

import radiotwin
from radiotwin.coverage.areas import (
    Area,
    CoverageGrid,
    area_records,
    class_bounds,
    with_ground_as_terrain,
)
from radiotwin.coverage.radio import (
    Bounds,
    CoverageSettings,
    ServerTally,
    channel_overlap,
    location_probability,
    rate_bps,
    thermal_noise_dbm,
)
from radiotwin.coverage.sources import (
    GainSource,
    altitude_row,
    filled_in_from_twin,
    source_of_map,
    source_of_twin,
    source_over,
    twin_transmitters,
)
from radiotwin.coverage.transmitters import (
    Transmitter,
    scene_transmitters,
    select,
    with_powers,
)
from radiotwin.errors import BadInput
from radiotwin.geo import origin_attributes
from radiotwin.io.texts import percent
from radiotwin.maps.radiomap import RadioMap
from radiotwin.runtime.console import progress
from radiotwin.scene import Scene
from radiotwin.scene.footing import footing
from radiotwin.twin import Twin

SCHEMA = "radiotwin.coverage/1"
DEFAULT_HEIGHT_M, DEFAULT_STEP_M = 1.5, 5.0
NOTED_RECEIVERS = 1_000  # sample whose links are checked against a law's validity range
_ATTRIBUTES = {
    "received_power_dbm": (
        "dBm", "received power of the best server (NaN: not detected, or left out)"),
    "received_power_sd_db": ("dB", "standard deviation of the received power"),
    "best_server": ("", "row of the best server among the transmitters (-1: none)"),
    "snr_db": ("dB", "signal-to-noise ratio"),
    "sinr_db": ("dB", "signal-to-interference-and-noise ratio"),
    "rate_bps": ("bit/s", "rate of one user"),
    "coverage_probability": ("1", "probability that the received power reaches the threshold"),
    "indoor": ("", "the cell's receiver is inside a building"),
}


@dataclass(frozen=True, eq=False)
class Coverage:
    """Coverage of a network.

    Attributes:
        dataset: variables `received_power_dbm`, `best_server`, `snr_db`, `sinr_db`, `rate_bps`,
            `indoor` and, of a model with a standard deviation, `received_power_sd_db` and
            `coverage_probability`, each (y, x); coordinates x, y: middles of the cells [m].
        transmitters: with power, load and frequency; `best_server` is an index into them.
        summary: content of `coverage.json`.
        grid: the cells.
        settings: of the prediction.
        areas: polygons with shares in the summary.
    """

    dataset: xr.Dataset
    transmitters: list[Transmitter]
    summary: dict[str, Any]
    grid: CoverageGrid
    settings: CoverageSettings
    areas: tuple[Area, ...] = ()


def predict_coverage(source: Twin | RadioMap | str, scene: Scene | Path | str,
                     transmitters: Sequence[Transmitter] | None = None,
                     settings: CoverageSettings | None = None, areas: Sequence[Area] = (),
                     devices: list[str] | None = None) -> Coverage:
    """Predict the coverage of a network over a scene.

    Args:
        source: model of the gains: a twin, a radio map of the scene, the name of a published law,
            or `paths`, which follows paths over the 3D map.
        scene: 3D map and radio.
        transmitters: None: the twin's devices, or those that the scene declares.
        settings: None: the defaults.
        areas: polygons to report covered shares of, beside the extent.
        devices: names of the transmitters to use; None: all.

    Returns:
        Rasters, shares of areas, and the transmitters with their assumed settings.

    Raises:
        BadInput: an impossible setting, an unknown transmit power, or a transmitter that the
            source lacks.
    """
    scene, settings = Scene.of(scene), settings or CoverageSettings()
    settings.check()
    chosen = _transmitters(source, scene, transmitters, devices, settings)
    grid, gains = _grid_and_gains(source, scene, chosen, settings)
    bandwidth_hz = settings.bandwidth_hz or scene.config.radio.bandwidth_hz
    noise_figure_db = _noise_figure_db(scene, settings)
    noise_dbm = thermal_noise_dbm(bandwidth_hz) + noise_figure_db
    values = _rasters(gains, scene, chosen, grid, settings, noise_dbm, bandwidth_hz)
    if settings.indoor_loss_db is not None and values["indoor"].any() \
            and not np.isfinite(values["received_power_dbm"][values["indoor"]]).any():
        raise BadInput(f"{gains.description} has no gain inside any building, so there is nothing "
                       "that an indoor loss could be taken off; leave --indoor-loss-db out")
    attributes: dict[str, Any] = {
        "schema": SCHEMA, "model": gains.description, "scene": scene.config.name,
        "height_m": grid.height_m, "step_m": grid.step_m, "bandwidth_hz": bandwidth_hz,
        "noise_figure_db": noise_figure_db, "noise_dbm": noise_dbm, "aclr_db": settings.aclr_db,
        "threshold_dbm": settings.threshold_dbm, "reliability": settings.reliability,
        "radiotwin_version": radiotwin.__version__}
    dataset = _dataset(values, chosen, grid, attributes, scene)
    summary = _summary(dataset, chosen, grid, gains, settings, areas, bandwidth_hz,
                       scene)
    return Coverage(dataset, chosen, summary, grid, settings, tuple(areas))


def _transmitters(source: Twin | RadioMap | str, scene: Scene,
                  given: Sequence[Transmitter] | None, devices: list[str] | None,
                  settings: CoverageSettings) -> list[Transmitter]:
    """Return transmitters with load and frequency, and the position and power the source needs."""
    found = scene_transmitters(scene) if given is None else list(given)
    if isinstance(source, Twin):
        found = filled_in_from_twin(source, twin_transmitters(source, found) if given is None
                                    else found)
    elif given is None and isinstance(source, RadioMap):
        by_name = {each.name: each for each in found}
        # The map holds the gains, so positions of its devices are not needed.
        found = [by_name.get(name, Transmitter(name, np.full(3, np.nan)))
                 for name in source.devices]
    if isinstance(source, RadioMap):
        if given is not None and any(each.antenna for each in found):
            warnings.warn("antennas of the transmitters' table are not used: a radio map has those "
                          "that it was made with", stacklevel=3)
        found = [replace(each, tx_power_dbm=source.tx_power_dbm.get(each.name))
                 if each.tx_power_dbm is None else each for each in found]
    if not found:
        raise BadInput(f"there is no transmitter: {scene.folder / 'scene.toml'} declares no "
                       "[[devices]]; add some, or give a table with --transmitters")
    found = select(found, devices)
    if isinstance(source, RadioMap):
        known = set(source.devices)
        for each in found:
            if each.name not in known:
                raise BadInput(f"device {each.name!r} is not in the radio map, which holds no "
                               "other transmitters than it was made for; leave it out with "
                               "--devices, or give a twin or a scene")
    if given is not None:
        found = _moved_outdoors(found, scene)
    found = [replace(each, load=settings.load if each.load is None else each.load,
                     frequency_hz=each.frequency_hz or scene.config.radio.frequency_hz)
             for each in found]
    if isinstance(source, Twin) and not source.has_gains:
        if settings.tx_power_dbm is not None:
            raise BadInput("the twin's levels are received powers, with transmit powers in them "
                           "that nobody declared; leave --tx-power-dbm out, or declare "
                           "tx_power_dbm in devices.csv and fit again")
        return found
    return with_powers(found, scene, settings.tx_power_dbm)


def _moved_outdoors(transmitters: list[Transmitter], scene: Scene) -> list[Transmitter]:
    """Move transmitters that are just inside a building or below ground outdoors, with a warning.

    BadInput if an error of the map does not explain it (`radiotwin.scene.footing`).
    """
    found = []
    for each in transmitters:
        x_m, y_m, z_m = each.position_m
        where = str(scene.city.misplaced(each.position_m)[0])
        outside = footing(scene.city, each.position_m) if where else None
        if outside is not None:
            warnings.warn(f"transmitter {each.name} would be inside a building of the map or below "
                          f"its ground, by no more than a map is off: moved {outside.move}",
                          stacklevel=4)
            each = replace(each, position_m=outside.point_m)
        elif where:
            top_m = float(scene.city.height_at(x_m, y_m))
            raise BadInput(f"transmitter {each.name!r} at ({x_m:g}, {y_m:g}, {z_m:g}) m is {where}"
                           + ("; z_m counts from the datum: raise it" if where == "below the ground"
                              else f" {top_m:.1f} m high; move it, or put it on the roof (z_m > "
                                   f"{top_m:.1f})"))
        found.append(each)
    return found


def _grid_and_gains(source: Twin | RadioMap | str, scene: Scene, transmitters: list[Transmitter],
                    settings: CoverageSettings) -> tuple[CoverageGrid, GainSource]:
    """Return the grid of cells, and the source of gains from the transmitters to them."""
    if isinstance(source, RadioMap):
        for name, value in (("step", settings.step_m), ("extent", settings.extent_m)):
            if value is not None:
                raise BadInput(f"a radio map has a grid of its own, and its {name} cannot be "
                               f"chosen: leave --{name} out, or make the map over a scene that "
                               f"was built with build-scene --{name}")
        level = altitude_row(source, settings.height_m)
        return (CoverageGrid.of_map(source.lattice, level),
                source_of_map(source, level, transmitters))
    _refuse_extent_off_map(settings.extent_m, scene)
    grid = CoverageGrid.over(
        settings.extent_m or scene.config.extent.bounds, settings.step_m or DEFAULT_STEP_M,
        settings.height_m or DEFAULT_HEIGHT_M)
    if isinstance(source, Twin):
        return grid, source_of_twin(source, scene, transmitters)
    if source == "paths" and settings.indoor_loss_db is not None:
        raise BadInput("no path over the map goes into a building, so there is nothing that an "
                       "indoor loss could be taken off; leave --indoor-loss-db out, or take a law "
                       "or a twin")
    return grid, source_over(source, scene, transmitters)


def _refuse_extent_off_map(extent_m: Bounds | None, scene: Scene) -> None:
    """Raise BadInput if an extent (x_min, x_max, y_min, y_max) [m] does not overlap the map."""
    west, east, south, north = scene.config.extent.bounds
    if extent_m is None:
        return
    x_min, x_max, y_min, y_max = extent_m
    if x_min >= east or x_max <= west or y_min >= north or y_max <= south:
        raise BadInput(f"an extent of x {x_min:g} to {x_max:g} m, y {y_min:g} to {y_max:g} m is "
                       f"outside the map, which reaches from x {west:g} to {east:g} m and from y "
                       f"{south:g} to {north:g} m; give one on it")


def _noise_figure_db(scene: Scene, settings: CoverageSettings) -> float:
    """Return the receivers' noise figure [dB]: as set, or as the scene's noise power implies."""
    if settings.noise_figure_db is not None:
        return settings.noise_figure_db
    radio = scene.config.radio
    figure_db = radio.noise_dbm - thermal_noise_dbm(radio.bandwidth_hz)
    if figure_db < 0:
        raise BadInput(f"{scene.folder / 'scene.toml'}: noise_dbm = {radio.noise_dbm:g} lies "
                       f"{-figure_db:.1f} dB below the thermal noise of bandwidth_hz = "
                       f"{radio.bandwidth_hz:g}, which no receiver reaches; correct it, or give "
                       "--noise-figure-db")
    return figure_db


def _rasters(gains: GainSource, scene: Scene, transmitters: list[Transmitter], grid: CoverageGrid,
             settings: CoverageSettings, noise_dbm: float,
             bandwidth_hz: float) -> dict[str, np.ndarray]:
    """Predict power, best server, SNR, SINR, rate and probability; return rasters (ny, nx) by name.

    Where nothing is detected, best server is -1, levels are NaN, and rate and probability 0; cells
    left out indoors have NaN, and server -1. A model without standard deviations has no
    rasters of standard deviation and coverage probability.
    """
    frequencies_hz = sorted({each.frequency_hz or 0.0 for each in transmitters})
    overlap = channel_overlap(np.array(frequencies_hz), bandwidth_hz, settings.aclr_db)
    shape, ground = grid.shape, with_ground_as_terrain(scene.city)
    values = {name: np.full(shape, np.nan, np.float32) for name in (
        "received_power_dbm", "received_power_sd_db", "snr_db", "sinr_db", "rate_bps",
        "coverage_probability")}
    values["best_server"] = np.full(shape, -1, np.int32)
    values["indoor"] = np.zeros(shape, bool)
    blocks = list(grid.blocks())
    with progress("coverage", total=len(blocks) * len(transmitters)) as advance:
        for rows in blocks:
            receiver_m = grid.receivers_m(rows, ground)
            indoor = scene.city.inside(receiver_m)
            used = np.flatnonzero(~indoor if settings.indoor_loss_db is None else
                                  np.ones(len(indoor), bool))
            index = used + rows.start * shape[1]
            tally = ServerTally(len(used), overlap)
            entry_loss_db = np.where(indoor[used], settings.indoor_loss_db or 0.0, 0.0)
            for row, each in enumerate(transmitters):
                mean_db, sd_db = gains.predict(row, receiver_m[used], index)
                power_dbm = mean_db - entry_loss_db
                if not gains.has_power:
                    power_dbm = power_dbm + each.fed_dbm
                tally.add(row, power_dbm, np.nan if sd_db is None else sd_db, each.load or 0.0,
                          frequencies_hz.index(each.frequency_hz or 0.0))
                advance(1)
            sinr_db = tally.sinr_db(noise_dbm)
            predicted = {
                "received_power_dbm": tally.power_dbm, "received_power_sd_db": tally.sd_db,
                "best_server": tally.server, "snr_db": tally.power_dbm - noise_dbm,
                "sinr_db": sinr_db, "rate_bps": rate_bps(sinr_db, bandwidth_hz, settings.rate),
                "coverage_probability": location_probability(
                    tally.power_dbm, tally.sd_db, settings.threshold_dbm)}
            for name, value in predicted.items():
                values[name].reshape(-1)[index] = value
            values["indoor"][rows] = indoor.reshape(-1, shape[1])
    if not np.isfinite(values["received_power_sd_db"]).any():
        del values["received_power_sd_db"], values["coverage_probability"]
    return values


def _dataset(values: dict[str, np.ndarray], transmitters: list[Transmitter], grid: CoverageGrid,
             attributes: dict[str, Any], scene: Scene) -> xr.Dataset:
    """Return rasters as a dataset with coordinates, units and the scene's origin."""
    dataset = xr.Dataset({name: (("y", "x"), value) for name, value in values.items()},
                         coords={"y": grid.y_m, "x": grid.x_m,
                                 "transmitter": np.array([each.name for each in transmitters],
                                                         dtype=object)},
                         attrs=attributes | origin_attributes(scene.config.origin))
    for name in dataset.data_vars:
        unit, long_name = _ATTRIBUTES[str(name)]
        dataset[name].attrs |= ({"units": unit} if unit else {}) | {"long_name": long_name}
    for axis, long_name in (("x", "east"), ("y", "north")):
        dataset[axis].attrs |= {"units": "m", "long_name": long_name}
    return dataset


def _some_receivers(dataset: xr.Dataset, grid: CoverageGrid, scene: Scene) -> np.ndarray:
    """Take every n-th outdoor cell, `NOTED_RECEIVERS` at most; return positions (n, 3) [m]."""
    outside = np.flatnonzero(~dataset["indoor"].values)
    chosen = outside[::max(1, -(-len(outside) // NOTED_RECEIVERS))]
    y_m, x_m = (axis[rows] for axis, rows in zip((grid.y_m, grid.x_m),
                                                 np.unravel_index(chosen, grid.shape)))
    return grid.at_height(x_m, y_m, with_ground_as_terrain(scene.city))


def _known(position_m: np.ndarray) -> list[float | None]:
    return [float(each) if np.isfinite(each) else None for each in position_m]


def _summary(dataset: xr.Dataset, transmitters: list[Transmitter], grid: CoverageGrid,
             gains: GainSource, settings: CoverageSettings, areas: Sequence[Area],
             bandwidth_hz: float, scene: Scene) -> dict[str, Any]:
    """Return the content of `coverage.json`: settings, notes, transmitters, shares of areas."""
    left_out = int(dataset["indoor"].sum()) if settings.indoor_loss_db is None else 0
    notes = gains.notes(_some_receivers(dataset, grid, scene))
    nothing = np.isnan(dataset["received_power_dbm"].values) & (
        ~dataset["indoor"].values if left_out else True)
    if nothing.any():
        notes.append(f"{percent(nothing.sum() / (nothing.size - left_out))} of the cells "
                     f"({int(nothing.sum()):,}) receive nothing from any transmitter: no path, or "
                     "no gain, is known there; they count as not covered")
    gaps_hz = np.diff(sorted({each.frequency_hz or 0.0 for each in transmitters}))
    if (gaps_hz < bandwidth_hz).any():
        notes.append(f"channels of {bandwidth_hz / 1e6:g} MHz whose frequencies are "
                     f"{gaps_hz.min() / 1e6:g} MHz apart overlap in part, and interfere there")
    return {
        **dataset.attrs, "notes": notes, "above_ground": grid.above_ground,
        "cells": int(np.prod(grid.shape)),
        "cells_left_out_indoors": left_out, "indoor_loss_db": settings.indoor_loss_db,
        "load": settings.load,
        "rate_model": {"share": settings.rate.share, "min_sinr_db": settings.rate.min_sinr_db,
                       "max_bps_hz": settings.rate.max_bps_hz,
                       "source": "3GPP TR 36.942 Annex A.1"},
        "reliability_quantile": float(ndtri(settings.reliability)),
        "transmitters": [
            {"device": each.name, **dict(zip(("x_m", "y_m", "z_m"), _known(each.position_m))),
             "tx_power_dbm": None if gains.has_power else each.tx_power_dbm,
             **({"cable_loss_db": each.cable_loss_db} if each.cable_loss_db else {}),
             "load": each.load,
             "frequency_hz": each.frequency_hz, "antenna": each.antenna is not None,
             **({} if each.antenna is None else {"azimuth_deg": each.antenna.azimuth_deg,
                                                 "tilt_deg": each.antenna.tilt_deg})}
            for each in transmitters],
        "areas": area_records(dataset, grid, transmitters, settings,
                              class_bounds(settings, bandwidth_hz), areas)}
