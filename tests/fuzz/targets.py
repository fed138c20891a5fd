"""Which file is damaged, and the command that then reads it."""

from dataclasses import dataclass

from tests.fuzz.honest import LINES


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
        """Ending of the file, which decides how it is damaged; that of a city model in JSON has two parts."""
        return ".city.json" if self.file.endswith(".city.json") else "." + self.file.rpartition(".")[2]


SURVEY = "survey scene --truth segmented --flights 1 -o out/measurements.csv"
FIT = "fit survey/measurements.csv --scene scene --model log_distance -o out"
LOCATE = "locate open/measurements.csv --twin loop/twin -o out.csv"
COVERAGE = "coverage town --transmitters sites/sites.csv --step 20 --indoor-loss-db 9 --formats nc -o out"
RESUME = ("marl.fedqmix --scene scene --truth segmented --real-episodes 1 --episodes 8 --flights 2 --compare none "
          "--planner-iterations 50 --hidden 8 --out run --resume")
SLOW = ("close-loop", "compare", "@args/compare", "@args/loop")
# Kind, files, commands: every command reads every file of its row; {} is the file.
TABLE = (
    ("scene.toml", "scene/scene.toml", (
        SURVEY, "map twin --scene scene --altitudes 55 -o out.npz", "export-scene scene -o out.glb", "report scene -o out.html",
        "close-loop survey/measurements.csv --scene scene --base log-distance -o out", "build-scene scene/city.xml -o out",
        "marl.fedqmix --scene scene --truth segmented --twin truth --algorithm random --real-episodes 1 --flights 2 "
        "--planner-iterations 50 --out out")),
    ("city.xml", "scene/city.xml", (SURVEY, "export-scene scene -o out", "build-scene scene/city.xml --check")),
    ("mesh", "scene/meshes/building_000.ply", (SURVEY, "export-scene scene -o out.obj")),
    ("foreign city", "city.xml roof.obj", ("build-scene city.xml -o out",)),
    ("foreign city", "exported/city.xml exported/meshes/building_000.ply", ("build-scene exported/city.xml -o out",)),
    ("OpenStreetMap", "town.osm town.osm.pbf", ("build-scene {} -o out",)),
    ("GeoJSON map", "town.geojson", ("build-scene {} -o out", f"{COVERAGE.replace('nc', 'gpkg')} --polygon town.geojson")),
    ("Overpass", "town.json", ("build-scene {} -o out",)), ("GeoPackage", "town.gpkg", ("build-scene {} -o out",)),
    ("GeoParquet", "town.parquet", ("build-scene {} -o out",)),
    ("Shapefile", "town.shp town.dbf town.prj", ("build-scene town.shp -o out",)), ("Shapefile", "town.zip", ("build-scene {} -o out",)),
    ("city model", "town.city.json town.gml", ("build-scene {} -o out",)),
    ("model", "box.glb box.gltf box.stl roof.obj", ("build-scene {} -o out",)),
    ("terrain", "dem.tif", ("build-scene town.geojson --terrain dem.tif -o out",)),
    ("materials", "materials.toml", ("build-scene town.geojson --material-table materials.toml -o out",)),
    ("antenna", "antennas/pattern.msi antennas/pattern.csv", ("report antennas -o out.html",)),
    ("measurements", "survey/measurements.csv survey/devices.csv", (FIT,)),
    ("measurements", "survey/packed.csv.gz survey/table.parquet", (FIT.replace("survey/measurements.csv", "{}"),)),
    ("measurements", "open/measurements.csv", ("close-loop {} --base log-distance -o out", LOCATE)),
    ("measurements", "survey/measurements.csv", ("compare survey/measurements.csv --scene scene -o out",)),
    ("log to import", "log.csv sites.csv import.toml", ("import log.csv --columns import.toml -o out",)),
    ("log to import", "log.csv.gz log.parquet german.csv logs.zip log.xlsx", ("import {} --columns import.toml -o out",)),
    ("log to import", "log.geojson", ("import {} --columns points.toml -o out",)),
    ("log to import", "fixed.csv masts.csv fixed.toml", ("import fixed.csv --columns fixed.toml -o out",)),
    ("log to import", "uplinks.jsonl wigle.csv", ("import {} -o out",)),
    ("log to import", "scan.csv", ("import {} --time-zone UTC --band-hz 1000,1600 --track flight.gpx -o out",)),
    ("track", "flight.gpx flight.nmea flight.ulg", ("import levels.csv --columns levels.toml --track {} -o out",)),
    ("points", "points.csv", ("gains scene --points points.csv --quality fast -o out.csv",)),
    ("twin", "twin/twin.json", ("map twin --scene scene --altitudes 55 -o out.nc", f"{FIT} --start twin",
                                "coverage twin --scene scene --tx-power-dbm 20 --step 30 --formats nc -o out")),
    ("twin", "twin/channel.safetensors", ("map twin --scene scene --altitudes 55 -o out.csv",)),
    ("twin", "twin_nn/twin.json", ("report twin_nn --scene scene -o out.html",)),
    ("twin", "twin_nn/channel.safetensors", ("map twin_nn --scene scene --altitudes 55 -o out.tif",)),
    ("twin", "loop/twin/twin.json", (LOCATE, "map loop/twin --scene scene --altitudes 55 -o out.nc")),
    ("twin", "twin_corrected/twin.json twin_corrected/channel.safetensors", ("locate links/measurements.csv --twin twin_corrected -o out.csv",)),
    ("twin", "twin_raytrace/twin.json twin_raytrace/channel.safetensors", (
        "map twin_raytrace --scene scene --altitudes 55 -o out.nc", "report twin_raytrace --scene scene -o out.html")),
    ("twin", "twin_kriging/twin.json twin_kriging/channel.safetensors", ("map twin_kriging --scene scene --altitudes 55 -o out.png",)),
    ("radio map", "map.nc", (
        "map map.nc --scene scene -o out.npz", "map map.nc --scene scene --altitudes 55 -o out.tif",
        "map map.nc --scene scene --devices d1 -o out.png", "report scene --truth map.nc -o out.html",
        "coverage map.nc --scene scene --tx-power-dbm 20 --formats tif,png -o out",
        "compare survey/measurements.csv --scene scene --truth map.nc -o out", "survey scene --truth map.nc --flights 1 -o out.csv")),
    ("transmitters", "sites/sites.csv sites/pattern.csv", (COVERAGE,)),
    ("run folder", "loop/closeloop.json loop/residuals.csv.gz loop/groups.png", ("report loop -o out.html",)),
    ("run folder", "comparison/compare.json", ("report comparison --scene scene -o out.html",)),
    ("run folder", "run/config.json run/flights.csv run/comparison.csv", ("report run -o out.html",)),
    ("command line", " ".join(f"args/{name}.args" for name in LINES), ("@{}",)),
    ("checkpoint", "run/checkpoint.safetensors run/config.json", (RESUME,)),
)


def _target(kind: str, file: str, command: str) -> Target:
    program = "" if command.startswith(("@", "marl.")) else "radiotwin "
    return Target(kind, file, program + command.format(file), command.format(file).startswith(SLOW) or "raytrace" in file)


TARGETS = [_target(kind, file, command) for kind, files, commands in TABLE for file in files.split() for command in commands]
