"""Honest files to begin from, made by the commands themselves in one folder."""

import contextlib
import gzip
import io
import json
import os
import re
import runpy
import shutil
import zipfile
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from unittest import mock

import numpy as np
import pandas as pd

from tests.command_line import run_in_this_process
from tests.importing.test_tracks import GPS, ulog
from tests.scene.readers import city_models
from tests.worlds import fly, measured

SQUARE = [[8.001, 50.001], [8.002, 50.001], [8.002, 50.002], [8.001, 50.002], [8.001, 50.001]]
RUN = "scene --truth segmented --real-episodes 1 --episodes 8 --flights 2 --compare none --planner-iterations 50 --hidden 8"
COMMANDS = (
    "radiotwin build-scene preset:small -o scene",
    "radiotwin survey scene --truth segmented --flights 2 -o survey/measurements.csv",
    "radiotwin fit survey/measurements.csv --scene scene --model log_distance -o twin",
    "radiotwin fit survey/measurements.csv --scene scene --model segmented_nn -o twin_nn",
    "radiotwin fit survey/measurements.csv --scene scene --model kriging -o twin_kriging",
    "radiotwin map twin --scene scene -o map.nc",
    "radiotwin compare survey/measurements.csv --scene scene -o comparison",
    "radiotwin close-loop open/measurements.csv --base log-distance -o loop",
    f"marl.fedqmix --scene {RUN} --out run",
    "radiotwin build-scene town.geojson -o town",
    "radiotwin import log.csv --columns import.toml -o imported",
    "radiotwin export-scene scene -o exported",
)
# A command line each, in a file of its own, which is damaged as any other; no value of it names an output.
LINES = {
    "build": "radiotwin build-scene town.geojson -o out --devices 2 --uavs 1 --seed 1 --frequency-hz 2.4e9 --bbox "
             "50,8,50.1,8.1 --height-default 10 --material default=itu_brick",
    "city": "radiotwin build-scene city.xml -o out --scale 1 --up z --bbox 0,0,90,90 --devices 1 --material wall=itu_brick",
    "survey": "radiotwin survey scene -o out.csv --truth segmented --flights 1 --pattern lawnmower --noise-db 1 --seed 1",
    "fit": "radiotwin fit survey/measurements.csv --scene scene -o out --model log_distance --seed 1 --start twin "
           "--devices survey/devices.csv",
    "map": "radiotwin map twin --scene scene -o out.nc --devices d1,d2 --altitudes 55",
    "loop": "radiotwin close-loop survey/measurements.csv -o out --base log-distance --hold-out block --seed 1 --scene scene",
    "locate": "radiotwin locate open/measurements.csv -o out.csv --twin loop/twin --truth located.csv --devices open/devices.csv",
    "compare": "radiotwin compare survey/measurements.csv -o out --scene scene --truth map.nc --held-out 1 --seed 1 --also twin",
    "coverage": "radiotwin coverage town -o out --transmitters sites/sites.csv --model p1411 --tx-power-dbm 20 --load 0.5 --height 2 "
                "--step 20 --bandwidth-hz 1e6 --noise-figure-db 9 --threshold-dbm -90 --classes=-80,-90 --reliability 0.95 "
                "--polygon town.geojson --indoor-loss-db 9 --rate 0.6,-10,4.4 --formats nc",
    "report": "radiotwin report twin -o out.html --scene scene --truth segmented --measurements survey/measurements.csv",
    "import": "radiotwin import log.csv -o out --columns import.toml --level-unit dBm --length-unit m --time-zone UTC "
              "--not-detected -150,no --not-measured x --not-detected-at-or-below -140 --min-level -160 --max-level 0 "
              "--min-distance-m 1 --max-distance-m 1e6 --average-m 10 --average median --origin 50,8,100 --devices sites.csv",
    "gains": "radiotwin gains scene -o out.csv --points points.csv --devices d1 --sum power --quality fast --seed 1",
    "marl": "python -m marl.fedqmix --out out --scene scene --truth segmented --twin log-distance --algorithm random "
            "--real-episodes 1 --noise-db 1 --seed 1 --flights 2 --planner-iterations 50",
    "learn": "python -m marl.fedqmix --out out --scene scene --algorithm iql --truth segmented --episodes 4 --planner-iterations 50 "
             "--real-episodes 1 --flights 2 --compare none --hidden 8 --parallel 2 --replay 8 --batch 2 --discount 0.9",
}


