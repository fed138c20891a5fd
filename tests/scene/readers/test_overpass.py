"""The download, from a server on this machine."""

import threading
import urllib.parse
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest

from radiotwin.errors import BadInput, RunFailed
from radiotwin.scene.readers.overpass import download_osm

BOX = (47.5, 8.7, 47.51, 8.72)


@pytest.fixture
def server():
    class Handler(BaseHTTPRequestHandler):
        asked = []

        def do_POST(self):
            body = self.rfile.read(int(self.headers["Content-Length"])).decode()
            Handler.asked.append(urllib.parse.parse_qs(body)["data"][0])
            self.send_response(200 if self.path == "/good" else 429)
            self.end_headers()
            self.wfile.write(b"<osm/>")

        def log_message(self, *_):
            pass

    http = HTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=http.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{http.server_port}", Handler.asked
    http.shutdown()


def test_the_query_asks_for_buildings_in_the_box(server, tmp_path):
    address, asked = server
    download_osm(tmp_path / "a.osm", BOX, f"{address}/good")
    assert (tmp_path / "a.osm").read_text() == "<osm/>"
    box = "(47.5000000,8.7000000,47.5100000,8.7200000)"
    for kind in ("way", "relation"):
        for key in ("building", "building:part"):
            assert f'{kind}["{key}"]{box}' in asked[0]
    assert asked[0].startswith("[out:xml]") and "(._;>;)" in asked[0]


def test_a_refusal_leaves_nothing(server, tmp_path):
    with pytest.raises(RunFailed, match="needs a network.*Too Many Requests"):
        download_osm(tmp_path / "a.osm", BOX, f"{server[0]}/busy")
    with pytest.raises(RunFailed, match="needs a network"):
        download_osm(tmp_path / "a.osm", BOX, "http://127.0.0.1:9/")
    assert not list(tmp_path.iterdir())


def test_bad_requests_do_not_reach_the_server(tmp_path):
    (tmp_path / "a.osm").write_text("mine")
    with pytest.raises(BadInput, match="exists already"):
        download_osm(tmp_path / "a.osm", BOX)
    with pytest.raises(BadInput, match="not called .osm"):
        download_osm(tmp_path / "a.geojson", BOX)
    with pytest.raises(BadInput, match="km² are too much"):
        download_osm(tmp_path / "b.osm", (47, 8, 48, 9))
