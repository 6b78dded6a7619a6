"""The store and who fills it: real processes, a stub for the work; kills, failures, two planners at once."""

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import threading
import time

import pytest

from ppo_dap.errors import InputError
from ppo_dap.study.store import supervise
from ppo_dap.study.store.claims import Watch, take
from ppo_dap.study.store.plan import Plan
from ppo_dap.study.store.store import Store, open_store
from ppo_dap.study.store.supervise import Supervisor
from study.store.store_made import COMMAND, ENVIRONMENT, base, contents, made, small_grid, study, supervisor, target

GRID = small_grid(slow=0.05)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """A store that one supervisor filled."""
    root = tmp_path_factory.mktemp("undisturbed")
    assert supervisor(root, GRID).run()
    return root


def test_a_study_is_made_in_order_and_once(undisturbed, capsys):
    assert made(undisturbed) == [1] * 10
    assert not list(undisturbed.rglob("claim-*"))
    again = supervisor(undisturbed, GRID, command=("false",))
    assert not again.open
    assert again.run()
    order = supervisor(undisturbed, GRID).plan.cells
    assert all(order.index(need) < order.index(cell) for cell in order for need in cell.needs.values())


def test_a_worker_refuses_a_cell_whose_needs_are_missing(tmp_path, capsys):
    """The planted fault of the order: without it the stub has nothing to read."""
    store, cell = Store(tmp_path), target(0, base())
    store.prepare(cell)
    done = subprocess.run([*COMMAND, str(tmp_path), cell.name, "1"], capture_output=True, text=True)
    assert done.returncode == 1
    assert "FileNotFoundError" in done.stderr.splitlines()[-1]


def test_two_planners_share_the_work(tmp_path, undisturbed, monkeypatch, capsys):
    both = [supervisor(tmp_path, GRID, workers=2) for _ in range(2)]
    started = []
    start = Supervisor._start
    monkeypatch.setattr(Supervisor, "_start", lambda self, *cell: (started.append(id(self)), start(self, *cell)))
    threads = [threading.Thread(target=one.run) for one in both]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(len(one.done) == 10 and not one.failed for one in both)
    assert made(tmp_path) == [1] * 10
    assert contents(tmp_path) == contents(undisturbed)
    assert len(set(started)) == 2


def test_without_claims_work_is_done_twice(tmp_path, monkeypatch, capsys):
    """The planted fault of the test above: workers that find every cell free."""
    script = tmp_path / "careless.py"
    script.write_text(
        "import sys; from pathlib import Path; from study.store import stub_worker\n"
        "from ppo_dap.study.store import worker\n"
        "from ppo_dap.study.store.claims import Claim\n"
        "def take(folder, number):\n"
        "    (folder / f'claim-{number}').touch()\n"
        "    return Claim(folder, number)\n"
        "worker.take = take; worker.Store.done = lambda self, name: False\n"
        "sys.exit(worker.main(make=stub_worker.make))\n"
    )
    root, cell = tmp_path / "store", base()
    Store(root).prepare(cell)
    for _ in range(2):
        command = [sys.executable, str(script), str(root), cell.name, "1"]
        subprocess.run(command, check=True, timeout=60, env=ENVIRONMENT)
    assert made(root) == [2]


def _kill_some(root, times, seed, over):
    """Kill `times` workers in `root`, each when its cell has a random number of lines, until `over` is set."""
    rng, killed = random.Random(seed), set()
    wanted = rng.randrange(4)
    while len(killed) < times and not over.is_set():
        time.sleep(rng.uniform(0.0, 0.02))
        for claim in root.rglob("claim-*"):
            with contextlib.suppress(OSError, ValueError, KeyError):
                pid, table = json.loads(claim.read_text())["pid"], claim.parent / "out" / "table"
                lines = table.read_text().count("\n") if table.exists() else 0
                if pid not in killed and lines >= wanted:  # one that is dead is a zombie for a moment
                    os.kill(pid, signal.SIGKILL)
                    killed.add(pid)
                    wanted = rng.randrange(4)
                    break
    return len(killed)


def test_ten_kills_leave_no_trace(tmp_path, undisturbed, capsys):
    over, killed = threading.Event(), []
    killer = threading.Thread(target=lambda: killed.append(_kill_some(tmp_path, 10, 0, over)))
    killer.start()
    complete = supervisor(tmp_path, GRID).run()
    over.set()
    killer.join()
    assert complete
    assert killed == [10]
    assert contents(tmp_path) == contents(undisturbed)
    assert "its worker was killed (SIGKILL), goes on" in capsys.readouterr().out


