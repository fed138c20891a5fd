import pytest
import trimesh

from radiotwin.scene.citymap import CityMap
from radiotwin.scene.folder import CityShape, write_city
from radiotwin.scene.materials import Material, itu_material


@pytest.fixture
def folder(tmp_path):
    own = Material("own", relative_permittivity=3.0, conductivity_s_per_m=0.1, scattering_coefficient=0.2)
    tower = trimesh.creation.box((10, 10, 40))
    write_city(
        tmp_path,
        [
            CityShape(
                "ground",
                trimesh.Trimesh([[-50, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0]], [[0, 1, 2], [0, 2, 3]]),
                itu_material("wet_ground"),
            ),
            CityShape("tower", tower.apply_translation([0, 0, 20]), itu_material("itu_concrete", thickness_m=0.3)),
            CityShape("shed", tower.copy().apply_translation([30, 0, -30]), own),
        ],
    )
    return tmp_path


def test_the_3d_map_reads_it(folder):
    city = CityMap.from_xml(folder / "city.xml")
    assert city.height_at([0, 30, -30], [0, 0, 0]).tolist() == pytest.approx([40, 10, 0])
    of_shape = [city.materials[row] for row in city.material[[0, 2, -1]]]
    assert [(each.itu, each.thickness_m) for each in of_shape[:2]] == [("wet_ground", 0.1), ("concrete", 0.3)]
    assert of_shape[2].relative_permittivity is not None and city.ground_material.itu == "wet_ground"


@pytest.mark.llvm
def test_sionna_rt_loads_it(folder):
    from sionna import rt

    scene = rt.load_scene(str(folder / "city.xml"), merge_shapes=False)
    scene.frequency = 2.4e9
    assert set(scene.objects) == {"ground", "tower", "shed"}
    tower = scene.objects["tower"].radio_material
    assert tower.relative_permittivity[0] == pytest.approx(5.24)
    assert tower.thickness[0] == pytest.approx(0.3)
    shed = scene.objects["shed"].radio_material
    assert [
        float(value[0]) for value in (shed.relative_permittivity, shed.conductivity, shed.scattering_coefficient)
    ] == pytest.approx([3.0, 0.1, 0.2])
