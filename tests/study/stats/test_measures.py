import numpy as np
import pytest

from ppo_dap.study.stats.measures import alc, late_return


def rows(steps, returns):
    return [{"env_steps": s, "return_mean": r} for s, r in zip(steps, returns, strict=True)]


def test_alc_of_a_line_is_its_height_in_the_middle():
    assert alc(rows([0, 10_000, 30_000, 200_000], [0, 10, 30, 200])) == pytest.approx(100)


def test_alc_cuts_the_curve_at_its_horizon():
    # A step function's area by hand: 0 until 100k, 7 from there on, read between two points at the cut.
    curve = rows([0, 100_000, 100_001, 199_000, 203_000, 400_000], [0, 0, 7, 7, 7, 1e9])
    assert alc(curve) == pytest.approx(3.5, rel=1e-4)
    assert alc(curve, epochs=20.0002) == pytest.approx(0, abs=1e-3)


def test_alc_against_a_fine_sum():
    rng = np.random.default_rng(0)
    steps = np.sort(rng.choice(np.arange(1, 260_000), 50, replace=False))
    steps[0], returns = 0, rng.normal(size=50)
    fine = np.linspace(0, 200_000, 2_000_001)
    assert alc(rows(steps, returns)) == pytest.approx(np.interp(fine, steps, returns).mean(), abs=1e-4)


def test_a_run_that_ends_too_early_has_no_alc():
    with pytest.raises(ValueError, match="end at 150000 steps, before 200000"):
        alc(rows([0, 150_000], [0, 1]))


def test_the_late_return_is_the_mean_over_the_last_tenth_of_the_steps():
    curve = rows([0, 89_999, 90_000, 95_000, 100_000], [0, 1e9, 1, 2, 6])
    assert late_return(curve) == 3.0
    assert late_return(curve[-1:]) == 6.0
    with pytest.raises(ValueError, match="without evaluations"):
        late_return([])
