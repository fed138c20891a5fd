"""Power of reflected and diffracted paths, computed from the geometry of a 3D map alone."""

from radiotwin.propagation.paths.facets import Edges, Facets, extract_edges, extract_facets
from radiotwin.propagation.paths.powers import PathPowers, path_powers

__all__ = ["Edges", "Facets", "PathPowers", "extract_edges", "extract_facets", "path_powers"]
