import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent.parent))
pytest.register_assert_rewrite("runs")

from runs import SCRIPTS, finish, flags  # noqa: E402


@pytest.fixture(autouse=True)
def one_thread():
    """For `-n 2` on two cores. A test may set another number."""
    torch.set_num_threads(1)


@pytest.fixture(scope="session", params=SCRIPTS)
def script(request):
    return request.param


@pytest.fixture(scope="session")
def reference(script, tmp_path_factory):
    """A run that was left alone; its directory, which no test changes."""
    path = tmp_path_factory.mktemp(script)
    finish(script, [*flags(script, path / "run"), *several(script)], path / "output")
    return path / "run"


def several(script):
    """SAC's runs have three environments."""
    return ["--num-envs", "3"] if script == "sac_minitaur" else []