def make_honest(folder: Path) -> None:
    """Fill a new folder."""
    (folder / "open").mkdir(parents=True)
    _write_survey(folder / "open")
    write_maps(folder)
    _write_log(folder)
    _write_other_logs(folder)
    _write_foreign_logs(folder)
    (folder / "points.csv").write_text("x_m,y_m,z_m\n10,20,30\n150,160,40\n")
    (folder / "pattern.csv").write_text("azimuth_deg,elevation_deg,gain_dbi\n" + "".join(
        f"{azimuth},{elevation},{-abs(elevation) / 10}\n" for azimuth in range(0, 360, 30)
        for elevation in range(-90, 91, 30)))
    (folder / "sites").mkdir()
    (folder / "sites" / "pattern.csv").write_bytes((folder / "pattern.csv").read_bytes())
    (folder / "sites" / "sites.csv").write_text(
        "device,x_m,y_m,z_m,tx_power_dbm,load,frequency_hz,antenna,azimuth_deg,tilt_deg\n"
        "roof,5,5,40,30,0.5,2.4e9,pattern.csv,120,-6\nmast,-20,30,40,20,,,,,\n")
    (folder / "pattern.msi").write_text("NAME test\nFREQUENCY 2400\nGAIN 2 dBi\n" + "".join(
        f"{cut} 360\n" + "".join(f"{angle} {angle % 90 / 10}\n" for angle in range(360))
        for cut in ("HORIZONTAL", "VERTICAL")))
    (folder / "materials.toml").write_text('default = "brick"\nground = "concrete"\n["building"]\nyes = "wood"\n')
    (folder / "args").mkdir()
    for name, line in LINES.items():
        (folder / "args" / f"{name}.args").write_text(line.removeprefix("python -m ").replace(" ", "\0"))
    with one_core():
        for line in COMMANDS:
            run_here(line, folder)
    _declare_antennas(folder / "scene")
    _write_effects(folder)
    table = pd.read_csv(folder / "survey" / "measurements.csv")
    table.to_csv(folder / "survey" / "packed.csv.gz", index=False)
    table.to_parquet(folder / "survey" / "table.parquet", index=False)


def _write_survey(folder: Path) -> None:
    """Write a survey of four devices, of which one is unknown, and a table of where they are."""
    made = fly(1, flights=3, slots=25, devices=4)
    made.gain_db += 6 * (made.flight == 1)
    survey = measured(made)
    survey.devices.to_csv(folder.parent / "located.csv", index=False)
    survey.save(folder / "measurements.csv")
    lost = survey.devices["device"] == "d3"
    survey.devices.assign(role=np.where(lost, "unknown", "anchor"), x_m=survey.devices["x_m"].mask(lost),
                          y_m=survey.devices["y_m"].mask(lost)).to_csv(folder / "devices.csv", index=False)


