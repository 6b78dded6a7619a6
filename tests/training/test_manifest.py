"""The cache of compiled programs: a damaged entry costs one compilation, and is no news to anybody."""

import os
import subprocess
import sys

CODE = """
from ppo_dap.training.manifest import prepare_jax
prepare_jax()
import jax
print(float(jax.jit(lambda x: x * 2 + 1)(3.0)))
"""


def test_a_program_whose_cache_a_kill_cut_short_is_compiled_anew_and_nothing_is_said(tmp_path):
    keep = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    run = [sys.executable, "-c", CODE]
    first = subprocess.run(run, env=keep | {"XDG_CACHE_HOME": str(tmp_path)}, capture_output=True, text=True)
    entries = [path for path in tmp_path.rglob("*-cache") if path.is_file()]
    assert entries
    for entry in entries:
        entry.write_bytes(entry.read_bytes()[:10])
    again = subprocess.run(run, env=keep | {"XDG_CACHE_HOME": str(tmp_path)}, capture_output=True, text=True)
    assert (first.stdout, first.stderr) == (again.stdout, again.stderr) == ("7.0\n", "")
    # The planted fault: without the filter the user is told.
    loud = subprocess.run(
        [sys.executable, "-c", CODE.replace("import jax", "import jax, warnings; warnings.resetwarnings()", 1)],
        env=keep | {"XDG_CACHE_HOME": str(tmp_path)},
        capture_output=True,
        text=True,
    )
    assert "Error reading persistent compilation cache entry" in loud.stderr
