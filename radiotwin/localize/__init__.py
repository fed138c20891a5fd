"""Positions of unknown devices: over a 3D map, along paths over it, and without one."""

from radiotwin.localize.along_paths import Relocation
from radiotwin.localize.estimate import (
    DeviceEstimate,
    LocalizeSettings,
    TwinDevice,
    read_device,
)
from radiotwin.localize.on_map import localize
from radiotwin.localize.without_map import PositionEstimate, calibrated_power, locate, whole_area

__all__ = ["DeviceEstimate", "LocalizeSettings", "PositionEstimate", "Relocation", "TwinDevice",
           "calibrated_power", "localize", "locate", "read_device", "whole_area"]
