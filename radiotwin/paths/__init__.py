"""Power of reflected and diffracted paths, computed from the geometry of a 3D map alone."""

from radiotwin.paths.edges import Edges, extract_edges
from radiotwin.paths.facets import Facets, extract_facets
from radiotwin.paths.powers import PathPowers, path_powers

__all__ = ["Edges", "Facets", "PathPowers", "extract_edges", "extract_facets", "path_powers"]
