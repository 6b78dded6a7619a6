"""Studies on a Ray cluster of two nodes: what comes out is what one machine makes, whichever node is lost."""

import contextlib
import functools
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import pytest

from ppo_dap.cli import main
from ppo_dap.errors import InputError, PPODAPError
from ppo_dap.study.store import ray_cluster, supervise
from ppo_dap.study.store.claims import Watch
from ppo_dap.study.store.ray_cluster import Cluster, one_line
from ppo_dap.study.store.store import open_store
from ppo_dap.study.store.studies import STUDIES
from study.store.store_made import COMMAND, base, contents, made, small_grid, study, supervisor

GRID = small_grid(runs=2, slow=0.25)
PYTHON = sys.executable


def _processes(folder):
    """Everything that was started with this RAY_TMPDIR."""
    found, mark = [], f"RAY_TMPDIR={folder}".encode()
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if mark in (process / "environ").read_bytes().split(b"\0"):
                found.append(process.name)
    return found


def _ps(what, pid):
    """A column of ps on a process, empty for none."""
    return subprocess.run(["ps", "-o", f"{what}=", "-p", str(pid)], capture_output=True, text=True).stdout.strip()


def _parent(pid):
    return int(_ps("ppid", pid) or 0)


def _children(pid):
    done = subprocess.run(["ps", "-A", "-o", "pid=,ppid="], capture_output=True, text=True)
    return [int(child) for child, parent in map(str.split, done.stdout.splitlines()) if int(parent) == pid]


@pytest.fixture(scope="module")
def starting():
    """Two nodes that know neither this NPROC nor this PYTHONPATH; afterwards nothing of them is left."""
    folder = tempfile.mkdtemp(prefix="ray", dir="/tmp")  # the paths of Ray's sockets must be short
    environment = {name: value for name, value in os.environ.items() if name not in ("NPROC", "PYTHONPATH")}
    process = subprocess.Popen(
        [PYTHON, Path(__file__).with_name("two_nodes.py")],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=environment | {"RAY_TMPDIR": folder, "RAY_USAGE_STATS_ENABLED": "0"},
        text=True,
    )
    with process:
        yield process
        linux = Path("/proc/self/environ").exists()
        assert not linux or _processes(folder)
        process.stdin.close()
        process.wait(60)
    for _ in range(600):
        if not _processes(folder):
            break
        time.sleep(0.05)
    assert _processes(folder) == []
    shutil.rmtree(folder)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory, starting):
    """What this machine alone makes of the grid, while Ray starts."""
    root = tmp_path_factory.mktemp("undisturbed")
    assert supervisor(root, GRID).run()
    return root


@pytest.fixture(scope="module")
def nodes(starting, undisturbed):
    """The address, and the numbers of the two raylets."""
    address, *raylets = starting.stdout.readline().split()
    return address, *map(int, raylets)


@pytest.fixture(scope="module")
def cluster(nodes, tmp_path_factory):
    with Cluster(nodes[0], tmp_path_factory.mktemp("store")) as found:
        yield found


def test_a_node_that_does_not_see_the_store_is_named(cluster, tmp_path):
    assert cluster.cpus == 2
    with ray_cluster.marked(tmp_path) as mark:
        assert cluster.look(mark) == 2
    for missing, why in ((mark, "another folder has this name there"), (mark / "x", "there is no such folder")):
        said = rf"--ray .*: node .* cannot work on the store {missing.parent}: {why}; each needs ppo-dap"
        with pytest.raises(InputError, match=said) as told:
            cluster.look(missing)
        assert "\n" not in str(told.value)


def test_the_mark_leaves_nothing_but_a_store(tmp_path):
    with ray_cluster.marked(tmp_path / "store") as mark:
        assert mark.is_file()
        assert open_store(tmp_path / "store")
    assert [path.name for path in (tmp_path / "store").iterdir()] == ["cells"]


def test_an_address_that_does_not_answer_is_told_soon(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(InputError, match=rf"--ray {address}: no Ray cluster answered within 0.5 s"):
            Cluster(address, tmp_path, wait=0.5)


def test_what_ray_says_of_an_address_is_told_in_one_line(tmp_path, monkeypatch):
    (tmp_path / "ray.py").write_text("def init(*what, **how):\n    raise ConnectionError('versions\\n  differ')\n")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    with pytest.raises(InputError, match=r"^--ray host:6379: versions differ$"):
        Cluster("host:6379", tmp_path)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--ray", "ray://host:10001"], "--ray ray://host:10001: must be HOST:PORT, auto or local"),
        (["--ray", "host:6379"], "--ray needs the extra `ray`: pip install ppo-dap[ray]"),
        (["--ray", "host:6379", "--dry-run"], "--ray runs cells, --dry-run and --draw run none"),
        (["--ray", "host:6379", "--draw"], "--ray runs cells, --dry-run and --draw run none"),
    ],
)
def test_what_ray_cannot_do_is_told_in_one_line(tmp_path, monkeypatch, capsys, options, said):
    monkeypatch.setitem(sys.modules, "ray", None)  # as if it were not installed
    assert main(["study", "smoke", "--store", str(tmp_path / "new"), *options]) == 2
    told = capsys.readouterr()
    assert said in told.err
    assert len(told.err.splitlines()) == 1
    assert not (tmp_path / "new").exists()


def test_a_long_error_becomes_one_line():
    assert one_line(RuntimeError("one\n  two")) == "one two"
    assert len(one_line(RuntimeError("word " * 1000))) < 210


