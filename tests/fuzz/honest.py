"""Honest files to begin from, made by the commands themselves in one folder."""

import contextlib
import io
import json
import os
import re
import runpy
import shutil
import signal
import sys
import warnings
from pathlib import Path

import numpy as np
import pandas as pd

SQUARE = [[8.001, 50.001], [8.002, 50.001], [8.002, 50.002], [8.001, 50.002], [8.001, 50.001]]
RUN = "scene --truth segmented --real-episodes 1 --episodes 8 --flights 2 --compare false --hidden 8"
COMMANDS = (
    "radiotwin build-scene preset:small -o scene",
    "radiotwin survey scene --truth segmented --flights 2 -o survey/measurements.csv",
    "radiotwin fit survey/measurements.csv --scene scene --model log_distance -o twin",
    "radiotwin fit survey/measurements.csv --scene scene -o twin_nn",
    "radiotwin map twin --scene scene -o map.nc",
    "radiotwin compare survey/measurements.csv --scene scene -o comparison",
    "radiotwin close-loop open/measurements.csv --base log-distance -o loop",
    f"marl.fedqmix --scene {RUN} --out run",
    "radiotwin build-scene town.geojson -o town",
    "radiotwin import log.csv --columns import.toml -o imported",
)


def make_honest(folder: Path) -> None:
    """Fill a new folder."""
    (folder / "open").mkdir(parents=True)
    _write_survey(folder / "open")
    _write_maps(folder)
    _write_log(folder)
    (folder / "points.csv").write_text("x_m,y_m,z_m\n10,20,30\n150,160,40\n")
    (folder / "pattern.csv").write_text("azimuth_deg,elevation_deg,gain_dbi\n" + "".join(
        f"{azimuth},{elevation},{-abs(elevation) / 10}\n" for azimuth in range(0, 360, 30)
        for elevation in range(-90, 91, 30)))
    (folder / "pattern.msi").write_text("NAME test\nFREQUENCY 2400\nGAIN 2 dBi\n" + "".join(
        f"{cut} 360\n" + "".join(f"{angle} {angle % 90 / 10}\n" for angle in range(360))
        for cut in ("HORIZONTAL", "VERTICAL")))
    (folder / "materials.toml").write_text('default = "brick"\nground = "concrete"\n["building"]\nyes = "wood"\n')
    for line in COMMANDS:
        run_here(line, folder)
    _declare_antennas(folder / "scene")
    table = pd.read_csv(folder / "survey" / "measurements.csv")
    table.to_csv(folder / "survey" / "packed.csv.gz", index=False)
    table.to_parquet(folder / "survey" / "table.parquet", index=False)


def _write_survey(folder: Path) -> None:
    rng = np.random.default_rng(1)
    device_m = rng.uniform(0, 300, (4, 2))
    rows = []
    for flight in range(3):
        path_m = np.cumsum(rng.normal(0, 15, (25, 2)), axis=0) + 150
        for slot, (x, y) in enumerate(path_m):
            for device, (east, north) in enumerate(device_m):
                distance_m = np.sqrt((x - east) ** 2 + (y - north) ** 2 + 50**2)
                level_db = -38 - 22 * np.log10(distance_m) + rng.normal(0, 2) + 6 * (flight == 1)
                rows.append((flight * 100 + slot, f"f{flight}", f"r{flight % 2}", x, y, 51.5, f"d{device}", level_db))
    names = ["time_s", "flight", "receiver", "receiver_x_m", "receiver_y_m", "receiver_z_m", "device", "gain_db"]
    pd.DataFrame(rows, columns=names).to_csv(folder / "measurements.csv", index=False)
    device_m[3] = np.nan
    pd.DataFrame({"device": [f"d{i}" for i in range(4)], "x_m": device_m[:, 0], "y_m": device_m[:, 1], "z_m": 1.5,
                  "role": ["anchor"] * 3 + ["unknown"]}).to_csv(folder / "devices.csv", index=False)


def _write_maps(folder: Path) -> None:
    shape = {"type": "Polygon", "coordinates": [SQUARE]}
    feature = {"type": "Feature", "properties": {"building": "yes", "height": "12"}, "geometry": shape}
    (folder / "town.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    (folder / "town.osm").write_bytes((Path(__file__).parents[1] / "footprints" / "town.osm").read_bytes())
    import pyogrio  # an extra, in the test extra, too
    import shapely

    pyogrio.raw.write(folder / "town.gpkg", np.array([shapely.to_wkb(shapely.Polygon(SQUARE))]), [np.array(["12"])],
                      ["height"], geometry_type="Polygon", crs="EPSG:4326", driver="GPKG")
    (folder / "city.xml").write_text("""<scene version="2.1.0"><default name="side" value="40"/>
<bsdf type="itu-radio-material" id="wall"><string name="type" value="concrete"/></bsdf>
<shape type="cube" id="block"><transform name="to_world"><scale x="$side" y="20" z="10"/>
<translate value="0, 0, 10"/></transform><ref id="wall" name="bsdf"/></shape>
<shape type="rectangle" id="floor"><transform name="to_world"><scale value="200"/></transform>
<ref id="wall" name="bsdf"/></shape></scene>""")


def _write_log(folder: Path) -> None:
    (folder / "log.csv").write_text("when,lat,lon,alt,cell,rsrp\n" + "".join(
        f"{1.7e9 + i},{50 + i * 1e-4},{8 + i * 2e-4},{40 + i % 3},c{i % 2},{-70 - i % 20}\n" for i in range(60)))
    (folder / "sites.csv").write_text("device,latitude,longitude,height\nc0,50.001,8.001,20\nc1,50.002,8.004,25\n")
    (folder / "import.toml").write_text(
        'devices = "sites.csv"\ntime_format = "epoch s"\nlevel_unit = "dBm"\nlength_unit = "m"\n[columns]\n'
        'time = "when"\nlatitude = "lat"\nlongitude = "lon"\naltitude = "alt"\ndevice = "cell"\nlevel = "rsrp"\n')


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


def run_here(line: str, folder: Path) -> None:
    """Run a command in this process, which then has imported all that its forked children need."""
    module, *arguments = line.split()
    argv, before, show = sys.argv, Path.cwd(), warnings.showwarning
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    said, status = io.StringIO(), 0
    try:
        sys.argv = [module, *arguments]
        os.chdir(folder)
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said), warnings.catch_warnings():
            run_command(module)
    except SystemExit as end:
        status = end.code or 0
    finally:
        os.chdir(before)
        sys.argv, warnings.showwarning = argv, show
        for number, handler in handlers.items():
            signal.signal(number, handler)
    if status:
        raise RuntimeError(f"{line}: exit status {status}\n{said.getvalue()}")


def run_command(module: str) -> None:
    """Run a command by `sys.argv`: `radiotwin`, or a module as `python -m` does."""
    if module == "radiotwin":
        from radiotwin.cli import main

        main()
    else:
        runpy.run_module(module, run_name="__main__")
