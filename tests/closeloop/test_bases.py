"""The base models, fitted to links that say little."""

from dataclasses import replace

import numpy as np
import trimesh

from radiotwin.channel.image_paths import REST_EXPONENT, REST_LOW_DB, _fit_rest
from radiotwin.links.link_data import prepare_links
from radiotwin.scene.citymap import CityMap


def test_where_all_that_is_hidden_is_blank_what_paths_leave_over_is_as_weak_as_it_may_be(open_ground):
    """40 receivers behind a wall 60 m high, none of which hears anything."""
    wall = trimesh.creation.box(bounds=[[45, -300, 0], [55, 300, 60]])
    receiver_m = np.column_stack([np.full(40, 150.0), np.linspace(-80, 80, 40), np.full(40, 10.0)])
    device_m = np.array([[0.0, 0, 10]])
    links = prepare_links(open_ground.measured(open_ground.fly(0)), None).select(np.arange(40))
    links = replace(links, level_db=np.full(40, np.nan), limit_db=-100.0, receiver_m=receiver_m,
                      device_m=device_m, device=np.zeros(40, int), city=CityMap(wall.vertices, wall.faces))
    assert not links.los.any()
    assert _fit_rest(links, device_m) == (REST_LOW_DB, REST_EXPONENT)
