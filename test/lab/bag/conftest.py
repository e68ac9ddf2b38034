# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A synthetic recording: its arrays, its messages, and a bag of them."""

import pytest

from ...support import synthetic_bags as made


@pytest.fixture(scope="module")
def recording():
    return made.trial(made.POSES, hold=2.0, rate=200.0)


@pytest.fixture(scope="module")
def content(recording):
    return list(made.messages(recording))


@pytest.fixture
def bag(content, tmp_path):
    return made.write_bag(tmp_path / "bag", content)