def write_maps(folder: Path) -> None:
    """Write a small city in every format that `build-scene` reads."""
    shape = {"type": "Polygon", "coordinates": [SQUARE]}
    feature = {"type": "Feature", "properties": {"building": "yes", "height": "12"}, "geometry": shape}
    (folder / "town.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    places = [{"lon": lon, "lat": lat} for lon, lat in SQUARE]
    (folder / "town.json").write_text(json.dumps({"elements": [
        {"type": "way", "id": 1, "tags": {"building": "yes", "height": "12"}, "geometry": places},
        {"type": "relation", "id": 2, "tags": {"type": "multipolygon", "building": "yes"},
         "members": [{"type": "way", "ref": 3, "role": "", "geometry": places}]}]}))
    (folder / "town.osm").write_bytes((Path(__file__).parents[1] / "scene" / "readers" / "town.osm").read_bytes())
    import pyogrio  # an extra, in the test extra, too
    import rasterio
    import shapely

    pyogrio.raw.write(folder / "town.gpkg", np.array([shapely.to_wkb(shapely.Polygon(SQUARE))]), [np.array(["12"])],
                      ["height"], geometry_type="Polygon", crs="EPSG:4326", driver="GPKG")
    pyogrio.raw.write(folder / "town.shp", np.array([shapely.to_wkb(shapely.Polygon(SQUARE))]), [np.array([12.5])],
                      ["HOEHE"], geometry_type="Polygon", crs="EPSG:4326", driver="ESRI Shapefile")
    import pyarrow as pa
    from pyarrow import parquet

    known = {"version": "1.1.0", "primary_column": "geom", "columns": {"geom": {"encoding": "WKB", "geometry_types": []}}}
    table = pa.table({"geom": [shapely.to_wkb(shapely.Polygon(SQUARE))], "height": [12.5], "class": ["yes"]})
    parquet.write_table(table.replace_schema_metadata({"geo": json.dumps(known)}), folder / "town.parquet")
    with zipfile.ZipFile(folder / "town.zip", "w") as archive:
        for suffix in (".shp", ".dbf", ".prj"):
            archive.write(folder / f"town{suffix}", f"town{suffix}")
    (folder / "town.city.json").write_text(json.dumps(city_models.cityjson([(0, 0, 1.2)])))
    (folder / "town.gml").write_text(city_models.citygml([city_models.house(691_000, 5_336_000, 500, "H")]))
    import trimesh

    box = trimesh.creation.box(bounds=[[0, 0, 0], [20, 30, 10]])
    for suffix in ("glb", "gltf", "stl", "ply"):
        data = box.export(file_type=suffix)
        for name, content in (data if suffix == "gltf" else {f"box.{suffix}": data}).items():
            (folder / name.replace("model", "box")).write_bytes(content)
    with rasterio.open(folder / "dem.tif", "w", driver="GTiff", width=60, height=60, count=1, dtype="float32",
                       crs="EPSG:4326", transform=rasterio.Affine(1e-4, 0, 7.9985, 0, -1e-4, 50.0045)) as file:
        file.write(np.add.outer(np.arange(60.0), np.arange(60.0)).astype("float32") + 300, 1)
    (folder / "city.xml").write_text("""<scene version="2.1.0"><default name="side" value="40"/>
<bsdf type="itu-radio-material" id="wall"><string name="type" value="concrete"/></bsdf>
<shape type="cube" id="block"><transform name="to_world"><scale x="$side" y="20" z="10"/>
<translate value="0, 0, 10"/></transform><ref id="wall" name="bsdf"/></shape>
<shape type="rectangle" id="floor"><transform name="to_world"><scale value="200"/></transform>
<ref id="wall" name="bsdf"/></shape><shape type="obj" id="roof"><string name="filename" value="roof.obj"/>
<ref id="wall" name="bsdf"/></shape></scene>""")
    (folder / "roof.obj").write_text("""# a pyramid
v 60 60 0
v 90 60 0
v 90 90 0
v 60 90 0
v 75 75 20
vn 0 0 1
vt 0 0
f 4/1/1 3/1/1 2/1/1 1/1/1
f 1 2 5
f 2 3 5
f 3 4 5
f -2 -5 -1
""")
    _in_a_child(_write_pbf, folder)


def _write_pbf(folder: Path) -> None:
    import osmium

    with osmium.SimpleWriter(str(folder / "town.osm.pbf")) as writer:
        for element in osmium.FileProcessor(str(folder / "town.osm")):
            writer.add(element)


def _in_a_child(function: Callable[[Path], None], folder: Path) -> None:
    """Call a function whose library leaves threads, for which children forked later would wait."""
    pid = os.fork()
    if pid == 0:
        try:
            function(folder)
            os._exit(0)
        finally:
            os._exit(1)
    if os.waitpid(pid, 0)[1]:
        raise RuntimeError(f"{function.__name__} failed")


def _write_effects(folder: Path) -> None:
    """Write twins with every kind of effect."""
    source = Path(__file__).parents[1] / "twin" / "stored"
    parts = json.loads((source / "effects.json").read_text())
    for name, over in (("corrected", "links"), ("raytrace", "map")):
        shutil.copytree(source / name, folder / f"twin_{name}")
        path = folder / f"twin_{name}" / "twin.json"
        record = json.loads(path.read_text())
        record["fitted"]["effects"] = [
            {key: value for key, value in part.items() if key != "over"} for part in parts
            if part["over"] == over and (over == "links" or part["name"] == "removed_obstacle" or "levels" in part)]
        path.write_text(json.dumps(record))
    shutil.copytree(source / "links", folder / "links")
    devices = pd.read_csv(folder / "links" / "devices.csv")
    devices.loc[devices.index[-1], "role"] = "unknown"
    devices.to_csv(folder / "links" / "devices.csv", index=False)
    run_here("radiotwin locate links/measurements.csv --twin twin_corrected -o links/located.csv", folder)


def _write_log(folder: Path) -> None:
    (folder / "log.csv").write_text("when,lat,lon,alt,cell,rsrp\n" + "".join(
        f"{1.7e9 + i},{50 + i * 1e-4},{8 + i * 2e-4},{40 + i % 3},c{i % 2},{-70 - i % 20}\n" for i in range(60)))
    (folder / "sites.csv").write_text("device,latitude,longitude,height\nc0,50.001,8.001,20\nc1,50.002,8.004,25\n")
    (folder / "import.toml").write_text(
        'devices = "sites.csv"\ntime_format = "epoch s"\nlevel_unit = "dBm"\nlength_unit = "m"\n[columns]\n'
        'time = "when"\nlatitude = "lat"\nlongitude = "lon"\naltitude = "alt"\ndevice = "cell"\nlevel = "rsrp"\n')


def _write_other_logs(folder: Path) -> None:
    """Write the same log in the other forms that `import` reads."""
    text = (folder / "log.csv").read_text()
    (folder / "log.csv.gz").write_bytes(gzip.compress(text.encode()))
    table = pd.read_csv(io.StringIO(text))
    table.to_parquet(folder / "log.parquet", index=False)
    points = [{"type": "Feature", "properties": {name: row[name] for name in ("when", "cell", "rsrp")},
               "geometry": {"type": "Point", "coordinates": [row["lon"], row["lat"], row["alt"]]}}
              for row in table.to_dict("records")]
    (folder / "log.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": points}))
    settings = (folder / "import.toml").read_text()
    (folder / "points.toml").write_text(
        settings.replace('"lat"', '"latitude"').replace('"lon"', '"longitude"').replace('"alt"', '"altitude"'))
    (folder / "masts.csv").write_text("receiver,latitude,longitude,height\nm0,50.0,8.0,30\nm1,50.001,8.002,32\n")
    (folder / "fixed.csv").write_text("when,mast,cell,rsrp,level_b\n" + "".join(
        f"{i},m{i % 2},c{i // 2 % 2},{-70 - i % 9},{-80 - i % 7}\n" for i in range(40)))
    (folder / "fixed.toml").write_text(
        'devices = "sites.csv"\nlength_unit = "m"\nreceivers = "masts.csv"\ntime_format = "epoch s"\nlevel_unit = "dBm"\n'
        'not_detected = [-150, "no"]\naverage_m = 20.0\n[origin]\nlatitude_deg = 50.0\nlongitude_deg = 8.0\n'
        'altitude_m = 0.0\n[columns]\ntime = "when"\nreceiver = "mast"\ndevice = "cell"\nlevel = "rsrp"\n')


