"""Hostile XML through every reader of the package: refused at once, nothing read outside."""

import os

import pytest

from radiotwin.errors import BadInput
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.mitsuba_xml import read_mitsuba_xml
from radiotwin.scene.readers.osm import read_osm_xml

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
    with pytest.raises(BadInput, match="declares the entity"):
        read(path)


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


def test_a_tag_without_end_is_not_read_again_and_again(tmp_path):
    """Rationale: Expat reads an unfinished tag from its beginning in every call: 40 MB took minutes."""
    (tmp_path / "a.xml").write_bytes(b'<scene a="' + b"x" * 40_000_000)
    with pytest.raises(BadInput, match=r"bytes in one tag; at most 8,388,608 .* RADIOTWIN_MAX_TAG_BYTES"):
        read_mitsuba_xml(tmp_path / "a.xml")


@pytest.mark.parametrize("reader", READERS)
def test_pipes_and_large_files(tmp_path, monkeypatch, reader):
    read, path = READERS[reader][0], tmp_path / "a.xml"
    path.write_text("<scene/>" + " " * 100)
    monkeypatch.setenv("RADIOTWIN_MAX_FILE_BYTES", "50")
    monkeypatch.setenv("RADIOTWIN_MAX_DOCUMENT_BYTES", "50")
    with pytest.raises(BadInput, match="108 bytes; at most 50 are read"):
        read(path)
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(BadInput, match="not a regular file"):
        read(path)
