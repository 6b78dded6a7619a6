"""One core for each run, claimed by a lock that no kill can leave behind."""

import os
import subprocess
import sys

import pytest

from ppo_dap.training.cores import pinned

pytestmark = pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system has no affinities")

HOLDER = """
import os, sys
from ppo_dap.training.cores import pinned
def show(*more):
    print(*more, sorted(os.sched_getaffinity(0)), flush=True)
os.sched_setaffinity(0, eval(sys.argv[1]))
show()
try:
    with pinned(True) as core:
        show(core)
        if sys.stdin.readline() == "fail\\n":
            raise OSError
except OSError:
    pass
show()
"""


@pytest.fixture
def hold(tmp_path):
    """Start a process that may use the given cores and takes one of them; its claims are apart from real runs'."""
    started = []

    def start(cores):
        process = subprocess.Popen(
            [sys.executable, "-c", HOLDER, repr(set(cores))],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"TMPDIR": str(tmp_path)},
        )
        started.append(process)
        assert process.stdout.readline() == f"{sorted(cores)}\n"
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


def held(process):
    """The core that a holder got, and the cores that it may run on."""
    core, cores = process.stdout.readline().split(maxsplit=1)
    return None if core == "None" else int(core), eval(cores)


def released(process, line="done\n"):
    """The cores that a holder may run on when it has let go."""
    return eval(process.communicate(line, timeout=60)[0])


@pytest.fixture
def cores():
    return sorted(os.sched_getaffinity(0))


def holding(hold, cores):
    """A holder that has got what it gets, and what that is."""
    process = hold(cores)
    return process, held(process)


def test_two_runs_get_different_cores_as_far_as_there_are(hold, cores):
    first, got = holding(hold, cores)
    assert got == (cores[0], cores[:1])
    second, got = holding(hold, cores)
    assert got == ((cores[1], cores[1:2]) if len(cores) > 1 else (None, cores))
    assert released(first) == released(second) == cores


def test_where_one_core_is_allowed_the_second_gets_none(hold, cores):
    only = cores[:1]
    first, got = holding(hold, only)
    assert got == (only[0], only)
    second, got = holding(hold, only)
    assert got == (None, only)
    assert released(second) == released(first) == only
    assert holding(hold, only)[1] == (only[0], only)  # free again


def test_an_error_lets_go_too(hold, cores):
    process, got = holding(hold, cores)
    assert got == (cores[0], [cores[0]])
    assert released(process, "fail\n") == cores
    assert holding(hold, cores)[1] == (cores[0], [cores[0]])


def test_a_killed_runs_claim_is_free_again(hold, cores):
    process, got = holding(hold, cores)
    assert got[0] == cores[0]
    process.kill()
    process.wait()
    assert holding(hold, cores)[1][0] == cores[0]


def test_a_run_that_does_not_want_to_be_pinned_is_not(cores):
    with pinned(False) as core:
        assert core is None
        assert sorted(os.sched_getaffinity(0)) == cores
