"""What is kept of a store: the figures of its runs, unchanged by a way through the files."""

import json
import math

import pytest

from ppo_dap.errors import InputError
from ppo_dap.study.results import Results, gather, load_results
from ppo_dap.study.store import cells
from ppo_dap.study.store.store import Store
from study.store.store_made import study

EVALUATIONS = [
    {"env_steps": steps, "return_mean": value, "return_std": 1.0, "episodes": 1, "length_mean": 10.0 * i}
    for i, (steps, value) in enumerate(((0, 0.0), (2000, 100.0), (4000, 200.0), (6000, 100.0)))
]


def _metrics(iteration, **how):
    row = {"env_steps": 2000 * (iteration + 1), "iteration": iteration, "seconds_iteration": 2.0, "seconds_env": 1.0}
    return row | {"ratio_error": 0.0, "ess": 4.0, "spr": 1.0, "oglr": 0.0, "batch_fresh": 1.0} | how


@pytest.fixture
def store(tmp_path):
    """One finished run of five iterations, and one that is still to be made."""
    store = Store(tmp_path / "store")
    done, open_ = (cells.run("Pendulum-v1", "ppo", seed=seed, steps=8000) for seed in (0, 1))
    out = store.out(done)
    out.mkdir(parents=True)
    config = {"task": "Pendulum-v1", "method": "ppo", "preset": "paper", "prior_hash": None, "processor": "A processor"}
    config["config"] = {"pet_frequency": 0, "steps": 8000, "seed": 0}
    (out / "config.json").write_text(json.dumps(config))
    (out / "audit.json").write_text(json.dumps({"static": []}))
    rows = [
        _metrics(0, ess=None),
        _metrics(1, ess=2.0),
        _metrics(2, spr=0.5, oglr=0.25, batch_fresh=0.5, pgshare=0.5),
        _metrics(3, ess=math.nan, pgshare=1.0),
        _metrics(4, ess=None, seconds_iteration=600.0, seconds_env=599.0),  # somebody closed the lid
    ]
    (out / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (out / "evaluations.jsonl").write_text("".join(json.dumps(row) + "\n" for row in EVALUATIONS))
    store.finish(done.name)
    store.note(done.name, end="stopped", seconds=5.0, peak_mib=100.0)
    store.note(done.name, end="done", seconds=7.5, peak_mib=90.0)
    return store, done, open_


def test_figures_of_a_run_are_those_of_its_tables(store):
    store, done, open_ = store
    found = gather(store, [done, open_], Results())
    assert list(found.runs) == [done.name]
    row = found.runs[done.name]
    assert row["last_return"] == 100.0
    assert row["last_length"] == 30.0
    # Two iterations that count after those that compile, of 1 s of environments and 2 s in all.
    assert (row["env_steps"], row["seconds_env"], row["seconds_iteration"]) == (4000, 2.0, 4.0)
    assert row["ess"] == 3.0  # of 2 and 4: None and NaN are no values
    assert (row["spr"], row["oglr"], row["batch_fresh"], row["pgshare"]) == (0.5, 0.25, 0.5, 0.5)
    assert row["pgshare_mean"] == 0.75
    assert (row["seconds"], row["peak_mib"]) == (12.5, 100.0)
    assert (row["logs_hash"], row["processor"]) == ("", "A processor")
    # A claim is violated, by the third iteration, and the method does not declare it.
    assert (row["strictly_on_policy"], row["as_declared"]) == (False, False)


def test_rows_of_a_study_have_its_labels_and_the_area_at_its_t(store):
    store, done, open_ = store
    results = gather(store, [done, open_], Results())
    grid = study(done, open_)
    for entry in grid.entries:
        entry.labels.update(arm="PPO (mine)", part="early")
    ((row),) = results.rows(grid)
    assert (row["label"], row["run"], row["seed"]) == ("PPO (mine)", done.name, 0)
    # T of this study is 1 epoch, 5000 steps: trapezoids of 2000, 2000 and 1000 steps, the last one up to 150.
    assert row["alc"] == pytest.approx((2000 * 50 + 2000 * 150 + 1000 * 175) / 5000)
    assert results.rows(grid, part="full") == []
    results.curves[done.name] = results.curves[done.name][:2]
    assert results.rows(grid, part="early")[0]["alc"] is None


def test_files_hold_what_was_gathered(store, tmp_path):
    store, done, _ = store
    found = gather(store, [done], Results())
    # Names that look like numbers, and are none.
    found.runs["1234567890123456"] = found.runs[done.name] | {"options": "1"}
    found.curves["1234567890123456"] = found.curves[done.name]
    found.reports["12e4567890123456"] = {"of": done.name, "within.rho": -0.25, "states": 4, "fallback": None}
    found.proposals[done.name] = [{"state": 0, "guided": g, "drawn": 2, "q": -0.5, "x": 1.25, "y": 3.0} for g in (0, 1)]
    found.save(tmp_path / "results")
    again = load_results(tmp_path / "results")
    assert again == found
    assert load_results(tmp_path / "nothing") == Results()
    # What was gathered once is not read again: its folder may be gone.
    (store.out(done) / "metrics.jsonl").unlink()
    assert gather(store, [done], again) == found


def test_a_run_that_the_store_made_again_takes_the_old_ones_place(store, tmp_path):
    store, done, _ = store
    found = gather(store, [done], Results())
    found.reports["r"] = {"of": done.name, "states": 4}
    found.reports["s"] = {"of": "another", "states": 4}
    found.proposals[done.name] = [{"state": 0}]
    found.save(tmp_path / "results")
    # Another store has made the same cell, on another processor.
    other = Store(tmp_path / "other")
    other.out(done).mkdir(parents=True)
    for path in store.out(done).iterdir():
        (other.out(done) / path.name).write_text(path.read_text().replace("A processor", "Another"))
    other.finish(done.name)
    other.note(done.name, end="done", seconds=7.0, peak_mib=100.0)
    kept = gather(other, [done], load_results(tmp_path / "results"))
    assert (kept.runs[done.name]["processor"], kept.runs[done.name]["seconds"]) == ("Another", 7.0)
    # What was measured on the old one is none of the new one's.
    assert (list(kept.reports), kept.proposals) == (["s"], {})
    kept.save(tmp_path / "results")
    assert load_results(tmp_path / "results") == kept


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("runs.csv", "cell,seed\nab,1,2\n", "damaged at"),
        ("evaluations.csv", "cell,env_steps,return_mean\nab,1\n", "damaged at"),
        ("runs.csv", "cell,seed\nab,1\n", "one lacks ab"),
        ("reports.csv", 'cell,of\n"ab', "is damaged"),
        ("runs.csv", "task,seed\nab,1\n", "damaged at"),
    ],
)
def test_damaged_files_are_told(name, text, message, tmp_path):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message):
        load_results(tmp_path)
