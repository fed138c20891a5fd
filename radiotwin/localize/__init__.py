"""Localisation of unknown devices in the 3D map."""

from radiotwin.localize.estimate import DeviceEstimate, LocalizeSettings
from radiotwin.localize.locate import localize

__all__ = ["DeviceEstimate", "LocalizeSettings", "localize"]
