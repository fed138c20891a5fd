"""Power of reflected and diffracted paths, computed from the geometry of a 3D map alone."""

from radiotwin.propagation.paths.powers import PathPowers, path_powers

__all__ = ["PathPowers", "path_powers"]
