"""Grids for the tests of tables."""

import dataclasses

import pytest

from ppo_dap.study.store.studies import SMOKE, STUDIES, make_study
from ppo_dap.study.tables import effects
from study.results_made import Light


@pytest.fixture(scope="module")
def studies():
    """Grids as they are declared; what a command declares is compared with these as well."""
    tiny = {f.name: getattr(SMOKE, f.name) for f in dataclasses.fields(SMOKE)}
    found = {name: make_study(name, scale=Light()) for name in STUDIES}
    found["smoke"] = make_study("smoke", scale=Light(**tiny))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(effects, "make_study", found.__getitem__)
        yield found


@pytest.fixture
def smoke(studies):
    """All studies at once: one task, one preset, the ends of each axis."""
    return studies["smoke"]
