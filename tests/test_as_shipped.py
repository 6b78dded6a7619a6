"""Tests that compare the bits of different programs, compiled as users' are: all else here is compiled in a hurry."""

import os
import re
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent


def test_bits_are_the_same_as_shipped():
    files = [
        path for path in HERE.rglob("test_*.py") if path != Path(__file__) and "mark.as_shipped" in path.read_text()
    ]
    command = [sys.executable, "-m", "pytest", "-m", "as_shipped", "-p", "no:cacheprovider", *map(str, sorted(files))]
    done = subprocess.run(command, env=os.environ | {"XLA_FLAGS": ""}, cwd=HERE.parent, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert int(re.search(r"(\d+) passed", done.stdout)[1]) >= 9
