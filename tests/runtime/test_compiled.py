import os
import subprocess
import sys


def test_a_change_in_another_file_reaches_kept_code(tmp_path):
    """numba alone would go on with the old callee: it looks at the file of the function that is called from Python."""
    (tmp_path / "outer.py").write_text(
        "from inner import times\nfrom radiotwin.runtime.compiled import njit\n"
        "@njit(cache=True)\ndef scaled(x):\n    return times(x)\n")
    found = []
    for factor in (2, 3, 3):
        (tmp_path / "inner.py").write_text(
            "from radiotwin.runtime.compiled import njit\n"
            f"@njit(cache=True)\ndef times(x):\n    return {factor} * x\n")
        code = "import outer; print(outer.scaled(7), sum(outer.scaled.stats.cache_hits.values()))"
        done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True,
                              env=os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path[1:]])})
        found.append(done.stdout.split())
    assert found == [["14", "0"], ["21", "0"], ["21", "1"]]
