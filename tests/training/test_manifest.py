"""What JAX is started with: products in float32 on every device, and a cache whose damage is no news to anybody."""

import json
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np

from ppo_dap.training.manifest import manifest

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


STARTED = """
import json, os
from ppo_dap.training.manifest import manifest, prepare_jax
prepare_jax()
about = manifest()
print(json.dumps([about["matmul_precision"], about["device"], os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"]]))
"""


def test_what_the_user_did_not_choose_is_chosen_and_the_manifest_tells_it():
    chosen = ("JAX_DEFAULT_MATMUL_PRECISION", "XLA_PYTHON_CLIENT_PREALLOCATE")
    bare = {name: value for name, value in os.environ.items() if name not in chosen}
    expected = {"highest": bare, "tensorfloat32": bare | {chosen[0]: "tensorfloat32", chosen[1]: "true"}}
    for precision, environment in expected.items():
        done = subprocess.run([sys.executable, "-c", STARTED], env=environment, capture_output=True, text=True)
        preallocate = environment.get(chosen[1], "false")
        assert json.loads(done.stdout) == [precision, jax.devices()[0].device_kind, preallocate], done.stderr
    assert manifest()["device"] == jax.devices()[0].device_kind


def test_a_product_in_a_stage_is_as_exact_as_the_one_of_the_policy_that_collects():
    rng = np.random.default_rng(0)
    a, b = (rng.standard_normal(shape, dtype=np.float32) for shape in ((64, 256), (256, 64)))
    exact = a.astype(np.float64) @ b

    def error(product):
        return np.linalg.norm(np.asarray(product, np.float64) - exact) / np.linalg.norm(exact)

    product = jax.jit(lambda a, b: a @ b)
    bound = 2 * error(a @ b)
    assert error(product(a, b)) < bound
    # The planted fault: factors rounded to 8 bits.
    assert error(product(*(jnp.asarray(x, jnp.bfloat16) for x in (a, b)))) > 100 * bound
