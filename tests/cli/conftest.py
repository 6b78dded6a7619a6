import pytest

from cli.cli_made import write_logs, write_priors, write_runs


@pytest.fixture(scope="session")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    write_logs(folder)
    write_priors(folder)
    write_runs(folder)
    return folder


@pytest.fixture
def here(tmp_path, monkeypatch):
    """The working folder, empty: a file that is written anywhere but where it should is seen."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def nothing_is_learned(monkeypatch):
    """Whatever gets as far as a fit or a run fails the test."""
    import ppo_dap.priors.fit
    import ppo_dap.training.run

    def too_far(*arguments, **options):
        raise AssertionError("it was not refused before the learning")

    monkeypatch.setattr(ppo_dap.priors.fit, "train_network", too_far)
    monkeypatch.setattr(ppo_dap.training.run, "_make_trainer", too_far)
