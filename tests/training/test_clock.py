"""Seconds by name, and the profile that is made of them."""

import threading
import time

import jax.numpy as jnp
import pytest

from ppo_dap.training.clock import Clock, profile


@pytest.fixture
def clock():
    clock = Clock()
    yield clock
    clock.close()


def slow(x):
    time.sleep(0.05)
    return {"result": x + 1}


class Promise:
    """A result that is there `seconds` from now, as what a dispatched program gives."""

    def __init__(self, seconds):
        self.when = time.perf_counter() + seconds

    def block_until_ready(self):
        time.sleep(max(0.0, self.when - time.perf_counter()))


def test_the_time_of_a_stage_is_added_to_its_name(clock):
    for _ in range(2):
        assert float(clock.dispatch("a", slow, jnp.ones(()))["result"]) == 2
    start = time.perf_counter()
    clock.dispatch("b", lambda x: (x, x), jnp.ones(()))
    seconds = clock.turn()()
    assert seconds.keys() == {"a", "b"}
    assert seconds["a"] >= 0.1
    assert 0 < seconds["b"] <= time.perf_counter() - start


def test_stages_that_queue_up_share_the_time_and_dispatch_waits_for_none(clock):
    """Both dispatched at once; the second is begun when the first is done."""
    start = time.perf_counter()
    clock.dispatch("a", Promise, 0.4)
    clock.dispatch("b", Promise, 0.6)
    assert time.perf_counter() - start < 0.4
    seconds = clock.turn()()
    assert seconds["a"] >= 0.4
    assert 0.6 <= seconds["a"] + seconds["b"] <= time.perf_counter() - start


def test_a_stage_that_is_dispatched_late_does_not_count_the_time_before(clock):
    clock.dispatch("a", Promise, 0.0)
    time.sleep(0.4)
    start = time.perf_counter()
    clock.dispatch("b", Promise, 0.1)
    assert 0.1 <= clock.turn()()["b"] <= time.perf_counter() - start


def test_the_hosts_blocks_are_timed_and_seconds_can_be_added(clock):
    start = time.perf_counter()
    for _ in range(2):
        with clock.host("waiting"):
            time.sleep(0.05)
    clock.add("env", 1.5)
    clock.add("env", 0.25)
    seconds = clock.turn()()
    assert 0.1 <= seconds["waiting"] <= time.perf_counter() - start
    assert seconds["env"] == 1.75


def test_an_iteration_has_its_own_seconds_even_while_its_stages_run(clock):
    clock.dispatch("a", Promise, 0.2)
    first = clock.turn()
    clock.dispatch("b", Promise, 0.3)
    clock.add("env", 2.0)
    second = clock.turn()
    assert second().keys() == {"b", "env"}
    assert first().keys() == {"a"}


def test_close_ends_the_thread():
    before = threading.active_count()
    clock = Clock()
    clock.dispatch("a", Promise, 0.1)
    assert threading.active_count() == before + 1
    clock.close()
    assert threading.active_count() == before


def row(iteration, **seconds):
    return {"iteration": 1, "loss": 7.0} | {f"seconds_{k}": v for k, v in {"iteration": iteration, **seconds}.items()}


def test_a_profile_by_hand():
    host = {"env": 1.0, "policy": 0.5, "waiting": 0.25, "host": 0.125, "recording": 0.0}
    rows = [
        row(1000.0, env=1.0, update=900.0),  # compiles
        row(2.0, **host, gae=0.25, update=1.5, proposals=0.5),
        row(6.0, **{**host, "env": 4.0}, gae=0.25, update=0.5, proposals=1.5, pet=0.5),
        {"iteration": 4, "loss": 7.0},  # without seconds
    ]
    lines = profile(rows)
    assert [tuple(line) for line in lines] == [
        ("environment", False, 5.0, 5 / 8),
        ("policy", False, 1.0, 1 / 8),
        ("waiting for the actor", False, 0.5, 0.5 / 8),
        ("statistics, random numbers", False, 0.25, 0.25 / 8),
        ("recording", False, 0.0, 0.0),
        ("dispatch and the rest", False, 1.25, 1.25 / 8),
        ("GAE", True, 0.5, 0.5 / 8),
        ("actor, V and Q", True, 2.0, 2 / 8),
        ("proposals", True, 2.0, 2 / 8),
        ("PET", True, 0.5, 0.5 / 8),
        ("audits", True, 0.0, 0.0),
    ]
    assert sum(line.seconds for line in lines if not line.beside) == 2 + 6


def test_a_run_of_one_iteration_has_no_profile():
    assert profile([]) == profile([row(5.0, env=1.0)]) == []


def test_a_stage_that_fails_on_the_device_leaves_nobody_waiting(clock):
    class Failing:
        def block_until_ready(self):
            raise RuntimeError("the device is gone")

    clock.dispatch("a", Failing)
    assert clock.turn()().keys() == {"a"}
    clock.dispatch("b", Promise, 0.0)
    assert clock.turn()().keys() == {"b"}
