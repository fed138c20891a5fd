"""Twin: fit to measurements, save and load, predict levels and maps, locate devices."""

from radiotwin.twin.fit import fit_twin
from radiotwin.twin.store import check_twin_target
from radiotwin.twin.twin import Twin, TwinDevice

__all__ = ["Twin", "TwinDevice", "check_twin_target", "fit_twin"]
