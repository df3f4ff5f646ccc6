"""Kept results are read back as they were, and a file from elsewhere runs nothing."""

from __future__ import annotations

import os
import pickle
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import kept
from benchmarks.undeclared_reference import Driven
from whill_mjx.vehicle.presets import preset

pytestmark = pytest.mark.quick


def test_records_and_arrays_come_back_as_they_were():
    spec, params = preset("whill_cr_physical")
    value = {"driven": Driven(noise=2.0), "vehicle": (spec, params), "table": np.arange(6.0).reshape(2, 3),
             "scalar": np.float64(3.0), "jax": jnp.arange(3), "none": None, "text": ("a", True)}  # fmt: skip
    again = kept.loads(kept.dumps(value))
    assert again["driven"] == value["driven"] and again["vehicle"][0] == spec and again["text"] == ("a", True)
    jax.tree.map(np.testing.assert_array_equal, again["vehicle"][1], params)
    np.testing.assert_array_equal(again["table"], value["table"])
    np.testing.assert_array_equal(again["jax"], value["jax"])


class Runs:
    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("function, arguments", [
    (os.system, ("touch ran",)), (eval, ("open('ran', 'w')",)), (Path.touch, (Path("ran"),)),
    (getattr, (Driven, "tag")),
])  # fmt: skip
def test_a_file_that_would_run_something_is_refused(function, arguments, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(kept.KeptError, match="is no record of this project"):
        kept.loads(pickle.dumps(Runs(function, *arguments)))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("data", [b"", b"\x80", b"not a pickle", kept.dumps(np.arange(9.0))[:-20]])
def test_a_damaged_file_is_refused(data):
    with pytest.raises(kept.KeptError):
        kept.loads(data)
