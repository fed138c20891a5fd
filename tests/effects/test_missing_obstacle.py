"""Where a building that the map does not show is proposed."""

import numpy as np
import trimesh

from radiotwin.effects.missing_obstacle import MissingObstacle
from radiotwin.scene.citymap import CityMap


def test_where_no_link_has_line_of_sight_nothing_can_be_missing(make_links, view):
    """A wall 100 m high stands between the device and every receiver."""
    wall = trimesh.creation.box(bounds=[[40, -500, 0], [50, 500, 100]])
    receiver_m = np.column_stack([np.linspace(100, 200, 40), np.linspace(-50, 50, 40), np.full(40, 20.0)])
    links = make_links([[0.0, 0, 1.5]], receiver_m, city=CityMap(wall.vertices, wall.faces))
    assert MissingObstacle().propose(view(links, np.full(40, 30.0), 1.0)) == []
