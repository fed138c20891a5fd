"""What a stranger's run holds is shown as text: in a real browser, none of it runs, and nothing is fetched."""

import csv
import json
import os
import re
import resource
import shutil
import subprocess
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from radiotwin.errors import BadInput
from radiotwin.maps.radiomap import RadioMap
from radiotwin.report import html, read_run, write_closeloop_page, write_report
from radiotwin.report.html import Table

SAMPLE = Path(__file__).parents[1] / "closeloop" / "sample" / "closeloop.json"
ATTACK = ("""</script></title></style></textarea>--><script>window.pwned=1</script><img src=x onerror="window.pwned=2">"""
          """<svg onload=pwned=3><link rel=stylesheet href=URL/a.css><img src="URL/b.png">"><a href="javascript:pwned=4">"""
          """'"` onmouseover=pwned=5 autofocus onfocus=pwned=6 {{7*7}}${pwned=7}<!--<script>\\u003cimg """
          """<base href="URL/"><form action="URL/c"><meta http-equiv=refresh content="0;url=URL/d">\u2028\u202e\x1b[2J""")
# A name of a device, a flight or a receiver has at most 200 characters, and none that is not seen.
IN_NAMES = ("""</script></textarea>--><script>pwned=1</script><img src=x onerror="pwned=2"><svg onload=pwned=3>"""
            """'"onmouseover=pwned=5 {{7*7}}<link rel=stylesheet href=URL/a>""")
KEPT = {"schema", "verdict", "sight", "statistic", "links", "positions", "role", "level", "model", "file", "los", "nlos", "effect", "name"}


@pytest.fixture(scope="module")
def server():
    """Address of a server, and what was asked of it."""
    asked = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            asked.append(self.path)
            self.send_error(404)

        def log_message(self, *_):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as found:
        threading.Thread(target=found.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{found.server_port}", asked
        found.shutdown()


def poisoned(value, attack, key=""):
    """Return JSON with the attack in every text, and in every key that is a name of the run's."""
    if isinstance(value, dict):
        named = key.startswith("by_") or key in ("parameters", "baselines")
        return {name + attack * (named and name not in KEPT): poisoned(each, attack, name) for name, each in value.items()}
    if isinstance(value, list):
        return [poisoned(each, attack, key) for each in value]
    return value + attack if isinstance(value, str) and key not in KEPT - {"name"} else value


@pytest.fixture(scope="module")
def hostile(run_folder, server, tmp_path_factory):
    """A run whose texts are all attacks, as its two pages: `{name: path}`."""
    attack, in_names = (text.replace("URL", server[0]) for text in (ATTACK, IN_NAMES))
    folder = tmp_path_factory.mktemp("hostile") / attack.replace("/", "\\")[:180]
    shutil.copytree(run_folder, folder)
    path = folder / "scene" / "scene.toml"
    # Names of a scene have letters and digits only.
    path.write_text(re.sub(r'^(source|seed|generator) = "(.*)"$',
                           lambda found: f"{found[1]} = {json.dumps(found[2] + attack)}", path.read_text(), flags=re.M))
    path = folder / "twin" / "twin.json"
    path.write_text(json.dumps(poisoned(json.loads(path.read_text()), attack)))
    truth = RadioMap.load(folder / "scene" / "truth.nc")
    names = [name + in_names for name in truth.devices]
    hostile = RadioMap(truth.dataset.assign_coords(device=np.array(names, dtype=object)).assign_attrs(source=attack))
    hostile.save(folder / "map.nc")
    (folder / "map.nc").rename(folder / f"{attack.replace('/', '')[:200]}.nc")
    for name in ("survey/measurements.csv.gz", "survey/devices.csv"):
        table = pd.read_csv(folder / name)
        for column in set(table) & {"flight", "receiver", "device"}:
            table[column] = table[column].astype(str) + in_names
        table.to_csv(folder / name, index=False, quoting=csv.QUOTE_NONNUMERIC)
    (folder / "closeloop.json").write_text(json.dumps(poisoned(json.loads(SAMPLE.read_text()), attack)))
    figure = Figure()
    figure.savefig(folder / "waterfall.png")
    links = pd.DataFrame({name: np.arange(6.0) for name in ("time_s", *(
        f"{end}_{axis}_m" for end in ("receiver", "device") for axis in "xyz"), "before_db", "after_db")})
    links.assign(flight=attack, receiver=attack, device=attack, los=1).to_csv(folder / "residuals.csv.gz", index=False)
    rows = [{"model": model + attack, "against": against + attack, "positions": "estimated", "links": links, "n": 3,
             "rmse_db": 1.0, "mae_db": 1.0, "bias_db": None} for model in ("a", "b") for against in ("x", "whole map")
            for links in ("all", "LoS", "NLoS")]
    where = [{"model": "a" + attack, "device": attack, "error_m": 2.0, "located": True}]
    (folder / "compare.json").write_text(json.dumps({"schema": "radiotwin.comparison/1", "scores": rows,
                                                     "locations": where}))
    (folder / "config.json").write_text(json.dumps({"run": {"truth": "segmented" + attack, "scene": attack}}))
    pd.DataFrame({"method": [attack], "trained_in": [attack], "real_episodes": [10], "truth_ratio": [0.5]}).to_csv(
        folder / "comparison.csv", index=False)
    with pytest.warns(UserWarning, match="another scene"):
        run = read_run(folder)
    assert run.scene and run.twin and run.planning is not None and run.residuals is not None and run.tracks is not None
    write_report(run, folder / "report.html")
    write_closeloop_page(run.closeloop, folder, "Close-loop of " + attack)
    return {name: folder / name for name in ("report.html", "closeloop.html")}


def used(page):
    """Touch everything of a page, and return what ran of what is not ours."""
    if page.locator("#viewer").count():
        page.wait_for_selector("body[data-ready-ms]")
        for name in ("view", "device", "flight"):
            for value in range(min(page.locator(f"#control-{name} option").count(), 6)):
                page.evaluate("([name, value]) => { control(name).value = value; control(name).onchange(); }", [name, value])
        page.hover("#viewer")
    page.evaluate("document.querySelectorAll('details').forEach(each => { each.open = true; })")
    page.evaluate("document.querySelectorAll('*').forEach(each => { if (each !== document.body)"
                  " each.dispatchEvent(new MouseEvent('mouseover')); })")
    page.wait_for_timeout(200)
    return page.evaluate("window.pwned ?? null")


@pytest.mark.parametrize("with_policy", [True, False], ids=["with policy", "by escaping alone"])
@pytest.mark.parametrize("name", ["report.html", "closeloop.html"])
def test_nothing_of_a_hostile_run_runs(hostile, opened_raw, server, tmp_path, name, with_policy):
    path = tmp_path / "page.html"
    text = hostile[name].read_text(encoding="utf-8")
    if not with_policy:
        text = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", text, count=1)
    path.write_text(text, encoding="utf-8")
    page, wrong = opened_raw(path)
    title = page.title()
    assert used(page) is None
    assert not wrong and not server[1] and page.title() == title and page.url == path.as_uri()
    assert page.locator("a, svg, form, base, link, img:not([src^='data:image/png'])").count() == 0
    assert "<script>window.pwned=1</script>" in page.inner_text("body"), "it is shown as it is"
    assert r"\u202e\x1b[2J" in page.inner_text("body"), "with what is hidden made visible"


@pytest.mark.parametrize("name", ["report.html", "closeloop.html"])
def test_the_policy_stops_what_escaping_would_let_through(hostile, opened_raw, server, tmp_path, name):
    path = tmp_path / "page.html"
    inserted = (f"<script>window.pwned=1</script><img src=x onerror='window.pwned=2'><img src='{server[0]}/e.png'>"
                f"<link rel=stylesheet href='{server[0]}/f.css'><base href='{server[0]}/'><p style='color:red' id=red>x</p>"
                f"<iframe src='{server[0]}/g'></iframe><script src='{server[0]}/h.js'></script>")
    path.write_text(hostile[name].read_text(encoding="utf-8").replace("<footer>", inserted + "<footer>"), encoding="utf-8")
    page, wrong = opened_raw(path)
    assert used(page) is None and not server[1]
    assert page.evaluate("getComputedStyle(document.getElementById('red')).color") != "rgb(255, 0, 0)"
    assert any("Content Security Policy" in text for text in wrong), wrong


def test_the_policy_names_what_the_page_holds_and_nothing_else(hostile):
    for path in hostile.values():
        text = path.read_text(encoding="utf-8")
        policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1]
        assert policy.startswith("default-src &#39;none&#39;;") and "unsafe" not in policy and "http" not in policy
        assert all(f"{kind} &#39;none&#39;" in policy for kind in ("connect-src", "base-uri", "form-action"))
        scripts = re.findall(r"<script>", text)
        assert policy.count("sha256-") == len(scripts) + 1
        assert text.index("Content-Security-Policy") < text.index("<style>") < text.index("<title>") + 10_000


