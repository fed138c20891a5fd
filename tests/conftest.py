"""Skips what a machine cannot run, with the reason; the order of the tests."""

import base64
import uuid

import pytest

from radiotwin.runtime import cuda, llvm
from radiotwin.scene.plot import draw_preview

LONG = ("examples", "tests/test_api", "tests/test_examples", "tests/marl", "tests/cli", "tests/twin", "tests/closeloop",
        "tests/trace", "tests/runtime", "tests/studies")
"""What has the longest tests; they come first, so that at the end no worker waits for one of them."""
PIXEL_PNG = base64.b64decode("iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAAAAAA6fptVAAAACklEQVR4nGNgAAAAAgABSK+kcQAAAABJRU5ErkJggg==")
GPU_TRIALS = {"tracing": cuda.tracing_refusal, "training": cuda.torch_refusal}


def pytest_collection_modifyitems(items):
    def place(item):
        return next((number for number, start in enumerate(LONG) if item.nodeid.startswith(start)), len(LONG))

    items.sort(key=place)
    needs_llvm = [item for item in items if item.get_closest_marker("llvm")]
    if needs_llvm and not llvm.available():
        for item in needs_llvm:
            item.add_marker(pytest.mark.skip(reason="no working libLLVM >= 17; `radiotwin doctor` says what to do"))
    for item in items:
        marker = item.get_closest_marker("gpu")
        refusal = marker and GPU_TRIALS[marker.args[0]]()
        if refusal:
            item.add_marker(pytest.mark.skip(reason=f"no GPU for {marker.args[0]}: {refusal}"))


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory, monkeypatch):
    """A folder for finished parts that no other test uses, nor the user; it is made when it is needed."""
    folder = tmp_path_factory.getbasetemp() / f"cache-{uuid.uuid4().hex}"
    monkeypatch.setenv("RADIOTWIN_CACHE", str(folder))
    return folder


@pytest.fixture(scope="session", autouse=True)
def plain_preview():
    """A picture of one pixel in the place of a scene's preview, whose drawing takes most of the time of a small build."""
    def draw(scene, path):
        path.write_bytes(PIXEL_PNG)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("radiotwin.scene.build.draw_preview", draw)
        yield draw


@pytest.fixture
def drawn_preview(monkeypatch):
    """The preview as ever."""
    monkeypatch.setattr("radiotwin.scene.build.draw_preview", draw_preview)


@pytest.fixture(scope="session")
def small_scene(tmp_path_factory):
    """The scene folder of `preset:small`."""
    from radiotwin.scene import Scene
    from radiotwin.scene.presets import build_preset

    folder = tmp_path_factory.mktemp("scenes") / "small"
    build_preset("small", folder)
    return Scene.load(folder)