def test_a_stale_claim_is_taken_over_from_the_last_checkpoint(tmp_path, undisturbed, capsys):
    store, cell = Store(tmp_path), base(slow=0.05)
    store.prepare(cell)
    (store.out(cell)).mkdir()
    lines = (undisturbed / "cells" / cell.name / "out" / "table").read_text().splitlines()
    (store.out(cell) / "table").write_text("\n".join([*lines[:3], lines[3][:7]]))  # cut off in its fourth line
    (store.folder(cell) / "claim-1").write_text(json.dumps({"host": "elsewhere", "pid": 1, "started": 1}))
    before = (store.out(cell) / "table").stat().st_size
    assert supervisor(tmp_path, study(cell), lease=0.3).run()
    assert before < (store.out(cell) / "table").stat().st_size
    assert (store.out(cell) / "table").read_text().splitlines() == lines


def test_a_live_claim_is_waited_for(tmp_path, capsys):
    store, cell = Store(tmp_path), base()
    store.prepare(cell)
    claim = take(store.folder(cell), 1)
    assert claim is not None
    one = supervisor(tmp_path, study(cell), lease=60.0)
    thread = threading.Thread(target=one.run)
    thread.start()
    time.sleep(0.5)
    assert thread.is_alive()
    assert not one.running
    (store.out(cell)).mkdir()
    store.finish(cell.name)
    claim.remove()
    thread.join(20)
    assert not thread.is_alive()
    assert cell in one.done
    assert made(tmp_path) == []


def test_a_worker_that_was_taken_for_dead_ends_itself(tmp_path):
    store, cell = Store(tmp_path), base(slow=60.0)
    store.prepare(cell)
    code = (
        "import sys; from pathlib import Path; from study.store.stub_worker import make\n"
        "from ppo_dap.study.store.store import Store; from ppo_dap.study.store.worker import work\n"
        "sys.exit(work(Store(Path(sys.argv[1])), sys.argv[2], 1, make, 0.05))"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path), cell.name], env=ENVIRONMENT)
    while Watch().free(store.folder(cell)) == 1:
        assert process.poll() is None
        time.sleep(0.02)
    assert take(store.folder(cell), 2) is not None
    assert process.wait(30) == 5


def test_a_failed_cell_is_tried_twice_and_stops_nothing_else(tmp_path, capsys):
    bad, need = target(1, fails=True), base(fails=True, seed=7)
    grid = study(bad, target(2), target(3, need), target(4, base(1)))
    one = supervisor(tmp_path, grid)
    assert not one.run()
    assert {cell.settings.get("seed") for cell in one.failed} == {1, 7}
    assert len(one.done) == 3
    assert [cell.settings["seed"] for cell in one.blocked()] == [3]
    assert one.failed[bad] == "ValueError: by anyone"
    assert len(Store(tmp_path).failures(bad.name)) == 2
    assert "FAILED: ValueError: by anyone" in capsys.readouterr().out
    again = supervisor(tmp_path, study(bad))  # who comes back has mended something: two more
    assert not again.run()
    assert len(Store(tmp_path).failures(bad.name)) == 4


def test_a_cell_that_fails_once_is_made(tmp_path, capsys):
    cell = base(fails_once=True)
    assert supervisor(tmp_path, study(cell)).run()
    assert [row["end"] for row in Store(tmp_path).attempts(cell.name)] == ["failed", "done"]


def test_two_planners_try_a_failing_cell_twice_in_all(tmp_path, capsys):
    cell = base(fails=True)
    both = [supervisor(tmp_path, study(cell)) for _ in range(2)]
    threads = [threading.Thread(target=one.run) for one in both]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(Store(tmp_path).failures(cell.name)) == 2
    assert all(cell in one.failed for one in both)


