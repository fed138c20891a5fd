"""Sector antennas that the loop found, as antennas that a scene declares."""

from pathlib import Path

import numpy as np
import pandas as pd
from pydantic import ValidationError

from radiotwin.cells import write_csv
from radiotwin.closeloop.run import Loop
from radiotwin.effects.sector_antenna import SectorAntenna, SectorPattern, sector_pattern_db
from radiotwin.scene import Scene
from radiotwin.scene.config import DeviceConfig, SceneConfig
from radiotwin.scene.names import safe_name, unique_name

ANTENNAS = "antennas"
AZIMUTH_DEG, ELEVATION_DEG = np.arange(0.0, 360.0, 5.0), np.arange(-90.0, 91.0, 2.0)
DECIMALS = 2  # of a gain [dBi] and an azimuth


def found_antennas(loop: Loop) -> dict[str, SectorPattern]:
    """Return device -> pattern of the sector antennas that were found.

    Args:
        loop: whose accepted effects are looked at.
    """
    names = loop.after.whole.links.device_names
    return {names[device]: pattern for each in loop.after.whole.effects
            if isinstance(each.effect, SectorAntenna)
            for device, pattern in each.params.devices.items()}


def with_antennas(config: SceneConfig, loop: Loop,
                  scene: Scene) -> tuple[SceneConfig, dict[str, SectorPattern], list[str]]:
    """Return a scene's configuration with the antennas that were found.

    An anchor of the measurements that the scene does not declare is declared with its antenna, if
    it is within the extent and outside buildings.

    Args:
        config: to add them to.
        loop: that found them.
        scene: that it was run with.

    Returns:
        the configuration, file in the scene's folder -> pattern, and a sentence for each.
    """
    links, devices = loop.after.whole.links, {each.device: each for each in config.devices}
    bounds, files, changes = config.extent.bounds, {}, []
    for name, pattern in found_antennas(loop).items():
        x_m, y_m, z_m = links.device_m[links.device_names.index(name)].tolist()
        device = devices.get(name)
        if device is None:
            within = bounds[0] <= x_m <= bounds[1] and bounds[2] <= y_m <= bounds[3]
            if not within or scene.city.inside(np.array([[x_m, y_m, z_m]]))[0]:
                changes.append(f"{name} has a sector antenna, and is not in the scene: it stands "
                               "outside the extent or in a building")
                continue
            try:
                device = DeviceConfig(device=name, x_m=round(x_m, 2), y_m=round(y_m, 2),
                                      z_m=round(z_m, 2), role="anchor")
            except ValidationError:  # measurements may call and place a device as they like
                changes.append(f"{name!r} has a sector antenna, and is not in the scene: scene.toml"
                               " has devices above z = 0, whose names are of letters, digits and "
                               "_.+-")
                continue
        others = {Path(each.antenna).stem.lower() for each in devices.values()
                  if each.antenna is not None and each.device != name}
        file = f"{ANTENNAS}/{unique_name(f'found_{safe_name(name)}', others)}.csv"
        azimuth_deg = round(pattern.azimuth_deg % 360, DECIMALS)
        devices[name] = device.model_copy(update={
            "antenna": file, "azimuth_deg": azimuth_deg, "tilt_deg": None})
        files[file] = pattern
        changes.append(f"{name} has a sector antenna that looks to {azimuth_deg:.0f}° and is "
                       f"{pattern.beamwidth_deg:.0f}° wide")
    return config.model_copy(update={"devices": list(devices.values())}), files, changes


def write_antenna(pattern: SectorPattern, path: Path) -> None:
    """Write a pattern about its own boresight, with its tilt, as lossless: its mean power is 1.

    Args:
        pattern: as it was found; what the data did not determine is as it was fitted.
        path: `.csv`, as `radiotwin.antennas.read_pattern` reads it.
    """
    elevation, azimuth = (axis.ravel() for axis in np.meshgrid(ELEVATION_DEG, AZIMUTH_DEG,
                                                               indexing="ij"))
    ahead = pattern.model_copy(update={"azimuth_deg": 0.0})
    gain_db = sector_pattern_db(azimuth, elevation, ahead)
    weight = np.cos(np.radians(elevation))
    mean = (weight @ 10 ** (gain_db / 10)) / weight.sum()
    path.parent.mkdir(parents=True, exist_ok=True)
    write_csv(pd.DataFrame({
        "azimuth_deg": azimuth, "elevation_deg": elevation,
        "gain_dbi": np.round(gain_db - 10 * np.log10(mean), DECIMALS)}), path)
