import sys
from types import ModuleType

import pytest


@pytest.fixture
def without_video(monkeypatch):
    """Gymnasium's MuJoCo tasks import a video writer at once that ppo-dap does not install: nothing here renders."""
    monkeypatch.setitem(sys.modules, "imageio", ModuleType("imageio"))
