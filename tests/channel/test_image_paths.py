"""The channel that follows paths, fitted to links that say little."""

import numpy as np
import trimesh

from radiotwin.channel.image_paths import DIFFUSE_DEFAULT, ImagePaths
from radiotwin.links import LinkGeometry
from radiotwin.scene.citymap import CityMap


def test_where_all_links_without_line_of_sight_are_blank_the_diffuse_power_is_as_weak_as_it_may_be():
    """40 receivers behind a wall 60 m high, none of which hears anything."""
    wall = trimesh.creation.box(bounds=[[45, -300, 0], [55, 300, 60]])
    city = CityMap(wall.vertices, wall.faces)
    receiver_m = np.column_stack([np.full(40, 150.0), np.linspace(-80, 80, 40), np.full(40, 10.0)])
    device_m = np.tile([0.0, 0, 10], (40, 1))
    los = city.line_of_sight(device_m, receiver_m)
    assert not los.any()
    links = LinkGeometry(device_m, receiver_m, los, np.zeros(40, int), city, 2.4e9)
    fitted = ImagePaths(diffuse=(-80.0, 2.0)).fit_diffuse(links, np.full(40, np.nan), -100.0)
    assert fitted.diffuse == DIFFUSE_DEFAULT
