"""The twin: fit, save, load, predict, map, locate."""

from radiotwin.twin.fit import fit_twin
from radiotwin.twin.store import check_twin_target
from radiotwin.twin.twin import Twin, TwinDevice

__all__ = ["Twin", "TwinDevice", "check_twin_target", "fit_twin"]
