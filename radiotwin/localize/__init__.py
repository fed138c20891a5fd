"""Positions of unknown devices: over a 3D map, along paths over it, and without one."""

from radiotwin.localize.along_paths import Relocation
from radiotwin.localize.calibration import RadiusCalibration, calibrate_radii, misfit
from radiotwin.localize.estimate import (
    DeviceEstimate,
    LocalizeSettings,
    TwinDevice,
    read_device,
)
from radiotwin.localize.on_map import localize
from radiotwin.localize.without_map import (
    PositionEstimate,
    locate,
    position_log_likelihood,
    whole_area,
)

__all__ = ["DeviceEstimate", "LocalizeSettings", "PositionEstimate", "RadiusCalibration",
           "Relocation", "TwinDevice", "calibrate_radii", "localize", "locate", "misfit",
           "position_log_likelihood", "read_device", "whole_area"]
