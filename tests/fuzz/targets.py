"""Which file is damaged, and the command that then reads it."""

from dataclasses import dataclass

from tests.fuzz.honest import LINES


def suffix_of(file: str) -> str:
    """Return the ending of a file's name; that of a city model in JSON has two parts."""
    return ".city.json" if file.endswith(".city.json") else "." + file.rpartition(".")[2]


@dataclass(frozen=True)
class Target:
    """A file of the honest folder and a command that reads it.

    `kind` is the class of files in the counts; `slow` commands are in no case of a test run.
    """

    kind: str
    file: str
    command: str
    slow: bool = False

    @property
    def suffix(self) -> str:
        """Ending of the file, which decides how it is damaged."""
        return suffix_of(self.file)


_SURVEY = "open/measurements.csv"
_FIT = "radiotwin fit survey/{} --scene scene --model log_distance -o out"
_RUN = ("marl.fedqmix --scene scene --truth segmented --real-episodes 1 --episodes 8 --flights 2 --compare none "
        "--planner-iterations 50 --hidden 8 --out run --resume")
_IMPORT = "radiotwin import {} --columns {} -o out"
_MESH = "scene/meshes/building_000.ply"
TARGETS = (
    *(Target("scene.toml", "scene/scene.toml", command) for command in (
        "radiotwin survey scene --truth segmented --flights 1 -o out/measurements.csv",
        "radiotwin map twin --scene scene --altitudes 55 -o out.npz", "radiotwin export-scene scene -o out.glb",
        "radiotwin report scene -o out.html")),
    *(Target("city.xml", "scene/city.xml", command) for command in (
        "radiotwin survey scene --truth segmented --flights 1 -o out/measurements.csv",
        "radiotwin export-scene scene -o out", "radiotwin build-scene scene/city.xml --check")),
    *(Target("mesh", _MESH, command) for command in (
        "radiotwin survey scene --truth segmented --flights 1 -o out/measurements.csv",
        "radiotwin export-scene scene -o out.obj")),
    Target("foreign city", "city.xml", "radiotwin build-scene city.xml -o out"),
    Target("OpenStreetMap", "town.osm", "radiotwin build-scene town.osm -o out"),
    Target("GeoJSON map", "town.geojson", "radiotwin build-scene town.geojson -o out"),
    Target("Overpass", "town.json", "radiotwin build-scene town.json -o out"),
    Target("GeoPackage", "town.gpkg", "radiotwin build-scene town.gpkg -o out"),
    Target("GeoParquet", "town.parquet", "radiotwin build-scene town.parquet -o out"),
    *(Target("Shapefile", f"town.{suffix}", "radiotwin build-scene town.shp -o out") for suffix in ("shp", "dbf", "prj")),
    Target("Shapefile", "town.zip", "radiotwin build-scene town.zip -o out"),
    Target("city model", "town.city.json", "radiotwin build-scene town.city.json -o out"),
    Target("city model", "town.gml", "radiotwin build-scene town.gml -o out"),
    *(Target("model", file, f"radiotwin build-scene {file} -o out") for file in ("box.glb", "box.gltf", "box.stl", "roof.obj")),
    Target("terrain", "dem.tif", "radiotwin build-scene town.geojson --terrain dem.tif -o out"),
    Target("materials", "materials.toml", "radiotwin build-scene town.geojson --material-table materials.toml -o out"),
    Target("antenna", "antennas/pattern.msi", "radiotwin report antennas -o out.html"),
    Target("antenna", "antennas/pattern.csv", "radiotwin report antennas -o out.html"),
    Target("measurements", "survey/measurements.csv", _FIT.format("measurements.csv")),
    Target("measurements", "survey/devices.csv", _FIT.format("measurements.csv")),
    Target("measurements", "survey/packed.csv.gz", _FIT.format("packed.csv.gz")),
    Target("measurements", "survey/table.parquet", _FIT.format("table.parquet")),
    Target("measurements", _SURVEY, f"radiotwin close-loop {_SURVEY} --base log-distance -o out", slow=True),
    Target("measurements", _SURVEY, f"radiotwin locate {_SURVEY} --twin loop/twin -o out.csv"),
    Target("measurements", "survey/measurements.csv", "radiotwin compare survey/measurements.csv --scene scene -o out",
           slow=True),
    *(Target("log to import", file, "radiotwin import log.csv --columns import.toml -o out")
      for file in ("log.csv", "sites.csv", "import.toml")),
    *(Target("twin", file, command) for file, command in (
        ("twin/twin.json", "radiotwin map twin --scene scene --altitudes 55 -o out.nc"),
        ("twin/channel.safetensors", "radiotwin map twin --scene scene --altitudes 55 -o out.csv"),
        ("twin_nn/twin.json", "radiotwin report twin_nn --scene scene -o out.html"),
        ("twin_nn/channel.safetensors", "radiotwin map twin_nn --scene scene --altitudes 55 -o out.tif"),
        ("loop/twin/twin.json", f"radiotwin locate {_SURVEY} --twin loop/twin -o out.csv"),
        ("loop/twin/twin.json", "radiotwin map loop/twin --scene scene --altitudes 55 -o out.nc"))),
    *(Target("radio map", "map.nc", command) for command in (
        "radiotwin map map.nc --scene scene -o out.npz", "radiotwin map map.nc --scene scene --altitudes 55 -o out.tif",
        "radiotwin map map.nc --scene scene --devices d1 -o out.png",
        "radiotwin report scene --truth map.nc -o out.html")),
    *(Target("transmitters", file, "radiotwin coverage town --transmitters sites/sites.csv --step 20 --indoor-loss-db 9 --formats nc "
             "-o out")
      for file in ("sites/sites.csv", "sites/pattern.csv")),
    Target("GeoJSON map", "town.geojson",
           "radiotwin coverage town --transmitters sites/sites.csv --step 20 --polygon town.geojson --indoor-loss-db 9 "
           "--formats gpkg -o out"),
    Target("radio map", "map.nc", "radiotwin coverage map.nc --scene scene --tx-power-dbm 20 --formats tif,png -o out"),
    Target("twin", "twin/twin.json", "radiotwin coverage twin --scene scene --tx-power-dbm 20 --step 30 --formats nc -o out"),
    *(Target("run folder", file, "radiotwin report loop -o out.html")
      for file in ("loop/closeloop.json", "loop/residuals.csv.gz", "loop/groups.png")),
    *(Target("run folder", f"comparison/{name}", "radiotwin report comparison --scene scene -o out.html")
      for name in ("compare.json",)),
    Target("run folder", "run/config.json", "radiotwin report run -o out.html"),
    Target("run folder", "run/flights.csv", "radiotwin report run -o out.html"),
    Target("run folder", "run/comparison.csv", "radiotwin report run -o out.html"),
    Target("scene.toml", "scene/scene.toml", "radiotwin close-loop survey/measurements.csv --scene scene --base log-distance -o out",
           slow=True),
    Target("scene.toml", "scene/scene.toml",
           "marl.fedqmix --scene scene --truth segmented --twin truth --algorithm random --real-episodes 1 --flights 2 "
           "--planner-iterations 50 --out out"),
    Target("scene.toml", "scene/scene.toml", "radiotwin build-scene scene/city.xml -o out"),
    Target("foreign city", "roof.obj", "radiotwin build-scene city.xml -o out"),
    Target("foreign city", "exported/city.xml", "radiotwin build-scene exported/city.xml -o out"),
    Target("foreign city", "exported/meshes/building_000.ply", "radiotwin build-scene exported/city.xml -o out"),
    Target("OpenStreetMap", "town.osm.pbf", "radiotwin build-scene town.osm.pbf -o out"),
    Target("measurements", "located.csv", f"radiotwin locate {_SURVEY} --twin loop/twin --truth located.csv -o out.csv"),
    *(Target("log to import", file, _IMPORT.format(file, settings)) for file, settings in (
        ("log.csv.gz", "import.toml"), ("log.parquet", "import.toml"), ("log.geojson", "points.toml"),
        ("fixed.csv", "fixed.toml"))),
    *(Target("log to import", file, _IMPORT.format("fixed.csv", "fixed.toml")) for file in ("masts.csv", "fixed.toml")),
    *(Target("log to import", file, _IMPORT.format(file, "import.toml"))
      for file in ("german.csv", "logs.zip", "log.xlsx")),
    *(Target("log to import", file, f"radiotwin import {file} -o out") for file in ("uplinks.jsonl", "wigle.csv")),
    Target("log to import", "scan.csv", "radiotwin import scan.csv --time-zone UTC --band-hz 1000,1600 --track flight.gpx -o out"),
    *(Target("track", file, f"radiotwin import levels.csv --columns levels.toml --track {file} -o out")
      for file in ("flight.gpx", "flight.nmea", "flight.ulg")),
    Target("points", "points.csv", "radiotwin gains scene --points points.csv --quality fast -o out.csv"),
    *(Target("twin", f"{folder}/{file}", command.format(folder), slow="raytrace" in folder)
      for folder, command in (
        ("twin_corrected", "radiotwin locate links/measurements.csv --twin {} -o out.csv"),
        ("twin_raytrace", "radiotwin map {} --scene scene --altitudes 55 -o out.nc"),
        ("twin_raytrace", "radiotwin report {} --scene scene -o out.html"),
        ("twin_kriging", "radiotwin map {} --scene scene --altitudes 55 -o out.png"))
      for file in ("twin.json", "channel.safetensors")),
    Target("twin", "twin/twin.json", _FIT.format("measurements.csv --start twin")),
    Target("radio map", "map.nc", "radiotwin compare survey/measurements.csv --scene scene --truth map.nc -o out", slow=True),
    Target("radio map", "map.nc", "radiotwin survey scene --truth map.nc --flights 1 -o out.csv"),
    *(Target("command line", f"args/{name}.args", f"@args/{name}.args", slow=name in ("compare", "loop"))
      for name in LINES),
    Target("checkpoint", "run/checkpoint.safetensors", _RUN),
    Target("checkpoint", "run/config.json", _RUN),
)
