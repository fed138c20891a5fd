"""Find reflected and diffracted paths over a 3D map, and compute their power."""

from radiotwin.propagation.paths.powers import PathPowers, path_powers

__all__ = ["PathPowers", "path_powers"]
