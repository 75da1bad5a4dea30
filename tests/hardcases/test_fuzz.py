"""Hostile COLMAP models, images, runs, requests and networks are read, or refused in one sentence. A hundred of each;
`python tests/hardcases/fuzz.py --inputs N` tries more."""

import sys

import pytest

from tests.hardcases.fuzz import KINDS, fuzz_all

INPUTS = {"run folder": 60}


@pytest.mark.skipif(sys.platform != "linux", reason="limits the memory of processes in the way of Linux")
@pytest.mark.parametrize("kind", KINDS)
def test_hostile_input_is_read_or_refused(kind):
    inputs = INPUTS.get(kind, 100)
    found, wrong = fuzz_all([kind], inputs, seed=0)
    assert not wrong, wrong[0]
    assert found[kind]["read"] + found[kind]["refused"] == inputs and found[kind]["refused"] > inputs // 4
