"""Files that radiotwin did not write are not replaced without --force; what it wrote is replaced as ever."""

import gzip
import shutil

import pytest

from radiotwin.maps.export import EXPORTERS

LOG = b"time,lat,lon,rssi\n1,47.5,8.7,-80\n"


@pytest.fixture(scope="module")
def place(scene_to_map, tmp_path_factory):
    return shutil.copytree(scene_to_map, tmp_path_factory.mktemp("others") / "place", ignore=shutil.ignore_patterns("cache"))


COMMANDS = {
    **{f"map twin --scene scene -o new{suffix}": LOG for suffix in (*EXPORTERS, ".png") if suffix not in (".kmz", ".zarr")},
    "survey scene --truth segmented -o new/m.csv": LOG, "survey scene --truth segmented -o new/m.csv.gz": gzip.compress(LOG),
    "survey scene --truth segmented -o new/m.parquet": LOG, "paths scene --points p.csv -o new-paths.nc": LOG,
    "report twin --scene scene -o new.html": LOG,
    **{f"export-scene scene -o new{suffix}": LOG for suffix in (".glb", ".gltf", ".obj")},
}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_file_of_the_user_is_kept(run, place, command):
    (place / "p.csv").write_text("x_m,y_m,z_m\n80,60,30\n")
    out = place / command.rpartition(" ")[2]
    out.parent.mkdir(exist_ok=True)
    out.write_bytes(COMMANDS[command])
    refused = run(command, place)
    assert refused.returncode == 2 and "and this command did not write it: choose another output path, or replace it with --force" in refused.stderr
    assert out.read_bytes() == COMMANDS[command]
    for again in (f"{command} --force", command):
        done = run(again, place)
        assert done.returncode == 0, done.stderr
    out.write_bytes(b"")
    assert run(command, place).returncode == 0, "an empty file is nobody's loss"


def test_a_store_of_another_program_is_kept(run, place):
    pytest.importorskip("zarr")
    store = place / "store.zarr"
    store.mkdir()
    (store / "zarr.json").write_text('{"zarr_format": 3, "node_type": "group"}')
    assert "store.zarr is there, and this command did not write it" in run("map twin --scene scene -o store.zarr", place).stderr
    assert [path.name for path in store.iterdir()] == ["zarr.json"]


@pytest.mark.parametrize("command, file, erased", [
    ("build-scene preset:small -o mine", "city.xml", "city.xml, and no scene.toml"), ("export-scene scene -o mine", "meshes", "meshes, and no devices.csv"),
    ("fit m.csv --scene scene --model log_distance -o mine", "report.html", "report.html, and no twin.json"),
    ("coverage scene --tx-power-dbm 20 -o mine", "sinr.tif", "sinr.tif, and no coverage.json"),
    ("import m.csv -o mine", "measurements.csv", "measurements.csv, and no import.json"),
    ("compare m.csv --scene scene -o mine", "scores.csv", "scores.csv, and no compare.json"),
    ("close-loop m.csv --scene scene -o mine", "effect_1.png", "effect_1.png, and no closeloop.json")])
def test_a_folder_of_the_user_is_kept(run, place, command, file, erased):
    shutil.rmtree(place / "mine", ignore_errors=True)
    (place / "mine").mkdir()
    (place / "mine" / file).write_bytes(LOG)
    refused = run(command, place)
    assert refused.returncode == 2 and f"mine holds {erased} of an earlier run, which the new content would erase" in refused.stderr
    assert [path.name for path in (place / "mine").iterdir()] == [file] and (place / "mine" / file).read_bytes() == LOG
