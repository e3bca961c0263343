import multiprocessing

import pytest
import torch

pytest.register_assert_rewrite("runs")

from runs import MODULES, Process, flags  # noqa: E402


@pytest.fixture(autouse=True)
def one_thread_and_nothing_left():
    """One thread is for `-n 2` on two cores: a test may set another number. A test that fails leaves no run behind."""
    torch.set_num_threads(1)
    yield
    for process in multiprocessing.active_children():
        process.kill()


@pytest.fixture(scope="session", params=MODULES)
def script(request):
    return request.param


@pytest.fixture(scope="session")
def reference(script, tmp_path_factory):
    """A run that was left alone; its directory, which no test changes."""
    path = tmp_path_factory.mktemp(script)
    run = Process(script, flags(script, path / "run"), path / "output")
    assert run.wait() == 0, run.stderr
    return path / "run"