def _write_foreign_logs(folder: Path) -> None:
    """Write logs as programs of others write them, and positions to join them with."""
    table = pd.read_csv(folder / "log.csv").head(20)
    text = "Messfahrt Süd\n\n" + table.to_csv(index=False, sep=";", decimal=",") + "Summe;20\n"
    (folder / "german.csv").write_bytes(text.encode("latin-1"))
    with zipfile.ZipFile(folder / "logs.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("one.csv", table.head(9).to_csv(index=False))
        archive.writestr("day 2/two.csv.gz", gzip.compress(table.tail(9).to_csv(index=False).encode()))
    table.to_excel(folder / "log.xlsx", index=False)
    (folder / "levels.csv").write_text("when,cell,rsrp\n" + "".join(f"{1.7e9 + i},c{i % 2},{-70 - i}\n" for i in range(9)))
    (folder / "levels.toml").write_text(
        'time_format = "epoch s"\nlevel_unit = "dBm"\n[columns]\ntime = "when"\ndevice = "cell"\nlevel = "rsrp"\n')
    times = [datetime.fromtimestamp(1.7e9 + i, UTC) for i in range(10)]
    (folder / "flight.gpx").write_text("<gpx><trk><trkseg>\n" + "".join(
        f'<trkpt lat="{50 + i / 1e4}" lon="8"><ele>{i}</ele><time>{time.isoformat()}</time></trkpt>\n'
        for i, time in enumerate(times)) + "</trkseg></trk></gpx>\n")
    (folder / "flight.nmea").write_text("".join(
        f"$GPRMC,{time:%H%M%S}.00,A,50{i / 100:07.4f},N,00800.0000,E,1,2,{time:%d%m%y},,\n" for i, time in enumerate(times)))
    rows = [(i * 1_000_000, int(time.timestamp() * 1e6), 500_000_000 + i, 80_000_000, i) for i, time in enumerate(times)]
    (folder / "flight.ulg").write_bytes(ulog({"vehicle_gps_position": (GPS[0], rows)}))
    (folder / "uplinks.jsonl").write_text("".join(json.dumps({
        "time": time.isoformat(), "deviceInfo": {"devEui": "n1"}, "object": {"latitude": 50 + i / 1e4, "longitude": 8.0},
        "rxInfo": [{"gatewayId": f"g{j}", "rssi": -90 - i, "snr": 5 - 3 * i, "location": {"latitude": 50.0, "longitude": 8.0 + j}}
                   for j in range(2)]}) + "\n" for i, time in enumerate(times)))
    (folder / "scan.csv").write_text("".join(
        f"{time:%Y-%m-%d, %H:%M:%S}, {low}, {low + 300}, 100.00, 5, -30, -31, -32, -32\n" for time in times for low in (1000, 1300)))
    (folder / "wigle.csv").write_text(
        "WigleWifi-1.6,appRelease=2,model=X\nMAC,SSID,AuthMode,FirstSeen,Channel,RSSI,CurrentLatitude,CurrentLongitude,Type\n"
        + "".join(f"aa,b,[ESS],{time:%Y-%m-%d %H:%M:%S},6,{-60 - i},{50 + i / 1e4},8,WIFI\n" for i, time in enumerate(times)))


def _declare_antennas(scene: Path) -> None:
    """Copy a scene and declare a pattern of each kind in the copy."""
    copy = scene.with_name("antennas")
    shutil.copytree(scene, copy)
    for name in ("pattern.csv", "pattern.msi"):
        shutil.copy(scene.with_name(name), copy)
    text = (copy / "scene.toml").read_text()
    text = re.sub(r"\[\[uavs\]\]\n", '[[uavs]]\nantenna = "pattern.csv"\n', text)
    text = re.sub(r"\[\[devices\]\]\n", '[[devices]]\nantenna = "pattern.msi"\n', text)
    (copy / "scene.toml").write_text(text)


def one_core() -> contextlib.AbstractContextManager:
    """Have this process believe that there is one core, so that it trains here and starts no others."""
    return mock.patch.object(os, "sched_getaffinity", lambda pid: {0})


def run_here(line: str, folder: Path) -> None:
    """Run a command in this process, which then has imported all that its forked children need."""
    module, *arguments = line.split()
    done = run_in_this_process(lambda: run_command(module), arguments, folder)
    if done.returncode:
        raise RuntimeError(f"{line}: exit status {done.returncode}\n{done.stdout}{done.stderr}")


def _gains_of_nothing(scene: object, device_m: np.ndarray, points_m: np.ndarray, *others: object) -> np.ndarray:
    """Take the place of the ray tracer, which needs LLVM and a process of its own."""
    return np.full((len(device_m), len(points_m)), -80.0)


def run_command(module: str) -> None:
    """Run a command by `sys.argv`: `radiotwin`, or a module as `python -m` does."""
    if module == "radiotwin":
        from radiotwin.cli import main

        with mock.patch("radiotwin.trace.run.trace_gains", _gains_of_nothing):
            main()
    else:
        runpy.run_module(module, run_name="__main__")
