# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Damaged recordings of every storage: a report, or a refusal in one sentence. `test.lab.bag.fuzz` goes on for long."""

from __future__ import annotations

import pytest

from .fuzz import FORMS, bags, tried


@pytest.fixture(scope="module")
def intact(tmp_path_factory):
    return bags(tmp_path_factory.mktemp("intact"))


@pytest.mark.parametrize("form", range(len(FORMS)), ids=[f"{plugin.name}-{mode}" for plugin, mode in FORMS])
def test_a_damaged_recording_is_reported_or_refused_in_one_sentence(intact, form):
    for seed in range(form, 6 * len(FORMS), len(FORMS)):
        assert tried(intact[form], seed) == ""