def test_a_worker_finds_our_environment_and_tells_how_it_ended(cluster, tmp_path, monkeypatch):
    out = tmp_path / "environment"
    code = "import json, os, sys; json.dump(dict(os.environ), open(sys.argv[1], 'w')); sys.exit('first\\nlast')"
    assert cluster.launch(["anything", "-c", code, str(out)]).ended.result(60) == (1, "last")
    found = json.loads(out.read_text())
    assert found["NPROC"] == "1"
    assert "OMP_NUM_THREADS" not in found or "OMP_NUM_THREADS" in os.environ
    here = [os.path.abspath(folder) for folder in os.environ.get("PYTHONPATH", "").split(os.pathsep) if folder]
    assert found.get("PYTHONPATH", "").split(os.pathsep) == (here or [""])
    killed = cluster.launch(["", "-c", "import os; os.kill(os.getpid(), 9)"])
    assert killed.ended.result(60) == (-9, "")
    assert cluster.launch(["", "-c", "\0"]).ended.result(60) == (1, "ValueError: embedded null byte")


def test_the_command_makes_cells_on_the_cluster(cluster, tmp_path, monkeypatch, capsys):
    def one(scale):
        """A stub."""
        return study(base()).entries

    launched, launch = [], cluster.launch
    monkeypatch.setattr(cluster, "launch", lambda command: launched.append(command) or launch(command))
    monkeypatch.setattr(ray_cluster, "Cluster", lambda address, root: contextlib.nullcontext(cluster))
    monkeypatch.setattr(supervise, "Supervisor", functools.partial(supervise.Supervisor, command=COMMAND, poll=0.05))
    monkeypatch.setattr("ppo_dap.commands.studies._speed", lambda task: 10_000.0)
    monkeypatch.setattr("ppo_dap.commands.studies._show", lambda *what: None)
    monkeypatch.setitem(STUDIES, "one", one)
    assert main(["study", "one", "--store", str(tmp_path), "--ray", "host:6379"]) == 0
    assert "with 2 workers" in capsys.readouterr().out
    assert len(launched) == 1
    monkeypatch.delattr(ray_cluster, "Cluster")  # with nothing to do, nobody is asked
    assert main(["study", "one", "--store", str(tmp_path), "--ray", "host:6379"]) == 0


def test_ctrl_c_ends_workers_on_nodes_and_frees_their_cells(cluster, tmp_path, capsys):
    cell, other = base(slow=60.0), base(1, slow=60.0)
    one = supervisor(tmp_path, study(cell, other), workers=3, launch=cluster.launch)
    one._start_some()
    for each in (cell, other):
        while not (one.store.out(each) / "table").exists():
            time.sleep(0.02)
    waiting = cluster.launch(["", "-c", "print()"])  # both CPUs are taken: it never begins
    one.running[base(2)] = waiting
    one._stop()
    for each in (cell, other):
        assert [row["end"] for row in one.store.attempts(each.name)] == ["stopped"]
        assert Watch().free(one.store.folder(each)) == 2


def _kill_node(raylet, root, over, killed):
    """Once half of the cells are there: SIGKILL to a raylet and all that it started, its workers' workers excepted."""
    while not over.is_set():
        time.sleep(0.01)
        if len(list(root.glob("cells/*/done.json"))) < 3:
            continue
        for claim in root.glob("cells/*/claim-*"):
            with contextlib.suppress(OSError, ValueError, KeyError):
                lines, pid = (
                    (claim.parent / "out" / "table").read_text().count("\n"),
                    json.loads(claim.read_text())["pid"],
                )
                if 1 <= lines <= 3 and _parent(_parent(pid)) == raylet:
                    doomed = [raylet, *_children(raylet)]
                    for process in doomed:
                        os.kill(process, signal.SIGKILL)
                    killed.append((claim.parent, pid))
                    return


def test_a_study_outlives_a_node(nodes, cluster, undisturbed, tmp_path, capsys):
    over, killed = threading.Event(), []
    killer = threading.Thread(target=_kill_node, args=(nodes[2], tmp_path, over, killed))
    killer.start()
    complete = supervisor(tmp_path, GRID, workers=cluster.cpus, launch=cluster.launch).run()
    over.set()
    killer.join()
    assert complete
    assert made(tmp_path) == [1] * 6
    assert contents(tmp_path) == contents(undisturbed)
    ((folder, pid),) = killed
    assert _ps("stat", pid)[:1] in ("", "Z")  # it noticed that who started it is gone
    assert (folder / "made").read_text() > "0"  # begun again from its checkpoint
    assert "its worker was killed (" in capsys.readouterr().out


def test_workers_end_with_their_planner_and_one_without_a_cluster_goes_on(cluster, tmp_path, capsys):
    cell = base(slow=0.4)
    one = supervisor(tmp_path, study(cell), launch=cluster.launch)
    one._start_some()
    while not (one.store.out(cell) / "last.safetensors").exists():
        time.sleep(0.02)
    cluster._agent.stdin.close()  # as the system does when a planner is killed
    assert supervisor(tmp_path, study(cell)).run()
    assert [row["end"] for row in one.store.attempts(cell.name)] == ["done"]
    assert (one.store.folder(cell) / "made").read_text() > "0"


def test_a_planner_that_has_lost_its_own_node_says_so(nodes, tmp_path, capsys):
    with Cluster(nodes[0], tmp_path) as cluster:
        one = supervisor(tmp_path, study(base(slow=60.0)), launch=cluster.launch)
        one._start_some()
        os.kill(nodes[1], signal.SIGKILL)
        for again in (one, supervisor(tmp_path, study(base(1)), launch=cluster.launch)):
            with pytest.raises(PPODAPError, match=r"the Ray cluster at .* is gone: call again"):
                again.run()
            again._stop()  # of no effect
