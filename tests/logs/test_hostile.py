"""300 damaged and hostile logs: refused in one line, warned about, or read right; nothing else ever happens."""

import hashlib
import json
import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from logs.hostile_made import MAKERS
from logs.hostile_tools import Payload
from logs.logs_made import make_logs, write_npz

COUNT = 300
BATCHES = 3
SECONDS = 10
MOST_MIB = 700  # beyond the libraries: 256 MiB of rows, and as much again while they are joined

READER = """
import hashlib, json, signal, sys, warnings
from ppo_dap.errors import InputError
from ppo_dap.logs import load_logs
import h5py, pyarrow.csv, pyarrow.parquet

def peak():
    return int(open("/proc/self/status").read().split("VmHWM:")[1].split()[0]) // 1024

before = peak()
for path in json.load(sys.stdin):
    print(json.dumps([path, "started"]), flush=True)
    signal.setitimer(signal.ITIMER_REAL, float(sys.argv[1]))  # ends this process where Python cannot
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            logs = load_logs(path)
            content = b"".join(getattr(logs, name).tobytes() for name in ("observations", "actions", "episode_ends"))
            said = ["loaded", hashlib.sha256(content).hexdigest(), [w.category.__name__ for w in caught]]
        except InputError as error:
            said = ["refused", str(error)]
        except BaseException as error:
            said = ["raised", repr(error)[:300]]
    signal.setitimer(signal.ITIMER_REAL, 0)
    print(json.dumps([path, *said]), flush=True)
print(json.dumps(["memory", peak() - before]), flush=True)
"""


def read_all(paths, seconds=SECONDS):
    """What became of each path, and the most memory in MiB; a path that ended the process "died"."""
    done = subprocess.run(
        [sys.executable, "-c", READER, str(seconds)], input=json.dumps(paths), capture_output=True, text=True
    )
    outcomes, memory = {}, None
    for line in done.stdout.splitlines():
        path, *said = json.loads(line)
        if path == "memory":
            (memory,) = said
        else:
            outcomes[path] = said
    for path, said in outcomes.items():
        if said == ["started"]:
            outcomes[path] = ["died", done.returncode, done.stderr[-500:]]
    return outcomes, memory


def expected():
    logs = make_logs()
    content = b"".join(getattr(logs, name).tobytes() for name in ("observations", "actions", "episode_ends"))
    return hashlib.sha256(content).hexdigest()


def fault(kind, path, said):
    """What is wrong with an outcome, or None."""
    if said[0] == "refused":
        fine = "\n" not in said[1] and said[1].startswith(path) and len(said[1]) < 2000
        return None if fine else f"{kind}: not one line of its own: {said[1][:300]!r}"
    if said[0] == "loaded":
        fine = kind.endswith("_loose") or "LogsWarning" in said[2] or said[1] == expected()
        return None if fine and set(said[2]) <= {"LogsWarning"} else f"{kind}: loaded otherwise, {said[2]}"
    return f"{kind}: {said}"


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="Linux says what the most memory was")
@pytest.mark.parametrize("batch", range(BATCHES))
def test_hostile_logs(tmp_path, batch):
    kinds, names = {}, list(MAKERS)
    for seed in range(batch, COUNT, BATCHES):
        folder = tmp_path / str(seed)
        folder.mkdir()
        kind = names[seed // BATCHES % len(names)]
        kinds[str(MAKERS[kind](folder, np.random.default_rng(seed)))] = f"{kind} of seed {seed}", kind
    outcomes, memory = read_all(list(kinds))
    assert set(outcomes) == set(kinds), f"died after {list(outcomes.items())[-1:]}"
    faults = [fault(kinds[path][1], path, said) for path, said in outcomes.items()]
    assert [f"{kinds[path][0]}: {f}" for path, f in zip(outcomes, faults, strict=True) if f] == []
    assert not list(tmp_path.rglob("canary"))
    assert memory < MOST_MIB, f"{memory} MiB"
    counts = [said[0] for said in outcomes.values()]
    assert counts.count("refused") > 50
    assert counts.count("loaded") > 5


def test_faults_are_found(tmp_path):
    """A reader that hangs or reads wrong values is noticed, and the pickle would make its canary."""
    os.mkfifo(tmp_path / "a")
    good, other = str(write_npz(tmp_path / "a.npz")), str(write_npz(tmp_path / "b.npz", actions=np.ones((12, 2))))
    outcomes, _ = read_all([good, other])
    assert fault("kind", good, outcomes[good]) is None
    assert "loaded otherwise" in fault("kind", other, outcomes[other])
    assert fault("kind_loose", other, outcomes[other]) is None
    assert "not one line" in fault("kind", good, ["refused", f"{good}: a\nb"])
    hang = f"def load_logs(path):\n    open({str(tmp_path / 'a')!r})\n"
    reader = READER.replace("from ppo_dap.logs import load_logs\n", hang)
    command = [sys.executable, "-c", reader, "0.3"]
    done = subprocess.run(command, input=json.dumps([good]), capture_output=True, text=True)
    assert done.returncode == -14
    pickle.loads(pickle.dumps(Payload(tmp_path / "canary"))).close()
    assert (tmp_path / "canary").exists()
