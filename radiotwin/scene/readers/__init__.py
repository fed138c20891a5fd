"""Scenes from maps: footprints and 3D city models as watertight buildings."""

from radiotwin.scene.readers.build import MapOptions, build_scene_from_map, map_name, map_suffix
from radiotwin.scene.readers.material_table import MaterialTable, read_material_table, with_pairs

__all__ = ["MapOptions", "MaterialTable", "build_scene_from_map", "map_name", "map_suffix",
           "read_material_table", "with_pairs"]
