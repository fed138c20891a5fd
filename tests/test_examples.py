"""The examples run as they are."""

import subprocess
import sys
from pathlib import Path

EXAMPLES = Path(__file__).parents[1] / "examples"


def test_first_twin(tmp_path):
    result = subprocess.run([sys.executable, str(EXAMPLES / "first_twin.py")], cwd=tmp_path, capture_output=True,
                            text=True, timeout=200)
    assert result.returncode == 0, result.stderr
    assert "segmented_nn" in result.stdout and result.stdout.strip().endswith("dB")
    assert (tmp_path / "first_twin" / "twin" / "twin.json").is_file()
