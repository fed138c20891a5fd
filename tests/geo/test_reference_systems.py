"""Names of coordinate reference systems: none of them opens a file."""

import os

import pytest
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError

from radiotwin.geo import reference_system

BOUND = """BOUNDCRS[
SOURCECRS[GEOGCRS["x",DATUM["d",ELLIPSOID["Bessel",6377397.155,299.1528128]],CS[ellipsoidal,2],AXIS["lat",north],
    AXIS["lon",east],ANGLEUNIT["degree",0.0174532925199433]]],
TARGETCRS[GEOGCRS["WGS 84",DATUM["World Geodetic System 1984",ELLIPSOID["WGS 84",6378137,298.257223563]],
    CS[ellipsoidal,2],AXIS["lat",north],AXIS["lon",east],ANGLEUNIT["degree",0.0174532925199433],ID["EPSG",4326]]],
ABRIDGEDTRANSFORMATION["t",METHOD["{}"]{}]]"""
BY_GRID = BOUND.format("NTv2", ',PARAMETERFILE["Latitude and longitude difference file","{}"]')
BY_PROJ = BOUND.format("PROJ-based operation method: +proj=pipeline +step +proj=hgridshift +grids={}", "")
HOSTILE = {
    "a grid": "+proj=utm +zone=32 +ellps=bessel +nadgrids={}",
    "a geoid": "+proj=utm +zone=32 +ellps=bessel +geoidgrids={} +title=[",
    "a file of definitions": "+init={}:1",
    "WKT with a grid": BY_GRID,
    "WKT with PROJ's language": BY_PROJ,
    "WKT with PROJ's language in printed quotes": BY_PROJ.replace('METHOD["', "METHOD[\u201c").replace("{}\"", "{}\u201d"),
    "PROJ's language after spaces": "  +proj=longlat +ellps=bessel +nadgrids={} [",
    "its path": "{}",
}


@pytest.mark.parametrize("name", ["EPSG:25832", "urn:ogc:def:crs:EPSG::25832", "ETRS89 / UTM zone 32N",
                                  CRS.from_epsg(25832).to_wkt(), CRS.from_epsg(25832).to_wkt("WKT1_GDAL"),
                                  CRS.from_epsg(25832).to_wkt("WKT1_ESRI")])
def test_names_that_are_known(name):
    assert reference_system(name).to_epsg(min_confidence=20) == 25832


def test_wkt_with_a_compound_name_or_a_shift_of_the_datum():
    assert reference_system(CRS("EPSG:25832+7837").to_wkt()).is_compound
    assert reference_system(CRS("+proj=utm +zone=32 +ellps=bessel +towgs84=598,73,418").to_wkt()).is_bound


@pytest.mark.parametrize("name", HOSTILE.values(), ids=list(HOSTILE))
def test_no_name_opens_a_file(name, tmp_path):
    """A pipe that nobody writes to would be waited for: the test would hang."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(CRSError):
        Transformer.from_crs(reference_system(name.replace("{}", str(pipe))), "EPSG:4326")


@pytest.mark.parametrize("text", [BY_GRID, BY_PROJ])
def test_nor_does_json(text):
    with pytest.raises(CRSError):
        reference_system(CRS.from_wkt(text.replace("{}", "/etc/passwd")).to_json())
