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
