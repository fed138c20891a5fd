"""Locate devices of unknown position in new measurements by a fitted twin."""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.geo import to_geographic
from radiotwin.inference.student import sd_of_scale
from radiotwin.io.cells import listed, read_cells
from radiotwin.io.forms import Origin
from radiotwin.links import Links, link_geometry, prepare_links
from radiotwin.links.alignment import as_measurements, in_known_frame
from radiotwin.links.declared import match_learnt_law
from radiotwin.links.measurements import Measurements
from radiotwin.links.site_table import read_site_table
from radiotwin.runtime.console import progress
from radiotwin.scene import Scene
from radiotwin.twin.localize import TwinDevice, locate, misfit, whole_area
from radiotwin.twin.localize.without_map import MIN_LINKS
from radiotwin.twin.model.model import CHANNEL_DOF, FittedModel
from radiotwin.twin.twin import Twin

NOT_BY_PATHS = ("and following paths from every position where a device may be takes too long: "
                "locate uses its law of distance and line of sight alone. close-loop --base twin "
                "makes one whose effects it uses, too, and fit --model paths locates devices "
                "along paths")
MAX_NAMED = 5  # receivers named in a note
MAX_PROBES = 2000  # links at which a channel's standard deviation is sampled
MIN_WIDENING = 1.2  # ratio of residuals to those in training above which radii are widened


def locate_devices(measurements: Measurements | pd.DataFrame | Path | str, twin: Twin,
                   scene: Scene | Path | str | None = None) -> tuple[pd.DataFrame, list[str]]:
    """Locate the devices of role unknown in new measurements.

    Args:
        measurements: links of these devices, and others; converted into the twin's frame if both
            have a known origin.
        twin: made by `fit` or `close-loop`.
        scene: the 3D map, or its folder, if the twin was made with one; None: the twin's own.

    Returns:
        a row for each device with `MIN_LINKS` links: `device, x_m, y_m, radius_m` (90 % of the
        probability), `links`, and if the origin is known `latitude_deg, longitude_deg`; and notes.

    Raises:
        BadInput: the twin needs a map, or was made without one; no unknown device; another quantity
            than the twin's; or no usable link.
    """
    if scene is None:
        scene = twin.scene if twin.channel.uses_map else None
    else:
        scene = Scene.of(scene)
    twin.require_map(scene)
    measurements = in_known_frame(as_measurements(measurements, scene), twin.origin, "the twin")
    unknown = measurements.select(~measurements.is_anchor[measurements.device_index])
    unknown = replace(unknown, devices=unknown.devices[~unknown.is_anchor].reset_index(drop=True))
    if unknown.table.empty:
        raise BadInput("no link is to a device of role unknown; set the role of those that are to "
                       "be found in devices.csv")
    if unknown.level_column != twin.level:
        raise BadInput(f"the measurements have {unknown.level_column}, the twin is of "
                       f"{twin.level}; both need the same")
    links = prepare_links(unknown, scene, to_locate=True)
    declared, assumed = match_learnt_law(links.device_names, links.declared, twin.declared, scene)
    links = links.with_ends(declared=declared).with_notes(*assumed)
    by_channel = twin.fitted.is_channel_alone or twin.channel.follows_paths
    model = _by_channel(twin, links) if by_channel else twin.fitted.for_positions()
    strangers = [name for name in links.receiver_names if name not in model.receivers]
    notes = list(links.notes)
    if twin.channel.follows_paths:
        notes.append(f"the twin follows paths, {NOT_BY_PATHS}")
    elif by_channel:
        notes.append("the twin is of `radiotwin fit`, which does not learn how far links of one "
                     "device err alike: the devices may be farther away than their radii say. "
                     "Radii of a twin of `radiotwin close-loop` allow for it")
    elif strangers:
        others = " and others" if len(strangers) > MAX_NAMED else ""
        notes.append(f"nothing is known of receivers {', '.join(strangers[:MAX_NAMED])}{others}: "
                     "they are taken for faultless ones")
    links = _with_receivers_of(links, [*model.receivers, *strangers])
    links = links.with_devices(np.nan_to_num(links.device_m))
    if twin.limit_db is not None:  # a few links do not tell how weak a level can be detected
        links = links.with_columns(limit_db=np.full(len(links), twin.limit_db))
    area_m = scene.config.extent.bounds if scene is not None else whole_area(model, links)
    with progress("locating", total=len(np.unique(links.device))) as advance:
        found = list(locate(model, links, area_m, lambda: advance(1)))
    widening = _widening(model, links, found)
    if widening > 1.0:
        notes.append("all positions are uncertain: where devices are located, residuals are "
                     f"{widening:.1f} times as large as those of the known devices that the twin "
                     "was learnt from: receivers or surroundings have changed since, or what was "
                     "learnt holds less where these devices are; radii are that much wider")
        found = [replace(device, credible_radius_m=widening * device.credible_radius_m)
                 for device in found]
    count = dict(zip(links.device_names, np.bincount(links.device)))
    lost = [f"{name} ({links_of})" for name, links_of in count.items()
            if links_of and name not in {device.device for device in found}]
    if lost:
        notes.append(f"not located, for want of links (at least {MIN_LINKS} are needed): "
                     f"{listed(lost)}")
    table = pd.DataFrame([(device.device, device.x_m, device.y_m, device.credible_radius_m,
                           count[device.device]) for device in found],
                         columns=["device", "x_m", "y_m", "radius_m", "links"]).round(1)
    if measurements.origin is not None:
        east_deg, north_deg = to_geographic(measurements.origin, table["x_m"], table["y_m"])
        table = table.assign(latitude_deg=north_deg.round(7), longitude_deg=east_deg.round(7))
    return table, notes


