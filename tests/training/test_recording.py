"""The tables of a run folder, and what the terminal shows of a run."""

import json
import re

import pytest

from ppo_dap.training.recording import TABLES, Lines, Recorder, Silent, make_progress, read_table


def row(steps):
    return {"env_steps": steps, "iteration": steps // 10, "loss": steps / 7}


def fill(folder, metrics, evaluations):
    recorder = Recorder(folder, False)
    for table, count in (("metrics", metrics), ("evaluations", evaluations)):
        for number in range(count):
            recorder.add(table, row(10 * number))
    recorder.close()
    return {table: (folder / f"{table}.jsonl").read_bytes() for table in TABLES}


def test_a_resumed_run_keeps_exactly_the_lines_of_its_checkpoint(tmp_path):
    before = fill(tmp_path, 5, 3)
    with open(tmp_path / "metrics.jsonl", "a") as file:
        file.write('{"env_steps": 50, "lo')  # cut off by a kill
    recorder = Recorder(tmp_path, False, {"metrics": 3, "evaluations": 1})
    kept = {table: (tmp_path / f"{table}.jsonl").read_bytes() for table in TABLES}
    assert kept["metrics"] == b"".join(before["metrics"].splitlines(keepends=True)[:3])
    assert kept["evaluations"] == b"".join(before["evaluations"].splitlines(keepends=True)[:1])
    recorder.add("metrics", row(30))
    assert recorder.counts == {"metrics": 4, "evaluations": 1}
    recorder.add("metrics", row(40))
    for number in (10, 20):
        recorder.add("evaluations", row(number))
    recorder.close()
    assert {table: (tmp_path / f"{table}.jsonl").read_bytes() for table in TABLES} == before


def test_a_checkpoint_before_the_first_line_keeps_none(tmp_path):
    fill(tmp_path, 2, 1)
    Recorder(tmp_path, False, {"metrics": 0, "evaluations": 0}).close()
    assert read_table(tmp_path, "metrics") == read_table(tmp_path, "evaluations") == []


def test_a_new_run_starts_empty(tmp_path):
    fill(tmp_path, 2, 1)
    recorder = Recorder(tmp_path, False)
    recorder.close()
    assert recorder.counts == {"metrics": 0, "evaluations": 0}
    assert read_table(tmp_path, "metrics") == read_table(tmp_path, "evaluations") == []


def test_each_line_is_there_at_once(tmp_path):
    recorder = Recorder(tmp_path / "made" / "here", False)
    recorder.add("metrics", row(10))
    assert json.loads((tmp_path / "made" / "here" / "metrics.jsonl").read_text()) == row(10)
    recorder.close()


def test_a_cut_off_last_line_is_left_out(tmp_path):
    fill(tmp_path, 3, 0)
    path = tmp_path / "metrics.jsonl"
    whole = path.read_bytes()
    start = whole.rindex(b"{")
    for end in range(start, len(whole) - 1):
        path.write_bytes(whole[:end])
        assert read_table(tmp_path, "metrics") == [row(0), row(10)]
    path.write_bytes(whole)
    assert read_table(tmp_path, "metrics") == [row(0), row(10), row(20)]


def test_a_table_that_is_not_there_has_no_rows(tmp_path):
    assert read_table(tmp_path, "metrics") == []


@pytest.mark.parametrize(("total", "step", "done"), [(100_000, 500, 0), (100_000, 500, 50_000), (10, 1, 0), (99, 4, 8)])
def test_lines_are_few_and_hold_the_numbers(capsys, total, step, done):
    lines = Lines("task method seed 3", total, done)
    for steps in range(done + step, total + step, step):
        lines.update(steps, {"return": steps / 8 + 0.25, "steps_per_second": 1000.0})
    lines.close()
    captured = capsys.readouterr()
    assert captured.out == ""
    shown = captured.err.splitlines()
    assert 1 <= len(shown) <= 20 * (total - done) / total + 1
    assert len(shown) <= 20
    pattern = re.compile(
        r"task method seed 3: ([\d,]+)/([\d,]+) steps, return ([\d,.]+), 1,000 steps/s, ([\d,]+) s left"
    )
    for line in shown:
        steps, of, value, left = (float(n.replace(",", "")) for n in pattern.fullmatch(line).groups())
        assert of == total
        assert value == pytest.approx(steps / 8 + 0.25, abs=0.051)
        assert left == pytest.approx(max(total - steps, 0) / 1000, abs=0.5)
    assert float(shown[-1].split("/")[0].split(": ")[1].replace(",", "")) >= total


def test_lines_show_a_dash_for_what_is_not_known_yet(capsys):
    Lines("run", 100, 0).update(50, {"return": None, "steps_per_second": None})
    assert capsys.readouterr().err == "run: 50/100 steps, return -, 0 steps/s, 0 s left\n"


def test_no_progress_shows_nothing_and_a_pipe_gets_lines(capsys):
    silent = make_progress("run", 100, 0, False)
    assert isinstance(silent, Silent)
    silent.update(100, {"return": 1.0, "steps_per_second": 1.0})
    silent.close()
    assert isinstance(make_progress("run", 100, 0, True), Lines)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("wanted", [True, False])
def test_tensorboard_is_written_when_asked_for(tmp_path, wanted):
    recorder = Recorder(tmp_path, wanted)
    recorder.add("metrics", row(10))
    recorder.add("evaluations", row(20) | {"return_mean": 5.0})
    recorder.close()
    events = list(tmp_path.rglob("events.out.tfevents.*"))
    if not wanted:
        assert events == []
        assert sorted(path.name for path in tmp_path.iterdir()) == ["evaluations.jsonl", "metrics.jsonl"]
        return
    (file,) = events
    assert file.parent == tmp_path / "tensorboard"
    content = file.read_bytes()
    assert b"metrics/loss" in content
    assert b"evaluations/return_mean" in content
    assert b"env_steps" not in content
