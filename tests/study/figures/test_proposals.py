"""Figure 11: which candidates are taken from a run, and what is drawn of them."""

import sys
from typing import Any, cast

import numpy as np
import pytest

from ppo_dap.errors import InputError
from ppo_dap.study.figures import proposals as proposal_figure
from ppo_dap.study.figures.proposals import high_q_shares, proposals_on, take_proposals, tsne
from ppo_dap.study.figures.studies import figures_of
from ppo_dap.study.results import Results
from ppo_dap.study.store.cells import Cell
from ppo_dap.study.store.grids import Entry, Study
from ppo_dap.study.store.store import Store


class Guided:
    """Two states with four candidates: Q is the first action, guidance adds 1 to it, weights take the best alone."""

    free = np.array(
        [[[0.1, 0.0], [0.2, 0.1], [0.3, 0.9], [0.4, 0.3]], [[2.0, 0.0], [1.0, 0.5], [0.0, 0.2], [4.0, 0.1]]]
    )

    def candidates(self, observations, guided, seed):
        return self.free + (np.array([1.0, 0.0]) if guided else 0.0)

    def q(self, observations, actions):
        return actions[..., 0]

    def energy_weights(self, q):
        return (q == q.max(1, keepdims=True)).astype(np.float32)

    def draw(self, weights, seed):
        return np.repeat(weights.argmax(1)[:, None], weights.shape[1], 1), {}


@pytest.fixture
def rows():
    return proposals_on(cast(Any, Guided()), np.zeros((2, 3)))


def test_a_row_is_a_candidate_of_one_kind(rows):
    assert [(row["state"], row["guided"]) for row in rows] == [(i, j) for i in (0, 1) for j in (0, 0, 0, 0, 1, 1, 1, 1)]
    # D_syn is four times the best of four, in each kind.
    assert [row["drawn"] for row in rows] == [0, 0, 0, 4, 0, 0, 0, 4] * 2
    for state in (0, 1):
        own = np.array([row["q"] for row in rows if row["state"] == state])
        values = np.concatenate([Guided.free[state, :, 0], Guided.free[state, :, 0] + 1])
        assert own == pytest.approx((values - values.mean()) / values.std(), abs=1e-4)
    assert len({(row["x"], row["y"]) for row in rows}) == len(rows)


def test_shares_of_high_q_are_those_of_what_d_syn_holds(rows):
    # State 0: unguided 0.1 to 0.4, whose 90th percentile is 0.37; guided all above. State 1: 3.4; of 1 to 5 one is.
    assert high_q_shares(rows) == {"no guidance": 2 / 8, "energy": 1.0, "energy + gradient": 1.0}
    for row in rows:
        row["drawn"] = 1
    assert high_q_shares(rows) == {"no guidance": 2 / 8, "energy": 2 / 8, "energy + gradient": 5 / 8}


def test_neighbours_stay_neighbours():
    rng = np.random.default_rng(0)
    actions = np.concatenate([rng.normal(place, 0.05, (12, 3)) for place in (-1.0, 1.0)])
    found = tsne(actions)
    centres = found[:12].mean(0), found[12:].mean(0)
    nearer = [np.argmin([np.linalg.norm(point - centre) for centre in centres]) for point in found]
    assert nearer == [0] * 12 + [1] * 12


def test_without_scikit_learn_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "sklearn.manifold", None)
    with pytest.raises(InputError, match=r"ppo-dap\[figures\]"):
        tsne(np.zeros((4, 2)))


def study(*seeds):
    prior = Cell("prior", {"kind": "diffusion"})
    cells = [Cell("run", {"task": "Hopper-v5", "seed": seed}, {"prior": prior}) for seed in seeds]
    how = {"study": "fig11", "arm": "PPO-DAP", "task": "Hopper-v5"}
    return Study("fig11", "", 40.0, tuple(Entry(cell, how | {"seed": cell.settings["seed"]}) for cell in cells))


def test_the_figure_has_a_panel_a_kind_of_guidance(rows):
    grid = study(0)
    results = Results(proposals={grid.entries[0].cell.name: rows})
    free, energy, both = figures_of(results, grid)["fig11"].axes[:3]
    assert [axes.get_title() for axes in (free, energy, both)] == [
        "no guidance: 25% high Q",
        "energy: 100% high Q",
        "energy + gradient: 100% high Q",
    ]
    for axes, guided, drawn in ((free, 0, 0), (energy, 0, 4), (both, 1, 4)):
        own = [row for row in rows if row["guided"] == guided and row["drawn"] >= drawn]
        places = sorted(map(tuple, axes.collections[0].get_offsets().tolist()))
        assert np.array(places) == pytest.approx(np.array(sorted((row["x"], row["y"]) for row in own)))
        assert sorted(axes.collections[0].get_array()) == pytest.approx(sorted(row["q"] for row in own))
    assert sum(width > 0 for width in free.collections[0].get_linewidths()) == 2
    assert energy.collections[0].get_sizes() == pytest.approx([28, 28])


def test_candidates_are_taken_once_from_the_first_seed_that_is_done(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(proposal_figure, "proposals_of", lambda folder, prior: asked.append((folder, prior)) or ["row"])
    store, grid = Store(tmp_path), study(0, 2, 1)
    assert take_proposals(store, grid, Results()).proposals == {}
    for entry in grid.entries[1:]:
        store.folder(entry.cell).mkdir(parents=True)
        store.finish(entry.cell.name)
    results = take_proposals(store, grid, Results())
    first = grid.entries[2].cell
    assert results.proposals == {first.name: ["row"]}
    assert asked == [(store.out(first), store.artefact(first.needs["prior"]))]
    assert take_proposals(store, grid, results).proposals == {first.name: ["row"]}
    assert len(asked) == 1
