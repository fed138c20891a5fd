"""Locate unknown devices: with a 3D map, along paths over the map, and without a map."""

from radiotwin.twin.localize.along_paths import Relocation
from radiotwin.twin.localize.calibration import RadiusCalibration, calibrate_radii, misfit
from radiotwin.twin.localize.estimate import TwinDevice
from radiotwin.twin.localize.likelihood import LawError
from radiotwin.twin.localize.on_map import LocalizeSettings, localize
from radiotwin.twin.localize.without_map import locate, position_log_likelihood, whole_area

__all__ = ["LawError", "LocalizeSettings", "RadiusCalibration", "Relocation", "TwinDevice",
           "calibrate_radii", "localize", "locate", "misfit", "position_log_likelihood",
           "whole_area"]