def test_a_worker_that_always_dies_is_given_up(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(supervise, "DEATHS", 4)
    cell = base(dies=True)
    one = supervisor(tmp_path, study(cell, target(1)))
    assert not one.run()
    assert one.failed == {cell: "its worker was killed 4 times (SIGKILL) and got no further"}
    assert len(one.done) == 1


def test_a_full_disk_is_told_in_one_line(tmp_path, capsys):
    one = supervisor(tmp_path, study(base(full=True)))
    assert not one.run()
    (error,) = one.failed.values()
    assert "No space left on device" in error
    assert "\n" not in error


def test_a_failure_that_cannot_be_noted_is_still_told(tmp_path, capsys):
    cell = base(fails=True)
    (tmp_path / "cells" / cell.name / "attempts.jsonl").mkdir(parents=True)  # as good as a disk without room
    one = supervisor(tmp_path, study(cell))
    one.store.__class__.attempts, before = (lambda self, name: []), Store.attempts
    try:
        assert not one.run()
        assert one.failed[cell] == "ValueError: by anyone"
    finally:
        Store.attempts = before


@pytest.mark.parametrize("ignored", [False, True])
def test_ctrl_c_ends_the_workers_and_frees_their_cells(tmp_path, capsys, ignored):
    cell = base(slow=60.0)
    one = supervisor(tmp_path, study(cell))
    # What a script starts in its background ignores the signal, and so does what that starts.
    before = signal.signal(signal.SIGINT, signal.SIG_IGN if ignored else signal.default_int_handler)
    try:
        one._start_some()
    finally:
        signal.signal(signal.SIGINT, before)
    while not (one.store.out(cell) / "table").exists():  # its claim is there before it is ready to note anything
        time.sleep(0.02)
    one._stop()
    assert [row["end"] for row in one.store.attempts(cell.name)] == ["stopped"]
    assert Watch().free(one.store.folder(cell)) == 2


def test_workers_end_with_their_planner_and_another_goes_on(tmp_path, capsys):
    cell = base(slow=0.3)
    code = (
        "import sys; from pathlib import Path; from study.store.store_made import *\n"
        "supervisor(Path(sys.argv[1]), study(base(slow=0.3))).run()"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    planner = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=ENVIRONMENT)
    store = Store(tmp_path)
    while not (store.out(cell) / "last.safetensors").exists():
        assert planner.poll() is None
        time.sleep(0.02)
    planner.kill()
    planner.wait()
    assert supervisor(tmp_path, study(cell)).run()
    assert len((store.out(cell) / "table").read_text().splitlines()) == 5
    assert [row["end"] for row in store.attempts(cell.name)] == ["done"]
    assert made(tmp_path) == [1]


def test_memory_is_the_workers_own():
    code = "from ppo_dap.study.store.worker import peak_mib; {}; print(peak_mib())"
    held = bytearray(400 * 2**20)  # by the process that starts the others
    small, large = (
        float(subprocess.run([sys.executable, "-c", code.format(what)], capture_output=True, text=True).stdout)
        for what in ("pass", "b = bytearray(b'1') * 300 * 2**20")
    )
    assert len(held) > 2**20 * small
    assert 290 < large - small < 310


def test_what_a_kill_left_half_written_is_removed(tmp_path):
    store, cell = Store(tmp_path), base()
    store.prepare(cell)
    (store.out(cell)).mkdir()
    (store.out(cell) / ".table.abcd.partial").touch()
    store.finish(cell.name)
    assert store.done(cell)
    assert not list(store.out(cell).iterdir())


def test_a_changed_default_is_told(tmp_path):
    cell = target(0, gamma=0.99)
    Store(tmp_path).prepare(cell)
    changed = target(0, gamma=0.9)
    changed.__dict__["name"] = cell.name  # as it is if 0.9 has become the default
    Plan(study(cell), Store(tmp_path), lambda task: 1.0).done  # noqa: B018 (it checks)
    with pytest.raises(InputError, match=r"was made with gamma 0.99, and gamma is 0.9 now: name another store"):
        Plan(study(changed), Store(tmp_path), lambda task: 1.0).done  # noqa: B018


def test_a_damaged_cell_is_told(tmp_path):
    cell = target(0)
    Store(tmp_path).prepare(cell)
    (Store(tmp_path).folder(cell) / "cell.json").write_text('{"kind"')
    with pytest.raises(InputError, match=r"cell.json is missing or damaged .* remove its folder"):
        Store(tmp_path).check(cell)


def test_a_folder_with_other_things_is_no_store(tmp_path):
    (tmp_path / "notes.txt").touch()
    for place, message in ((tmp_path, "other files in it"), (tmp_path / "notes.txt", "is a file: name a folder")):
        with pytest.raises(InputError, match=message):
            open_store(place)
    assert open_store(tmp_path / "new").free_bytes() > 0
