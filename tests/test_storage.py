import os
import subprocess
import sys

import numpy as np
import pytest
from safetensors.numpy import save_file

from ppo_dap.errors import InputError
from ppo_dap.storage import read_tensors, write_atomically, write_tensors

TENSORS = {"a": np.arange(6, dtype=np.float32).reshape(2, 3), "b": np.array(2.5), "c": np.arange(4).reshape(2, 2).T}
META = {"kind": "thing", "format": 2, "text": "ü", "nested": {"none": None, "list": [1, 2.5]}}


@pytest.fixture
def path(tmp_path):
    file = tmp_path / "file"
    write_tensors(file, TENSORS, META)
    return file


def test_what_is_read_is_what_was_written(path):
    tensors, meta = read_tensors(path, "thing", 2)
    assert meta == META
    assert tensors.keys() == TENSORS.keys()
    for name, tensor in TENSORS.items():
        assert tensors[name].dtype == tensor.dtype
        np.testing.assert_array_equal(tensors[name], tensor)
    write_tensors(path, {"a": np.zeros(1)}, META)
    assert list(read_tensors(path, "thing", 3)[0]) == ["a"]


@pytest.mark.parametrize("name", ["fsync", "replace"])
def test_a_write_that_fails_leaves_the_file_as_it_was(path, monkeypatch, name):
    before = path.read_bytes()

    def fail(*args):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, name, fail)
        with pytest.raises(OSError, match="No space left"):
            write_tensors(path, {"a": np.zeros(100)}, META)
    assert path.read_bytes() == before
    assert os.listdir(path.parent) == ["file"]


@pytest.mark.parametrize(
    ("write", "survives"), [("write_atomically(path, content)", True), ("path.write_bytes(content)", False)]
)
def test_a_full_disk_leaves_the_file_as_it_was(tmp_path, write, survives):
    """A limit on file sizes stands in for the full disk; a plain write (planted) loses the old content."""
    file = tmp_path / "file"
    write_atomically(file, b"old")
    code = f"""
import resource
from pathlib import Path
from ppo_dap.storage import write_atomically
path, content = Path({str(file)!r}), bytes(100_000)
resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))
try:
    {write}
except OSError as error:
    print("refused", error.errno)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("refused")
    assert (file.read_bytes() == b"old") == survives
    assert os.listdir(tmp_path) == ["file"]


def truncated(path):
    path.write_bytes(path.read_bytes()[:-3])


def other_kind(path):
    write_tensors(path, TENSORS, {**META, "kind": "other"})


def newer(path):
    write_tensors(path, TENSORS, {**META, "format": 3})


def foreign_tensors(path):
    save_file(TENSORS | {"c": np.zeros(2)}, path)


def header_of_another_shape(path):
    save_file({"a": np.zeros(2)}, path, metadata={"meta": "[1, 2]"})


def header_not_json(path):
    save_file({"a": np.zeros(2)}, path, metadata={"meta": "{"})


def absent(path):
    path.unlink()


def folder(path):
    path.unlink()
    path.mkdir()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (absent, "no thing file"),
        (folder, "no thing file"),
        (truncated, "not a whole thing file"),
        (lambda path: path.write_bytes(b""), "not a whole thing file"),
        (lambda path: path.write_text("epoch,return\n0,1\n"), "not a whole thing file"),
        (lambda path: path.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100)), "not a whole thing file"),
        (header_not_json, "not a whole thing file"),
        (header_of_another_shape, "thing file"),
        (foreign_tensors, "foreign safetensors"),
        (other_kind, "other file"),
        (newer, "format 3.*reads up to 2"),
    ],
)
def test_a_file_that_cannot_be_read_says_why_in_one_line(path, damage, message):
    damage(path)
    with pytest.raises(InputError, match=message) as caught:
        read_tensors(path, "thing", 2)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)
