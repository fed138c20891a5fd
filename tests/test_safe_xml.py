"""Hostile XML through every reader of the package: refused at once, nothing read outside."""

import time

import pytest

from radiotwin.errors import BadInput
from radiotwin.footprints.osm_xml import read_osm_xml
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.mitsuba_xml import read_mitsuba_xml

LAUGHS = "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 12))
HOSTILE = {
    "billion laughs": f'<!DOCTYPE x [<!ENTITY a0 "ha">{LAUGHS}]>',
    "another file": '<!DOCTYPE x [<!ENTITY a11 SYSTEM "file:///etc/passwd">]>',
    "parameter entity": '<!DOCTYPE x [<!ENTITY % all SYSTEM "file:///etc/passwd"> %all;]>',
    "unparsed": '<!DOCTYPE x [<!NOTATION n SYSTEM "n"><!ENTITY a11 SYSTEM "file:///etc/passwd" NDATA n>]>',
}
READERS = {"osm": (read_osm_xml, '<osm><node id="1" lat="1" lon="1"/>&a11;</osm>'),
           "scene": (read_mitsuba_xml, "<scene>&a11;</scene>"), "city": (CityMap.from_xml, "<scene>&a11;</scene>")}


@pytest.mark.parametrize("what", HOSTILE)
@pytest.mark.parametrize("reader", READERS)
def test_entities_are_refused(tmp_path, what, reader):
    read, body = READERS[reader]
    path = tmp_path / f"a.{'osm' if reader == 'osm' else 'xml'}"
    path.write_text(HOSTILE[what] + body)
    began_s = time.monotonic()
    with pytest.raises(BadInput, match="declares the entity"):
        read(path)
    assert time.monotonic() - began_s < 1


@pytest.mark.parametrize("encoding", ["utf-7", "shift_jis", "no-such", "hex"])
def test_encodings_that_cannot_be_read(tmp_path, encoding):
    (tmp_path / "a.osm").write_text(f'<?xml version="1.0" encoding="{encoding}"?><osm/>')
    with pytest.raises(BadInput, match="cannot be decoded|malformed XML"):
        read_osm_xml(tmp_path / "a.osm")


def test_deep_nesting_is_no_danger(tmp_path):
    deep = 20_000
    (tmp_path / "a.osm").write_text("<osm>" + "<way id='1'>" * deep + "</way>" * deep + "</osm>")
    assert len(read_osm_xml(tmp_path / "a.osm").ways) == 1
    (tmp_path / "a.xml").write_text("<scene>" + "<shape>" * deep + "</shape>" * deep + "</scene>")
    with pytest.raises(BadInput):
        CityMap.from_xml(tmp_path / "a.xml")