def _with_receivers_of(links: Links, names: Sequence[str]) -> Links:
    """Renumber the receivers of links by their index in `names`, which has all of them."""
    index_of = {name: i for i, name in reversed(list(enumerate(names)))}
    new_index = np.array([index_of[name] for name in links.receiver_names])
    tracks = {(int(new_index[receiver]), flight): track
              for (receiver, flight), track in links.tracks.items()}
    return links.with_columns(receiver=new_index[links.receiver]).with_ends(
        receiver_names=list(names), flown=replace(links.ends.flown, tracks=tracks))


def _by_channel(twin: Twin, links: Links) -> FittedModel:
    """Return a model of the twin's fast law (if it traces paths) or of its trend, without effects.

    Its error scales are the law's medians for the twin's devices at the receivers of the links.
    """
    channel = twin.channel.quick if twin.channel.follows_paths else twin.channel.trend
    known = np.isfinite(twin.device_m).all(axis=1)
    rows = np.unique(np.linspace(0, len(links) - 1, MAX_PROBES).astype(int))
    device = np.flatnonzero(known)[np.arange(len(rows)) % known.sum()]
    probes = link_geometry(twin.device_m, links.receiver_m[rows], device, links.city,
                           links.frequency_hz)
    sd_db, group = channel.predict(probes)[1], channel.error_group(probes)
    usual_db = [np.median(sd_db[group == number] if (group == number).any() else sd_db)
                for number in range(channel.error_groups(probes))]
    scale_db = np.array(usual_db) / sd_of_scale(CHANNEL_DOF)
    levels = np.zeros(channel.level_columns(probes)[0].shape[1])
    return FittedModel(channel, (), (), levels, scale_db, CHANNEL_DOF,
                       np.nan_to_num(twin.device_m), (), links.first_s, 0.0)


def _widening(model: FittedModel, links: Links, found: list[TwinDevice]) -> float:
    """Return the factor on radii as links fit worse than in training; 1 up to `MIN_WIDENING`."""
    if np.isnan(model.typical_misfit) or not found:
        return 1.0
    row = {name: row for row, name in enumerate(links.device_names)}
    misfits = [misfit(model, links.select(links.device == row[device.device]), device)
               for device in found]
    ratio = float(np.sqrt(np.nanmedian(misfits) / model.typical_misfit))
    return ratio if ratio > MIN_WIDENING else 1.0


def read_truth(path: Path, origin: Origin | None) -> pd.DataFrame:
    """Read true positions of devices from a table of sites.

    Args:
        path: a table of sites, see `radiotwin.links.site_table`.
        origin: origin of the local frame; None: unknown.

    Returns:
        `device, x_m, y_m`; NaN if a position is unknown.

    Warns:
        A column is not used.

    Raises:
        BadInput: no position, a device twice, a value that is no number, or degrees without an
            origin.
    """
    sites = read_site_table(path, read_cells(path), lambda row: f"row {row + 2}", "device")
    sites.refuse("device", sites.names.duplicated(), "occurs twice; every device needs one row")
    for note in sites.notes:
        warnings.warn(note, stacklevel=2)
    x_m, y_m, _ = sites.local_m(origin, None, "the twin").T
    return pd.DataFrame({"device": sites.names, "x_m": x_m, "y_m": y_m})


def position_errors(positions: pd.DataFrame, truth: pd.DataFrame) -> dict[str, float]:
    """Compute the errors of located positions, and the share of them within the radius.

    Args:
        positions: result of `locate_devices`.
        truth: true positions, `device, x_m, y_m`.

    Returns:
        number of devices, median and 90 % quantile of the distance [m], and the share of devices
        within their radius.

    Raises:
        BadInput: no located device has a true position.
    """
    both = positions.merge(truth[["device", "x_m", "y_m"]].dropna(), on="device",
                           suffixes=("", "_true"))
    if both.empty:
        raise BadInput("the table of true positions has none of the located devices: it has "
                       f"{listed(truth['device'])}, and located are {listed(positions['device'])}")
    error_m = np.hypot(both["x_m"] - both["x_m_true"], both["y_m"] - both["y_m_true"])
    return {"devices": len(both), "median_m": float(error_m.median()),
            "ninety_m": float(error_m.quantile(0.9)),
            "within": float((error_m <= both["radius_m"]).mean())}