def test_long_tables_texts_and_lists_are_cut_and_counted(tmp_path):
    rows = [[f"row {n}", float(n)] for n in range(html.MAX_ROWS + 7)]
    html.write_page("run.html", tmp_path / "page.html", {
        "title": "t" * 10**6, "page_title": "t", "viewer": None, "lead": [], "notes": [f"note {n}" for n in range(10_000)],
        "closeloop": None, "comparison": None, "planning": None, "law": None, "marks": [], "facts": ["f"],
        "estimates": Table(("device", "x"), rows)})
    text = (tmp_path / "page.html").read_text()
    assert len(text) < 10**6 and text.count("<tr>") == html.MAX_ROWS + 1
    assert "… and 7 more rows" in text and f"… and {10_000 - html.MAX_NOTES} more" in text


def test_a_full_disk_is_one_message_and_the_old_page_stays(run_folder, tmp_path):
    page = tmp_path / "page.html"
    page.write_text("old")
    code = "from radiotwin.cli import main; main()"

    def small_files():
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))

    done = subprocess.run([sys.executable, "-c", code, "report", str(run_folder), "--force", "-o", str(page)],
                          capture_output=True, text=True, preexec_fn=small_files, env=os.environ)
    assert done.returncode == 1 and "Traceback" not in done.stderr, done.stderr
    assert len(done.stderr.strip().splitlines()) == 1 and str(page) in done.stderr
    assert page.read_text() == "old" and [path.name for path in tmp_path.iterdir()] == ["page.html"]


def test_a_folder_of_a_name_that_is_no_text_is_bad_input_or_shown(tmp_path):
    folder = os.fsencode(tmp_path) + b"/\xff\xfe"
    os.mkdir(folder)
    with pytest.raises(BadInput, match="holds nothing"):
        read_run(Path(os.fsdecode(folder)))
    text = html.shown(Path(os.fsdecode(folder)).name)
    assert text == r"\udcff\udcfe" and text.encode()
