"""What each command refuses: exit status 2, one message, and nothing is written."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from radiotwin.links.measurements import read_measurements
from radiotwin.runtime import cuda
from radiotwin.scene import Scene
from tests.scene.readers import city_models
from tests.worlds import placed

TOWN = Path(__file__).parents[1] / "scene" / "readers" / "town.osm"
SITES = "device,x_m,y_m,z_m,tx_power_dbm\nroof,110,90,60,30\n"
LOG = "time,lat,lon,cell,rsrp\n2022-10-30 12:00:00,48.1,11.5,a,-80\n2022-10-30 12:00:01,48.2,11.6,a,-99\n"
METRES = [[5e5, 6e6], [6e5, 6e6], [6e5, 7e6], [5e5, 6e6]]
AREAS = {"points": {"type": "Point", "coordinates": [8, 47]}, "metres": {"type": "Polygon", "coordinates": [METRES]},
         "far": {"type": "Polygon", "coordinates": [[[9, 47], [9.1, 47], [9, 47.1], [9, 47]]]}}


def edited(source, target, old, new):
    shutil.copytree(source, target)
    text = (target / "scene.toml").read_text()
    assert old in text
    (target / "scene.toml").write_text(text.replace(old, new))


@pytest.fixture(scope="module")
def folder(scene_to_map, tmp_path_factory):
    """Good files of every kind, and bad ones beside them."""
    folder = shutil.copytree(scene_to_map, tmp_path_factory.mktemp("refusals") / "work", ignore=shutil.ignore_patterns("cache"))
    scene, measurements = Scene.load(folder / "scene"), read_measurements(folder / "m.csv")
    table = pd.read_csv(folder / "m.csv", dtype=object)
    seen = scene.city.line_of_sight(scene.device_m[measurements.device_index], measurements.receiver_m)
    for name, bad in (("column", table.drop(columns="receiver_z_m")), ("silent", table.assign(gain_db="")), ("hidden", table[~seen])):
        bad.to_csv(folder / f"{name}.csv", index=False)
    (folder / "unknown.csv").write_text((folder / "devices.csv").read_text().replace("anchor", "unknown"))
    edited(folder / "scene", folder / "negative", "frequency_hz = 2400000000.0", "frequency_hz = -2.4e9")
    edited(folder / "scene", folder / "walled", "x_m = 160.0\ny_m = 120.0", "x_m = 130.0\ny_m = 170.0")
    placed(scene).save(folder / "placed")
    shutil.copytree(folder / "scene", folder / "cut")
    mesh = folder / "cut" / "meshes" / "building_000.ply"
    mesh.write_bytes(mesh.read_bytes()[:mesh.stat().st_size // 2])
    (folder / "sites.csv").write_text(SITES)
    (folder / "plain.csv").write_text("device,x_m,y_m,z_m\nmast,110,90,60\n")
    (folder / "p.csv").write_text("x_m,y_m,z_m\n1,2,3\n")
    for name, geometry in AREAS.items():
        feature = {"type": "Feature", "properties": {"name": "far", "height": 9}, "geometry": geometry}
        (folder / f"{name}.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    (folder / "malformed.osm").write_text("<osm><way")
    (folder / "a.gml").write_text(city_models.citygml([city_models.house(691_000, 5_336_000, 500, "H")]))
    (folder / "steel.xml").write_text((folder / "scene" / "city.xml").read_text().replace("concrete", "kryptonite"))
    (folder / "dem.tif").touch()
    shutil.copy(TOWN, folder / "town.osm")
    (folder / "log.csv").write_text(LOG)
    (folder / "s.csv").write_text("2024-03-01, 10:00:00, 1000000, 1200000, 100000.00, 7, -30.0, -30.0, -30.0\n")
    (folder / "deep.geojson").write_text('{"features":' + "[" * 100_000 + "]" * 100_000 + "}")
    np.save(folder / "array.npy", np.zeros(3))
    return folder


FIT, COVERAGE, PLAN = "fit m.csv --scene scene -o new", "coverage placed --transmitters sites.csv -o new", "plan twin --scene scene -o new"
IMPORT = "import log.csv --columns 'time=time,latitude=lat,longitude=lon,device=cell,level=rsrp' --level-unit dBm " \
         "--time-format 'ISO 8601' --time-zone UTC -o new"
LOCAL = "import p.csv --columns level=z_m,device=x_m,x=x_m,y=y_m --level-unit dBm --length-unit m -o new"
SCAN = "import s.csv --time-zone UTC --columns x='always 1',y='always 2' --length-unit m -o new"
TOWN_IN = "build-scene town.osm -o new"
REFUSED = [
    # Measurements, devices and scenes
    ("fit column.csv --scene scene -o new", "column.csv.*receiver_z_m.*missing"),
    (f"{FIT} --devices unknown.csv", "no anchor"), ("fit silent.csv --scene scene -o new", "nothing was detected"),
    ("fit hidden.csv --scene scene -o new", "all links NLoS.*log_distance"), ("fit no.csv --scene scene -o new", "no.csv does not exist"),
    ("fit array.npy --scene scene -o new", "array.npy"), ("fit m.csv --scene nowhere -o new", "nowhere is not a folder"),
    ("fit m.csv --scene negative -o new", "scene.toml.*radio.frequency_hz = -2400000000.0"),
    ("survey walled --truth segmented -o new.csv", "scene.toml.*device 'd3'.*inside a building"),
    ("survey cut --truth segmented -o new.csv", "building_000.ply.*truncated"),
    # Fit, compare, close the loop, locate
    (f"{FIT} --model magic", "'magic' is unknown; allowed are"), (f"{FIT} --shift=1e308,0", "a shift by 1e.308, 0 m is not possible"),
    (f"{FIT} --shift 3", "give DX,DY in metres"), (f"{FIT} --shift 1,inf", "give DX,DY in metres"),
    ("fit m.csv --scene scene -o scene", "scene holds city.xml, meshes, preview.png, scene.toml, and no twin.json"),
    ("compare m.csv --scene scene -o new", "1 flight.*at least 2"), ("compare m.csv --scene scene --held-out 0", "at least 1 is needed"),
    ("compare m.csv --scene scene -o scene", "cannot write scene: it is the scene's folder"),
    ("close-loop m.csv --scene scene -o ./scene", "cannot write scene: it is the scene's folder"),
    ("close-loop m.csv --scene nowhere", "nowhere"), ("close-loop m.csv --shift 1,2", "add --scene"),
    ("locate m.csv --twin t -o new.xlsx", "unknown format; allowed are .csv and .csv.gz"),
    # Files that the command reads
    ("gains scene --points p.csv -o p.csv", "reads p.csv, which would be lost"),
    ("paths scene --points p.csv -o scene/city.xml", "reads scene/city.xml, which would be lost"),
    ("trace scene -o scene/scene.toml", "reads scene/scene.toml, which would be lost"),
    ("survey scene --truth segmented -o scene/buildings.csv", "scene/buildings.csv, which would be lost"),
    ("locate m.csv --twin t -o devices.csv", "reads devices.csv, which would be lost"),
    ("build-scene scene/city.xml -o scene", "choose another output"),
    # Surveys, maps, exports, reports
    ("survey scene --truth traced -o new.csv", "truth.nc does not exist.*radiotwin trace"),
    ("survey scene --truth segmented --pattern spiral -o new.csv", "'spiral' is unknown; allowed are"),
    ("survey scene --truth segmented -o new.xlsx", "unknown format"), ("survey scene --truth segmented --noise-db 1e308 -o new.csv", "noise_db"),
    ("map nothing --scene scene", "not a twin's folder"), ("map twin --scene scene -o new.bmp", "unknown format '.bmp'; allowed are"),
    ("map map.nc --scene scene", "give the file to write with --out"), ("map no.nc --scene scene -o new.csv", "does not exist"),
    ("map map.nc --scene scene -o new.csv --devices d9", "device 'd9' is not in the map"),
    ("map map.nc --scene scene -o new.csv --altitudes 61", "altitude 61 m is not in the map"),
    ("map map.nc --scene scene -o new.csv --altitudes high", "--altitudes 'high' is not numbers"),
    ("map map.nc --scene scene -o map.nc/new.csv", "cannot write"), ("export-scene scene -o city.stl", "unknown format '.stl'"),
    ("export-scene scene -o scene", "scene holds city.xml, meshes, preview.png, scene.toml"), ("export-scene none -o new", "none is not a folder"),
    ("export twin --scene scene --points p.csv -o new --to omnet", "allowed is ns3"),
    ("report scene -o scene/scene.toml", "unknown format; allowed are .html and .htm"), ("report nowhere", "is not a folder"),
    ("report cut/meshes", "holds nothing to show"), ("demo --scene preset:none -o new", "does not exist|torch"),
    # Tracing
    ("trace scene --quality best", "quality 'best' is unknown; allowed are"), ("trace scene --devices d99", "d99"),
    ("trace scene --plan --workers 0", "--workers '0': allowed are auto"), ("trace scene --device d3", "--device 'd3'.*auto, cpu, cuda"),
    ("trace scene --quality fast --target-db 1", "both say how many rays there are; give one"),
    ("trace scene --solver map --target-db 1", "needs the solver 'paths'"),
    ("gains scene --points p.csv --target-db 99", "target_db = 99: allowed is 0.05 to 20 dB"),
    ("gains scene --points none.csv", "none.csv does not exist"), ("gains scene --points map.nc", "map.nc: unknown format; allowed are .csv"),
    ("gains scene --points p.csv --sum loud", "combining = 'loud' is unknown"), ("gains scene --points p.csv --devices d9", "device 'd9' is not in"),
    ("gains scene --points p.csv -o new.xlsx", "unknown format; allowed are .csv and .csv.gz"),
    pytest.param("gains scene --points p.csv --device cuda", "--device cuda.*radiotwin doctor",
                 marks=pytest.mark.skipif(cuda.tracing_refusal() is None, reason="there is a GPU")),
    ("paths scene --points p.csv --velocity 5,north -o new.nc", "VX,VY,VZ"),
    # Coverage
    ("coverage placed --model p1411 --transmitters plain.csv -o new", "power of mast is not known.*give --tx-power-dbm"),
    ("coverage nothing -o new", "nothing is neither a folder nor a radio map"),
    ("coverage map.nc -o new", "needs the scene's 3D map; give its folder with --scene"),
    ("coverage scene --scene scene -o new", "is a scene already; leave --scene out"),
    ("coverage map.nc --scene scene --model p1411 -o new", "--model is for a scene without measurements"),
    (f"{COVERAGE} --model okumura", "channel model 'okumura' is unknown"), (f"{COVERAGE} --classes x", "--classes 'x' is not numbers"),
    (f"{COVERAGE} --rate 1,2", "--rate '1,2' is not 3 numbers"), (f"{COVERAGE} --extent 1,2,3", "--extent '1,2,3' is not 4 numbers"),
    (f"{COVERAGE} --load 2", "a load of 2 is not possible"), (f"{COVERAGE} --formats shp", "unknown format 'shp'"),
    (f"{COVERAGE} --polygon none.geojson", "none.geojson does not exist"), (f"{COVERAGE} --polygon points.geojson", "holds no polygon"),
    (f"{COVERAGE} --polygon far.geojson", "'far': no cell's middle lies in it"),
    (f"{COVERAGE} --polygon metres.geojson", "no longitude and latitude in degrees"),
    ("coverage placed --transmitters sites.csv -o .", "which the new content would erase"),
    # Plans
    (f"{PLAN} --base 1e6,0", "not over the lattice"), (f"{PLAN} --battery 0.2", "greater than or equal to 0.5"),
    (f"{PLAN} --data none.csv", "none.csv"), (f"{PLAN} --no-fly none.geojson", "origin|none.geojson"), (f"{PLAN} --clearance-m 500", "does not reach"),
    # Cities
    ("build-scene preset:atlantis -o new", "'atlantis' does not exist; allowed are rbm"), ("build-scene sionna:atlantis -o new", "atlantis.*munich"),
    ("build-scene no.osm -o new", "no.osm does not exist; give the path of a map"), ("build-scene malformed.osm -o new", "line 1.*malformed XML"),
    ("build-scene steel.xml -o new", r"kryptonite|\.ply"), ("build-scene preset:small -o m.csv", "m.csv is a file"),
    (f"{TOWN_IN} --frequency-hz -1", "frequency"), (f"{TOWN_IN} --bbox 1,2,3", "--bbox '1,2,3' is not 4 numbers"),
    (f"{TOWN_IN} --bbox 2,0,1,3", "the south below the north"), (f"{TOWN_IN} --bbox 8,47,9,48", "seem to be swapped: --bbox is LAT_MIN,LON_MIN"),
    (f"{TOWN_IN} --height-default -3", "default height of -3 m"), (f"{TOWN_IN} --material brick=cheese", "no ITU material 'cheese'"),
    (f"{TOWN_IN} --material brick", "'brick' is not NAME=ITU"), (f"{TOWN_IN} --material-table none.toml", "none.toml does not exist"),
    (f"{TOWN_IN} --scale 2 --up y", "--scale, --up cannot be used with it"), (f"{TOWN_IN} --ground-column H", "--height-column, too"),
    (f"{TOWN_IN} --crs EPSG:32632", "as all of OpenStreetMap; leave --crs out"),
    ("build-scene metres.geojson -o new --crs +init=/etc/passwd", "is no coordinate reference system that is known"),
    ("build-scene a.gml -o new --scale 2", "a.gml is a map: --scale cannot be used"),
    ("build-scene sionna:munich --terrain dem.tif", "--terrain cannot be used with it"),
    (f"{TOWN_IN} --terrain none.tif", "none.tif does not exist; give the path of a terrain raster"),
    ("build-scene a.osm --overpass", "--overpass downloads an area; give it with --bbox"),
    ("build-scene a.osm --overpass --bbox 0,0,9,9", "are too much for a public server"),
    (f"{TOWN_IN} --altitudes 0", "altitudes of 0 m are not possible"), (f"{TOWN_IN} --altitudes 2,2", "an altitude is given twice"),
    (f"{TOWN_IN} --uavs 1000000000", "RADIOTWIN_MAX_UAVS"),
    (f"{TOWN_IN} --step 0", "a step of 0 m is not possible"), (f"{TOWN_IN} --extent 5,5,5,9", "the minimum below the maximum"),
    (f"{TOWN_IN} --step 0.01 --extent=-900,-900,900,900", "RADIOTWIN_MAX_POSITIONS"), (f"{TOWN_IN} --extent=-1e5,0,1e5,5", "km are allowed"),
    (f"{TOWN_IN} --origin x,y", "--origin 'x,y'"), (f"{TOWN_IN} --origin 95,8", "origin.*95"),
    # Imports
    ("import no.csv -o new", "no.csv does not exist"), (IMPORT.replace("=rsrp", "=rssi"), "column 'rssi'.*missing"),
    (f"{IMPORT} --columns nowhere.toml", "nowhere.toml does not exist"), (f"{IMPORT} --columns time", "time does not exist.*latitude=lat"),
    (f"{IMPORT} --level-unit bel", "level_unit.*bel.*dBm"), (f"{IMPORT} --time-zone Europe/Atlantis", "'Europe/Atlantis' is unknown"),
    (f"{IMPORT} --average mode", "average.*mode.*median"), (f"{IMPORT} --average-m -5", "--average-m: average_m: -5"),
    (f"{IMPORT} -o log.csv", "log.csv is a file"), (f"{IMPORT} --time-format {'%Y' * 5000}", "at most 200"),
    (f"{LOCAL} --crs '{'GEOGCS[' * 1000}'", "is unknown"), (f"{LOCAL} --devices {'n' * 300}.csv", "cannot be read"),
    (LOCAL.replace("new", "n" * 300), "cannot write"), (LOCAL.replace("p.csv", "deep.geojson"), "RADIOTWIN_MAX_NESTING"),
    (f"{LOCAL} --track-topic /a", "--track-topic is of a track; give that with --track, too"),
    (f"{SCAN} --band-hz 2e6,1e6", "give the lower edge first"), (f"{SCAN} --band-hz low,high", "band_hz"), (f"{SCAN} --only Type", "is not COLUMN=A|B"),
    (f"{SCAN} --delimiter x", "delimiter"), (f"{SCAN} --format none", "format 'none' is unknown"), (f"{SCAN} --header a,,b", "header"),
    (f"{SCAN} --track no.gpx", "no.gpx does not exist"),
]


@pytest.mark.parametrize(("command", "message"), REFUSED)
def test_one_message_and_nothing_is_written(run, folder, command, message):
    before = sorted(folder.rglob("*"))
    done = run(command, folder)
    said = " ".join(done.stderr.split())
    assert done.returncode == 2 and "Traceback" not in said and said.count("radiotwin:") == 1, (done.returncode, said)
    assert re.search(message, said), said
    assert len(said) < 12_000 and sorted(folder.rglob("*")) == before
