"""Claims: one holder at a time, whatever dies, falls silent or is late."""

import json
import os
import subprocess
import sys
import threading
import time

import pytest

from ppo_dap.study.store import claims
from ppo_dap.study.store.claims import Claim, Heart, Watch, newest, take


def _foreign(folder, number=1):
    """A claim of a process on another machine."""
    (folder / f"claim-{number}").write_text(json.dumps({"host": "elsewhere", "pid": os.getpid(), "started": 1}))


def _taken(folder, number):
    claim = take(folder, number)
    assert claim is not None
    return claim


def _newest(folder):
    found = newest(folder)
    assert found is not None
    return found


def _dead_pid():
    done = subprocess.Popen([sys.executable, "-c", ""])
    done.wait()
    return done.pid


def test_one_of_many_processes_gets_a_claim(tmp_path):
    """Started one after another and let loose together, by a file that they all wait for."""
    go, folder = tmp_path / "go", tmp_path / "cell"
    folder.mkdir()
    code = (
        "import sys, pathlib\nfrom ppo_dap.study.store.claims import take\n"
        f"while not pathlib.Path({str(go)!r}).exists(): pass\n"
        f"sys.exit(0 if take(pathlib.Path({str(folder)!r}), 1) else 1)"
    )
    workers = [subprocess.Popen([sys.executable, "-c", code]) for _ in range(4)]
    go.touch()
    assert [worker.wait() for worker in workers].count(0) == 1
    assert [path.name for path in folder.iterdir()] == ["claim-1"]


def test_a_live_claim_is_respected(tmp_path):
    assert take(tmp_path, 1) is not None
    watch = Watch(lease=1000.0)
    assert watch.free(tmp_path) is None
    assert take(tmp_path, 1) is None


def test_a_claim_of_a_dead_process_is_free_at_once(tmp_path):
    claim = {"host": claims.host(), "pid": _dead_pid(), "started": 1}
    (tmp_path / "claim-3").write_text(json.dumps(claim))
    assert Watch(lease=1000.0).free(tmp_path) == 4
    # The same on another machine: nobody can tell that it is dead.
    (tmp_path / "claim-3").write_text(json.dumps(claim | {"host": "elsewhere"}))
    assert Watch(lease=1000.0).free(tmp_path) is None


def test_a_process_that_has_another_ones_number_is_another(tmp_path):
    take(tmp_path, 1)
    path = tmp_path / "claim-1"
    content = json.loads(path.read_text())
    if content["started"] is None:
        pytest.skip("this system does not say when processes started")
    path.write_text(json.dumps(content | {"started": content["started"] - 1}))
    assert Watch(lease=1000.0).free(tmp_path) == 2


def test_silence_on_another_machine_is_told_by_our_own_clock(tmp_path, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    _foreign(tmp_path)
    os.utime(tmp_path / "claim-1", (10**6, 10**6))  # long ago, or so that machine's clock says
    watch = Watch(lease=60.0)
    assert watch.free(tmp_path) is None
    now[0] = 59.0
    assert watch.free(tmp_path) is None
    os.utime(tmp_path / "claim-1", (10**6 + 1, 10**6 + 1))  # a sign of life
    now[0] = 100.0
    assert watch.free(tmp_path) is None
    now[0] = 161.0
    assert watch.free(tmp_path) == 2


def test_a_claim_that_was_never_written_out_is_free_after_a_while(tmp_path, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    (tmp_path / "claim-1").touch()
    watch = Watch(lease=60.0)
    assert watch.free(tmp_path) is None
    now[0] = 61.0
    assert watch.free(tmp_path) == 2


def test_taking_over_leaves_one_claim_and_the_late_one_loses(tmp_path):
    _foreign(tmp_path)
    late = Claim(tmp_path, 1)
    assert late.holds
    assert take(tmp_path, 2) is not None
    assert take(tmp_path, 2) is None
    assert take(tmp_path, 1) is None
    assert [path.name for path in tmp_path.iterdir()] == ["claim-2"]
    assert not late.holds
    late.release()  # of no effect on who has taken over
    assert _newest(tmp_path).number == 2
    assert "released" not in _newest(tmp_path).content


def test_a_released_claim_is_free(tmp_path):
    _taken(tmp_path, 1).release()
    assert Watch(lease=1000.0).free(tmp_path) == 2


def test_a_heart_beats_and_notices_who_took_over(tmp_path):
    claim, lost = _taken(tmp_path, 1), threading.Event()
    os.utime(claim.path, (1, 1))
    with Heart(claim, lost.set, every=0.01):
        for _ in range(1000):
            if claim.path.stat().st_mtime > 1:
                break
            time.sleep(0.01)
        assert claim.path.stat().st_mtime > 1
        assert not lost.is_set()
        assert take(tmp_path, 2) is not None
        assert lost.wait(10)


def test_a_heart_stops_with_its_parent(tmp_path, monkeypatch):
    claim, lost = _taken(tmp_path, 1), threading.Event()
    with Heart(claim, lost.set, every=0.01):
        assert not lost.wait(0.1)
        monkeypatch.setattr(os, "getppid", lambda: 1)
        assert lost.wait(10)
