import dataclasses
import json

import jax
import numpy as np
import pytest
import safetensors.numpy

from ppo_dap.errors import InputError
from ppo_dap.priors.prior import Prior, load_prior


def saved(prior, folder):
    path = folder / "prior"
    path.unlink(missing_ok=True)  # it may be one that a test has damaged
    prior.save(path)
    return path


def rewritten(path, header=None, drop=None, **changes):
    """The file with its header replaced or changed, or with an array dropped."""
    with safetensors.safe_open(path, framework="numpy") as file:
        ((name, text),) = file.metadata().items()
    tensors = safetensors.numpy.load(path.read_bytes())
    tensors.pop(drop, None)
    header = json.dumps({**json.loads(text), **changes}) if header is None else header
    path.write_bytes(safetensors.numpy.save(tensors, {name: header}))
    return path


def test_a_loaded_prior_is_the_same_prior(every_prior, tmp_path):
    loaded = load_prior(saved(every_prior, tmp_path))
    assert isinstance(loaded, Prior)
    states = np.random.default_rng(0).standard_normal((7, 2))
    np.testing.assert_array_equal(
        loaded.sample(states, jax.random.key(1), 5), every_prior.sample(states, jax.random.key(1), 5)
    )
    for field in dataclasses.fields(every_prior):
        if field.name != "network":
            np.testing.assert_equal(getattr(loaded, field.name), getattr(every_prior, field.name))


def test_save_writes_exactly_the_path_and_nothing_else(every_prior, tmp_path):
    path = saved(every_prior, tmp_path / "new" / "folder")
    first = path.read_bytes()
    every_prior.save(str(path))
    assert path.read_bytes() == first
    assert [p.name for p in path.parent.iterdir()] == ["prior"]


def test_a_failed_save_leaves_the_old_file(prior, tmp_path, monkeypatch):
    path = saved(prior, tmp_path)
    first = path.read_bytes()

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(InputError, match=r"cannot write prior .*: No space left on device"):
        prior.save(path)
    assert path.read_bytes() == first
    assert [p.name for p in tmp_path.iterdir()] == ["prior"]


def refuse(path, message):
    with pytest.raises(InputError, match=message) as caught:
        load_prior(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_missing_file_and_folder(tmp_path):
    refuse(tmp_path / "none", "no prior file at")
    refuse(tmp_path, "no prior file at")


def test_damaged_files(prior, tmp_path):
    path = saved(prior, tmp_path)
    whole = path.read_bytes()
    for size in (0, 5, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        refuse(path, "is not a whole prior file")
    path.write_text("not a prior at all, just some text that goes on for a while")
    refuse(path, "is not a whole prior file")


def test_other_safetensors_file(tmp_path):
    path = tmp_path / "other.safetensors"
    path.write_bytes(safetensors.numpy.save({"a": np.zeros(3)}))
    refuse(path, "is not a prior file but a foreign")


def test_newer_format(prior, tmp_path):
    refuse(rewritten(saved(prior, tmp_path), format=99), "format 99")


def test_older_format(prior, tmp_path):
    refuse(rewritten(saved(prior, tmp_path), format=1), "older ppo-dap: fit the prior again")


def test_missing_or_misshapen_arrays(prior, tmp_path):
    refuse(rewritten(saved(prior, tmp_path), drop="network.out.weight"), "nothing for network.out.weight")
    refuse(rewritten(saved(prior, tmp_path), drop="action_low"), "action_low is missing")


def test_another_kinds_arrays_are_refused(prior, tmp_path):
    refuse(
        rewritten(saved(prior, tmp_path), prior="flow", config={}), "nothing for network.state_net|where .* is needed"
    )


def test_unreadable_header(prior, tmp_path):
    for header in ("{", "[]", "{}", '{"format": "one"}', '{"format": 1, "kind": "policy"}'):
        refuse(rewritten(saved(prior, tmp_path), header), "is not a (whole )?prior file")
    refuse(rewritten(saved(prior, tmp_path), prior="oracle"), "unknown prior kind 'oracle'")
    refuse(rewritten(saved(prior, tmp_path), config={"widht": 3}), "damaged.*widht")


def test_wrong_sizes_are_refused(prior):
    with pytest.raises(InputError, match=r"observations have shape \(4, 3\): this prior takes \(n, 2\)"):
        prior.sample(np.zeros((4, 3)), jax.random.key(0), 2)
    with pytest.raises(InputError, match="fitted with condition_on 'return'; this one was not"):
        prior.sample(np.zeros((4, 2)), jax.random.key(0), 2, asked="top")
    with pytest.raises(InputError, match="observations have NaN or infinite entries"):
        prior.sample(np.full((4, 2), np.nan), jax.random.key(0), 2)
    with pytest.raises(InputError, match="num must be a whole number of 0 or more, not -1"):
        prior.sample(np.zeros((4, 2)), jax.random.key(0), -1)


def test_a_prior_is_written_over_a_prior_alone(prior, tmp_path):
    path = saved(prior, tmp_path)
    prior.save(path)
    for content in (b"logs", b"", b"PK\x03\x04 and more"):
        path.write_bytes(content)
        with pytest.raises(InputError, match="prior is there already and is no prior: name a new file"):
            prior.save(path)
        assert path.read_bytes() == content
